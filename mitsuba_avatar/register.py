"""Videos to a capture: `python -m mitsuba_avatar.register FOLDER --out DIR [section.key value ...]`.

The folder holds synchronized videos, their calibration and 2D keypoints (docs/registration.md). The same command again resumes an
interrupted registration; with other settings, it repeats the stages that they touch.
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from mitsuba_avatar.command_line import interruptible, parse_command
from mitsuba_avatar.files import check_writable
from mitsuba_avatar.presets import resolve
from mitsuba_avatar.progress import StageProgress
from mitsuba_avatar.registration.settings import RegistrationSettings
from mitsuba_avatar.rendering import backend

DIAGNOSTICS = "diagnostics.mp4"
DIAGNOSTICS_FPS = 15.0  # at most: slow motion shows what is off


@dataclass(frozen=True)
class RegisterCommand:
    """Make a capture of calibrated, synchronized videos of one person."""

    folder: Annotated[str, tyro.conf.Positional]  # videos, calibration, keypoints_2d/
    out: str = ""  # folder of the capture to write; default: runs/captures/<name of the folder>
    settings: str = ""  # YAML file of settings; the ones below otherwise
    variant: str = "auto"  # Mitsuba variant


@interruptible("register", kept="finished stages are kept. Give the same command again to go on.")
def main(arguments: list[str] | None = None) -> int:
    """Run the command; returns the exit status."""
    try:
        command, overrides = parse_command(RegisterCommand, RegistrationSettings, arguments)
        settings = resolve(command.settings or None, overrides, kind=RegistrationSettings)
        out = Path(command.out) if command.out else Path("runs/captures") / Path(command.folder).absolute().name
        check_writable(out)
        backend.select_variant(command.variant)
        return register(Path(command.folder), out, settings)
    except (ValueError, OSError, backend.BackendError) as error:
        sys.stderr.write(f"register: {error}\n")
        return 2


def register(folder: Path, out: Path, settings: RegistrationSettings) -> int:
    """Register with progress bars, write the diagnostics video, and say how well it fits.

    Raises:
        FileNotFoundError, ValueError: the recording is not usable; the message names file and remedy.
        FileExistsError: `out` holds a finished capture, or something else.
    """
    # Load torch and Mitsuba: only after the variant is set.
    from mitsuba_avatar.captures.folder import DESCRIPTION_FILE, Capture
    from mitsuba_avatar.registration.diagnostics import overlay_pictures
    from mitsuba_avatar.registration.recording import open_recording
    from mitsuba_avatar.registration.registering import Registration
    from mitsuba_avatar.registration.registration_report import summary
    from mitsuba_avatar.reporting.video import write_video

    if (out / DESCRIPTION_FILE).exists() and (out / DIAGNOSTICS).exists():
        raise FileExistsError(f"expected a new folder at {out}; got a finished capture. Choose another, or delete its {DESCRIPTION_FILE}.")
    with StageProgress() as progress:
        if (out / DESCRIPTION_FILE).exists():  # an earlier run stopped while it drew
            capture = Capture.open(out)
        else:
            capture, quality = Registration(open_recording(folder, settings.calibration), settings, out, progress.update).run()
            for name, value in summary(quality).items():
                sys.stderr.write(f"{name}: {value}\n")
        pictures = overlay_pictures(capture, lambda done, total: progress.update("diagnostics", done, total))
        write_video(out / DIAGNOSTICS, pictures, fps=min(DIAGNOSTICS_FPS, capture.description.fps))
    sys.stderr.write(f"Look at {out / DIAGNOSTICS} first, then: python -m mitsuba_avatar.fit --capture {out}\n")
    sys.stdout.write(f"{out}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
