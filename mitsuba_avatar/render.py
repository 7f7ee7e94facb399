"""Render a fitted avatar: `python -m mitsuba_avatar.render RUN [--path orbit] [--scene half_lit] [--format png exr mp4]`.

The avatar is driven by a capture (by default the one it was trained on), with a zero latent code. Without --scene the project's surface
renderer draws radiance as it was captured; with --scene it is path-traced among the lamps and objects of a Mitsuba scene. Pictures that
exist are skipped, so a killed command goes on where it stopped; docs/rendering.md has the rest.
"""

import hashlib
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from mitsuba_avatar.command_line import interruptible
from mitsuba_avatar.files import atomic_path
from mitsuba_avatar.rendering import backend

if TYPE_CHECKING:  # these load torch and Dr.Jit, which must wait for the variant
    from mitsuba_avatar.loaded_run import LoadedRun
    from mitsuba_avatar.reporting.novel_views import DrawnView, NovelView, ViewPainter
    from mitsuba_avatar.reporting.picture_folder import PictureFolder
    from mitsuba_avatar.reporting.view_transform import ViewTransform

# What decides the bytes of a picture, and stands in the folder's render.json.
PICTURE_SETTINGS = (
    *("path", "file", "split", "frames", "hold", "play", "width", "height", "capture", "scene", "light", "captured_light"),
    *("samples", "noise", "seconds", "max_depth", "view_transform", "exposure", "backdrop", "variant"),
)


@dataclass(frozen=True)
class RenderCommand:
    """Draw a run's avatar from cameras of your choice."""

    run: Annotated[Path, tyro.conf.Positional]  # run folder that fit wrote
    path: Literal["orbit", "turntable", "spiral", "keyframes", "held_out", "cameras"] = "orbit"  # the cameras' way
    file: str = ""  # of keyframes (YAML) or of cameras (a cameras.json)
    format: tuple[Literal["png", "exr", "mp4", "ply"], ...] = ("png",)  # any of them; ply: the posed mesh, metres, world axes
    split: Literal["test", "train", "stress"] = "test"  # frames that drive the avatar, spread over the path
    frames: int = 24  # how many pictures the path has
    hold: int | None = None  # drive with this one frame (number) of the capture throughout
    play: int | None = None  # drive with consecutive frames of the capture from this one (number) on
    width: int = 360  # pixels; held-out cameras and cameras of a file keep their size
    height: int = 540
    capture: str = ""  # driving capture of the same rig, a folder or FORMAT:DIR; default: the run's
    checkpoint: str = "last"  # best or last
    scene: str = ""  # path-trace in this scene: a name in scenes/ or an XML file
    light: Literal["relit", "baked"] = "relit"  # in a scene: lit by its lamps, or glowing as captured
    captured_light: str = "auto"  # divided out for relighting: auto (the capture's own), uniform, or a scene
    samples: int = 64  # path tracing: samples a pixel
    noise: float = 0.0  # path tracing: sample each picture until its relative noise is this
    seconds: float = 0.0  # path tracing: as many samples as fit into this time on the first picture
    max_depth: int = 4  # path tracing: segments of a path
    only: str = ""  # pictures of the path to draw: 3,10:20
    shard: str = ""  # i/n: draw every n-th of them, from the i-th (0-based)
    overwrite: bool = False  # draw also what exists
    view_transform: Literal["srgb", "soft"] = "srgb"  # of png and mp4
    exposure: float = 0.0  # stops, of png and mp4
    backdrop: float | None = 0.18  # linear radiance behind the person; None: transparent
    fps: float = 12.0  # of mp4
    out: str = ""  # folder; default: RUN/renders/<path>[_<scene>_<light>]
    variant: str = "auto"  # Mitsuba variant


@interruptible("render", kept="finished pictures are kept. Give the same command again to go on.")
def main(arguments: list[str] | None = None) -> int:
    """Run the command; returns the exit status."""
    command = tyro.cli(RenderCommand, args=arguments)
    try:
        _check(command)
        backend.select_variant(command.variant)
        output = _render(command)
    except (ValueError, OSError, backend.BackendError) as error:
        sys.stderr.write(f"render: {error}\n")
        return 2
    sys.stdout.write(f"{output}\n")
    return 0


def _check(command: RenderCommand) -> None:
    """Refuse before anything is loaded what cannot be meant."""
    if command.frames < 1:
        raise ValueError(f"expected --frames of at least 1; got {command.frames}.")
    if command.hold is not None and command.play is not None:
        raise ValueError("expected --hold or --play; got both. Leave one out.")
    if (command.path in ("keyframes", "cameras")) != bool(command.file):
        raise ValueError(f"expected --file with --path keyframes or cameras, and with no other; got --file {command.file!r}.")
    if command.noise < 0 or command.seconds < 0 or (command.noise > 0 and command.seconds > 0):
        raise ValueError(f"expected --noise or --seconds above 0, not both; got {command.noise} and {command.seconds}.")
    if not command.scene and (command.noise or command.seconds):
        raise ValueError("--noise and --seconds are for path tracing: name a --scene.")
    if "mp4" in command.format and command.backdrop is None:
        raise ValueError("a video has no transparency: give --backdrop a number, or leave mp4 out.")


def _render(command: RenderCommand) -> Path:
    # Imported after the variant is set, because these modules load torch and Dr.Jit.
    from mitsuba_avatar.loaded_run import LoadedRun
    from mitsuba_avatar.progress import progress_bar
    from mitsuba_avatar.reporting.novel_views import pictures_of, shard_of
    from mitsuba_avatar.reporting.picture_folder import PictureFolder
    from mitsuba_avatar.reporting.view_transform import ViewTransform

    transform = ViewTransform(command.view_transform, command.exposure, command.backdrop)
    loaded = LoadedRun.open(command.run, command.capture, command.checkpoint)
    views = _views(command, loaded)
    mine = shard_of(command.shard, pictures_of(command.only, len(views)))
    folder = PictureFolder(_output(command, loaded), _picture_settings(command, loaded), command.overwrite)
    endings = tuple(dict.fromkeys("png" if ending == "mp4" else ending for ending in command.format))
    todo = {views[i].name: views[i] for i in reversed(mine) if any(folder.needs(f"{views[i].name}.{ending}") for ending in endings)}
    if todo:
        has_albedo = "exr" in endings or (command.scene != "" and command.light == "relit")
        painter = _painter(command, loaded, views, folder, has_albedo)
        with progress_bar("rendering", len(mine), len(mine) - len(todo)) as bar:
            for done, view in enumerate(sorted(todo.values(), key=lambda view: view.number)):
                drawn = painter.draw(view, has_layers="exr" in endings)
                for ending in endings:
                    if folder.needs(f"{view.name}.{ending}"):
                        _write(folder.path / f"{view.name}.{ending}", drawn, transform, loaded)
                bar.update(len(mine) - len(todo) + done + 1)
    return _video(command, folder, views, transform) if "mp4" in command.format else folder.path


def _views(command: RenderCommand, loaded: "LoadedRun") -> list["NovelView"]:
    """All pictures of the path."""
    import numpy as np

    from mitsuba_avatar.captures.cameras import load_cameras
    from mitsuba_avatar.driving.animation import outline
    from mitsuba_avatar.driving.signals import DrivingSignals
    from mitsuba_avatar.reporting import camera_paths
    from mitsuba_avatar.reporting.novel_views import NovelView

    capture, frames = loaded.capture, _frames(command, loaded)
    size, turns = (command.frames, command.width, command.height), np.tile(np.eye(4), (command.frames, 1, 1))
    if command.path in ("held_out", "cameras"):
        if command.path == "cameras":
            known = list(load_cameras(command.file).values())
        else:
            known = [capture.cameras[name] for name in capture.camera_names(held_out=True)]
        if not known:
            raise ValueError(f"{capture.path} has no held-out cameras. Use --path orbit, or list some in capture.yaml.")
        cameras = [known[i % len(known)] for i in range(command.frames)]
    elif command.path == "keyframes":
        cameras = camera_paths.key_framed(command.file, *size)
    else:
        corners = outline(loaded.avatar, DrivingSignals.of_capture(capture, sorted(set(frames))), most_frames=command.frames)
        if command.path == "turntable":
            cameras, turns = camera_paths.turntable(corners, *size)
        else:
            cameras = (camera_paths.orbit if command.path == "orbit" else camera_paths.spiral)(corners, *size)
    names = [f"{camera.name}_{capture.frames[frame].number:06d}" for camera, frame in zip(cameras, frames, strict=True)]
    # A camera that sees a frame twice takes one picture: the path's first.
    return [NovelView(names.index(name), name, frames[i], cameras[i], turns[i]) for i, name in enumerate(names)]


def _frames(command: RenderCommand, loaded: "LoadedRun") -> list[int]:
    """Frame index that drives each picture."""
    numbers = [frame.number for frame in loaded.capture.frames]
    start = command.hold if command.hold is not None else command.play
    if start is None:
        split = loaded.capture.frame_indices(command.split)
        if not split:
            raise ValueError(f"expected {command.split} frames in {loaded.capture.path}; got none. Use another --split.")
        return [split[i * len(split) // command.frames] for i in range(command.frames)]  # repeats where pictures outnumber frames
    if start not in numbers:
        raise ValueError(f"expected a frame number {min(numbers)}..{max(numbers)} of {loaded.capture.path}; got {start}.")
    first = numbers.index(start)
    if command.hold is not None:
        return [first] * command.frames
    if first + command.frames > len(numbers):
        raise ValueError(f"expected {command.frames} frames from number {start} on; {loaded.capture.path} has {len(numbers) - first}.")
    return list(range(first, first + command.frames))


def _painter(
    command: RenderCommand, loaded: "LoadedRun", views: list["NovelView"], folder: "PictureFolder", has_albedo: bool
) -> "ViewPainter":
    """What draws the pictures; the folder settles how many samples a time budget means."""
    from dataclasses import replace

    from mitsuba_avatar.captures.cameras import film_size
    from mitsuba_avatar.progress import progress_bar
    from mitsuba_avatar.rendering.lit_scene import LitScene
    from mitsuba_avatar.rendering.path_tracing import PathTracer, SampleBudget
    from mitsuba_avatar.reporting.novel_views import ViewPainter
    from mitsuba_avatar.reporting.playback import Playback
    from mitsuba_avatar.reporting.relighting import CapturedLight, SurfaceRadiance, estimate_albedo, scene_file

    topology, tracer = loaded.run.rig.topology, None
    budget = SampleBudget(command.samples, command.noise)
    if command.scene:
        lit = LitScene(scene_file(command.scene), topology, loaded.avatar.settings.texture_size, command.light)
        tracer = PathTracer(lit, command.max_depth)
    albedo = None
    if has_albedo:
        trained = loaded.trained_capture()
        shown = SurfaceRadiance(Playback(loaded.avatar, trained, loaded.occlusion()), topology)
        with progress_bar("albedo", len(shown.frames)) as bar:
            albedo = estimate_albedo(shown, CapturedLight.of(trained, command.captured_light), bar.update)
    playback = Playback(loaded.avatar, loaded.capture, loaded.occlusion())
    painter = ViewPainter(playback, loaded.renderer(*film_size(view.camera for view in views)), albedo, tracer, budget)
    settled = folder.settle(lambda: {"samples": painter.samples_within(command.seconds, views[0])} if command.seconds else {})
    return replace(painter, budget=SampleBudget(settled["samples"])) if command.seconds else painter


def _write(path: Path, drawn: "DrawnView", transform: "ViewTransform", loaded: "LoadedRun") -> None:
    import trimesh

    from mitsuba_avatar.reporting.exr import write_exr
    from mitsuba_avatar.reporting.view_transform import write_png

    if path.suffix == ".exr":
        write_exr(path, drawn.exr_layers(), comments=drawn.comments)
    elif path.suffix == ".png":
        write_png(path, transform.apply(drawn.radiance, drawn.coverage), transform)
    else:
        with atomic_path(path) as temporary:
            trimesh.Trimesh(drawn.vertices, loaded.run.rig.topology.faces, process=False).export(temporary)


def _video(command: RenderCommand, folder: "PictureFolder", views: list["NovelView"], transform: "ViewTransform") -> Path:
    """The video, once all its pictures are there; until then the folder."""
    from mitsuba_avatar.captures.cameras import film_size
    from mitsuba_avatar.captures.images import read_image
    from mitsuba_avatar.reporting.video import centred, write_video

    paths = [folder.path / f"{view.name}.png" for view in views]
    missing = sum(not path.exists() for path in paths)
    if missing:
        sys.stderr.write(f"render: the video waits for {missing} pictures of other shards; run again when they are drawn.\n")
        return folder.path
    output = folder.path.with_name(f"{folder.path.name}.mp4")
    size, colour = film_size(view.camera for view in views), transform.backdrop_bytes()
    write_video(output, (centred(read_image(path), *size, colour) for path in paths), command.fps)
    return output


def _output(command: RenderCommand, loaded: "LoadedRun") -> Path:
    name = command.path + (f"_{Path(command.scene).stem}_{command.light}" if command.scene else "")
    return Path(command.out) if command.out else loaded.run.path / "renders" / name


def _picture_settings(command: RenderCommand, loaded: "LoadedRun") -> dict[str, Any]:
    """What a picture's bytes depend on: the flags, and the weights of the avatar."""
    digest = hashlib.sha256()
    for value in loaded.avatar.state_dict().values():
        digest.update(value.cpu().contiguous().numpy().tobytes())
    flags = {name: getattr(command, name) for name in PICTURE_SETTINGS}
    if not command.scene:  # of no meaning then
        flags = {name: value for name, value in flags.items() if name not in ("light", "samples", "noise", "seconds", "max_depth")}
    return flags | {"weights": digest.hexdigest()[:16]}


if __name__ == "__main__":
    sys.exit(main())
