"""Fields over the surface as pictures: effects of controls, uncertainty, distance from the truth, painted on the posed body.

Each figure is a row of tiles for each body, front and back, with one colour scale for the whole figure.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np
import torch
from jaxtyping import Float
from matplotlib.figure import Figure
from torch import Tensor

from mitsuba_avatar.analysis.effects import Effect, shape_uncertainty, texture_uncertainty
from mitsuba_avatar.analysis.measures import Study, surface_distances
from mitsuba_avatar.body.mesh import vertex_normals
from mitsuba_avatar.body.uv import UvAtlas
from mitsuba_avatar.captures.cameras import Camera
from mitsuba_avatar.captures.colour import decode, encode
from mitsuba_avatar.files import atomic_path
from mitsuba_avatar.rendering.ambient_occlusion import FrameOcclusion
from mitsuba_avatar.rendering.cameras import CameraBatch
from mitsuba_avatar.rendering.surface import SurfaceRenderer
from mitsuba_avatar.reporting.camera_paths import orbit
from mitsuba_avatar.reporting.figures import heat_map

WIDTH, HEIGHT = 210, 330  # pixels of a tile
TEXTURE = 256  # texels that fields are painted with
COLOURS = "magma"
AMBIENT = 0.45  # part of the brightness that does not depend on the normal
DPI = 100


@dataclass(frozen=True)
class Painted:
    """A field on a posed body.

    Attributes:
        label: what stands above it.
        field: [V] of vertices, or [T, T] of texels.
        vertices: [V, 3] of the body that wears it, metres, world.
    """

    label: str
    field: np.ndarray
    vertices: Float[Tensor, "V 3"]


class FieldPainter:
    """Draws fields on bodies seen from the front and from behind.

    Args:
        study: gives rig and topology.
    """

    def __init__(self, study: Study):
        self.topology = study.rig.topology
        self.atlas = UvAtlas(self.topology, TEXTURE)
        self.renderer = SurfaceRenderer(self.topology, WIDTH, HEIGHT, samples_per_pixel=16)

    def save(self, path: Path | str, title: str, unit: str, rows: Sequence[Sequence[Painted]]) -> None:
        """Write a figure of one row of bodies for each entry of `rows`; the scale ends at the 99th percentile of all fields."""
        most = max(float(np.percentile(painted.field, 99)) for row in rows for painted in row) or 1.0
        columns = max(map(len, rows))
        figure = Figure(figsize=(columns * 2 * WIDTH / DPI + 1.0, len(rows) * (HEIGHT / DPI + 0.35) + 0.5), dpi=DPI, layout="constrained")
        axes = figure.subplots(len(rows), columns, squeeze=False)
        for axis in axes.ravel():
            axis.set_axis_off()
        for row, bodies in enumerate(rows):
            for column, painted in enumerate(bodies):
                axes[row, column].imshow(self._draw(painted, most))
                axes[row, column].set_title(painted.label, fontsize=9)
        scale = matplotlib.cm.ScalarMappable(matplotlib.colors.Normalize(0, most), COLOURS)
        figure.colorbar(scale, ax=axes, shrink=0.6, pad=0.01).set_label(unit)
        figure.suptitle(title, fontsize=11)
        with atomic_path(path) as temporary:
            figure.savefig(temporary, format=Path(path).suffix[1:])

    @torch.no_grad()
    def _draw(self, painted: Painted, most: float) -> Float[np.ndarray, "H W2 3"]:
        """Front and back, side by side, display-encoded."""
        field = torch.from_numpy(np.asarray(painted.field, np.float32))
        if field.ndim == 1:
            field = self.atlas.texels_from_vertices(field[None, :, None])[0, 0]
        else:
            field = torch.nn.functional.interpolate(field[None, None], size=(TEXTURE, TEXTURE), mode="bilinear", align_corners=False)[0, 0]
        colour = torch.from_numpy(decode(heat_map(field.numpy(), most, COLOURS), "srgb")).permute(2, 0, 1)
        cameras = _front_and_back(painted.vertices)
        batch = CameraBatch.from_cameras(cameras)
        normals = self.atlas.texels_from_vertices(vertex_normals(painted.vertices[None], torch.from_numpy(self.topology.faces)))[0]
        middle = painted.vertices.mean(0)
        textures = []
        for centre in batch.centers:
            towards = torch.nn.functional.normalize(centre - middle, dim=0)
            textures.append(colour * (AMBIENT + (1 - AMBIENT) * (normals * towards[:, None, None]).sum(0).clamp(min=0)))
        white = torch.ones(3)
        image, _ = self.renderer.render(painted.vertices[None], torch.stack(textures), batch, background=white)
        display = encode(image.cpu().clamp(0, 1), "srgb").permute(0, 2, 3, 1).numpy()
        return np.concatenate(list(display), axis=1)


def save_effects(shape_path: Path | str, colour_path: Path | str, study: Study, painter: FieldPainter, effects: Sequence[Effect]) -> None:
    """The paper's figure on localized effects: where each control moves the surface, where it changes colours, and the share outside its
    region."""
    rest, half = study.avatar.template_vertices, -(-len(effects) // 2)

    def save(path: Path | str, title: str, unit: str, fields: Sequence[np.ndarray], shares: Sequence[float]) -> None:
        labels = [f"{effect.name}\n{100 * share:.1f} % outside its region" for effect, share in zip(effects, shares, strict=True)]
        bodies = [Painted(label, field, rest) for label, field in zip(labels, fields, strict=True)]
        painter.save(path, title, unit, [bodies[:half], bodies[half:]])

    moved, recoloured = ([getattr(effect, name) for effect in effects] for name in ("moved_mm", "recoloured"))
    save(shape_path, "Where a control moves the surface (z = 0)", "mm", moved, [effect.share_outside for effect in effects])
    shares = [effect.share_recoloured_outside for effect in effects]
    save(colour_path, "Where a control changes colours (z = 0, occlusion held)", "linear radiance", recoloured, shares)


def save_uncertainty(
    shape_path: Path | str, texture_path: Path | str, study: Study, painter: FieldPainter, occlusion: FrameOcclusion | None
) -> None:
    """Spread over codes drawn from the prior, of shape and of texture, for three test frames."""
    frames = _some(study, 3)
    posed = [torch.from_numpy(study.surface(frame, None)) for frame in frames]
    shapes = [Painted(f"frame {frame}", shape_uncertainty(study, frame), body) for frame, body in zip(frames, posed, strict=True)]
    painter.save(shape_path, "Spread of the shape over codes drawn from the prior", "mm", [shapes])
    textures = []
    for frame, body in zip(frames, posed, strict=True):
        centers = CameraBatch.from_cameras(_front_and_back(body)).centers
        maps = None if occlusion is None else occlusion.maps([frame])
        textures.append(Painted(f"frame {frame}", texture_uncertainty(study, frame, centers, maps), body))
    painter.save(texture_path, "Spread of the texture over codes drawn from the prior", "linear radiance", [textures])


def save_geometry_gain(path: Path | str, study: Study, painter: FieldPainter) -> None:
    """Distance from the true surface: the registered mesh above, the decoded mesh below, three training frames."""
    rows: list[list[Painted]] = [[], []]
    for frame in _some(study, 3, "train"):
        exact = torch.from_numpy(np.array(study.exact[frame], np.float32))
        for row, name, distance in zip(rows, ("registered", "decoded"), surface_distances(study, frame), strict=True):
            row.append(Painted(f"{name}, frame {frame}: {distance.mean():.2f} mm", distance, exact))
    painter.save(path, "Distance from the true surface, before and after training", "mm", rows)


def _some(study: Study, count: int, split: str = "test") -> list[int]:
    frames = study.frames(split) or study.frames("train")
    return [frames[(2 * i + 1) * len(frames) // (2 * count)] for i in range(count)]


def _front_and_back(vertices: Float[Tensor, "V 3"]) -> list[Camera]:
    """Two cameras on opposite sides, at the same distance."""
    return orbit(vertices.double().numpy(), 2, WIDTH, HEIGHT)
