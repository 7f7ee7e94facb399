"""Train and compare all variants of the avatar: `python -m mitsuba_avatar.ablate [--capture DIR] [--seeds N] [section.key value ...]`.

Every row of the paper's Table 1 (configs/ablation/), on the same capture, with the same capacity, steps and seeds; overrides change all
rows alike. Writes table.md, table.tex and table.json. Interrupted, it goes on where it stopped when the same command is given again.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

from mitsuba_avatar.ablation.adoption import adopt
from mitsuba_avatar.ablation.plan import REHEARSAL, capture_digest, plan_runs
from mitsuba_avatar.ablation.rows import choose_rows
from mitsuba_avatar.ablation.schedule import default_jobs, run_workers
from mitsuba_avatar.ablation.table import markdown, write_tables
from mitsuba_avatar.body.source_captures import capture_folder
from mitsuba_avatar.captures.formats.opening import SourceName
from mitsuba_avatar.command_line import interruptible, parse_command
from mitsuba_avatar.files import check_writable
from mitsuba_avatar.filming.settings import StudioSettings
from mitsuba_avatar.presets import resolve
from mitsuba_avatar.progress import StageProgress, progress_bar, tracked
from mitsuba_avatar.rendering import backend
from mitsuba_avatar.settings import Settings


@dataclass(frozen=True)
class AblateCommand:
    """Train every row of the ablation table, measure it, write the table."""

    capture: str = ""  # capture folder, or FORMAT:DIR; default: the studio's preset study, filmed on first use (20 to 50 minutes)
    out: str = ""  # where runs and tables go; default: runs/ablation, runs/rehearsal
    rows: str = ""  # comma-separated; default: all of configs/ablation/
    seeds: int = 1  # how many of each row
    budget: float = 1.0  # factor on the number of iterations of every row
    rehearsal: bool = False  # learn from registered meshes alone: minutes instead of hours; the table is then in millimetres
    jobs: int = 0  # rows trained at a time; default: one a core, at most four
    measured: str = ""  # table.json of runs that were measured elsewhere, separated by commas: seeds that are not trained again
    first_seed: int = 0  # seeds are counted from here: for a share of them on another machine
    variant: str = "auto"  # Mitsuba variant, for filming


@interruptible("ablate", kept="every run is saved. Give the same command again to go on.")
def main(arguments: list[str] | None = None) -> int:
    """Run the command; returns the exit status."""
    try:
        command, overrides = parse_command(AblateCommand, Settings, arguments)
        if command.jobs < 0:
            raise ValueError(f"expected --jobs of at least 1, or 0 for the default; got {command.jobs}.")
        rows = choose_rows(command.rows)
        folder = Path(command.out or ("runs/rehearsal" if command.rehearsal else "runs/ablation"))
        check_writable(folder)
        capture = capture_folder(command.capture, tracked) if command.capture else _study(command.variant)
        # Of a data set read in place, the folder in the cache is named after the data set's state: its path tells as much.
        digest = capture_digest(capture) if SourceName.parse(command.capture) is None else None
        words = [*(REHEARSAL if command.rehearsal else ()), *overrides]
        seeds = range(command.first_seed, command.first_seed + command.seeds)
        runs = plan_runs(folder, rows, seeds, command.budget, capture, words, digest)
        for table in filter(None, command.measured.split(",")):
            adopt(runs, Path(table.strip()))
        for run in runs:
            run.note_capture()
        iterations = sum(run.settings.training.iterations for run in runs)
        with progress_bar("ablation", iterations, sum(run.iterations_done() for run in runs)) as bar:
            try:
                run_workers(runs, command.jobs or default_jobs(), bar.update)
            finally:  # what is measured is tabled, whatever happened to the rest
                entries = write_tables(folder, runs)
        sys.stdout.write(markdown(entries))
        sys.stderr.write(f"Tables are in {folder}\n")
        return 0
    except (ValueError, OSError, RuntimeError, backend.BackendError) as error:
        sys.stderr.write(f"ablate: {error}\n")
        return 2


def _study(variant: str) -> Path:
    """The studio's capture for ablations, filmed if it is not there."""
    backend.select_variant(variant)
    # Load torch and Mitsuba: only after the variant is set.
    from mitsuba_avatar.filming.film import default_capture_path, film_capture

    settings = resolve("studio/study", kind=StudioSettings)
    folder = default_capture_path(settings)
    if not (folder / "capture.yaml").is_file():
        sys.stderr.write("No capture given: filming the studio's preset study (once; later ablations reuse it).\n")
        with StageProgress() as progress:
            film_capture(settings, folder, progress.update)
    return folder


if __name__ == "__main__":
    sys.exit(main())
