"""Pictures of the registered mesh over all views, with the mask's outline, to be looked at before anything long."""

from collections.abc import Callable, Iterator

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8

from mitsuba_avatar.body.rig import load_rig
from mitsuba_avatar.captures.folder import Capture
from mitsuba_avatar.captures.silhouettes import outline
from mitsuba_avatar.rendering.cameras import CameraBatch
from mitsuba_avatar.rendering.surface import SurfaceRenderer

MESH_COLOUR = (255, 145, 20)
MASK_COLOUR = (40, 150, 255)
MESH_SHARE = 0.55  # of the mesh in the picture; the rest is the image
LIGHT = (0.3, -0.4, 0.87)  # towards it, world axes: from above and a side, so that limbs have form


class Overlays:
    """Draws frames of a capture: every camera's image with the shaded mesh (orange) and the mask's outline (blue), side by side."""

    def __init__(self, capture: Capture):
        self.capture, camera = capture, next(iter(capture.cameras.values()))
        self.renderer = SurfaceRenderer(load_rig(capture.rig_path).topology, camera.width, camera.height, samples_per_pixel=4)
        self.cameras = CameraBatch.from_cameras(list(capture.cameras.values()))

    def picture(self, frame: int) -> UInt8[np.ndarray, "H W 3"]:
        """All views of a frame, in the order of the cameras."""
        vertices = torch.from_numpy(np.array(self.capture.vertices[frame]))[None]
        with torch.no_grad():
            layers = self.renderer.render_layers(vertices, torch.zeros(len(self.cameras), 3, 1, 1), self.cameras)
        light = torch.tensor(LIGHT)[None, :, None, None] / np.linalg.norm(LIGHT)
        shade = 0.35 + 0.65 * (0.5 + 0.5 * (layers.normal * light).sum(1))
        return np.concatenate(
            [
                self._view(name, frame, shade[index].numpy(), layers.mask[index, 0].numpy())
                for index, name in enumerate(self.capture.cameras)
            ],
            axis=1,
        )

    def _view(
        self, name: str, frame: int, shade: Float[np.ndarray, "H W"], coverage: Float[np.ndarray, "H W"]
    ) -> UInt8[np.ndarray, "H W 3"]:
        image = self.capture.display_image(name, frame) * 255
        share = MESH_SHARE * coverage[..., None]
        picture = (1 - share) * image + share * shade[..., None] * np.array(MESH_COLOUR, np.float32)
        picture = picture.clip(0, 255).astype(np.uint8)
        picture[outline(self.capture.mask(name, frame) > 0.5)] = MASK_COLOUR
        cv2.putText(picture, name, (6, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (255, 255, 255), 1, cv2.LINE_AA)
        return picture


def overlay_pictures(capture: Capture, progress: Callable[[int, int], None]) -> Iterator[UInt8[np.ndarray, "H W 3"]]:
    """The picture of every frame, one after the other: frames of a video."""
    overlays = Overlays(capture)
    for frame in range(len(capture.frames)):
        yield overlays.picture(frame)
        progress(frame + 1, len(capture.frames))
