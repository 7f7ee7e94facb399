"""Driving that leaves what an avatar knows: held at the rig's limits, or projected onto what the training poses span.

Both say how much they changed, angle by angle, because an avatar that silently does something else than asked is hard to debug.

Symbols: N frames, D pose angles, F entries of the face signal, T training frames, K principal components. Radians.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from mitsuba_avatar.body.rig import Rig
from mitsuba_avatar.driving.principal_directions import num_explaining
from mitsuba_avatar.driving.signals import DrivingSignals

TOLERANCE = 1e-5  # radians: less is rounding
EXPLAINED = 0.98  # share of the training variance that the principal components carry
REACH = 1.25  # a coordinate may go that far beyond the largest of the training frames


@dataclass(frozen=True)
class RangeReport:
    """What was changed.

    Attributes:
        what: was done, in words.
        num_frames, num_angles: N, D.
        changed_frames: in which some angle was changed.
        largest: angle name -> largest change, radians; only those that were changed, most first.
        mean: change, radians, over all that were changed.
    """

    what: str
    num_frames: int
    num_angles: int
    changed_frames: int
    largest: dict[str, float]
    mean: float

    @staticmethod
    def compare(what: str, names: tuple[str, ...], before: Float[Tensor, "N D"], after: Float[Tensor, "N D"]) -> "RangeReport":
        """The report of a change from `before` to `after`, [N, D] radians."""
        change = (after - before).abs()
        is_changed = change > TOLERANCE
        largest = {name: float(column.max()) for name, column in zip(names, change.T, strict=True) if float(column.max()) > TOLERANCE}
        return RangeReport(
            what=what,
            num_frames=len(before),
            num_angles=len(names),
            changed_frames=int(is_changed.any(1).sum()),
            largest=dict(sorted(largest.items(), key=lambda item: -item[1])),
            mean=float(change[is_changed].mean()) if largest else 0.0,
        )

    def summary(self) -> str:
        """One line for the user."""
        if not self.largest:
            return f"{self.what}: all {self.num_angles} angles of {self.num_frames} frames were in range"
        worst = ", ".join(f"{name} {np.degrees(change):.1f}" for name, change in list(self.largest.items())[:3])
        return (
            f"{self.what}: changed {len(self.largest)} of {self.num_angles} angles in {self.changed_frames} of {self.num_frames} frames, "
            f"by {np.degrees(self.mean):.1f} degrees on average; farthest {worst}"
        )


def clamped(signals: DrivingSignals, rig: Rig) -> tuple[DrivingSignals, RangeReport]:
    """Signals with every angle held within the rig's limits; root and face as they are."""
    lower, upper = torch.from_numpy(rig.dofs.lower), torch.from_numpy(rig.dofs.upper)
    theta = signals.theta.clamp(lower, upper)
    report = RangeReport.compare("clamped to the rig's limits", rig.dofs.names, signals.theta, theta)
    return DrivingSignals(theta, signals.root, signals.face, signals.fps, signals.clips), report


@dataclass(frozen=True, eq=False)  # arrays have no truth value to compare by
class TrainingSubspace:
    """Principal components of the training frames' signals, with how far the training frames go along each.

    Attributes:
        mean: [C]. directions: [K, C] orthonormal rows. lowest, highest: [K] coordinates of the training frames, widened by `REACH`.
    """

    mean: Float64[np.ndarray, "C"]  # noqa: F821
    directions: Float64[np.ndarray, "K C"]
    lowest: Float64[np.ndarray, "K"]  # noqa: F821
    highest: Float64[np.ndarray, "K"]  # noqa: F821

    @staticmethod
    def of(values: Float[Tensor, "T C"]) -> "TrainingSubspace":
        """The components that carry `EXPLAINED` of the variance of training frames [T, C]."""
        rows = values.double().numpy()
        mean = rows.mean(0)
        _, singular, directions = np.linalg.svd(rows - mean, full_matrices=False)
        directions = directions[: num_explaining(singular, EXPLAINED)]
        coordinates = (rows - mean) @ directions.T
        return TrainingSubspace(mean, directions, REACH * coordinates.min(0), REACH * coordinates.max(0))

    def project(self, values: Float[Tensor, "N C"]) -> Float[Tensor, "N C"]:
        """The nearest values that the components can make, coordinate by coordinate within the reach of the training frames."""
        coordinates = (values.double().numpy() - self.mean) @ self.directions.T
        return torch.from_numpy(self.mean + np.clip(coordinates, self.lowest, self.highest) @ self.directions).float()


def projected(signals: DrivingSignals, training: DrivingSignals, rig: Rig) -> tuple[DrivingSignals, RangeReport]:
    """Signals projected onto the principal components of the training frames: pose angles and face, each apart; within the rig's limits.

    Args:
        signals: that would drive the avatar.
        training: that it was trained with.
        rig: names and limits of the angles.
    """
    theta = TrainingSubspace.of(training.theta).project(signals.theta)
    theta = theta.clamp(torch.from_numpy(rig.dofs.lower), torch.from_numpy(rig.dofs.upper))
    face = TrainingSubspace.of(training.face).project(signals.face)
    report = RangeReport.compare("projected onto the training poses", rig.dofs.names, signals.theta, theta)
    return DrivingSignals(theta, signals.root, face, signals.fps, signals.clips), report
