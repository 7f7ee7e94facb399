"""Occlusion maps of coming frames, baked by a process of its own while the caller trains.

A capture of thousands of frames would otherwise be baked before the first step; so the first step waits for the maps of one batch. Maps
come to the same bytes as without, by way of the cache on disk.
"""

import pickle
import subprocess
import sys
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import suppress
from itertools import islice

from jaxtyping import Float
from torch import Tensor

from mitsuba_avatar.rendering.ambient_occlusion import FrameOcclusion

AT_ONCE = 64  # maps that the worker is asked for at a time: what is wanted at once waits for no more than these
POLL = 0.002  # seconds between looks at the disk


class OcclusionAhead:
    """Maps as `FrameOcclusion` gives them, but of a worker that bakes ahead. Close it, or leave: it ends with this process.

    Args:
        frames: the sequence; maps that it has on disk are not baked again.
        order: in which its frames will be wanted, repetitions allowed; what is wanted out of order comes next. Read from the thread that
            calls `maps`.

    Raises:
        ChildProcessError: the worker cannot start.
    """

    def __init__(self, frames: FrameOcclusion, order: Iterable[int]):
        self.frames = frames
        self._order: Iterator[int] = iter(order)
        self._asked: list[int] = []  # and not seen on disk yet
        self._lock = threading.Lock()
        self._worker: subprocess.Popen | None = subprocess.Popen(
            [sys.executable, "-m", "mitsuba_avatar.rendering.occlusion_worker"],
            stdin=subprocess.PIPE,
            start_new_session=True,  # Ctrl-C is for the trainer, which still wants the maps of the batch that it ends with
        )
        self._send(frames.recipe())
        self._ask([])

    def maps(self, frames: list[int]) -> Float[Tensor, "P 1 S S"]:
        """Occlusion of the given rows of theta, [P, 1, S, S]; waits for those that are not on disk yet.

        Raises:
            ChildProcessError: the worker ended before its work.
        """
        with self._lock:
            self._ask(frames)
            while self._worker is not None and not all(map(self.frames.is_baked, frames)):
                self._check()
                time.sleep(POLL)
        return self.frames.maps(frames)

    def close(self) -> None:
        """End the worker, whatever it was asked for; what is not on disk then is baked by the caller."""
        with self._lock:
            if self._worker is not None:
                self._worker.terminate()
                self._end()

    def _ask(self, wanted: list[int]) -> None:
        """Send the worker what is wanted now and, as far as it has not enough to do, what comes next; end it where nothing is left."""
        if self._worker is None:
            return
        self._asked = [frame for frame in self._asked if not self.frames.is_baked(frame)]
        new = [frame for frame in wanted if frame not in self._asked and not self.frames.is_baked(frame)]
        coming = (frame for frame in self._order if not self.frames.is_baked(frame))
        new += islice(coming, max(AT_ONCE - len(self._asked) - len(new), 0))
        if new:
            self._asked += new
            self._send(new)
        elif not self._asked:
            self._end()

    def _send(self, message: object) -> None:
        try:
            pickle.dump(message, self._worker.stdin)
            self._worker.stdin.flush()
        except BrokenPipeError:
            self._worker.wait()
            self._check()

    def _check(self) -> None:
        if self._worker is not None and self._worker.poll() is not None:
            status = self._worker.returncode
            self._end()
            raise ChildProcessError(
                f"maps(): expected the process that bakes ambient occlusion to go on; it ended with status {status} (its own words are "
                "above; killed for lack of memory, it has none). Maps baked so far are kept: give the same command again, with --resume."
            )

    def _end(self) -> None:
        if self._worker is not None:
            with suppress(BrokenPipeError):  # what a worker that has died did not read
                self._worker.stdin.close()
            self._worker.wait()
            self._worker = None
