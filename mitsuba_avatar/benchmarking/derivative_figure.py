"""The renderer's teaching figure: how fast every pixel changes where the body moves, by derivative and by finite differences."""

from pathlib import Path

import matplotlib
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mitsuba_avatar.benchmarking.workload import orbit
from mitsuba_avatar.body.rig import Rig
from mitsuba_avatar.body.uv import UvAtlas
from mitsuba_avatar.files import atomic_path
from mitsuba_avatar.rendering.surface import SurfaceRenderer

FILM = (96, 128)  # width, height
STEP = 0.002  # metres of motion at a time for finite differences, a tenth of a pixel
SAMPLES = 256  # a pixel
PASSES = 32  # renders with other seeds whose mean is shown


def draw_derivative_figure(rig: Rig, path: Path) -> None:
    """Image, derivative, finite difference and their difference, for radiance and mask, of a body that leans sideways."""
    vertices = torch.from_numpy(rig.rest_vertices)
    vertices = (vertices - (vertices.amin(dim=0) + vertices.amax(dim=0)) / 2)[None]
    motion = torch.zeros_like(vertices)
    motion[..., 0] = (vertices[..., 2] - vertices[..., 2].min()) / 1.6  # metres a unit: the head moves by about one
    textures, cameras = _bands(rig, vertices), orbit(2, *FILM)
    fine = SurfaceRenderer(rig.topology, *FILM, samples_per_pixel=SAMPLES)
    plain = SurfaceRenderer(rig.topology, *FILM, samples_per_pixel=4)

    with torch.no_grad():
        image = torch.cat(fine.render(vertices, textures, cameras), dim=1)
        derivative = torch.stack(
            [torch.cat(plain.derivative(vertices, textures, cameras, motion, seed=seed), dim=1) for seed in range(PASSES)]
        ).mean(dim=0)
        difference = torch.zeros_like(derivative)
        for seed in range(PASSES):
            for sign in (1, -1):
                moved = torch.cat(fine.render(vertices + sign * STEP * motion, textures, cameras, seed=seed), dim=1)
                difference += sign * moved / (2 * STEP * PASSES)
    _draw([panel[1].numpy() for panel in (image, derivative, difference)], path)


def _bands(rig: Rig, vertices: Float[Tensor, "1 V 3"]) -> Float[Tensor, "2 3 256 256"]:
    """Soft stripes that follow position, so that the texture has no jumps of its own, the same for both views."""
    position = UvAtlas(rig.topology, 256).texels_from_vertices(vertices)[0]
    channels = [0.5 + 0.35 * torch.sin(14 * position[2] + phase + 5 * position[0]) for phase in (0.0, 1.0, 2.2)]
    return torch.stack(channels).repeat(2, 1, 1, 1)


def _draw(panels: list[Float[np.ndarray, "4 H W"]], path: Path) -> None:
    matplotlib.use("Agg")
    from matplotlib import pyplot

    image, derivative, difference = panels
    figure, axes = pyplot.subplots(2, 4, figsize=(11, 7.4), layout="constrained")
    rows = (("radiance, mean of channels", slice(0, 3)), ("mask", slice(3, 4)))
    for (name, channels), (shown, by_derivative, by_difference, rest) in zip(rows, axes, strict=True):
        values = [panel[channels].mean(axis=0) for panel in (derivative, difference)]
        limit = float(np.quantile(np.abs(values[1]), 0.995))
        picture = np.clip(image[channels], 0, 1).transpose(1, 2, 0)
        shown.imshow(picture if picture.shape[2] == 3 else picture[..., 0], cmap="gray", vmin=0, vmax=1)
        shown.set_ylabel(name)
        titles = ("derivative", "finite differences", "derivative - finite differences")
        for axis, title, value in zip((by_derivative, by_difference, rest), titles, (*values, values[0] - values[1]), strict=True):
            drawn = axis.imshow(value, cmap="RdBu_r", vmin=-limit, vmax=limit)
            if name != "mask":
                axis.set_title(title)
        figure.colorbar(drawn, ax=rest, shrink=0.85)
        for axis in (shown, by_derivative, by_difference, rest):
            axis.set_xticks([])
            axis.set_yticks([])
    axes[0, 0].set_title("image")
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=110)
    pyplot.close(figure)
