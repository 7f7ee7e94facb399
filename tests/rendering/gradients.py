"""Gradients of the renderer as estimates with standard errors, and finite differences of its own images to hold them against.

Images are checked against an independent reference elsewhere (test_surface_image), which is what makes finite differences of them a
reference for gradients.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from mitsuba_avatar.rendering.cameras import CameraBatch
from mitsuba_avatar.rendering.surface import SurfaceRenderer


@dataclass(frozen=True)
class Setup:
    """What is drawn, and the weights of a loss that is linear in the image: sum(weights * image), image [B, 4, H, W]."""

    vertices: Tensor  # [P, V, 3]
    textures: Tensor
    cameras: CameraBatch
    weights: Tensor  # [B, 4, H, W]; the last channel weighs the mask


@dataclass(frozen=True)
class Estimate:
    mean: np.ndarray
    error: np.ndarray  # standard error of the mean
    deviation: np.ndarray  # of one evaluation

    @staticmethod
    def of(samples: list[np.ndarray]) -> "Estimate":
        stacked = np.stack(samples).astype(np.float64)
        deviation = stacked.std(axis=0, ddof=1)
        return Estimate(stacked.mean(axis=0), deviation / np.sqrt(len(stacked)), deviation)


def losses_of(renderer: SurfaceRenderer, setup: Setup, vertices: Tensor, textures: Tensor, seed: int) -> tuple[Tensor, Tensor]:
    """The radiance's and the mask's part of the loss."""
    radiance, mask = renderer.render(vertices, textures, setup.cameras, seed=seed)
    return (radiance * setup.weights[:, :3]).sum(), (mask * setup.weights[:, 3:]).sum()


def derivatives(renderer: SurfaceRenderer, setup: Setup, directions: Tensor, repeats: int, reach: float = 0.0) -> Estimate:
    """Mean over seeds of the derivatives [2, K] of the radiance's and the mask's loss along directions [K, P, V, 3].

    Args:
        reach: with a finite difference's step, derivatives are taken at evenly spread offsets within it: their mean *is* the finite
            difference, however the loss curves between, so that a long and therefore quiet step makes a fair reference.
    """
    samples = []
    for seed in range(repeats):
        offset = reach * (2 * (seed + 0.5) / repeats - 1)
        derivative = np.zeros((2, len(directions)))
        for part in range(2):  # a render each: one backward pass may follow it
            for index, direction in enumerate(directions if reach else [torch.zeros_like(setup.vertices)]):
                vertices = (setup.vertices + offset * direction).requires_grad_()
                losses_of(renderer, setup, vertices, setup.textures, 1000 + 2 * seed + part)[part].backward()
                along = torch.einsum("pvc,kpvc->k", vertices.grad.double(), directions.double()).numpy()
                derivative[part, index if reach else slice(None)] = along[index] if reach else along
        samples.append(derivative)
    return Estimate.of(samples)


def finite_difference(renderer: SurfaceRenderer, setup: Setup, directions: Tensor, step: float, repeats: int) -> Estimate:
    """Central differences [2, K] of both losses along directions [K, P, V, 3], each with the same seeds on both sides."""
    samples = []
    with torch.no_grad():
        for seed in range(repeats):
            columns = []
            for direction in directions:
                ahead, behind = (
                    losses_of(renderer, setup, setup.vertices + sign * step * direction, setup.textures, seed) for sign in (1, -1)
                )
                columns.append([(a.item() - b.item()) / (2 * step) for a, b in zip(ahead, behind, strict=True)])
            samples.append(np.array(columns).T)
    return Estimate.of(samples)


def assert_close(estimate: Estimate, expected: Estimate | np.ndarray, bias: float, noise: float) -> None:
    """Means agree to `bias` of the expected scale, or inside three standard errors, which must themselves be below `noise` of it.

    The scale is the largest expected entry of a row (last axis): entries that nearly cancel are held to the same absolute error.
    """
    mean, expected_error = (expected.mean, expected.error) if isinstance(expected, Estimate) else (expected, 0.0)
    scale = np.abs(mean).max(axis=-1, keepdims=True)
    error = np.sqrt(estimate.error**2 + expected_error**2) / scale
    difference = np.abs(estimate.mean - mean) / scale
    report = f"got {estimate.mean}\nexpected {mean}\nbias {difference}\nstandard error {error}"
    assert error.max() <= noise, f"too noisy to tell\n{report}"
    assert (difference <= np.maximum(bias, 3 * error)).all(), report
