"""The simulated garment of one segment on disk: whole, or begun, so that whoever needs more of it goes on where another stopped.

<segment>.npy                        [n, G, 3] every frame, metres, world axes
<segment>.begun/000200-000399.npz    some frames, and the state after the last of them; gone once the segment is whole

Several processes may simulate one segment beside each other: they find the same bits, and what both made is kept once.
"""

import shutil
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path

import numpy as np
from jaxtyping import Float32
from numpy.lib.format import open_memmap

from mitsuba_avatar.files import atomic_path
from mitsuba_avatar.filming.cloth_simulation import ClothState

PIECE = 200  # frames at most that are lost when a process is killed
Simulate = Callable[[ClothState | None], Iterator[ClothState]]  # goes on after a state, or starts
Progress = Callable[[int], None]  # how many frames were simulated


class GarmentRecord:
    """What is there of a segment's garment."""

    def __init__(self, path: Path, count: int):
        """Files of a segment of `count` frames; `path` ends with .npy and names the whole one."""
        self.path, self.count = path, count
        self._folder = path.with_suffix(".begun")
        self._first, self._vertices = 0, np.zeros((0, 0, 3), np.float32)  # the piece read last

    @property
    def simulated(self) -> int:
        """How many frames are there, counted from the segment's first."""
        if self.path.is_file():
            return self.count
        return max((last + 1 for _, last in self._pieces()), default=0)

    def frame(self, index: int) -> Float32[np.ndarray, "G 3"]:
        """The garment in a frame that is there, counted from the segment's first."""
        if not 0 <= index - self._first < len(self._vertices):
            if self.path.is_file():
                self._first, self._vertices = 0, np.load(self.path, mmap_mode="r")
            else:
                self._first, last = next(piece for piece in self._pieces() if piece[0] <= index <= piece[1])
                self._vertices = self._read(self._first, last)["frames"]
        return np.array(self._vertices[index - self._first])

    def extend(self, until: int, simulate: Simulate, progress: Progress) -> None:
        """Simulate until a frame is there, and keep what was simulated piece by piece.

        Raises:
            ValueError: as `simulate`; the pieces before are kept.
        """
        if self.simulated > until:
            return
        try:
            last = self._last_state()
        except FileNotFoundError:  # another process has just made the segment whole
            if self.path.is_file():
                return
            raise
        frames: list[np.ndarray] = []
        for done, state in enumerate(simulate(last)):
            frames.append(state.vertices)
            progress(done + 1)
            if len(frames) == PIECE or state.frame == until:
                self._write(np.stack(frames), state)
                frames = []
            if state.frame == until:
                break
        if until == self.count - 1:
            self._join()

    def _pieces(self) -> list[tuple[int, int]]:
        """First and last frame of each piece."""
        names = [path.stem.split("-") for path in self._folder.glob("[0-9]*.npz")]
        return sorted((int(first), int(last)) for first, last in names)

    def _piece_path(self, first: int, last: int) -> Path:
        return self._folder / f"{first:06d}-{last:06d}.npz"

    def _read(self, first: int, last: int) -> dict[str, np.ndarray]:
        with np.load(self._piece_path(first, last)) as file:
            return dict(file)

    def _last_state(self) -> ClothState | None:
        """The state after the last frame that is there."""
        pieces = self._pieces()
        if not pieces:
            return None
        kept = self._read(*max(pieces, key=lambda piece: piece[1]))
        del kept["frames"]
        return ClothState(**kept | {name: int(kept[name]) for name in ("frame", "steps")})

    def _write(self, frames: Float32[np.ndarray, "n G 3"], state: ClothState) -> None:
        with atomic_path(self._piece_path(state.frame + 1 - len(frames), state.frame)) as temporary:
            np.savez(temporary, frames=frames, **asdict(state))

    def _join(self) -> None:
        """Make one file of the pieces."""
        with atomic_path(self.path) as temporary:
            whole = None
            for first, last in self._pieces():
                frames = self._read(first, last)["frames"]
                if whole is None:
                    whole = open_memmap(temporary, "w+", np.float32, (self.count, *frames.shape[1:]))
                whole[first : last + 1] = frames
            del whole  # written out
        shutil.rmtree(self._folder, ignore_errors=True)  # another process may be at it too
