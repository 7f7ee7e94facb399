"""Whether gradients are right on average: derivatives along motions of the body against finite differences of converged images.

Images are checked against independent references in the tests, which is what makes their finite differences a reference for gradients.
A finite difference over a step is the mean of the derivative within it: derivatives are taken at offsets spread over the step, so that
the step may be long, and the difference quiet, however the loss curves between.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from mitsuba_avatar.benchmarking.noise import Contender, body_motions, linear_losses
from mitsuba_avatar.benchmarking.workload import Workload
from mitsuba_avatar.rendering.surface import SurfaceRenderer

MOTIONS = ("sideways", "up", "turn", "bend")  # of `body_motions`
STEP = 0.004  # metres or radians, half a pixel
SAMPLES = 256  # a pixel of the images whose differences are taken


@dataclass(frozen=True)
class Estimate:
    """Means [2, K] (radiance, mask; one a motion) and their standard errors."""

    mean: np.ndarray
    error: np.ndarray

    @staticmethod
    def of(samples: list[np.ndarray]) -> "Estimate":
        """Of independent samples, [2, K] each."""
        stacked = np.stack(samples)
        return Estimate(stacked.mean(axis=0), stacked.std(axis=0, ddof=1) / np.sqrt(len(stacked)))

    def bias(self, reference: "Estimate") -> "Estimate":
        """Difference from a reference, as a share of the reference's largest entry of each row."""
        scale = np.abs(reference.mean).max(axis=1, keepdims=True)
        return Estimate((self.mean - reference.mean) / scale, np.hypot(self.error, reference.error) / scale)


def finite_differences(workload: Workload, repeats: int, progress: Callable[[], None]) -> Estimate:
    """Central differences along every motion, each with the same seeds on both sides; `progress` is called after every repeat."""
    renderer, samples = SurfaceRenderer(workload.rig.topology, workload.width, workload.height, samples_per_pixel=SAMPLES), []
    with torch.no_grad():
        for seed in range(repeats):
            columns = []
            for motion in body_motions(workload.vertices):
                ahead, behind = (
                    linear_losses(renderer, workload, workload.vertices + sign * STEP * motion, workload.textures, seed) for sign in (1, -1)
                )
                columns.append([(a.double() - b.double()).item() / (2 * STEP) for a, b in zip(ahead, behind, strict=True)])
            samples.append(np.array(columns).T)
            progress()
    return Estimate.of(samples)


def mean_derivatives(contender: Contender, workload: Workload, repeats: int, progress: Callable[[], None]) -> Estimate:
    """Derivatives of a contender along every motion, at `repeats` offsets spread over the step of the finite differences."""
    motions, samples = body_motions(workload.vertices), []
    for seed in range(repeats):
        offset = STEP * (2 * (seed + 0.5) / repeats - 1)
        columns = [contender.derivatives(workload.vertices + offset * motion, motion[None], seed + 1)[:, 0] for motion in motions]
        samples.append(np.stack(columns, axis=1))
        progress()
    return Estimate.of(samples)
