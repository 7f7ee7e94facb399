"""A small temporal model of the latent code: linear, Gaussian, autoregressive, given the drive.

    s_t = s_{t-1} A + u_t B + b + noise,        z_t = mean + s_t E

s are coordinates of z in the principal directions E of the training frames' posterior means, u principal coordinates of the driving
signal (pose angles and face) and of its change since the frame before. A few hundred frames, as a capture has them, determine such a
model; a recurrent network would learn them by heart. Ridge regression in closed form; its strength is chosen by leaving out clip after
clip and letting the model run free along them, which is how it is used.

Symbols: N frames, Z latent size, K principal directions of z, U entries of u.
"""

import zipfile
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from mitsuba_avatar.driving.principal_directions import num_explaining
from mitsuba_avatar.driving.signals import DrivingSignals
from mitsuba_avatar.driving.training_latents import TrainingLatents
from mitsuba_avatar.files import atomic_path

EXPLAINED = 0.95  # share of the variance that the principal directions of z carry, and of each driving signal
MOST_DIRECTIONS = 32
RIDGES = (1e-2, 1e-1, 1.0, 10.0, 100.0, 1000.0)  # in units of one frame of unit variance
WARM_UP = 100  # frames that a drawn sequence runs before its first
LARGEST_RADIUS = 0.98  # spectral radius of A: a transient dies out within a few seconds


@dataclass(frozen=True, eq=False)  # arrays have no truth value to compare by
class TemporalModel:
    """Fitted with `fit`, used with `run`.

    Attributes:
        mean_z: [Z]; basis: [K, Z] orthonormal rows E.
        input_mean, input_projection: [C], [C, P] from the driving signal, pose and face side by side, to unit principal coordinates.
        transition: [K, K] A. response: [2 P, K] B. bias: [K] b. deviation: [K] of the noise.
        fps: of the training frames; other drives are resampled to it and back.
        ridge: that was chosen.
        explained: share of the variance of z over clips left out that the free-running model predicts (at most 1; negative: worse than
            the mean code).
    """

    mean_z: Float64[np.ndarray, "Z"]  # noqa: F821
    basis: Float64[np.ndarray, "K Z"]
    input_mean: Float64[np.ndarray, "C"]  # noqa: F821
    input_projection: Float64[np.ndarray, "C P"]
    transition: Float64[np.ndarray, "K K"]
    response: Float64[np.ndarray, "U K"]
    bias: Float64[np.ndarray, "K"]  # noqa: F821
    deviation: Float64[np.ndarray, "K"]  # noqa: F821
    fps: float
    ridge: float
    explained: float

    @staticmethod
    def fit(training: TrainingLatents) -> "TemporalModel":
        """Fit to the training frames, clip by clip.

        Raises:
            ValueError: no clip has two frames, or the avatar has no latent code.
        """
        clips = [clip for clip in training.signals.clips if clip.stop - clip.start > 1]
        if not clips or training.mu.shape[1] == 0:
            raise ValueError(
                f"TemporalModel.fit(): expected latent codes of frames that follow each other; got {training.mu.shape[1]} entries and "
                f"{len(clips)} clips of two frames or more. Impute with zero or nearest."
            )
        folds = _folds(clips)
        scores = {ridge: _left_out_score(training, clips, folds, ridge) for ridge in RIDGES}
        ridge = max(RIDGES, key=scores.__getitem__)
        return _fit(training, clips, ridge, scores[ridge])

    def run(self, drive: DrivingSignals, noise: torch.Generator | None = None) -> Float[Tensor, "N Z"]:
        """Codes along a drive: the most likely ones, or a sequence drawn with `noise`.

        Every clip starts at the state that its first frame would keep up for ever.
        """
        signal = torch.cat([drive.theta, drive.face], dim=1).double().numpy()
        if signal.shape[1] != len(self.input_mean):
            raise ValueError(
                f"TemporalModel.run(): expected {len(self.input_mean)} driving numbers a frame; got {signal.shape[1]}. "
                "Use a drive of the avatar that the model was fitted for."
            )
        codes = np.empty((len(drive), len(self.mean_z)))
        for clip in drive.clips:
            times = np.arange(clip.stop - clip.start) / drive.fps
            own = np.arange(int(times[-1] * self.fps + 1e-6) + 1) / self.fps
            if own[-1] < times[-1] - 1e-6:
                own = np.append(own, own[-1] + 1 / self.fps)
            states = self._states(_resampled(signal[clip], times, own), noise)
            codes[clip] = self.mean_z + _resampled(states, own, times) @ self.basis
        return torch.from_numpy(codes).float()

    def summary(self) -> str:
        """One line for the user."""
        verdict = "" if self.explained > 0 else ": no better than the mean code, which it therefore stays close to"
        return f"temporal model: {len(self.basis)} directions of z; predicts {100 * self.explained:.0f} % of left-out clips{verdict}"

    def save(self, path: Path) -> None:
        """Write as one `.npz`, whole or not at all."""
        with atomic_path(path) as temporary:
            np.savez_compressed(temporary, **{entry.name: np.asarray(getattr(self, entry.name)) for entry in fields(self)})

    @staticmethod
    def load(path: Path) -> "TemporalModel":
        """Read what `save` wrote.

        Raises:
            ValueError: the file is damaged.
        """
        try:
            with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
                parts = {entry.name: stored[entry.name] for entry in fields(TemporalModel)}
        except (zipfile.BadZipFile, ValueError, KeyError, EOFError) as error:
            raise ValueError(f"TemporalModel.load(): expected a whole model in {path}; got: {error}. Delete the file.") from error
        return TemporalModel(**{name: float(value) if value.ndim == 0 else value for name, value in parts.items()})

    def _states(self, signal: Float64[np.ndarray, "N C"], noise: torch.Generator | None) -> Float64[np.ndarray, "N K"]:
        """Coordinates s of the frames of one clip."""
        inputs = _inputs(self.input_mean, self.input_projection, signal)
        warm_up = 0 if noise is None else WARM_UP  # so that the first frame scatters as much as the others
        pushed = np.concatenate([np.repeat(inputs[:1], warm_up, axis=0), inputs]) @ self.response + self.bias
        count = len(self.bias)
        states = np.empty_like(pushed)
        states[0] = np.linalg.solve((np.eye(count) - self.transition).T, pushed[0])
        if noise is not None:
            pushed = pushed + torch.randn(*pushed.shape, generator=noise, dtype=torch.float64).numpy() * self.deviation
        for frame in range(1, len(states)):
            states[frame] = states[frame - 1] @ self.transition + pushed[frame]
        return states[warm_up:]


def _fit(training: TrainingLatents, clips: Sequence[slice], ridge: float, explained: float) -> TemporalModel:
    """Ridge regression over the steps inside some clips."""
    signals = training.signals
    rows = np.concatenate([np.arange(clip.start, clip.stop) for clip in clips])
    codes = training.mu.double().numpy()
    mean_z = codes[rows].mean(0)
    _, values, directions = np.linalg.svd(codes[rows] - mean_z, full_matrices=False)
    basis = directions[: _kept(values)]
    signal = torch.cat([signals.theta, signals.face], dim=1).double().numpy()
    input_mean, projection = _input_projection(signal[rows], signals.theta.shape[1])
    states = (codes - mean_z) @ basis.T
    before, after, inputs = [], [], []
    for clip in clips:
        pushed = _inputs(input_mean, projection, signal[clip])
        before.append(states[clip][:-1])
        after.append(states[clip][1:])
        inputs.append(pushed[1:])
    past, now, pushed = np.concatenate(before), np.concatenate(after), np.concatenate(inputs)
    scale = max(float(states[rows].std()), 1e-12)  # states in units of their spread, as the inputs are: one ridge serves both
    design = np.concatenate([past / scale, pushed, np.ones((len(past), 1))], axis=1)
    penalty = ridge * np.eye(design.shape[1])
    penalty[-1, -1] = 0
    weights = np.linalg.lstsq(design.T @ design + penalty, design.T @ now, rcond=None)[0]
    count = len(basis)
    transition = weights[:count] / scale
    radius = float(np.abs(np.linalg.eigvals(transition)).max())
    transition *= min(1.0, LARGEST_RADIUS / max(radius, 1e-12))
    residual = now - past @ transition - pushed @ weights[count:-1] - weights[-1]
    return TemporalModel(
        mean_z, basis, input_mean, projection, transition, weights[count:-1], weights[-1], residual.std(0), signals.fps, ridge, explained
    )


def _folds(clips: Sequence[slice]) -> list[list[slice]]:
    """Clips to leave out together: each one, or the last third of a clip that is alone."""
    if len(clips) > 1:
        return [[clip] for clip in clips]
    start, stop = clips[0].start, clips[0].stop
    return [[slice(stop - max(1, (stop - start) // 3), stop)]]


def _left_out_score(training: TrainingLatents, clips: Sequence[slice], folds: list[list[slice]], ridge: float) -> float:
    """Share of the variance of z about the kept clips' mean that free-running models predict over the clips left out."""
    missed = total = 0.0
    for fold in folds:
        kept = [clip for clip in (_without(clip, fold) for clip in clips) if clip.stop - clip.start > 1]
        if not kept:
            continue
        model = _fit(training, kept, ridge, 0.0)
        for clip in fold:
            truth = training.mu[clip].double().numpy()
            predicted = model.run(training.signals.chosen(range(clip.start, clip.stop))).double().numpy()
            missed += float(np.square(truth - predicted).sum())
            total += float(np.square(truth - model.mean_z).sum())
    return 1 - missed / total if total > 0 else 0.0


def _without(clip: slice, fold: list[slice]) -> slice:
    """What remains of a clip before the part that a fold leaves out."""
    left_out = [other for other in fold if clip.start <= other.start < clip.stop]
    return slice(clip.start, left_out[0].start) if left_out else clip


def _input_projection(signal: Float64[np.ndarray, "N C"], dofs: int) -> tuple[Float64[np.ndarray, "C"], Float64[np.ndarray, "C P"]]:  # noqa: F821
    """Mean, and projection to principal coordinates of unit total variance a block; pose and face apart."""
    mean, columns = signal.mean(0), []
    for block in (slice(0, dofs), slice(dofs, signal.shape[1])):
        _, values, directions = np.linalg.svd(signal[:, block] - mean[block], full_matrices=False)
        if len(values) == 0 or values[0] <= 0:
            continue
        spread = np.sqrt(np.square(values).sum() / len(signal))
        projection = np.zeros((signal.shape[1], _kept(values)))
        projection[block] = directions[: projection.shape[1]].T / spread
        columns.append(projection)
    return mean, np.concatenate(columns, axis=1) if columns else np.zeros((signal.shape[1], 1))


def _kept(values: Float64[np.ndarray, "R"]) -> int:  # noqa: F821
    """How many principal directions carry `EXPLAINED` of the variance; at least one, at most `MOST_DIRECTIONS`."""
    return min(num_explaining(values, EXPLAINED), MOST_DIRECTIONS)


def _inputs(
    mean: Float64[np.ndarray, "C"],  # noqa: F821
    projection: Float64[np.ndarray, "C P"],
    signal: Float64[np.ndarray, "N C"],
) -> Float64[np.ndarray, "N U"]:
    """u of the frames of one clip: coordinates, and their change since the frame before (none in the first)."""
    coordinates = (signal - mean) @ projection
    return np.concatenate([coordinates, np.diff(coordinates, axis=0, prepend=coordinates[:1])], axis=1)


def _resampled(
    values: Float64[np.ndarray, "N C"],
    times: Float64[np.ndarray, "N"],  # noqa: F821
    wanted: Float64[np.ndarray, "M"],  # noqa: F821
) -> Float64[np.ndarray, "M C"]:
    """Values at other times, linear in between, constant beyond the ends."""
    place = np.interp(wanted, times, np.arange(len(times)))
    low = np.floor(place).astype(int)
    high = np.minimum(low + 1, len(times) - 1)
    share = (place - low)[:, None]
    return values[low] * (1 - share) + values[high] * share
