"""Look at a fitted avatar in the browser: `python -m mitsuba_avatar.view RUN [--motion FILE] [--port N] [--measure SECONDS]`.

Sliders turn pose angles, face and latent code; a timeline plays the capture's test split or a recorded motion; a click on the map of poses
loads one. `--measure` draws without a browser and prints how many pictures a second this machine makes.
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from mitsuba_avatar.command_line import interruptible
from mitsuba_avatar.rendering import backend

if TYPE_CHECKING:
    from mitsuba_avatar.loaded_run import LoadedRun
    from mitsuba_avatar.viewing.session import ViewedAvatar


@dataclass(frozen=True)
class ViewCommand:
    """Look at a run's avatar from all sides and turn everything that drives it."""

    run: Annotated[Path, tyro.conf.Positional]  # run folder that fit wrote
    motion: str = ""  # timeline: a capture's folder, .bvh or .npy; default: the test split of the run's capture
    port: int = 8080  # the viewer's address is http://localhost:PORT
    host: str = "127.0.0.1"  # address to listen on; 0.0.0.0 lets other machines in
    height: int = 480  # of the pictures; the width follows the window
    measure: float = 0.0  # seconds to draw for without a browser, to print the rate; 0 serves the viewer
    capture: str = ""  # another capture of the same rig, a folder or FORMAT:DIR; default: the run's
    checkpoint: str = "last"  # best or last
    variant: str = "auto"  # Mitsuba variant


@interruptible("view", kept="a viewer keeps nothing. Give the same command again.")
def main(arguments: list[str] | None = None) -> int:
    """Run the command; returns the exit status."""
    command = tyro.cli(ViewCommand, args=arguments)
    try:
        if not 64 <= command.height <= 2160 or not 0 < command.port < 65536 or command.measure < 0:
            raise ValueError(
                f"expected --height of 64 to 2160, --port of 1 to 65535 and --measure of 0 or more; got {command.height}, "
                f"{command.port} and {command.measure}."
            )
        backend.select_variant(command.variant)
        return _view(command)
    except (ValueError, OSError, ImportError, backend.BackendError) as error:
        sys.stderr.write(f"view: {error}\n")
        return 2


def _view(command: ViewCommand) -> int:
    # Imported after the variant is set, because these modules load torch and Dr.Jit.
    from mitsuba_avatar.loaded_run import LoadedRun
    from mitsuba_avatar.viewing.session import ViewerSession

    loaded = LoadedRun.open(command.run, command.capture, command.checkpoint)
    session = ViewerSession(open_viewed_avatar(loaded, command.motion, command.checkpoint))
    if command.measure:
        figures = session.measure(command.measure, round(command.height * 4 / 3), command.height)
        parts = ", ".join(f"{name.removesuffix('_ms')} {value:.0f} ms" for name, value in figures.items() if name.endswith("_ms"))
        size = f"{round(command.height * 4 / 3)}x{command.height}"
        sys.stdout.write(f"{figures['frames_per_second']:.1f} pictures a second of {size} pixels: {parts}\n")
        return 0
    try:
        from mitsuba_avatar.viewing.browser import BrowserViewer
    except ModuleNotFoundError as error:
        raise ImportError(f"the viewer needs {error.name}, which is not installed. Run `pip install 'mitsuba-avatar[view]'`.") from error
    viewer = BrowserViewer(session, command.host, command.port, command.height, f"{command.run.resolve().name}")
    sys.stdout.write(f"http://{'localhost' if command.host == '127.0.0.1' else command.host}:{command.port} (Ctrl+C ends it)\n")
    sys.stdout.flush()
    try:
        viewer.run()
    except KeyboardInterrupt:
        sys.stdout.write("\n")
    return 0


def open_viewed_avatar(loaded: "LoadedRun", motion: str = "", checkpoint: str = "last") -> "ViewedAvatar":
    """What a viewer shows of a run: its training and test poses, latent codes where they can be had, and a timeline.

    Args:
        loaded: the run.
        motion: what the timeline plays, see `driving.sources`; empty for the capture's test split, or all frames where it has none.
            Another capture's face is played too; a motion without a face keeps the mean of the training frames.
        checkpoint: that `loaded` was opened with.

    Raises:
        FileNotFoundError, ValueError: the motion cannot be read, or is of another rig.
    """
    import numpy as np
    import torch

    from mitsuba_avatar.driving.signals import DrivingSignals
    from mitsuba_avatar.driving.sources import load_body
    from mitsuba_avatar.driving.training_latents import training_latents
    from mitsuba_avatar.viewing.session import MOST_NAMED_FACE_ENTRIES, ViewedAvatar

    run, capture = loaded.run, loaded.capture
    splits = {frame.purpose for frame in capture.frames}
    training = DrivingSignals.of_capture(capture, capture.frame_indices("train" if "train" in splits else None))
    others = {split: DrivingSignals.of_capture(capture, capture.frame_indices(split)) for split in sorted(splits - {"train"})}
    latents = None
    if run.settings.model.use_latent:
        try:
            latents = training_latents(run, loaded.avatar, loaded.trained_capture, checkpoint)
        except FileNotFoundError as error:  # without meshes there is nothing to encode: z is drawn or zero
            sys.stderr.write(f"view: no latent codes of training frames ({error})\n")
    timeline = next(iter(others.values()), training)
    if motion:
        track = load_body(motion, run.rig)
        face = training.face.mean(0).expand(len(track.theta), -1).clone()
        recorded = None if track.capture is None else track.capture.face
        if recorded is not None and recorded.shape[1] == run.face_size:
            face = torch.from_numpy(np.array(recorded[list(track.frames)], np.float32))
        theta, root = (torch.from_numpy(np.asarray(values, np.float32)) for values in (track.theta, track.root))
        timeline = DrivingSignals(theta, root, face, track.fps, track.clips)
        others["motion"] = timeline
    description = capture.description
    is_named = description.face_signal == "action_codes" and 0 < len(description.face_names) <= MOST_NAMED_FACE_ENTRIES
    return ViewedAvatar(
        avatar=loaded.avatar,
        rig=run.rig,
        timeline=timeline,
        training=training,
        latents=latents,
        others=others,
        face_names=tuple(description.face_names) if is_named else (),
        occlusion=loaded.occlusion(),
    )


if __name__ == "__main__":
    sys.exit(main())
