"""Progress in a log file: one line when it is due, with rate and time left; nothing where it is silenced."""

import pytest

from mitsuba_avatar import progress
from mitsuba_avatar.progress import StageProgress, progress_bar


@pytest.fixture
def clock(monkeypatch):
    """A clock that the test moves."""

    class Clock:
        now = 100.0

    monkeypatch.setattr(progress.time, "monotonic", lambda: Clock.now)
    return Clock


def test_a_log_file_gets_a_line_when_one_is_due(clock, capsys):
    with progress_bar("fitting", 100) as bar:
        clock.now += 4
        bar.update(20)
        assert not capsys.readouterr().err
        clock.now += 6.5
        bar.update(42, loss=0.123456, kl=1234567.0)
        assert capsys.readouterr().err.split() == ["fitting:", "42/100", "4.0/s", "14", "s", "left", "loss", "0.1235", "kl", "1.235e+06"]
        clock.now += 1
        bar.update(43)
        assert not capsys.readouterr().err
        bar.update(100)
        assert capsys.readouterr().err.startswith("fitting: 100/100")


def test_the_rate_of_a_resumed_step_counts_its_own_work_alone(clock, capsys):
    with progress_bar("fitting", 1000, initial=900) as bar:
        clock.now += 20
        bar.update(910)
    assert capsys.readouterr().err.split()[1:5] == ["910/1000", "2.0", "s", "each"]


def test_the_total_may_become_known_late(clock, capsys):
    with progress_bar("filming", 1) as bar:
        clock.now += 20
        bar.update(5, 30)
    assert "5/30" in capsys.readouterr().err


def test_long_lines_stay_whole(clock, capsys):
    """A log is searched line by line; a terminal's width does not matter to it."""
    with progress_bar("fitting", 10) as bar:
        bar.update(10, **{f"quite_a_long_name_of_a_term_{i}": 1.5 for i in range(8)})
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_other_ranks_are_silent(clock, capsys):
    with progress_bar("fitting", 10, is_shown=False) as bar:
        clock.now += 20
        bar.update(10)
    assert capsys.readouterr() == ("", "")


def test_nothing_done_yet_is_not_a_division_by_zero(clock, capsys):
    with progress_bar("fitting", 10) as bar:
        clock.now += 20
        bar.update(0)
    assert "0/10  -  inf s left" in capsys.readouterr().err


def test_stages_follow_each_other(capsys: pytest.CaptureFixture[str]):
    """Each stage ends with a line of its own where there is no terminal."""
    with StageProgress() as progress:
        progress.update("simulating", 1, 2)
        progress.update("simulating", 2, 2)
        progress.update("filming", 3, 3)
    lines = [line for line in capsys.readouterr().err.splitlines() if line]
    assert [line.split("  ")[0] for line in lines] == ["simulating: 2/2", "filming: 3/3"]
