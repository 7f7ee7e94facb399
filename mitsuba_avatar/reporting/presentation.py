"""What a run shows of itself: preview panels while it trains, comparisons with the baselines when it is done."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from mitsuba_avatar.body.mesh import vertex_normals
from mitsuba_avatar.body.rig import Rig
from mitsuba_avatar.body.uv import UvAtlas
from mitsuba_avatar.captures.colour import encode
from mitsuba_avatar.reporting.evaluation import METHODS, Evaluator, as_images
from mitsuba_avatar.reporting.figures import Preview, View, comparison_grid, preview_panel, save_image
from mitsuba_avatar.training.batches import FrameBatch

SHADING_SIZE = 256  # texels of the texture that shows the mesh's shape
BACKDROP = 0.18  # linear radiance behind the mesh of a preview: mid-grey


@dataclass(frozen=True)
class Shot:
    """A frame of a capture seen by one of its cameras."""

    frame: int
    camera: str


class Presentation:
    """Draws an avatar in training or at its end.

    Args:
        evaluator: with avatar, capture and renderer.
        rig: of the capture.
    """

    def __init__(self, evaluator: Evaluator, rig: Rig):
        self.evaluator = evaluator
        self.shading_atlas = UvAtlas(rig.topology, SHADING_SIZE)
        self.faces = torch.from_numpy(rig.topology.faces)

    @torch.no_grad()
    def preview(self, shots: Sequence[Shot]) -> UInt8[np.ndarray, "h w 3"]:
        """Panel with a row per shot: capture | render | error | mesh | texture | AO | shadow, driven with a zero latent code."""
        evaluator, previews = self.evaluator, []
        for shot in shots:
            avatar = evaluator.avatar
            batch = evaluator.reader.read([shot.frame], [[shot.camera]]).to(avatar.mean_texture.device)
            output = avatar.decode(batch.theta, batch.root, batch.face, None, batch.camera_centers, batch.ambient_occlusion)
            drawn = evaluator.draw("avatar", batch)
            mesh, mask = evaluator.renderer.render(
                output.vertices, self._shaded(output.vertices.cpu(), batch.cameras.centers), batch.cameras, seed=shot.frame
            )
            previews.append(
                Preview(
                    view=self._view(shot, batch),
                    render=batch.pictures(drawn.images)[0],
                    mesh=batch.pictures(encode(mesh + (1 - mask) * BACKDROP, "srgb").clamp(0, 1))[0],
                    texture=as_images(encode(output.textures[0].clamp(0, 1), "srgb"))[0],
                    ambient_occlusion=batch.ambient_occlusion[0, 0].cpu().numpy(),
                    shadow=output.gain[0, 0].clamp(0, 1).cpu().numpy(),
                )
            )
        return preview_panel(previews)

    def compare(self, shots: Sequence[Shot]) -> UInt8[np.ndarray, "h w 3"]:
        """Grid with a row per shot: the capture, then avatar and baselines with their errors."""
        views, pictures = [], {method: [] for method in METHODS}
        for shot in shots:
            batch = self.evaluator.reader.read([shot.frame], [[shot.camera]])
            views.append(self._view(shot, batch))
            for method in METHODS:
                pictures[method].append(batch.pictures(self.evaluator.draw(method, batch).images)[0])
        return comparison_grid(views, pictures)

    def save_held_out_pictures(self, folder: Path, shots: Sequence[Shot]) -> list[Path]:
        """One PNG per shot, at the capture's size: the avatar alone."""
        paths = []
        for shot in shots:
            batch = self.evaluator.reader.read([shot.frame], [[shot.camera]])
            number = self.evaluator.capture.frames[shot.frame].number
            paths.append(folder / f"{shot.camera}_{number:06d}.png")
            save_image(paths[-1], batch.pictures(self.evaluator.draw("avatar", batch).images)[0])
        return paths

    def _view(self, shot: Shot, batch: FrameBatch) -> View:
        frame = self.evaluator.capture.frames[shot.frame]
        return View(f"{shot.camera} {frame.split} {frame.number}", batch.pictures(batch.images)[0], batch.coverage(batch.masks)[0])

    def _shaded(self, vertices: Float[Tensor, "P V 3"], centers: Float[Tensor, "B 3"]) -> Float[Tensor, "B 3 S S"]:
        """Grey textures lit from each camera: the shape alone."""
        normals = vertex_normals(vertices, self.faces)
        surface = self.shading_atlas.texels_from_vertices(torch.cat([vertices, normals], dim=2))
        to_camera = torch.nn.functional.normalize(centers[:, :, None, None] - surface[:, :3], dim=1)
        facing = (to_camera * torch.nn.functional.normalize(surface[:, 3:], dim=1)).sum(1, keepdim=True).clamp(min=0)
        return (0.04 + 0.6 * facing).expand(-1, 3, -1, -1)
