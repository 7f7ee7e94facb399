"""Measure a fitted avatar: `python -m mitsuba_avatar.evaluate RUN [--capture DIR] [--frames N]`.

Prints tables of the avatar and the baselines over train and test frames, seen and held-out cameras, one for each protocol (mask, image,
box: docs/reports.md), and writes metrics.json and, with a row for every picture, metrics.csv.
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from mitsuba_avatar.command_line import interruptible
from mitsuba_avatar.files import check_writable
from mitsuba_avatar.rendering import backend


@dataclass(frozen=True)
class EvaluateCommand:
    """Measure a run's avatar against its capture."""

    run: Annotated[Path, tyro.conf.Positional]  # run folder that fit wrote
    capture: str = ""  # another capture of the same rig, a folder or FORMAT:DIR; default: the one it was trained on
    frames: int = 0  # frames per split; default: the run's setting evaluation.frames_per_split
    checkpoint: str = "last"  # best or last
    out: str = ""  # where metrics go; default: RUN/metrics.json; the pictures' CSV lies beside it
    protocols: tuple[Literal["mask", "image", "box"], ...] = ("mask", "image", "box")  # regions that image errors are averaged over
    flip: bool = True  # measure FLIP, which takes longer than everything else
    lpips: str = ""  # measure LPIPS too, with the weights of this file (docs/reports.md)
    flicker_frames: int = 4  # frames per split whose flicker is measured; 0 for none
    variant: str = "auto"  # Mitsuba variant


@interruptible("evaluate", kept="finished files are whole and kept. Give the same command again to write all of them.")
def main(arguments: list[str] | None = None) -> int:
    """Run the command; returns the exit status."""
    command = tyro.cli(EvaluateCommand, args=arguments)
    try:
        if command.frames < 0:
            raise ValueError(f"expected --frames of at least 1, or 0 for the run's own number; got {command.frames}.")
        if command.flicker_frames < 0 or not command.protocols:
            raise ValueError(
                f"expected --flicker-frames of 0 or more and at least one of --protocols; got {command.flicker_frames} and "
                f"{command.protocols}."
            )
        backend.select_variant(command.variant)
        return _evaluate(command)
    except (ValueError, OSError, backend.BackendError) as error:
        sys.stderr.write(f"evaluate: {error}\n")
        return 2


def _evaluate(command: EvaluateCommand) -> int:
    # Imported after the variant is set, because these modules load torch and Dr.Jit.
    from mitsuba_avatar.loaded_run import LoadedRun
    from mitsuba_avatar.progress import progress_bar
    from mitsuba_avatar.reporting.evaluation import Measures
    from mitsuba_avatar.reporting.lpips import Lpips
    from mitsuba_avatar.reporting.tables import terminal_table

    network = Lpips.load(command.lpips) if command.lpips else None
    loaded = LoadedRun.open(command.run, command.capture, command.checkpoint)
    output = Path(command.out) if command.out else loaded.run.metrics_path
    check_writable(output.parent)
    evaluator = loaded.evaluator()
    frames = evaluator.split_frames(command.frames or loaded.run.settings.evaluation.frames_per_split)
    measures = Measures(command.protocols, has_flip=command.flip, has_seams=True, lpips=network)
    with progress_bar("evaluating", sum(map(len, frames.values()))) as bar:
        metrics = evaluator.measure(frames, progress=bar.update, measures=measures)
    if command.flicker_frames:
        moments = evaluator.split_frames(command.flicker_frames)
        with progress_bar("flicker", sum(map(len, moments.values()))) as bar:
            metrics.absorb(evaluator.measure_flicker(moments, progress=bar.update))
    metrics.save(output)
    metrics.save_pictures(output.with_suffix(".csv"))
    for protocol in command.protocols:
        sys.stdout.write(f"protocol {protocol}\n{terminal_table(metrics.means(), protocol)}\n\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
