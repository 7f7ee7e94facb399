"""What a run shows of itself: preview panels while it trains, comparisons with the baselines and an orbit when it is done."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from scipy.spatial import ConvexHull
from torch import Tensor

from mitsuba_avatar.body.mesh import vertex_normals
from mitsuba_avatar.body.rig import Rig
from mitsuba_avatar.body.uv import UvAtlas
from mitsuba_avatar.captures.cameras import Camera
from mitsuba_avatar.captures.colour import encode
from mitsuba_avatar.captures.folder import Capture
from mitsuba_avatar.model.avatar import Avatar
from mitsuba_avatar.rendering.ambient_occlusion import AmbientOcclusion
from mitsuba_avatar.rendering.cameras import CameraBatch
from mitsuba_avatar.rendering.surface import SurfaceRenderer
from mitsuba_avatar.reporting.evaluation import METHODS, Evaluator, as_images
from mitsuba_avatar.reporting.figures import Preview, View, comparison_grid, preview_panel, save_image, to_bytes

SHADING_SIZE = 256  # texels of the texture that shows the mesh's shape
BACKDROP = 0.18  # linear radiance behind an avatar on an orbit: mid-grey


@dataclass(frozen=True)
class Shot:
    """A frame of a capture seen by one of its cameras."""

    frame: int
    camera: str


@dataclass(frozen=True)
class Driven:
    """An avatar in one pose, seen by one camera. Geometry layers are those of the first sample of a pixel, zero where it sees nothing.

    Attributes:
        vertices: [V, 3] metres, world axes.
        radiance: [H, W, 3] linear, premultiplied by coverage. mask: [H, W, 1].
        normal: [H, W, 3] unit, world axes. depth: [H, W, 1] metres along the camera's axis.
        position: [H, W, 3] metres, world axes. uv: [H, W, 2].
    """

    vertices: Float[np.ndarray, "V 3"]
    radiance: Float[np.ndarray, "H W 3"]
    mask: Float[np.ndarray, "H W 1"]
    normal: Float[np.ndarray, "H W 3"]
    depth: Float[np.ndarray, "H W 1"]
    position: Float[np.ndarray, "H W 3"]
    uv: Float[np.ndarray, "H W 2"]

    def on_backdrop(self) -> UInt8[np.ndarray, "H W 3"]:
        """The picture over a mid-grey backdrop, display-encoded, as bytes."""
        return to_bytes(np.clip(encode(self.radiance + (1 - self.mask) * np.float32(BACKDROP), "srgb"), 0, 1))

    def layers(self) -> dict[str, Float[np.ndarray, "H W *C"]]:
        """What a multi-channel EXR holds, by the names of `reporting.exr`."""
        return {
            "colour": np.concatenate([self.radiance, self.mask], axis=-1),  # premultiplied, as EXR has it
            "mask": self.mask[..., 0],
            "depth": self.depth[..., 0],
            "normal": self.normal,
            "position": self.position,
            "uv": self.uv,
        }


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
                    view=self._view(shot, batch.images, batch.masks),
                    render=as_images(drawn.images)[0],
                    mesh=as_images(encode(mesh + (1 - mask) * BACKDROP, "srgb").clamp(0, 1))[0],
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
            views.append(self._view(shot, batch.images, batch.masks))
            for method in METHODS:
                pictures[method].append(as_images(self.evaluator.draw(method, batch).images)[0])
        return comparison_grid(views, pictures)

    def save_held_out_pictures(self, folder: Path, shots: Sequence[Shot]) -> list[Path]:
        """One PNG per shot, at the capture's size: the avatar alone."""
        paths = []
        for shot in shots:
            batch = self.evaluator.reader.read([shot.frame], [[shot.camera]])
            number = self.evaluator.capture.frames[shot.frame].number
            paths.append(folder / f"{shot.camera}_{number:06d}.png")
            save_image(paths[-1], as_images(self.evaluator.draw("avatar", batch).images)[0])
        return paths

    def _view(self, shot: Shot, images: Float[Tensor, "1 3 H W"], masks: Float[Tensor, "1 1 H W"]) -> View:
        frame = self.evaluator.capture.frames[shot.frame]
        return View(f"{shot.camera} {frame.split} {frame.number}", as_images(images)[0], masks[0, 0].cpu().numpy())

    def _shaded(self, vertices: Float[Tensor, "P V 3"], centers: Float[Tensor, "B 3"]) -> Float[Tensor, "B 3 S S"]:
        """Grey textures lit from each camera: the shape alone."""
        normals = vertex_normals(vertices, self.faces)
        surface = self.shading_atlas.texels_from_vertices(torch.cat([vertices, normals], dim=2))
        to_camera = torch.nn.functional.normalize(centers[:, :, None, None] - surface[:, :3], dim=1)
        facing = (to_camera * torch.nn.functional.normalize(surface[:, 3:], dim=1)).sum(1, keepdim=True).clamp(min=0)
        return (0.04 + 0.6 * facing).expand(-1, 3, -1, -1)


def draw_along(
    avatar: Avatar,
    capture: Capture,
    frames: Sequence[int],
    cameras: Sequence[Camera],
    renderer: SurfaceRenderer,
    occlusion: AmbientOcclusion,
) -> Iterator[Driven]:
    """Drive an avatar with frames of a capture, one camera each.

    Args:
        avatar: to be driven, latent code zero.
        capture: whose theta, root and face drive it; it may be another capture of the same rig.
        frames: frame indices.
        cameras: as many as frames, of the renderer's film size.
        renderer: of that size.
        occlusion: baker at the avatar's shadow size.
    """
    device = avatar.mean_texture.device
    for index, camera in zip(frames, cameras, strict=True):
        theta, root, face = (_row(values, index).to(device) for values in (capture.theta, capture.root, capture.face))
        batch = CameraBatch.from_cameras([camera])
        with torch.no_grad():  # left before the yield: the caller's own gradients are not this function's business
            template = avatar.pose_template(theta, torch.eye(4, device=device)[None])[0]
            share = occlusion.bake(template.cpu(), seed=index)[None, None]
            output = avatar.decode(theta, root, face, None, batch.centers[None].to(device), share.to(device))
            layers = renderer.render_layers(output.vertices, output.textures.flatten(0, 1), batch, seed=index)
        images = {name: as_images(getattr(layers, name))[0] for name in ("radiance", "mask", "normal", "depth", "position", "uv")}
        yield Driven(vertices=output.vertices[0].cpu().numpy(), **images)


@torch.no_grad()
def posed_corners(avatar: Avatar, capture: Capture, frames: Sequence[int]) -> Float[np.ndarray, "N 3"]:
    """Corners of the convex hull of the posed template in some frames: a camera that has them in view sees all of it.

    Args:
        avatar: whose template is posed.
        capture: whose theta and root pose it.
        frames: frame indices; a repeated one counts once.

    Returns:
        [N, 3] metres, world axes.
    """
    device, corners = avatar.mean_texture.device, np.zeros((0, 3), np.float32)
    for index in sorted(set(frames)):
        template = avatar.pose_template(_row(capture.theta, index).to(device), _row(capture.root, index).to(device))[0]
        points = np.concatenate([corners, template.cpu().numpy()])
        corners = points[ConvexHull(points).vertices]
    return corners


def _row(values: Float[np.ndarray, "N *shape"], index: int) -> Float[Tensor, "1 *shape"]:
    """One frame of an array, copied out of the file, as a batch of one."""
    return torch.from_numpy(np.array(values[index], np.float32))[None]
