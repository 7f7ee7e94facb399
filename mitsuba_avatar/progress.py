"""Progress of long steps: a live bar with rate and time left on a terminal, a line every few seconds in a log file."""

import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import TypeVar

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, Task, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.text import Text

Item = TypeVar("Item")
LOG_INTERVAL = 10.0  # seconds between lines where there is no terminal


class _RateColumn(ProgressColumn):
    """Steps per second, or seconds per step where they are slow."""

    def render(self, task: Task) -> Text:
        return Text(_rate(task.speed or task.finished_speed or 0.0), style="cyan")


class ProgressBar:
    """One long step; `progress_bar` makes it."""

    def __init__(self, console: Console, progress: Progress, description: str, total: int, initial: int):
        self._console, self._progress, self._description, self._total, self._initial = console, progress, description, total, initial
        self._task = progress.add_task(description, total=total, completed=initial, notes="")
        self._started = self._logged = time.monotonic()

    def update(self, done: int, total: int | None = None, **notes: float) -> None:
        """Set how much is done, out of `total` if that changed, with named numbers to show beside the bar."""
        self._total = self._total if total is None else total
        text = "  ".join(f"{name} {value:.4g}" for name, value in notes.items())
        self._progress.update(self._task, completed=done, total=self._total, notes=text)
        now = time.monotonic()
        is_due = now - self._logged > LOG_INTERVAL or done == self._total
        if not self._console.is_terminal and is_due:
            self._logged = now
            rate = (done - self._initial) / max(now - self._started, 1e-6)
            left = (self._total - done) / rate if rate > 0 else float("inf")
            self._console.print(
                f"{self._description}: {done}/{self._total}  {_rate(rate)}  {left:.0f} s left  {text}", highlight=False, soft_wrap=True
            )


@contextmanager
def progress_bar(description: str, total: int, initial: int = 0, is_shown: bool = True) -> Iterator[ProgressBar]:
    """A bar for `total` steps of which `initial` are done; `is_shown` false keeps it silent (other ranks of a distributed run)."""
    console = Console(stderr=True, quiet=not is_shown)
    columns = [
        TextColumn("{task.description}"),
        BarColumn(bar_width=30),
        MofNCompleteColumn(),
        _RateColumn(),
        TimeElapsedColumn(),
        TextColumn("<"),
        TimeRemainingColumn(),
        TextColumn("{task.fields[notes]}"),
    ]
    with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
        yield ProgressBar(console, progress, description, total, initial)


def tracked(items: Sequence[Item], description: str) -> Iterator[Item]:
    """The items one by one, with a progress bar."""
    with progress_bar(description, len(items)) as bar:
        for done, item in enumerate(items, start=1):
            yield item
            bar.update(done)


class StageProgress:
    """Bars for a step with several stages whose names and lengths come as it goes; use it in a `with` statement."""

    def __enter__(self) -> "StageProgress":
        self._stack, self._stage, self._bar = ExitStack(), "", None
        return self

    def update(self, stage: str, done: int, total: int) -> None:
        """Set how much of a stage is done; a new name ends the bar of the last one and begins its own."""
        if stage != self._stage:
            self._stack.close()
            self._stage, self._bar = stage, self._stack.enter_context(progress_bar(stage, total))
        self._bar.update(done, total)

    def __exit__(self, *reason: object) -> None:
        self._stack.close()


def _rate(per_second: float) -> str:
    """A rate as people read it."""
    if per_second <= 0:
        return "-"
    return f"{per_second:.1f}/s" if per_second >= 1 else f"{1 / per_second:.1f} s each"
