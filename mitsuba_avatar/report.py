"""Report on fitted avatars: `python -m mitsuba_avatar.report RUN [RUN...] [--out DIR]`.

Writes comparison with insets and error maps, LaTeX tables, vector curves, per-camera and per-frame CSV, settings, and for each run a page
that needs nothing else. Figures come from metrics.json and metrics.csv of the runs; what `evaluate` has not measured yet is measured now.
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from mitsuba_avatar.command_line import interruptible
from mitsuba_avatar.files import check_writable
from mitsuba_avatar.rendering import backend

if TYPE_CHECKING:
    from mitsuba_avatar.reporting.report import ReportedRun


@dataclass(frozen=True)
class ReportCommand:
    """Figures, tables and pages of one or several runs."""

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional]  # run folders that fit wrote
    out: str = ""  # folder; default: RUN/report, or report beside the first of several runs
    views: int = 4  # of the comparison
    frames: int = 4  # frames per split that are measured where a run has no metrics.csv
    measure: bool = False  # measure anew, whatever there is
    capture: str = ""  # another capture of the same rig, a folder or FORMAT:DIR; default: the one each run was trained on
    checkpoint: str = "last"  # best or last
    variant: str = "auto"  # Mitsuba variant


@interruptible("report", kept="finished files are whole and kept. Give the same command again to write all of them.")
def main(arguments: list[str] | None = None) -> int:
    """Run the command; returns the exit status."""
    command = tyro.cli(ReportCommand, args=arguments)
    try:
        if not command.runs:
            raise ValueError("expected at least one run folder; got none.")
        if command.views < 1 or command.frames < 1:
            raise ValueError(f"expected --views and --frames of at least 1; got {command.views} and {command.frames}.")
        backend.select_variant(command.variant)
        output = _report(command)
    except (ValueError, OSError, backend.BackendError) as error:
        sys.stderr.write(f"report: {error}\n")
        return 2
    sys.stdout.write(f"{output}\n")
    return 0


def _report(command: ReportCommand) -> Path:
    # Imported after the variant is set, because these modules load torch and Dr.Jit.
    from mitsuba_avatar.reporting.report import Report

    first = command.runs[0].resolve()
    folder = Path(command.out) if command.out else (first if len(command.runs) == 1 else first.parent) / "report"
    check_writable(folder)
    report = Report([_reported(path, name, command) for path, name in zip(command.runs, _names(command.runs), strict=True)], folder)
    report.write_tables()
    report.write_curves()
    report.write_comparison(command.views)
    report.write_pages()
    return folder


def _reported(path: Path, name: str, command: ReportCommand) -> "ReportedRun":
    """A run with its measurements: those on disk, or new ones, which leave the run folder as it is."""
    from mitsuba_avatar.loaded_run import LoadedRun
    from mitsuba_avatar.progress import progress_bar
    from mitsuba_avatar.reporting.evaluation import EVERY_MEASURE
    from mitsuba_avatar.reporting.metrics import load_metrics, load_pictures
    from mitsuba_avatar.reporting.report import ReportedRun

    loaded = LoadedRun.open(path, command.capture, command.checkpoint)
    evaluator, json_path = loaded.evaluator(), loaded.run.metrics_path
    csv_path = json_path.with_suffix(".csv")
    if not command.measure and not command.capture and csv_path.is_file() and json_path.is_file():
        return ReportedRun(name, loaded.run, evaluator, load_metrics(json_path), load_pictures(csv_path), command.checkpoint)
    frames = evaluator.split_frames(command.frames)
    total = sum(map(len, frames.values()))
    with progress_bar(f"measuring {name}", total) as bar:
        metrics = evaluator.measure(frames, progress=bar.update, measures=EVERY_MEASURE)
    with progress_bar(f"flicker of {name}", total) as bar:
        metrics.absorb(evaluator.measure_flicker(frames, progress=bar.update))
    return ReportedRun(name, loaded.run, evaluator, metrics.means(), metrics.picture_rows(), command.checkpoint)


def _names(paths: tuple[Path, ...]) -> list[str]:
    """Names of the runs: of their folders, with the parent's before where two are alike."""
    names = [path.resolve().name for path in paths]
    return [name if names.count(name) == 1 else f"{path.resolve().parent.name}_{name}" for name, path in zip(names, paths, strict=True)]


if __name__ == "__main__":
    sys.exit(main())
