"""The process that bakes occlusion ahead of a training: `python -m mitsuba_avatar.rendering.occlusion_worker`.

Started by `OcclusionAhead`. It reads from its standard input: a pickled `OcclusionRecipe` first, pickled lists of frames then. Every map
becomes a file of the cache; nothing is answered. The end of its input, also when the trainer dies, ends it.
"""

import os
import pickle
import signal
import sys

from mitsuba_avatar.rendering import backend


def main() -> int:
    """Bake what is asked for until the input ends, or SIGTERM comes; returns the exit status."""
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(0))  # by way of an exception, so that no half-written file stays
    _select_variant()
    frames = pickle.load(sys.stdin.buffer).frames()
    while True:
        try:
            wanted = pickle.load(sys.stdin.buffer)
        except EOFError:
            return 0
        for frame in wanted:
            frames.prepare(frame)


def _select_variant() -> None:
    """The processor, where it can: the trainer's GPU has enough to do. Half of its cores, at least two."""
    try:
        backend.select_variant(backend.LLVM_VARIANT)
    except backend.BackendError:  # a machine with OptiX and without libLLVM
        backend.select_variant()
    # Load torch and Dr.Jit: only after the variant is set.
    import drjit
    import torch

    drjit.set_thread_count(max(backend.FEWEST_THREADS, (os.cpu_count() or 1) // 2))
    torch.set_num_threads(1)


if __name__ == "__main__":
    sys.exit(main())
