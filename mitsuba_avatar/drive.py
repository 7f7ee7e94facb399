"""Drive a fitted avatar: `python -m mitsuba_avatar.drive RUN --pose FILE [--face FILE] [--imputation NAME] [--path orbit]`.

Body and face come from captures, our arrays, BVH, Live Link Face or action codes; the latent code, which nobody measures, is imputed.
Writes a video or pictures, an overview and drive.json; prints frames per second of decoding and of rendering. docs/driving.md has the rest.
"""

import dataclasses
import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
import tyro
from jaxtyping import Float

from mitsuba_avatar.command_line import interruptible
from mitsuba_avatar.files import atomic_path, check_writable
from mitsuba_avatar.rendering import backend

if TYPE_CHECKING:  # these load torch and Dr.Jit, which must wait for the variant
    from torch import Tensor

    from mitsuba_avatar.captures.cameras import Camera
    from mitsuba_avatar.captures.folder import Capture
    from mitsuba_avatar.driving.animation import FrameClock
    from mitsuba_avatar.driving.assembly import AssembledDrive
    from mitsuba_avatar.driving.imputation import Imputation
    from mitsuba_avatar.driving.limits import RangeReport
    from mitsuba_avatar.driving.signals import DrivingSignals
    from mitsuba_avatar.driving.sources import FaceTrack
    from mitsuba_avatar.driving.training_latents import TrainingLatents
    from mitsuba_avatar.model.avatar import Avatar
    from mitsuba_avatar.training.run_folder import RunFolder

OVERVIEW = 8  # pictures of the overview
ImputationChoice = Literal["zero", "mean", "prior", "clip", "nearest", "temporal", "temporal_sample"]


@dataclass(frozen=True)
class DriveCommand:
    """Drive a run's avatar with a recording."""

    run: Annotated[Path, tyro.conf.Positional]  # run folder that fit wrote
    pose: str = ""  # what moves the body: capture, folder of arrays, .npy, .bvh; default: the run's capture
    face: str = ""  # what moves the face: capture, .npy, .csv; default: that of --pose, or the mean training face
    imputation: ImputationChoice = "zero"  # of the latent code
    latents: str = ""  # .npy [N, Z] with the latent codes themselves, as reconstruct writes them; goes before --imputation
    range: Literal["clamp", "project", "none"] = "clamp"  # angles out of range: to the rig's limits, onto the training poses, as they are
    split: Literal["test", "train", "validation", "stress", "all"] = "test"  # frames of a capture
    seconds: float = 0.0  # of the recording; 0: all
    fps: float = 0.0  # to read a recording at, and of arrays; 0: its own (BVH: at most 30, arrays: 10)
    in_place: bool = False  # leave out the way over the floor
    path: Literal["front", "orbit", "spiral", "turntable", "held_out"] = "front"  # cameras: one in front, ways around, the capture's
    format: tuple[Literal["mp4", "png"], ...] = ("mp4",)
    width: int = 360  # pixels; held-out cameras keep their size
    height: int = 540
    samples: int = 0  # a pixel; 0: those of the run's final pictures
    checkpoint: str = "last"  # best or last
    seed: int = 0  # of imputations that draw
    export_decoder: str = ""  # write the decoder to this .pt2 file (torch.export) and, without --pose, do nothing else
    out: str = ""  # folder; default: RUN/drives/<name of pose>_<imputation>
    variant: str = "auto"  # Mitsuba variant


@interruptible("drive", kept="finished files are whole and kept. Give the same command again to write all of them.")
def main(arguments: list[str] | None = None) -> int:
    """Run the command; returns the exit status."""
    command = tyro.cli(DriveCommand, args=arguments)
    try:
        backend.select_variant(command.variant)
        return _run(command)
    except (ValueError, OSError, backend.BackendError) as error:
        sys.stderr.write(f"drive: {error}\n")
        return 2


def _run(command: DriveCommand) -> int:
    # Imported after the variant is set, because these modules load torch and Dr.Jit.
    from mitsuba_avatar.driving.decoder_export import export_decoder
    from mitsuba_avatar.training.run_folder import RunFolder

    if command.checkpoint not in ("best", "last"):
        raise ValueError(f"expected --checkpoint best or last; got {command.checkpoint!r}.")
    run = RunFolder.open(command.run)
    avatar = run.load_avatar(command.checkpoint)
    if command.export_decoder:
        path = Path(command.export_decoder)
        check_writable(path.parent)
        export_decoder(avatar, run.rig, path)
        sys.stdout.write(f"{path}\n")
        if not command.pose:
            return 0
    name = Path(command.pose).stem if command.pose else command.split
    folder = Path(command.out) if command.out else run.path / "drives" / f"{name}_{'given' if command.latents else command.imputation}"
    check_writable(folder)
    training = _Training(run, avatar, command.checkpoint)
    drive, report = _signals(command, run, avatar, training)
    _write_lines([*drive.notes, f"setting: {drive.setting}", *([report.summary()] if report else [])])
    latents = _imputation(command, avatar, training).latents(drive.signals)
    clock = _draw(command, run, avatar, drive.signals, latents, folder)
    _write_lines([f"{len(drive.signals)} frames; {clock.summary()}"])
    _write_facts(folder, command, drive, report, clock)
    sys.stdout.write(f"{folder}\n")
    return 0


class _Training:
    """What the encoder says about the training frames: opened when somebody asks."""

    def __init__(self, run: "RunFolder", avatar: "Avatar", checkpoint: str):
        self.run, self.avatar, self.checkpoint = run, avatar, checkpoint

    def latents(self) -> "TrainingLatents":
        """From the run folder, or encoded now."""
        from mitsuba_avatar.driving.training_latents import training_latents
        from mitsuba_avatar.progress import progress_bar

        with progress_bar("training latents", 1) as bar:
            return training_latents(self.run, self.avatar, self.run.open_capture, self.checkpoint, bar.update)


def _signals(
    command: DriveCommand, run: "RunFolder", avatar: "Avatar", training: _Training
) -> tuple["AssembledDrive", "RangeReport | None"]:
    """What drives the avatar, brought into range."""
    from mitsuba_avatar.body.source_captures import capture_folder
    from mitsuba_avatar.captures.folder import Capture
    from mitsuba_avatar.driving.assembly import assemble, trained_face
    from mitsuba_avatar.driving.limits import clamped, projected
    from mitsuba_avatar.driving.sources import load_body, load_face

    pose = capture_folder(command.pose) if command.pose else run.open_capture().path
    body = load_body(pose, run.rig, command.fps, command.split, command.seconds)
    has_face = isinstance(body.capture, Capture) and body.capture.face is not None or (pose.is_dir() and (pose / "face.npy").is_file())
    source = command.face or (str(pose) if has_face else "")
    face = load_face(source, trained_face(run), body.fps, command.split) if source else None
    if face is not None:
        body = dataclasses.replace(body, theta=_with_gaze(run, body.theta, face, body.fps))
    drive = assemble(run, avatar, body, face, lambda: training.latents().signals)
    if command.in_place:
        drive = dataclasses.replace(drive, signals=drive.signals.in_place())
    if command.range == "none":
        return drive, None
    if command.range == "clamp":
        signals, report = clamped(drive.signals, run.rig)
    else:
        signals, report = projected(drive.signals, training.latents().signals, run.rig)
    return dataclasses.replace(drive, signals=signals), report


def _with_gaze(run: "RunFolder", theta: Float[np.ndarray, "N D"], face: "FaceTrack", fps: float) -> Float[np.ndarray, "N D"]:
    """Eyes turned as action codes say, where the body's recording holds them still and the rig has eyes."""
    from mitsuba_avatar.filming.face import gaze_of_actions

    names = run.rig.dofs.names
    eyes = [f"{side}_eye_{way}" for side in ("left", "right") for way in ("elevation", "abduction")]
    if face.kind.signal != "action_codes" or not set(eyes) <= set(names):
        return theta
    columns = [names.index(name) for name in eyes]
    if theta[:, columns].any():
        return theta
    codes = face.recording.at(np.arange(len(theta)) / fps)
    gaze = gaze_of_actions(codes, face.kind.names)
    turned = theta.copy()
    turned[:, columns] = gaze.reshape(-1, 4) * [1, 1, 1, -1]  # abduction is outwards: the right eye's has the other sign
    return turned


def _imputation(command: DriveCommand, avatar: "Avatar", training: _Training) -> "Imputation":
    """The imputation asked for; a temporal model is fitted on first use and kept in the run folder."""
    import torch

    from mitsuba_avatar.driving.imputation import FROM_TRAINING, GivenLatents, make_imputation
    from mitsuba_avatar.driving.temporal_model import TemporalModel
    from mitsuba_avatar.driving.training_latents import latents_path

    size = avatar.settings.latent_size if avatar.settings.use_latent else 0
    if command.latents:
        try:
            codes = np.load(command.latents, allow_pickle=False)
        except (ValueError, EOFError) as error:
            raise ValueError(f"expected a plain array in {command.latents}; got: {error}. Save it with numpy.save().") from error
        if codes.ndim != 2 or codes.shape[1] != size:
            raise ValueError(f"expected latent codes [N, {size}] in {command.latents}; got {list(codes.shape)}. Use codes of this avatar.")
        return GivenLatents(torch.from_numpy(codes.astype(np.float32)))
    if size == 0 or command.imputation not in FROM_TRAINING:
        return make_imputation(command.imputation, size, seed=command.seed)
    latents, model = training.latents(), None
    if command.imputation.startswith("temporal"):
        path = latents_path(training.run, "temporal", command.checkpoint)
        model = TemporalModel.load(path) if path.is_file() else TemporalModel.fit(latents)
        if not path.is_file():
            model.save(path)
        _write_lines([model.summary()])
    return make_imputation(command.imputation, size, latents, model, command.seed)


def _draw(
    command: DriveCommand,
    run: "RunFolder",
    avatar: "Avatar",
    signals: "DrivingSignals",
    latents: "Tensor",
    folder: Path,
) -> "FrameClock":
    """Decode, render, write."""
    from mitsuba_avatar.body.source_captures import capture_folder
    from mitsuba_avatar.captures.cameras import film_size
    from mitsuba_avatar.captures.folder import DESCRIPTION_FILE, Capture
    from mitsuba_avatar.driving.animation import FrameClock, animate, outline
    from mitsuba_avatar.loaded_run import avatar_occlusion
    from mitsuba_avatar.progress import progress_bar
    from mitsuba_avatar.rendering.surface import SurfaceRenderer
    from mitsuba_avatar.reporting.figures import Tile, compose, save_image
    from mitsuba_avatar.reporting.video import centred, write_video
    from mitsuba_avatar.reporting.view_transform import ViewTransform, write_png

    count, transform, clock = len(signals), ViewTransform(), FrameClock()
    capture = None
    if command.path == "held_out":  # of what drives, or of the run's capture where that has no cameras
        driving = capture_folder(command.pose) if command.pose else None
        capture = Capture.open(driving) if driving is not None and (driving / DESCRIPTION_FILE).is_file() else run.open_capture()
    cameras, turns = _cameras(command, capture, outline(avatar, signals), count)
    signals = signals.turned(turns)
    samples = command.samples or run.settings.evaluation.samples_per_pixel
    size = film_size(cameras)
    renderer = SurfaceRenderer(run.rig.topology, *size, samples_per_pixel=samples)
    frames = animate(avatar, signals, latents, list(enumerate(cameras)), renderer, avatar_occlusion(run), clock)
    kept = {round(i * (count - 1) / max(1, OVERVIEW - 1)) for i in range(OVERVIEW)}
    tiles = []

    def pictures() -> Iterator[np.ndarray]:
        with progress_bar("driving", count) as bar:
            for frame in frames:
                picture = transform.apply(frame.radiance, frame.coverage)
                if "png" in command.format:
                    write_png(folder / f"{frame.row:06d}.png", picture, transform)
                if frame.row in kept:
                    tiles.append(Tile(f"{frame.row / signals.fps:.1f} s", picture / 255))
                bar.update(frame.row + 1)
                yield picture

    if "mp4" in command.format:
        write_video(folder / "drive.mp4", (centred(picture, *size, transform.backdrop_bytes()) for picture in pictures()), signals.fps)
    else:
        for _ in pictures():
            pass
    save_image(folder / "overview.png", compose([tiles], height=min(cameras[0].height, 400)))
    return clock


def _cameras(
    command: DriveCommand, capture: "Capture | None", points: Float[np.ndarray, "P 3"], count: int
) -> tuple["Sequence[Camera]", Float[np.ndarray, "N 4 4"]]:
    """A camera a frame, and the rigid transform of the world that turns the person in it."""
    from mitsuba_avatar.reporting import camera_paths

    size = (command.width, command.height)
    if command.path == "turntable":
        return camera_paths.turntable(points, count, *size)
    if capture is not None:
        names = capture.camera_names(held_out=True)
        if not names:
            raise ValueError(f"{capture.path} has no held-out cameras. Use --path orbit, or list some in capture.yaml.")
        cameras = [capture.cameras[names[i * len(names) // count]] for i in range(count)]  # one after the other: a cut, not a flicker
    elif command.path == "front":
        cameras = camera_paths.orbit(points, 1, *size) * count
    else:
        cameras = {"orbit": camera_paths.orbit, "spiral": camera_paths.spiral}[command.path](points, count, *size)
    return cameras, np.tile(np.eye(4), (count, 1, 1))


def _write_facts(folder: Path, command: DriveCommand, drive: "AssembledDrive", report: "RangeReport | None", clock: "FrameClock") -> None:
    """drive.json: what was asked, what was done, how fast."""
    facts = {
        "command": {name: str(value) if isinstance(value, Path) else value for name, value in dataclasses.asdict(command).items()},
        "frames": len(drive.signals),
        "setting": drive.setting,
        "notes": list(drive.notes),
        "range": None if report is None else dataclasses.asdict(report),
        "frames_per_second": clock.frames_per_second(),
    }
    with atomic_path(folder / "drive.json") as temporary:
        temporary.write_text(json.dumps(facts, indent=2) + "\n", encoding="utf-8")


def _write_lines(lines: "Sequence[str]") -> None:
    sys.stdout.write("".join(f"{line}\n" for line in lines))


if __name__ == "__main__":
    sys.exit(main())
