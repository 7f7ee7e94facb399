"""Film a synthetic capture: `python -m mitsuba_avatar.studio [--preset NAME] [--out DIR] [--shard i/n] [key value ...]`.

Without `--out` the capture lands in the cache folder, where `python -m mitsuba_avatar.fit` finds it. Interrupted filming resumes when
the same command is given again; several processes may film one capture, each its shard, in any order.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

from mitsuba_avatar.command_line import interruptible, parse_command
from mitsuba_avatar.filming.plan import LONG, Shard, plan_filming
from mitsuba_avatar.filming.settings import StudioSettings
from mitsuba_avatar.presets import resolve
from mitsuba_avatar.progress import StageProgress
from mitsuba_avatar.rendering import backend

VIDEO = "video.mp4"


@dataclass(frozen=True)
class StudioCommand:
    """Film a synthetic person with Mitsuba's path tracer into a capture."""

    preset: str = "default"  # preset of configs/studio/, or a YAML file
    out: str = ""  # capture folder; default: in the cache, named after preset and settings
    shard: str = ""  # i/n: make only the i-th of n parts of the images
    plan: bool = False  # print what the capture would be and cost, and film nothing
    gates: bool = False  # simulate, print how much of the clothes' shape pose explains and whether that is enough, and film nothing
    variant: str = "auto"  # Mitsuba variant


@interruptible("studio", kept="what was filmed is kept. Give the same command again to go on.")
def main(arguments: list[str] | None = None) -> int:
    """Run the command; returns the exit status."""
    try:
        command, overrides = parse_command(StudioCommand, StudioSettings, arguments)
        preset = command.preset if command.preset.endswith(".yaml") else f"studio/{command.preset}"
        settings = resolve(preset, overrides, kind=StudioSettings)
        plan = plan_filming(settings)
        if command.plan:
            sys.stdout.write(plan.text())
            return 0
        shard = Shard.parse(command.shard)
        if plan.seconds_of_shard(shard.count) > LONG:
            raise ValueError(f"expected less work than {LONG / 3600:.0f} hours; got\n{plan.text()}Give --shard, with more parts.")
        backend.select_variant(command.variant)
        return show_gates(settings, command.out) if command.gates else film(settings, command.out, shard)
    except (ValueError, OSError, backend.BackendError) as error:
        sys.stderr.write(f"studio: {error}\n")
        return 2


def film(settings: StudioSettings, out: str, shard: Shard) -> int:
    """Film with progress bars and say where. A capture that is there already is left as it is.

    Raises:
        FileExistsError: if `out` holds something else.
        ValueError: if a garment explodes.
        OSError: no write permission, disk full.
    """
    # Load torch and Mitsuba: only after the variant is set.
    from mitsuba_avatar.filming.film import CONTACT_SHEET, default_capture_path, film_capture
    from mitsuba_avatar.reporting.capture_video import write_capture_video

    folder = Path(out) if out else default_capture_path(settings)
    with StageProgress() as progress:
        capture = film_capture(settings, folder, progress.update, shard)
    if capture is None:
        sys.stderr.write(f"this shard is filmed; images of others are missing in {folder}\n")
        return 0
    if not (folder / VIDEO).is_file():
        write_capture_video(capture, folder / VIDEO)
    sys.stderr.write(f"{len(capture.frames)} frames from {len(capture.cameras)} cameras. Look at {folder}/{CONTACT_SHEET} and {VIDEO}\n")
    sys.stdout.write(f"{folder}\n")
    return 0


def show_gates(settings: StudioSettings, out: str) -> int:
    """Simulate all garments (they are kept for filming), and print what pose explains, what is chaos, and how far test poses lie.

    Returns:
        0 if all gates pass, 1 otherwise.
    """
    from mitsuba_avatar.filming.film import default_capture_path, rehearse

    folder = Path(out) if out else default_capture_path(settings)
    with StageProgress() as progress:
        hidden, distances = rehearse(settings, folder, progress.update)
    sys.stdout.write(f"{hidden.table()}\n\ndegrees from test poses to the nearest training pose (median)\n")
    for segment, degrees in distances.items():
        sys.stdout.write(f"{segment:>32} {degrees:6.1f}\n")
    gates = hidden.gates()
    for gate, is_passed in gates.items():
        sys.stdout.write(f"{'pass' if is_passed else 'FAIL'}  {gate}\n")
    return 0 if all(gates.values()) else 1


if __name__ == "__main__":
    sys.exit(main())
