"""Trains and measures the runs of an ablation in worker processes, several at a time, with one progress bar over all iterations.

Two workers with one thread each do more in the same time than one worker with two: small maps leave a second thread idle. A worker
writes to worker.log in its run folder. Ctrl-C reaches the workers too (they belong to the same terminal); each saves a checkpoint, and
the same command goes on from there. A worker that fails does not stop the others: a night is not lost because one row diverged.
"""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

from mitsuba_avatar.ablation.plan import PLANNED, PlannedRun
from mitsuba_avatar.presets import save_settings

POLL = 1.0  # seconds between looks at the workers
TAIL = 12  # lines of a failed worker's log that are shown
LOG = "worker.log"


def run_workers(planned: list[PlannedRun], jobs: int, progress: Callable[[int, int], None]) -> None:
    """Finish every run that is not measured yet, as far as they can be finished.

    Args:
        planned: in the order in which they are started.
        jobs: workers at a time.
        progress: called as progress(iterations done, iterations in all).

    Raises:
        RuntimeError: workers failed; all other runs are finished. The message names them and ends with the log of the first.
        KeyboardInterrupt: Ctrl-C or SIGTERM; after all workers have saved.
    """
    previous = signal.signal(signal.SIGTERM, signal.default_int_handler)  # ended from outside, workers must not go on unseen
    waiting = [run for run in planned if not run.is_measured]
    total = sum(run.settings.training.iterations for run in planned)
    workers: dict[subprocess.Popen, PlannedRun] = {}
    failures: list[tuple[PlannedRun, int]] = []
    try:
        while waiting or workers:
            while waiting and len(workers) < jobs:
                run = waiting.pop(0)
                workers[_start(run, max((os.cpu_count() or 1) // jobs, 1))] = run
            time.sleep(POLL)
            for worker in [worker for worker in workers if worker.poll() is not None]:
                run = workers.pop(worker)
                if worker.returncode != 0:
                    failures.append((run, worker.returncode))
            progress(sum(run.iterations_done() for run in planned), total)
        if failures:
            raise RuntimeError(_told(failures))
    finally:
        _stop(list(workers))
        signal.signal(signal.SIGTERM, previous)


def default_jobs() -> int:
    """One worker a core, as long as memory is likely to hold them."""
    return max(1, min(os.cpu_count() or 1, 4))


def _start(run: PlannedRun, threads: int) -> subprocess.Popen:
    """A worker for one run."""
    run.path.mkdir(parents=True, exist_ok=True)
    save_settings(run.path / PLANNED, run.settings)
    command = [sys.executable, "-m", "mitsuba_avatar.ablation.worker", run.row.name, str(run.path), str(threads)]
    environment = os.environ | {"OMP_NUM_THREADS": str(threads), "MKL_NUM_THREADS": str(threads)}
    with (run.path / LOG).open("ab") as log:
        return subprocess.Popen(command, stdout=log, stderr=log, stdin=subprocess.DEVNULL, env=environment)


def _stop(workers: list[subprocess.Popen]) -> None:
    """Ask workers to save and end, and wait for them."""
    for worker in workers:
        worker.send_signal(signal.SIGTERM)
    for worker in workers:
        worker.wait()


def _told(failures: list[tuple[PlannedRun, int]]) -> str:
    """Which runs failed, and how the first one's log ends."""
    named = ", ".join(f"{run.path} ended with status {status}" for run, status in failures)
    log: Path = failures[0][0].path / LOG
    lines = log.read_text(encoding="utf-8", errors="replace").splitlines()[-TAIL:]
    return f"run_workers(): {named}; all other runs are finished. {log} ends:\n" + "\n".join(f"    {line}" for line in lines)
