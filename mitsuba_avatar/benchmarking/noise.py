"""How noisy the gradients of one render are, and what they cost: the sweep that the renderer's default sample counts come from.

The standard deviation of one evaluation falls like 1 / sqrt(samples), so settings of different cost compare by deviation times square
root of milliseconds: the deviation that a fixed time of averaging would leave. Smaller is better.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mitsuba_avatar.benchmarking.contenders import DirectProjective
from mitsuba_avatar.benchmarking.workload import Workload, make_workload
from mitsuba_avatar.body.rig import Rig
from mitsuba_avatar.rendering.surface import SurfaceRenderer

# Samples a pixel, samples a contour edge on average.
SETTINGS = ((1, 1), (1, 2), (1, 4), (2, 2), (4, 1), (4, 2), (4, 4), (4, 8), (16, 4), (16, 8))
ONE_PER_PIXEL = (1, 18)  # boundary samples as many as pixels, on the workload of `noise_workload`
WIDTH, HEIGHT, VIEWS = 160, 256, 4
CALLS = (1, 2, 4, 8, 16)  # consecutive ones that are averaged
ORIENTATIONS = 6  # of the body


@dataclass(frozen=True)
class Contender:
    """One setting to sweep over.

    Attributes:
        name: of its row.
        render: one call, forward and backward, as it is timed.
        derivatives: [2, K] of the radiance's and the mask's loss along motions [K, P, V, 3], of given vertices [P, V, 3], with a seed.
    """

    name: str
    render: Callable[[], None]
    derivatives: Callable[[Float[Tensor, "P V 3"], Float[Tensor, "K P V 3"], int], Float[np.ndarray, "2 K"]]


@dataclass(frozen=True)
class NoiseRow:
    """One line of the sweep.

    Attributes:
        radiance, mask: standard deviation of one evaluation, over motions and orientations, as a share of the largest derivative;
            NaN where there is no mask.
        milliseconds: of a call with all views, forward and backward.
    """

    name: str
    radiance: float
    mask: float
    milliseconds: float

    def at_equal_time(self, deviation: float) -> float:
        """Deviation times square root of milliseconds."""
        return deviation * self.milliseconds**0.5


def body_motions(vertices: Float[Tensor, "P V 3"]) -> Float[Tensor, "4 P V 3"]:
    """Along x, along z, about the vertical axis, and a bend of the upper half sideways; metres or radians a unit."""
    x, y, z = vertices.unbind(-1)
    zero, one = torch.zeros_like(x), torch.ones_like(x)
    height = (z - z.amin(dim=1, keepdim=True)) / (z.amax() - z.amin())
    motions = [(one, zero, zero), (zero, zero, one), (-y, x, zero), (height.square(), 0.3 * height.square(), zero)]
    return torch.stack([torch.stack(motion, dim=-1) for motion in motions])


def noise_workload(rig: Rig) -> Workload:
    """One body seen from all sides, and a loss whose weights vary smoothly over the image, as errors of a fit do."""
    workload = make_workload(rig, WIDTH, HEIGHT, VIEWS, meshes=1)
    coarse = torch.rand(VIEWS, 4, 4, 3, generator=torch.Generator().manual_seed(1))
    return replace(workload, weights=torch.nn.functional.interpolate(coarse, size=(HEIGHT, WIDTH), mode="bilinear"))


def contenders(workload: Workload) -> list[Contender]:
    """All settings of the surface renderer, and `direct_projective`."""
    swept = [surface_contender(workload, *settings) for settings in (*SETTINGS, ONE_PER_PIXEL)]
    return [*swept, projective_contender(workload)]


def surface_contender(workload: Workload, samples: int, per_edge: int) -> Contender:
    """The surface renderer with the given samples a pixel and, on average, a contour edge."""
    renderer = SurfaceRenderer(workload.rig.topology, workload.width, workload.height, samples, per_edge)
    seeds = iter(range(1, 2**31))

    def render() -> None:
        vertices, textures = workload.vertices.clone().requires_grad_(), workload.textures.clone().requires_grad_()
        sum(linear_losses(renderer, workload, vertices, textures, next(seeds))).backward()

    def derivatives(vertices: Float[Tensor, "P V 3"], motions: Float[Tensor, "K P V 3"], seed: int) -> Float[np.ndarray, "2 K"]:
        rows = []
        for part in range(2):  # a render each: one backward pass may follow it
            moved = vertices.clone().requires_grad_()
            linear_losses(renderer, workload, moved, workload.textures, seed)[part].backward()
            rows.append(torch.einsum("pvc,kpvc->k", moved.grad.double(), motions.double()).numpy())
        return np.stack(rows)

    return Contender(f"{samples}, {per_edge}", render, derivatives)


def linear_losses(
    renderer: SurfaceRenderer, workload: Workload, vertices: Float[Tensor, "P V 3"], textures: Float[Tensor, "B 3 h w"], seed: int
) -> tuple[Tensor, Tensor]:
    """The radiance's and the mask's part of the workload's loss."""
    radiance, mask = renderer.render(vertices, textures, workload.cameras, seed=seed)
    return (radiance * workload.weights[:, :3]).sum(), (mask * workload.weights[:, 3:]).sum()


def projective_contender(workload: Workload) -> Contender:
    """Mitsuba's `direct_projective`; it has no mask."""
    peer = DirectProjective(workload)

    def derivatives(vertices: Float[Tensor, "P V 3"], motions: Float[Tensor, "K P V 3"], seed: int) -> Float[np.ndarray, "2 K"]:
        peer.place(vertices)
        peer.seed = 1000 * seed
        along = torch.einsum("pvc,kpvc->k", peer.vertex_gradients().double(), motions.double()).numpy()
        return np.stack([along, np.full(len(motions), np.nan)])

    return Contender("direct_projective", peer.forward_and_backward, derivatives)


def orientations(vertices: Float[Tensor, "P V 3"]) -> list[Float[Tensor, "P V 3"]]:
    """The body turned about the vertical axis: the noise of one view depends on the random starts of few long edges and sharp texels."""
    x, y, z = vertices.unbind(-1)
    angles = torch.arange(ORIENTATIONS) * (2 * np.pi / ORIENTATIONS)
    return [torch.stack([a.cos() * x - a.sin() * y, a.sin() * x + a.cos() * y, z], dim=-1) for a in angles]


def measure_noise(contender: Contender, workload: Workload, repeats: int, milliseconds: float) -> NoiseRow:
    """Deviations over `repeats` seeds of each orientation of the body, beside the time that a call takes."""
    (radiance,), (mask,) = _deviations(contender, workload, repeats, calls=(1,))
    return NoiseRow(contender.name, float(radiance), float(mask), milliseconds)


def measure_averages(contender: Contender, workload: Workload, repeats: int) -> Float[np.ndarray, "2 N"]:
    """Deviations of the mean over each number of `CALLS`, of radiance and mask, as shares of the largest derivative.

    Calls are consecutive: where their positions are drawn anew each time, deviations fall like the square root of the number.

    Args:
        repeats: means over the longest run of calls, for every orientation of the body.
    """
    return _deviations(contender, workload, repeats * max(CALLS), CALLS)


def _deviations(contender: Contender, workload: Workload, repeats: int, calls: tuple[int, ...]) -> Float[np.ndarray, "2 N"]:
    """Root mean square over motions, median over orientations, as a share of an orientation's largest derivative, on average.

    The median, since a rare sample on a face that is seen nearly edge-on outweighs all others of its orientation.
    """
    variances, scales = [], []
    for turned in orientations(workload.vertices):
        motions = body_motions(turned)
        samples = np.stack([contender.derivatives(turned, motions, seed) for seed in range(1, repeats + 1)])
        means = [samples.reshape(-1, count, *samples.shape[1:]).mean(axis=1) for count in calls]
        variances.append([mean.var(axis=0, ddof=1).mean(axis=1) for mean in means])
        scales.append(np.abs(samples.mean(axis=0)).max(axis=1))
    return (np.sqrt(np.median(variances, axis=0)) / np.mean(scales, axis=0)).T
