"""How much of a garment's shape the pose explains, and how much is hidden: the part that only a latent code can carry.

Predictors are fitted to training frames and scored on others: the mean garment, linear regression on the pose angles that move it, the
mean of the nearest poses' garments. The hidden share is what the better of the last two leaves over. The chaos floor says how much of it
no signal can explain: how far two simulations drift apart whose garments started a millimetre from each other.

One more regression reads the whole driving signal, fingers and face included, as a decoder without localization does. Where chance
correlations make it no better than the mean garment, a latent code that has swallowed all of the drive costs nothing, for z = 0 then
decodes the mean: such a capture cannot rank avatars by what their codes leak.

Symbols: N frames, D pose angles, C vertices of the garment in rest space. Metres; figures are in millimetres.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from mitsuba_avatar.body.rig import Rig
from mitsuba_avatar.filming.garment_mesh import GarmentMesh
from mitsuba_avatar.ridge import ridge_prediction

STEADY = 1e-4  # radians, or strength of a facial action: a signal that varies less explains nothing
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
        whole: error of linear regression on the whole driving signal, where it was given.
    """

    train_frames: int
    test_frames: int
    mean: Error
    linear: Error
    nearest: Error
    floor: Error | None = None
    whole: Error | None = None

    @property
    def hidden_mm(self) -> float:
        """Root mean square of what the better prediction from pose leaves over."""
        return min(self.linear.rms_mm, self.nearest.rms_mm)

    @property
    def hidden_share(self) -> float:
        """The same as a share of the garment's variance."""
        return (self.hidden_mm / self.mean.rms_mm) ** 2 if self.mean.rms_mm > 0 else 0.0

    def gates(self) -> dict[str, bool]:
        """Whether a capture can show what the method claims: pose explains much, chance correlations do not undo that, and what pose
        does not explain is mostly not chaos.
        """
        gates = {"linear regression on pose clearly beats the mean garment": self.linear.rms_mm <= LINEAR_BEATS_MEAN * self.mean.rms_mm}
        if self.whole is not None:
            # Mean distances: the root mean square is ruled by the few frames in which a garment hangs far off.
            beats = self.whole.mean_mm <= LINEAR_BEATS_MEAN * self.mean.mean_mm
            gates["so does, in mean distance, regression on the whole driving signal"] = beats
        if self.floor is not None:
            gates["the chaos floor is below half the mean garment's error"] = self.floor.rms_mm <= FLOOR_BELOW_MEAN * self.mean.rms_mm
        return gates

    def table(self) -> str:
        """The figures as text of equal columns."""
        rows = [("nothing (mean)", self.mean), ("pose, linearly", self.linear), ("nearest pose", self.nearest)]
        if self.whole is not None:
            rows.append(("all, linearly", self.whole))
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
    whole: Float32[np.ndarray, "N S"] | None = None,
) -> HiddenState:
    """Fit the predictors on training frames and score them on the others.

    Args:
        theta: pose angles that can matter (see `angles_that_move`).
        vertices: the garment in rest space, metres.
        is_train: which frames are for training; the others are scored.
        neighbours: poses whose garments the nearest-pose prediction averages.
        floor: the chaos floor, to be reported beside.
        whole: everything that drives, to be scored beside the pose.

    Raises:
        ValueError: if there are fewer than two training frames or no test frame.
    """
    if is_train.sum() < 2 or is_train.all():
        raise ValueError(
            f"measure_hidden_state(): expected at least 2 training frames and 1 other; got {is_train.sum()} and {(~is_train).sum()}. "
            "Film more frames, or give a split."
        )
    angles, spread = _varied(theta, is_train)
    flat = vertices.reshape(len(vertices), -1).astype(np.float64)
    average = flat[is_train].mean(axis=0)
    garment = flat - average
    train, test = (angles[is_train], garment[is_train]), (angles[~is_train], garment[~is_train])

    def error(predicted: np.ndarray) -> Error:
        return Error.of((predicted - test[1]).reshape(len(predicted), -1, 3))

    def linear(signals: np.ndarray) -> Error:
        return error(ridge_prediction(signals[is_train], train[1], signals[~is_train]))

    return HiddenState(
        train_frames=int(is_train.sum()),
        test_frames=int((~is_train).sum()),
        mean=error(np.zeros_like(test[1])),
        linear=linear(angles / spread),
        # In radians, not in standard deviations: a finger that hardly moves must not count like a shoulder.
        nearest=error(train[1][_nearest(train[0], test[0], neighbours)].mean(axis=1)),
        floor=floor,
        whole=None if whole is None else linear(np.divide(*_varied(whole, is_train))),
    )


def _varied(signals: Float32[np.ndarray, "N S"], is_train: Bool[np.ndarray, "N"]) -> tuple[np.ndarray, np.ndarray]:
    """Signals that vary between training frames, less their mean there, [N, s], and their deviations, [s]."""
    signals = signals.astype(np.float64)
    mean, spread = signals[is_train].mean(axis=0), signals[is_train].std(axis=0)
    return (signals - mean)[:, spread > STEADY], spread[spread > STEADY]


def angles_that_move(rig: Rig, mesh: GarmentMesh) -> Int[np.ndarray, "A"]:
    """Rows of the pose angles that turn a joint which carries part of a garment."""
    influence = mesh.skinning_weights.max(axis=0) > INFLUENCE
    return np.flatnonzero(influence[rig.dofs.joints])


def _nearest(angles: np.ndarray, asked: np.ndarray, neighbours: int) -> Int[np.ndarray, "M K"]:
    """The frames whose angles are nearest, by Euclidean distance."""
    squared = (asked**2).sum(axis=1)[:, None] - 2 * asked @ angles.T + (angles**2).sum(axis=1)
    return np.argsort(squared, axis=1, kind="stable")[:, : min(neighbours, len(angles))]
