"""Principal directions of a set of vectors: handles for signals that have too many entries to turn one by one,
and what such signals are kept to."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True, eq=False)  # arrays have no truth value to compare by
class PrincipalDirections:
    """Orthogonal directions of largest variance, each as long as one standard deviation along it.

    Attributes:
        mean: [C] of the samples.
        steps: [K, C] one standard deviation along each direction, largest first.
    """

    mean: Float[np.ndarray, "C"]  # noqa: F821
    steps: Float[np.ndarray, "K C"]

    @staticmethod
    def of(samples: Float[np.ndarray, "N C"], count: int) -> "PrincipalDirections":
        """At most `count` directions of N samples; fewer where they vary in fewer. The largest entry of each direction is positive."""
        samples = np.asarray(samples, np.float64)
        mean = samples.mean(axis=0)
        _, singular, directions = np.linalg.svd(samples - mean, full_matrices=False)
        deviations = singular / np.sqrt(len(samples))
        kept = np.flatnonzero(deviations > 1e-6 * max(float(deviations[0]), 1e-12))[:count]
        directions = directions[kept]
        directions *= np.sign(directions[np.arange(len(kept)), np.abs(directions).argmax(axis=1)])[:, None]
        return PrincipalDirections(mean, deviations[kept, None] * directions)

    def offset(self, coefficients: Float[np.ndarray, "K"]) -> Float[np.ndarray, "C"]:  # noqa: F821
        """[C] what so many standard deviations along each direction add up to."""
        return coefficients @ self.steps

    def coordinates(self, samples: Float[np.ndarray, "N C"]) -> Float[np.ndarray, "N K"]:
        """[N, K] standard deviations along each direction, from the mean."""
        return (np.asarray(samples, np.float64) - self.mean) @ (self.steps / np.square(self.steps).sum(axis=1, keepdims=True)).T


def num_explaining(singular: Float[np.ndarray, "R"], share: float) -> int:  # noqa: F821
    """How many principal directions, one at least, carry a share (0..1) of the variance; `singular` are the singular values, falling."""
    carried = np.cumsum(np.square(singular)) / max(float(np.square(singular).sum()), 1e-30)  # samples that do not vary have no variance
    return min(int(np.searchsorted(carried, share)) + 1, len(singular))
