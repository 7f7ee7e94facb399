"""Results of stages on disk, so that an interrupted registration goes on where it stopped.

A result carries a key: a digest of the settings and of the results that it was made from. A stage whose key still fits is read back;
any other is made anew, and with it everything after it.
"""

import hashlib
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from mitsuba_avatar.files import atomic_path

KEY = "stage_key"


def stage_key(*parts: object) -> str:
    """Digest of what a stage depends on; parts must print the same for the same content."""
    return hashlib.sha256("\n".join(repr(part) for part in parts).encode()).hexdigest()[:16]


class StageFolder:
    """Named results in one folder."""

    def __init__(self, path: Path):
        self.path = path

    def arrays(self, name: str, key: str, make: Callable[[], dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
        """The arrays of a stage: read if made with this key, else made and kept, whole or not at all."""
        stored = self._read(name)
        if stored is not None and str(stored.get(KEY)) == key:
            return {entry: values for entry, values in stored.items() if entry != KEY}
        made = make()
        with atomic_path(self.path / f"{name}.npz") as temporary:
            np.savez(temporary, **made, **{KEY: np.array(key)})
        return made

    def is_done(self, name: str, key: str) -> bool:
        """Whether a stage that leaves files elsewhere was finished with this key."""
        marker = self.path / f"{name}.done"
        return marker.is_file() and marker.read_text(encoding="utf-8") == key

    def mark_done(self, name: str, key: str) -> None:
        """Say that a stage that leaves files elsewhere is finished."""
        with atomic_path(self.path / f"{name}.done") as temporary:
            temporary.write_text(key, encoding="utf-8")

    def _read(self, name: str) -> dict[str, np.ndarray] | None:
        path = self.path / f"{name}.npz"
        if not path.is_file():
            return None
        try:
            with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
                return {entry: stored[entry] for entry in stored.files}
        except (zipfile.BadZipFile, ValueError, EOFError, KeyError):
            return None  # a damaged result is made again
