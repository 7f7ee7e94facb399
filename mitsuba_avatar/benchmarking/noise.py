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


@dataclass(frozen=True)
class Contender:
    """One setting to sweep over.

    Attributes:
        name: of its row.
        render: one call, forward and backward, as it is timed.
        derivatives: [2, K] of the radiance's and the mask's loss along motions [K, P, V, 3], with a seed.
    """

    name: str
    render: Callable[[], None]
    derivatives: Callable[[Float[Tensor, "K P V 3"], int], Float[np.ndarray, "2 K"]]


@dataclass(frozen=True)
class NoiseRow:
    """One line of the sweep.

    Attributes:
        radiance, mask: standard deviation of one evaluation, root mean square over the motions, as a share of the largest derivative;
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
    return [*(_surface(workload, *settings) for settings in (*SETTINGS, ONE_PER_PIXEL)), _direct_projective(workload)]


def _surface(workload: Workload, samples: int, per_edge: int) -> Contender:
    renderer = SurfaceRenderer(workload.rig.topology, workload.width, workload.height, samples, per_edge)
    weights, seed = workload.weights, iter(range(1, 2**31))

    def draw(seed: int) -> tuple[Tensor, Tensor, Tensor]:
        vertices, textures = workload.vertices.clone().requires_grad_(), workload.textures.clone().requires_grad_()
        radiance, mask = renderer.render(vertices, textures, workload.cameras, seed=seed)
        return vertices, (radiance * weights[:, :3]).sum(), (mask * weights[:, 3:]).sum()

    def render() -> None:
        _, of_radiance, of_mask = draw(next(seed))
        (of_radiance + of_mask).backward()

    def derivatives(motions: Float[Tensor, "K P V 3"], seed: int) -> Float[np.ndarray, "2 K"]:
        rows = []
        for part in range(2):  # a render each: one backward pass may follow it
            vertices, *losses = draw(2 * seed + part)
            losses[part].backward()
            rows.append(torch.einsum("pvc,kpvc->k", vertices.grad.double(), motions.double()).numpy())
        return np.stack(rows)

    return Contender(f"{samples}, {per_edge}", render, derivatives)


def _direct_projective(workload: Workload) -> Contender:
    peer = DirectProjective(workload)

    def derivatives(motions: Float[Tensor, "K P V 3"], seed: int) -> Float[np.ndarray, "2 K"]:
        peer.seed = 1000 * seed
        gradient = peer.vertex_gradients().double()
        return np.stack([torch.einsum("pvc,kpvc->k", gradient, motions.double()).numpy(), np.full(len(motions), np.nan)])

    return Contender("direct_projective", peer.forward_and_backward, derivatives)


def measure_noise(contender: Contender, motions: Float[Tensor, "K P V 3"], repeats: int, milliseconds: float) -> NoiseRow:
    """Deviations over `repeats` seeds, beside the time that a call takes."""
    samples = np.stack([contender.derivatives(motions, seed) for seed in range(1, repeats + 1)])
    deviation = np.sqrt((samples.std(axis=0, ddof=1) ** 2).mean(axis=1)) / np.abs(samples.mean(axis=0)).max(axis=1)
    return NoiseRow(contender.name, float(deviation[0]), float(deviation[1]), milliseconds)
