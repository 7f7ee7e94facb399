"""Measure a fitted avatar: `python -m mitsuba_avatar.evaluate RUN [--capture DIR] [--frames N]`.

Prints the table of the avatar and the baselines over train and test frames, seen and held-out cameras, and writes metrics.json.
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from mitsuba_avatar.files import check_writable
from mitsuba_avatar.rendering import backend


@dataclass(frozen=True)
class EvaluateCommand:
    """Measure a run's avatar against its capture."""

    run: Annotated[Path, tyro.conf.Positional]  # run folder that fit wrote
    capture: str = ""  # another capture of the same rig; default: the one it was trained on
    frames: int = 0  # frames per split; default: the run's setting evaluation.frames_per_split
    checkpoint: str = "last"  # best or last
    output: str = ""  # where metrics go; default: RUN/metrics.json
    variant: str = "auto"  # Mitsuba variant


def main(arguments: list[str] | None = None) -> int:
    """Run the command; returns the exit status."""
    command = tyro.cli(EvaluateCommand, args=arguments)
    try:
        if command.frames < 0:
            raise ValueError(f"expected --frames of at least 1, or 0 for the run's own number; got {command.frames}.")
        backend.select_variant(command.variant)
        return _evaluate(command)
    except (ValueError, OSError, backend.BackendError) as error:
        sys.stderr.write(f"evaluate: {error}\n")
        return 2


def _evaluate(command: EvaluateCommand) -> int:
    # Imported after the variant is set, because these modules load torch and Dr.Jit.
    from mitsuba_avatar.loaded_run import LoadedRun
    from mitsuba_avatar.progress import progress_bar
    from mitsuba_avatar.reporting.tables import terminal_table

    loaded = LoadedRun.open(command.run, command.capture, command.checkpoint)
    output = Path(command.output) if command.output else loaded.run.metrics_path
    check_writable(output.parent)
    evaluator = loaded.evaluator()
    frames = evaluator.split_frames(command.frames or loaded.run.settings.evaluation.frames_per_split)
    with progress_bar("evaluating", sum(map(len, frames.values()))) as bar:
        metrics = evaluator.measure(frames, progress=bar.update)
    metrics.save(output)
    sys.stdout.write(terminal_table(metrics.means()) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
