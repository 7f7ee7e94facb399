"""How much of a garment's shape the pose explains, and how much is hidden: the part that only a latent code can carry.

Three predictors are fitted to training frames and scored on others: the mean garment, linear regression on the pose angles, the mean of
the nearest poses' garments. The hidden share is what the better of the last two leaves over. The chaos floor says how much of it no
signal can explain: how far two simulations drift apart whose garments started a millimetre from each other.

Symbols: N frames, D pose angles, C vertices of the garment in rest space. Metres; figures are in millimetres.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from mitsuba_avatar.body.rig import Rig
from mitsuba_avatar.filming.garment_mesh import GarmentMesh
from mitsuba_avatar.ridge import ridge_prediction

STEADY = 1e-4  # radians: an angle that varies less explains nothing
INFLUENCE = 0.02  # mean skinning weight from which a joint counts as moving the garment
LINEAR_BEATS_MEAN = 0.85  # gate: the error of linear regression relative to the mean garment's, at most
FLOOR_BELOW_MEAN = 0.5  # gate: the chaos floor relative to the mean garment's error, at most


@dataclass(frozen=True)
class Error:
    """Distance between predicted and true vertices over all test frames: root mean square, and mean, in millimetres."""

    rms_mm: float
    mean_mm: float

    @classmethod
    def of(cls, difference: Float[np.ndarray, "N C 3"]) -> "Error":
        """Of differences in metres."""
        squared = (difference.astype(np.float64) ** 2).sum(axis=-1)
        return cls(1e3 * float(np.sqrt(squared.mean())), 1e3 * float(np.sqrt(squared).mean()))


@dataclass(frozen=True)
class HiddenState:
    """What pose leaves unexplained of a garment.

    Attributes:
        train_frames, test_frames: how many were fitted and scored.
        mean, linear, nearest: errors of the three predictors on test frames.
        floor: chaos floor, where it was measured.
    """

    train_frames: int
    test_frames: int
    mean: Error
    linear: Error
    nearest: Error
    floor: Error | None = None

    @property
    def hidden_mm(self) -> float:
        """Root mean square of what the better prediction from pose leaves over."""
        return min(self.linear.rms_mm, self.nearest.rms_mm)

    @property
    def hidden_share(self) -> float:
        """The same as a share of the garment's variance."""
        return (self.hidden_mm / self.mean.rms_mm) ** 2 if self.mean.rms_mm > 0 else 0.0

    def gates(self) -> dict[str, bool]:
        """Whether a capture can show what the method claims: pose explains much, and what it does not is mostly not chaos."""
        gates = {"linear regression on pose clearly beats the mean garment": self.linear.rms_mm <= LINEAR_BEATS_MEAN * self.mean.rms_mm}
        if self.floor is not None:
            gates["the chaos floor is below half the mean garment's error"] = self.floor.rms_mm <= FLOOR_BELOW_MEAN * self.mean.rms_mm
        return gates

    def table(self) -> str:
        """The figures as text of equal columns."""
        rows = [("nothing (mean)", self.mean), ("pose, linearly", self.linear), ("nearest pose", self.nearest)]
        if self.floor is not None:
            rows.append(("itself (floor)", self.floor))
        lines = [f"{'predicted from':<16}{'RMS mm':>9}{'mean mm':>9}{'of variance':>13}"]
        for name, error in rows:
            share = (error.rms_mm / self.mean.rms_mm) ** 2 if self.mean.rms_mm > 0 else 0.0
            lines.append(f"{name:<16}{error.rms_mm:>9.2f}{error.mean_mm:>9.2f}{100 * share:>11.1f} %")
        return "\n".join(lines)


def measure_hidden_state(
    theta: Float32[np.ndarray, "N D"],
    vertices: Float32[np.ndarray, "N C 3"],
    is_train: Bool[np.ndarray, "N"],
    neighbours: int = 1,
    floor: Error | None = None,
) -> HiddenState:
    """Fit the predictors on training frames and score them on the others.

    Args:
        theta: pose angles that can matter (see `angles_that_move`).
        vertices: the garment in rest space, metres.
        is_train: which frames are for training; the others are scored.
        neighbours: poses whose garments the nearest-pose prediction averages.
        floor: the chaos floor, to be reported beside.

    Raises:
        ValueError: if there are fewer than two training frames or no test frame.
    """
    if is_train.sum() < 2 or is_train.all():
        raise ValueError(
            f"measure_hidden_state(): expected at least 2 training frames and 1 other; got {is_train.sum()} and {(~is_train).sum()}. "
            "Film more frames, or give a split."
        )
    angles = theta.astype(np.float64)
    mean, spread = angles[is_train].mean(axis=0), angles[is_train].std(axis=0)
    varied = spread > STEADY
    # In radians, not in standard deviations: for the nearest pose a finger that hardly moves must not count like a shoulder.
    angles, spread = (angles - mean)[:, varied], spread[varied]
    flat = vertices.reshape(len(vertices), -1).astype(np.float64)
    average = flat[is_train].mean(axis=0)
    garment = flat - average
    train, test = (angles[is_train], garment[is_train]), (angles[~is_train], garment[~is_train])

    def error(predicted: np.ndarray) -> Error:
        return Error.of((predicted - test[1]).reshape(len(predicted), -1, 3))

    return HiddenState(
        train_frames=int(is_train.sum()),
        test_frames=int((~is_train).sum()),
        mean=error(np.zeros_like(test[1])),
        linear=error(ridge_prediction(train[0] / spread, train[1], test[0] / spread)),
        nearest=error(train[1][_nearest(train[0], test[0], neighbours)].mean(axis=1)),
        floor=floor,
    )


def angles_that_move(rig: Rig, mesh: GarmentMesh) -> Int[np.ndarray, "A"]:
    """Rows of the pose angles that turn a joint which carries part of a garment."""
    influence = mesh.skinning_weights.max(axis=0) > INFLUENCE
    return np.flatnonzero(influence[rig.dofs.joints])


def _nearest(angles: np.ndarray, asked: np.ndarray, neighbours: int) -> Int[np.ndarray, "M K"]:
    """The frames whose angles are nearest, by Euclidean distance."""
    squared = (asked**2).sum(axis=1)[:, None] - 2 * asked @ angles.T + (angles**2).sum(axis=1)
    return np.argsort(squared, axis=1, kind="stable")[:, : min(neighbours, len(angles))]
