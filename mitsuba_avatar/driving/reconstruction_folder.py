"""Reconstructed frames on disk, one file each, so that a command that was stopped goes on where it was.

```
settings.json                what the frames were reconstructed with; a folder takes no frames of other settings
frames/000130.npz            theta, root, face, z; where the descent started; its losses; seconds
theta.npy root.npy face.npy z.npy frames.npy     all frames together, in the order of the sequence: what `drive` reads
```
"""

import json
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from mitsuba_avatar.driving.reconstruction import BodyState
from mitsuba_avatar.files import atomic_path, check_writable


@dataclass(frozen=True, eq=False)  # arrays have no truth value to compare by
class ReconstructedFrame:
    """One frame's descent.

    Attributes:
        start, state: before and after.
        losses: [steps] of the descent.
        seconds: it took.
    """

    start: BodyState
    state: BodyState
    losses: Float32[np.ndarray, "steps"]  # noqa: F821
    seconds: float


class ReconstructionFolder:
    """The frames of one sequence.

    Args:
        path: the folder; it need not exist.
        settings: all that decides what comes out; values that JSON knows.

    Raises:
        ValueError: the folder holds frames of other settings, or its settings cannot be read.
        PermissionError: nothing can be written there.
    """

    def __init__(self, path: Path, settings: Mapping[str, Any]):
        check_writable(path)
        self.path = path
        settings = json.loads(json.dumps(dict(settings)))  # as it will be read back
        file = path / "settings.json"
        if file.exists():
            try:
                stored = dict(json.loads(file.read_text(encoding="utf-8")))
            except (ValueError, TypeError) as error:
                raise ValueError(f"ReconstructionFolder(): expected settings in {file}; got: {error}. Remove the folder.") from error
            for key in sorted(set(stored) | set(settings)):
                if stored.get(key) != settings.get(key):
                    raise ValueError(
                        f"ReconstructionFolder(): expected {key} = {stored.get(key)!r}, with which {path} was begun; got "
                        f"{settings.get(key)!r}. Name another folder with --out, or remove this one."
                    )
            return
        with atomic_path(file) as temporary:
            temporary.write_text(json.dumps(settings, indent=1) + "\n", encoding="utf-8")

    def save(self, number: int, frame: ReconstructedFrame) -> None:
        """Keep a frame, whole or not at all."""
        arrays = frame.state.save_arrays() | {f"start_{name}": values for name, values in frame.start.save_arrays().items()}
        with atomic_path(self._frame_path(number)) as temporary:
            np.savez(temporary, losses=frame.losses, seconds=np.array(frame.seconds), **arrays)

    def load(self, number: int) -> ReconstructedFrame | None:
        """A frame, or None if it is still to be done.

        Raises:
            ValueError: the file is damaged.
        """
        path = self._frame_path(number)
        if not path.is_file():
            return None
        try:
            with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
                arrays = {name: stored[name] for name in stored.files}
            start = {name.removeprefix("start_"): values for name, values in arrays.items() if name.startswith("start_")}
            return ReconstructedFrame(BodyState.of_arrays(start), BodyState.of_arrays(arrays), arrays["losses"], float(arrays["seconds"]))
        except (zipfile.BadZipFile, ValueError, KeyError, EOFError) as error:
            raise ValueError(f"ReconstructionFolder.load(): expected a whole frame in {path}; got: {error!r}. Delete the file.") from error

    def save_signals(self, numbers: Sequence[int], states: Sequence[BodyState]) -> None:
        """Write all frames together, as `drive --pose` and `--latents` read them."""
        rows = [state.save_arrays() for state in states]
        together = {name: np.stack([row[name] for row in rows]) for name in rows[0]} | {"frames": np.array(numbers, np.int64)}
        for name, values in together.items():
            with atomic_path(self.path / f"{name}.npy") as temporary:
                np.save(temporary, values)

    def _frame_path(self, number: int) -> Path:
        return self.path / "frames" / f"{number:06d}.npz"
