"""Workers: what one of them does to the others."""

import subprocess
import sys
from pathlib import Path

import pytest

from mitsuba_avatar.ablation import schedule
from mitsuba_avatar.ablation.plan import PlannedRun
from mitsuba_avatar.ablation.rows import ROWS
from mitsuba_avatar.presets import resolve

MEASURE = "import pathlib, sys; pathlib.Path(sys.argv[1]).write_text('{}')"
FAIL = "import sys; print('no such luck'); sys.exit(3)"


@pytest.fixture
def runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[PlannedRun]:
    """Four rows whose workers do nothing but end: the second one badly."""
    planned = [PlannedRun(row, resolve(row.preset), tmp_path / row.name) for row in ROWS[:4]]

    def start(run: PlannedRun, threads: int) -> subprocess.Popen:
        run.path.mkdir()
        with (run.path / schedule.LOG).open("wb") as log:
            script = FAIL if run is planned[1] else MEASURE
            return subprocess.Popen([sys.executable, "-c", script, str(run.measures_path)], stdout=log, stderr=log)

    monkeypatch.setattr(schedule, "_start", start)
    monkeypatch.setattr(schedule, "POLL", 0.05)
    return planned


def test_a_failed_worker_is_told_in_the_end_and_all_others_are_finished(runs: list[PlannedRun]):
    with pytest.raises(RuntimeError) as caught:
        schedule.run_workers(runs, 2, lambda done, total: None)
    assert f"{runs[1].path} ended with status 3; all other runs are finished" in str(caught.value)
    assert "no such luck" in str(caught.value)
    assert [run.is_measured for run in runs] == [True, False, True, True]


def test_progress_counts_measured_runs_in_full(runs: list[PlannedRun]):
    told: list[tuple[int, int]] = []
    schedule.run_workers(runs[2:], 1, lambda done, total: told.append((done, total)))
    iterations = runs[2].settings.training.iterations
    assert told[-1] == (2 * iterations, 2 * iterations)
