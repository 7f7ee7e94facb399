"""What the encoder says about the frames that an avatar was trained on: encoded once, kept in the run folder.

```
latents/training_000900.npz      posterior means and log variances, with the driving signals that they belong to
```
The number is the checkpoint's iteration, so that a run that trains on encodes anew.

Symbols: N training frames, Z latent size, D pose angles, F entries of the face signal.
"""

import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mitsuba_avatar.captures.folder import Capture
from mitsuba_avatar.driving.signals import DrivingSignals
from mitsuba_avatar.files import atomic_path
from mitsuba_avatar.model.avatar import Avatar
from mitsuba_avatar.model.encoder import Posterior
from mitsuba_avatar.training.run_folder import RunFolder

ENCODED_AT_ONCE = 8  # frames


@dataclass(frozen=True, eq=False)  # tensors have no truth value to compare by
class TrainingLatents:
    """The aggregate posterior of an avatar, frame by frame.

    Attributes:
        mu, logvar: [N, Z] of each training frame; Z is 0 for an avatar without a latent code.
        signals: that drive these frames.
    """

    mu: Float[Tensor, "N Z"]
    logvar: Float[Tensor, "N Z"]
    signals: DrivingSignals

    @staticmethod
    @torch.no_grad()
    def encode(avatar: Avatar, capture: Capture, progress: Callable[[int, int], None] = lambda done, total: None) -> "TrainingLatents":
        """Encode the registered meshes of a capture's training frames.

        Args:
            avatar: its encoder is used; one without a latent code gives codes of no entries.
            capture: that the avatar was trained on.
            progress: called as progress(done, total).

        Raises:
            FileNotFoundError: the capture has no registered meshes, or no driving signals.
        """
        frames = capture.frame_indices("train")
        signals = DrivingSignals.of_capture(capture, frames)
        if not avatar.settings.use_latent:
            return TrainingLatents(torch.zeros(len(frames), 0), torch.zeros(len(frames), 0), signals)
        if capture.vertices is None:
            raise FileNotFoundError(
                f"TrainingLatents.encode(): expected registered meshes in {capture.path / 'vertices.npy'}; got none. "
                "Impute with zero or prior, which need no encoder."
            )
        posterior = encode_frames(avatar, capture, frames, signals, progress)
        return TrainingLatents(posterior.mu, posterior.logvar, signals)

    def save(self, path: Path) -> None:
        """Write as one `.npz`, whole or not at all."""
        signals = self.signals
        with atomic_path(path) as temporary:
            np.savez_compressed(
                temporary,
                mu=self.mu.numpy(),
                logvar=self.logvar.numpy(),
                theta=signals.theta.numpy(),
                root=signals.root.numpy(),
                face=signals.face.numpy(),
                fps=np.array(signals.fps),
                clips=np.array([(clip.start, clip.stop) for clip in signals.clips]),
            )

    @staticmethod
    def load(path: Path) -> "TrainingLatents":
        """Read what `save` wrote.

        Raises:
            ValueError: the file is damaged.
        """
        try:
            with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
                tensors = {name: torch.from_numpy(stored[name]) for name in ("mu", "logvar", "theta", "root", "face")}
                clips = tuple(slice(int(start), int(stop)) for start, stop in stored["clips"])
                signals = DrivingSignals(tensors["theta"], tensors["root"], tensors["face"], float(stored["fps"]), clips)
        except (zipfile.BadZipFile, ValueError, KeyError, EOFError) as error:
            raise ValueError(f"TrainingLatents.load(): expected whole latents in {path}; got: {error}. Delete the file.") from error
        return TrainingLatents(tensors["mu"], tensors["logvar"], signals)


@torch.no_grad()
def encode_frames(
    avatar: Avatar,
    capture: Capture,
    frames: list[int],
    signals: DrivingSignals,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Posterior:
    """What the encoder says about the registered meshes of some frames, on the host.

    Args:
        avatar: with a latent code.
        capture: with registered meshes.
        frames: N of its rows.
        signals: that drive these N frames.
        progress: called as progress(done, total).
    """
    device, parts = avatar.mean_texture.device, []
    for start in range(0, len(frames), ENCODED_AT_ONCE):
        rows = slice(start, min(start + ENCODED_AT_ONCE, len(frames)))
        vertices = torch.from_numpy(np.stack([capture.vertices[frame] for frame in frames[rows]]).astype(np.float32))
        unposed = avatar.unpose(vertices.to(device), signals.theta[rows].to(device), signals.root[rows].to(device))
        parts.append(avatar.encode(unposed))
        progress(rows.stop, len(frames))
    return Posterior(torch.cat([part.mu for part in parts]).cpu(), torch.cat([part.logvar for part in parts]).cpu())


def latents_path(run: RunFolder, kind: str, checkpoint: str) -> Path:
    """File of what was derived from the encoder of a checkpoint, "best" or "last": `kind` is "training" or "temporal"."""
    index = run.checkpoints.index()
    if index is None:
        raise FileNotFoundError(f"latents_path(): expected a checkpoint in {run.path}; got none. Train it first.")
    return run.path / "latents" / f"{kind}_{index.iteration_of(checkpoint):06d}.npz"


def training_latents(
    run: RunFolder,
    avatar: Avatar,
    open_capture: Callable[[], Capture],
    checkpoint: str = "last",
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> TrainingLatents:
    """Latents of a run's training frames: from its folder, or encoded now and kept there.

    Args:
        run: of the avatar.
        avatar: of the checkpoint.
        open_capture: opens the capture that the run was trained on; called only where nothing is kept yet.
        checkpoint: "best" or "last".
        progress: called as progress(done, total).

    Raises:
        FileNotFoundError: as `TrainingLatents.encode`, or the run has no checkpoint.
        ValueError: a damaged file.
    """
    path = latents_path(run, "training", checkpoint)
    if path.is_file():
        return TrainingLatents.load(path)
    latents = TrainingLatents.encode(avatar, open_capture(), progress)
    latents.save(path)
    return latents
