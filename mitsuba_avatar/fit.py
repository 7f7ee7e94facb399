"""Fit an avatar to a capture: `python -m mitsuba_avatar.fit [--config NAME] [--capture DIR] [section.key value ...]`.

Without a capture, the embedded default one is filmed on first use. Everything lands in a run folder (training/run_folder.py).
`torchrun --nproc_per_node N -m mitsuba_avatar.fit ... [--run-folder DIR]` trains data-parallel.
"""

# The rank's device must be chosen before torch and Dr.Jit are imported, and the variant before any of Mitsuba's types.
from mitsuba_avatar.training.distributed import claim_device

PROCESS = claim_device()

import dataclasses  # noqa: E402
import shlex  # noqa: E402
import sys  # noqa: E402
import time  # noqa: E402
from dataclasses import dataclass  # noqa: E402
from pathlib import Path  # noqa: E402
from typing import Annotated  # noqa: E402

import tyro  # noqa: E402

from mitsuba_avatar.captures.formats.opening import SourceName  # noqa: E402
from mitsuba_avatar.command_line import interruptible, parse_command  # noqa: E402
from mitsuba_avatar.presets import resolve  # noqa: E402
from mitsuba_avatar.rendering import backend  # noqa: E402
from mitsuba_avatar.settings import Settings  # noqa: E402


@dataclass(frozen=True)
class FitCommand:
    """Fit an avatar to a capture by differentiable rendering."""

    config: str = "default"  # preset of configs/, or a YAML file
    capture: str = ""  # capture folder, or FORMAT:DIR (docs/data_sets.md); default: the setting capture.path, else the embedded capture
    # torchrun's own parser stumbles over --run on its way here (Python 3.11 and older), hence the second name.
    run: Annotated[str, tyro.conf.arg(aliases=("--run-folder",))] = ""  # run folder; default: runs/<config>, numbered if taken
    resume: bool = False  # continue the run
    variant: str = ""  # Mitsuba variant; default: the setting rendering.variant


@interruptible("fit", kept="nothing was trained yet. Give the same command again.")
def main(arguments: list[str] | None = None) -> int:
    """Run the command; returns the exit status."""
    try:
        command, overrides = parse_command(FitCommand, Settings, arguments)
        settings = _resolved(command, overrides)
        settings = _with_variant(settings, backend.select_variant(settings.rendering.variant))
        return _fit(command, settings)
    except (ValueError, OSError, FloatingPointError, backend.BackendError) as error:
        sys.stderr.write(f"fit: {error}\n")
        return 2


def _resolved(command: FitCommand, overrides: list[str]) -> Settings:
    preset: str | Path = command.config
    if command.resume:
        preset = _run_path(command) / "settings.yaml"
        if not preset.is_file():
            raise FileNotFoundError(f"fit(): expected a run to resume with {preset}; got none. Name its folder with --run.")
    if command.capture:
        # Absolute, so that the run can be resumed from another folder.
        overrides = [*overrides, f"capture.path={SourceName.parse(command.capture) or Path(command.capture).absolute()}"]
    if command.variant:
        overrides = [*overrides, f"rendering.variant={command.variant}"]
    return resolve(preset, overrides)


def _with_variant(settings: Settings, variant: str) -> Settings:
    """Settings that say which variant ran, not "auto"."""
    return dataclasses.replace(settings, rendering=dataclasses.replace(settings.rendering, variant=variant))


def _run_path(command: FitCommand) -> Path:
    """The run folder that the command speaks of."""
    base = Path(command.run) if command.run else Path("runs") / Path(command.config).stem
    if command.run or command.resume:
        return base
    path, number = base, 2
    while path.exists():
        path, number = base.with_name(f"{base.name}-{number}"), number + 1
    return path


def _fit(command: FitCommand, settings: Settings) -> int:
    # Imported here, after the variant is set, because these modules load torch and Dr.Jit.
    from mitsuba_avatar.fitting import Fit

    started = time.perf_counter()
    path = _run_path(command)
    try:
        fit = Fit.prepare(settings, path, PROCESS, is_resumed=command.resume)
        try:
            is_finished = fit.train()
        finally:
            fit.leave()
        if is_finished and PROCESS.is_main:
            fit.present()
    except KeyboardInterrupt:
        is_finished = False
    if PROCESS.is_main:
        seconds = time.perf_counter() - started
        sys.stderr.write(f"Done in {seconds:.0f} s. Look at {path}\n" if is_finished else _how_to_resume(path))
    return 0 if is_finished else 130


def _how_to_resume(path: Path) -> str:
    """What an interrupted fit says last."""
    from mitsuba_avatar.training.run_folder import RunFolder

    try:
        index = RunFolder.open(path).checkpoints.index()
    except FileNotFoundError:
        index = None
    if index is None:
        return (
            "Interrupted before the first checkpoint: no training to resume. Filmed images and baked occlusion are kept; "
            "give the same command again to go on from them.\n"
        )
    command, flag = "python -m mitsuba_avatar.fit", "--run"
    if PROCESS.is_distributed:
        command, flag = f"torchrun --nproc_per_node {PROCESS.num_ranks} -m mitsuba_avatar.fit", "--run-folder"
    line = f"{command} {flag} {shlex.quote(str(path))} --resume"
    return f"Interrupted; everything up to iteration {index.last} is saved. Continue with: {line}\n"


if __name__ == "__main__":
    sys.exit(main())
