"""Film a synthetic capture: `python -m mitsuba_avatar.studio [--preset NAME] [--out DIR] [key value ...]`.

Without `--out` the capture lands in the cache folder, where `python -m mitsuba_avatar.fit` finds it. Interrupted filming resumes when
the same command is given again.
"""

import sys
import time
from dataclasses import dataclass

from mitsuba_avatar.command_line import parse_command
from mitsuba_avatar.filming.settings import StudioSettings
from mitsuba_avatar.presets import resolve
from mitsuba_avatar.progress import progress_bar
from mitsuba_avatar.rendering import backend


@dataclass(frozen=True)
class StudioCommand:
    """Film a synthetic person with Mitsuba's path tracer into a capture."""

    preset: str = "default"  # preset of configs/studio/, or a YAML file
    out: str = ""  # capture folder; default: in the cache, named after preset and settings
    variant: str = "auto"  # Mitsuba variant


def main(arguments: list[str] | None = None) -> int:
    """Run the command; returns the exit status."""
    out = ""
    try:
        command, overrides = parse_command(StudioCommand, StudioSettings, arguments)
        preset = command.preset if command.preset.endswith(".yaml") else f"studio/{command.preset}"
        settings = resolve(preset, overrides, kind=StudioSettings)
        backend.select_variant(command.variant)
        out = film(settings, command.out)
    except (ValueError, OSError, backend.BackendError) as error:
        sys.stderr.write(f"studio: {error}\n")
        return 2
    except KeyboardInterrupt:
        sys.stderr.write("studio: interrupted; what was filmed is kept. Give the same command again to go on.\n")
        return 130
    sys.stdout.write(f"{out}\n")
    return 0


def film(settings: StudioSettings, out: str = "") -> str:
    """Film with a progress bar; returns the capture's folder. A capture that is there already is left as it is.

    Raises:
        FileExistsError: if `out` holds something else.
        OSError: no write permission, disk full.
    """
    # Loads torch and Mitsuba: only after the variant is set.
    from mitsuba_avatar.filming.film import default_capture_path, film_capture

    started = time.perf_counter()
    folder = out or str(default_capture_path(settings))
    total = settings.motion.train_frames + settings.motion.test_frames
    with progress_bar("filming", total) as bar:
        capture = film_capture(settings, folder, progress=lambda done, total: bar.update(done, total))
    sys.stderr.write(
        f"{len(capture.frames)} frames from {len(capture.cameras)} cameras in {time.perf_counter() - started:.0f} s. "
        f"Look at {capture.path}/contact_sheet.png\n"
    )
    return folder


if __name__ == "__main__":
    sys.exit(main())
