"""Imputation of the latent code: what z is while an avatar is driven, when nothing says what it should be.

| name | z |
|---|---|
| zero | zero in every frame, the most likely code under the prior; what the paper evaluates |
| mean | the mean of the training frames' posterior means |
| prior | drawn from N(0, I) anew in every frame |
| clip | drawn from N(0, I) once for each clip, and held |
| nearest | the posterior mean of the training frame nearest in driving space |
| temporal | the most likely sequence of an autoregressive model of z given the drive (`temporal_model`) |
| temporal_sample | a sequence drawn from that model |

Symbols: N frames, Z latent size. Source: arXiv:2105.10441, section 4.2.2 (unmatched setting).
"""

from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor

from mitsuba_avatar.driving.signals import DrivingSignals
from mitsuba_avatar.driving.temporal_model import TemporalModel
from mitsuba_avatar.driving.training_latents import TrainingLatents

ImputationName = Literal["zero", "mean", "prior", "clip", "nearest", "temporal", "temporal_sample"]
FROM_TRAINING = ("mean", "nearest", "temporal", "temporal_sample")  # need what the encoder says about the training frames


@runtime_checkable
class Imputation(Protocol):
    """A way to make up latent codes for a sequence of driving signals."""

    def latents(self, drive: DrivingSignals) -> Float[Tensor, "N Z"]:
        """[N, Z] one code a frame, in the host's memory; the same at every call."""
        ...


@dataclass(frozen=True, eq=False)  # tensors have no truth value to compare by
class ConstantLatent:
    """One code for all frames: `torch.zeros(Z)`, or the mean of the training frames."""

    z: Float[Tensor, "Z"]  # noqa: F821

    def latents(self, drive: DrivingSignals) -> Float[Tensor, "N Z"]:
        """The code, N times."""
        return self.z.expand(len(drive), -1).clone()


@dataclass(frozen=True, eq=False)  # tensors have no truth value to compare by
class GivenLatents:
    """Codes that somebody found out, row by row: those of a reconstruction, say."""

    z: Float[Tensor, "M Z"]

    def latents(self, drive: DrivingSignals) -> Float[Tensor, "N Z"]:
        """The first N codes.

        Raises:
            ValueError: there are fewer codes than frames.
        """
        if len(self.z) < len(drive):
            raise ValueError(f"GivenLatents: expected a latent code for each of {len(drive)} frames; got {len(self.z)}. Drive with fewer.")
        return self.z[: len(drive)]


@dataclass(frozen=True)
class PriorSample:
    """Codes drawn from N(0, I).

    Attributes:
        size: Z.
        seed: equal seeds give equal codes.
        is_held: one draw a clip instead of one a frame.
    """

    size: int
    seed: int = 0
    is_held: bool = False

    def latents(self, drive: DrivingSignals) -> Float[Tensor, "N Z"]:
        """Drawn codes; with `is_held`, the k-th clip's is the same whatever the clips' lengths."""
        generator = torch.Generator().manual_seed(self.seed)
        if not self.is_held:
            return torch.randn(len(drive), self.size, generator=generator)
        drawn = torch.randn(len(drive.clips), self.size, generator=generator)
        return drawn.repeat_interleave(torch.tensor([clip.stop - clip.start for clip in drive.clips]), dim=0)


class NearestLatent:
    """Codes of the training frames that are nearest in driving space.

    The distance adds up pose angles and face signal, each in units of how far it spreads over the training frames, so that neither
    drowns the other however many entries it has. The root does not count.

    Args:
        training: codes to choose from, with their driving signals.
    """

    def __init__(self, training: TrainingLatents):
        self.training = training
        self._scales = [_spread(values) for values in (training.signals.theta, training.signals.face)]
        self._tree = cKDTree(self._features(training.signals))

    def nearest_frames(self, drive: DrivingSignals) -> np.ndarray:
        """[N] rows of the training frames that are taken."""
        return self._tree.query(self._features(drive))[1]

    def latents(self, drive: DrivingSignals) -> Float[Tensor, "N Z"]:
        """Posterior means of the nearest training frames."""
        return self.training.mu[torch.from_numpy(self.nearest_frames(drive))]

    def _features(self, signals: DrivingSignals) -> Float[np.ndarray, "N C"]:
        blocks = [values.double() / scale for values, scale in zip((signals.theta, signals.face), self._scales, strict=True)]
        return torch.cat(blocks, dim=1).numpy()


@dataclass(frozen=True, eq=False)
class TemporalLatents:
    """Codes of a temporal model: its most likely sequence, or with `is_sampled` one drawn with `seed`."""

    model: TemporalModel
    is_sampled: bool = False
    seed: int = 0

    def latents(self, drive: DrivingSignals) -> Float[Tensor, "N Z"]:
        """Run the model along every clip, from the state that the clip's first frame would keep up for ever."""
        noise = torch.Generator().manual_seed(self.seed) if self.is_sampled else None
        return self.model.run(drive, noise)


def make_imputation(
    name: ImputationName,
    latent_size: int,
    training: TrainingLatents | None = None,
    temporal: TemporalModel | None = None,
    seed: int = 0,
) -> Imputation:
    """The imputation of a name.

    Args:
        name: see the table above.
        latent_size: Z of the avatar; 0 for one without a latent code, which has nothing to impute.
        training: needed by those of FROM_TRAINING.
        temporal: of the temporal ones; None fits a model to `training`.
        seed: of those that draw.

    Raises:
        ValueError: an unknown name, a name that needs `training` without it, or anything but zero for an avatar without a latent code.
    """
    if name not in ("zero", "prior", "clip", *FROM_TRAINING):
        raise ValueError(f"make_imputation(): expected one of zero, prior, clip, {', '.join(FROM_TRAINING)}; got {name!r}.")
    if latent_size == 0 and name != "zero":
        raise ValueError(f"make_imputation(): expected an avatar with a latent code to impute {name!r}; it has none. Use zero.")
    if name in FROM_TRAINING and training is None:
        raise ValueError(f"make_imputation(): expected the training frames' latents for {name!r}; got None. Encode them first.")
    if name == "zero":
        return ConstantLatent(torch.zeros(latent_size))
    if name == "mean":
        return ConstantLatent(training.mu.mean(0))
    if name in ("prior", "clip"):
        return PriorSample(latent_size, seed, is_held=name == "clip")
    if name == "nearest":
        return NearestLatent(training)
    model = TemporalModel.fit(training) if temporal is None else temporal
    return TemporalLatents(model, is_sampled=name == "temporal_sample", seed=seed)


def _spread(values: Float[Tensor, "N C"]) -> Float[Tensor, ""]:
    """Root of the summed variances; 1 for a signal that never moves."""
    spread = values.double().var(0, correction=0).sum().sqrt()
    return torch.where(spread > 0, spread, torch.ones_like(spread))
