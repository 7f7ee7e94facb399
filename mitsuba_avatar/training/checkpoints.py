"""Checkpoints of a run: weights in safetensors, optimizer state beside them, both whole or absent.

```
checkpoints/avatar_000400.safetensors     weights and training statistics; rig fingerprint and iteration in the header
checkpoints/training_000400.pt            optimizer state, readable with torch.load(weights_only=True)
checkpoints/checkpoints.json              {"last": 400, "best": 200, "best_psnr": 31.2}
```
checkpoints.json is written after the files that it names, so a crash or a full disk leaves the previous checkpoint in force.
"""

import json
import pickle
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from mitsuba_avatar.files import atomic_path


@dataclass(frozen=True)
class CheckpointIndex:
    """Which checkpoints a run has: iterations done, and the best validation PSNR in dB (None until one was measured)."""

    last: int
    best: int
    best_psnr: float | None

    def iteration_of(self, which: str) -> int:
        """Iterations done by the "last" or "best" checkpoint."""
        return {"last": self.last, "best": self.best}[which]


class Checkpoints:
    """The checkpoint folder of one run.

    Args:
        folder: made on the first save.
        rig_fingerprint: a checkpoint of another rig is refused.
    """

    def __init__(self, folder: Path, rig_fingerprint: str):
        self.folder, self.rig_fingerprint = folder, rig_fingerprint

    def index(self) -> CheckpointIndex | None:
        """What is there; None for a run without a checkpoint."""
        path = self.folder / "checkpoints.json"
        if not path.exists():
            return None
        try:
            return CheckpointIndex(**json.loads(path.read_text()))
        except (ValueError, TypeError) as error:  # no JSON, or other keys
            raise ValueError(
                f"Checkpoints: expected last, best and best_psnr in {path}; got: {error}. Restore the file or start the run anew."
            ) from error

    def save(self, avatar_state: dict[str, Tensor], training_state: dict[str, Any], iteration: int, psnr: float | None) -> None:
        """Save a checkpoint as the last, and as the best if `psnr` (dB, None when not measured) beats the best so far.

        Raises:
            OSError: the disk is full or not writable; the previous checkpoint stays in force.
        """
        previous = self.index()
        tensors = {name: value.detach().cpu().contiguous().clone() for name, value in avatar_state.items()}
        header = {"rig_fingerprint": self.rig_fingerprint, "iteration": str(iteration)}
        try:
            with atomic_path(self._avatar_path(iteration)) as temporary:
                save_file(tensors, temporary, metadata=header)
            with atomic_path(self._training_path(iteration)) as temporary:
                torch.save(training_state, temporary)
        except (OSError, SafetensorError, RuntimeError) as error:  # what Python, safetensors and torch raise on a full disk
            kept = "there is none before it" if previous is None else f"the one of iteration {previous.last} is kept"
            raise OSError(
                f"save(): expected room and permission for the checkpoint of iteration {iteration} in {self.folder}; got: {error}. "
                f"Free disk space, then --resume: {kept}."
            ) from error
        is_best = previous is None or previous.best_psnr is None or (psnr is not None and psnr > previous.best_psnr)
        best, best_psnr = (iteration, psnr) if is_best else (previous.best, previous.best_psnr)
        with atomic_path(self.folder / "checkpoints.json") as temporary:
            temporary.write_text(json.dumps({"last": iteration, "best": best, "best_psnr": best_psnr}))
        for path in self.folder.glob("*_[0-9]*.*"):
            if int(path.stem.rsplit("_", 1)[1]) not in (iteration, best):
                path.unlink()

    def load_avatar(self, which: str = "last") -> dict[str, Tensor]:
        """State of the avatar, "last" or "best".

        Raises:
            FileNotFoundError: the run has no checkpoint yet.
            ValueError: the checkpoint belongs to another rig, or the file is damaged.
        """
        path = self._avatar_path(self._iteration(which))
        try:
            with safe_open(path, framework="pt") as file:
                fingerprint = (file.metadata() or {}).get("rig_fingerprint", "unknown")
                if fingerprint != self.rig_fingerprint:
                    raise ValueError(
                        f"load_avatar(): {path} was trained on another rig (fingerprint {fingerprint[:12]}, this rig has "
                        f"{self.rig_fingerprint[:12]}). Use a capture with the rig of the run, or train anew."
                    )
                return {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - no dictionary
        except (SafetensorError, OSError) as error:
            raise ValueError(f"load_avatar(): {path} cannot be read: {error}. Restore it or start the run anew.") from error

    def load_training(self) -> tuple[int, dict[str, Any]]:
        """Iteration and training state of the last checkpoint.

        Raises:
            FileNotFoundError: the run has no checkpoint yet.
            ValueError: the file is missing or damaged.
        """
        iteration = self._iteration("last")
        path = self._training_path(iteration)
        try:
            return iteration, torch.load(path, weights_only=True)
        except (OSError, EOFError, RuntimeError, pickle.UnpicklingError) as error:
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise ValueError(f"load_training(): {path} cannot be read: {reason}. Restore it or start the run anew.") from error

    def _iteration(self, which: str) -> int:
        index = self.index()
        if index is None:
            raise FileNotFoundError(f"Checkpoints: no checkpoint in {self.folder}. Start the fit again without --resume.")
        return index.iteration_of(which)

    def _avatar_path(self, iteration: int) -> Path:
        return self.folder / f"avatar_{iteration:06d}.safetensors"

    def _training_path(self, iteration: int) -> Path:
        return self.folder / f"training_{iteration:06d}.pt"
