"""What drives an avatar over time: pose angles, root and face signal of N frames, and which of them follow each other.

Symbols: N frames, D pose angles, F entries of the face signal. Radians, metres, seconds, world axes.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mitsuba_avatar.captures.folder import Capture


@dataclass(frozen=True, eq=False)  # tensors have no truth value to compare by
class DrivingSignals:
    """Driving signals of a sequence, in the host's memory.

    Attributes:
        theta: [N, D] joint angles, radians.
        root: [N, 4, 4] rigid world_from_root, metres.
        face: [N, F] face signal as the avatar was trained on.
        fps: frames per second.
        clips: runs of frames that follow each other in time, in order, together all frames; empty stands for one run.

    Raises:
        ValueError: lengths that differ, no frames, values that are not finite, or clips that are no partition of the frames.
    """

    theta: Float[Tensor, "frames D"]
    root: Float[Tensor, "roots 4 4"]
    face: Float[Tensor, "faces F"]
    fps: float
    clips: tuple[slice, ...] = field(default=())

    def __post_init__(self) -> None:
        counts = {"theta": len(self.theta), "root": len(self.root), "face": len(self.face)}
        if len(set(counts.values())) != 1 or len(self.theta) == 0:
            raise ValueError(f"DrivingSignals(): expected one row for each frame, and a frame; got {counts}. Cut or repeat rows.")
        for name in counts:
            if not bool(torch.isfinite(getattr(self, name)).all()):
                raise ValueError(f"DrivingSignals(): expected finite {name}; got NaN or infinity. Repair the recording.")
        if not 0 < self.fps < float("inf"):
            raise ValueError(f"DrivingSignals(): expected a positive frame rate; got {self.fps}. Give frames per second.")
        if not self.clips:
            object.__setattr__(self, "clips", (slice(0, len(self.theta)),))
        covered = [index for clip in self.clips for index in range(clip.start, clip.stop)]
        if covered != list(range(len(self.theta))):
            raise ValueError(f"DrivingSignals(): expected clips that cover {len(self.theta)} frames once, in order; got {self.clips}.")

    def __len__(self) -> int:
        """N."""
        return len(self.theta)

    def chosen(self, rows: Sequence[int]) -> "DrivingSignals":
        """Some frames, in any order and as often as named; those that do not follow each other come into clips of their own."""
        clip_of_row = np.concatenate([np.full(clip.stop - clip.start, order) for order, clip in enumerate(self.clips)])
        runs = consecutive_runs(list(rows), [int(clip_of_row[row]) for row in rows])
        index = torch.tensor(list(rows), dtype=torch.int64)
        return DrivingSignals(self.theta[index], self.root[index], self.face[index], self.fps, runs)

    def turned(self, transforms: Float[np.ndarray, "frames 4 4"]) -> "DrivingSignals":
        """The same person moved in the world: rigid [N, 4, 4], applied after the root."""
        root = torch.from_numpy(np.asarray(transforms, np.float32)) @ self.root
        return DrivingSignals(self.theta, root, self.face, self.fps, self.clips)

    def in_place(self) -> "DrivingSignals":
        """The same motion without the way over the floor: the root keeps its mean place in x and y, and its height."""
        root = self.root.clone()
        root[:, :2, 3] = root[:, :2, 3].mean(0)
        return DrivingSignals(self.theta, root, self.face, self.fps, self.clips)

    @staticmethod
    def of_capture(capture: Capture, frames: Sequence[int] | None = None) -> "DrivingSignals":
        """Signals of a capture's frames, as they are stored.

        Args:
            capture: with pose, root and face.
            frames: frame indices in rising order; None for all.

        Raises:
            FileNotFoundError: a driving signal is missing.
        """
        missing = [name for name in ("theta", "root", "face") if getattr(capture, name) is None]
        if missing:
            raise FileNotFoundError(
                f"DrivingSignals.of_capture(): expected {', '.join(missing)} in {capture.path}; got none. Add the files to the capture."
            )
        rows = list(range(len(capture.frames))) if frames is None else list(frames)
        runs = consecutive_runs(rows, [capture.frames[row].segment for row in rows])
        theta, root, face = (torch.from_numpy(np.array(values[rows], np.float32)) for values in (capture.theta, capture.root, capture.face))
        return DrivingSignals(theta, root, face, capture.description.fps, runs)


def consecutive_runs(rows: Sequence[int], labels: Sequence[object]) -> tuple[slice, ...]:
    """Places in `rows` that hold numbers one after the other under one label, as slices in order."""
    starts = [place for place in range(len(rows)) if place == 0 or rows[place] != rows[place - 1] + 1 or labels[place] != labels[place - 1]]
    return tuple(slice(start, end) for start, end in zip(starts, [*starts[1:], len(rows)], strict=True))
