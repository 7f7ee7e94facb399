"""Render a fitted avatar: `python -m mitsuba_avatar.render RUN [--path orbit|held_out] [--format png|exr|mp4|ply]`.

The avatar is driven by a capture (by default the one it was trained on), with a zero latent code. EXR files hold linear radiance,
mask, depth, normal, position and uv under the standard layer names; PNG and MP4 show it over a grey backdrop, sRGB-encoded.
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from mitsuba_avatar.files import atomic_path, check_writable
from mitsuba_avatar.rendering import backend


@dataclass(frozen=True)
class RenderCommand:
    """Draw a run's avatar from cameras of your choice."""

    run: Annotated[Path, tyro.conf.Positional]  # run folder that fit wrote
    path: Literal["orbit", "held_out"] = "orbit"  # cameras: a walk around, or the capture's held-out cameras
    format: Literal["png", "exr", "mp4", "ply"] = "png"  # ply: the posed mesh, metres, world axes
    split: Literal["test", "train"] = "test"  # frames that drive the avatar
    frames: int = 24  # how many pictures
    width: int = 360  # of an orbit; held-out cameras keep their size
    height: int = 540
    capture: str = ""  # driving capture of the same rig; default: the run's
    checkpoint: str = "last"  # best or last
    output: str = ""  # folder; default: RUN/renders/<path>
    variant: str = "auto"  # Mitsuba variant


def main(arguments: list[str] | None = None) -> int:
    """Run the command; returns the exit status."""
    command = tyro.cli(RenderCommand, args=arguments)
    try:
        if command.frames < 1:
            raise ValueError(f"expected --frames of at least 1; got {command.frames}.")
        backend.select_variant(command.variant)
        output = _render(command)
    except (ValueError, OSError, backend.BackendError) as error:
        sys.stderr.write(f"render: {error}\n")
        return 2
    sys.stdout.write(f"{output}\n")
    return 0


def _render(command: RenderCommand) -> Path:
    # Imported after the variant is set, because these modules load torch and Dr.Jit.
    import trimesh

    from mitsuba_avatar.loaded_run import LoadedRun
    from mitsuba_avatar.progress import progress_bar
    from mitsuba_avatar.reporting.camera_paths import orbit
    from mitsuba_avatar.reporting.exr import write_exr
    from mitsuba_avatar.reporting.figures import save_image
    from mitsuba_avatar.reporting.presentation import Shot, draw_along, posed_corners
    from mitsuba_avatar.reporting.video import write_video

    loaded = LoadedRun.open(command.run, command.capture, command.checkpoint)
    capture = loaded.capture
    split = capture.frame_indices(command.split)
    frames = [split[i * len(split) // command.frames] for i in range(command.frames)]  # repeats where pictures outnumber frames
    if command.path == "orbit":
        corners = posed_corners(loaded.avatar, capture, frames)
        cameras = orbit(corners, len(frames), command.width, command.height)
        names = [camera.name for camera in cameras]
        shots = [Shot(frame, name) for frame, name in zip(frames, names, strict=True)]
    else:
        names = capture.camera_names(held_out=True)
        if not names:
            raise ValueError(f"{capture.path} has no held-out cameras. Use --path orbit, or list some in capture.yaml.")
        shots = [Shot(frame, names[i % len(names)]) for i, frame in enumerate(frames)]
        cameras = [capture.cameras[shot.camera] for shot in shots]
    sizes = {(camera.width, camera.height) for camera in cameras}
    if len(sizes) > 1:
        raise ValueError(f"expected held-out cameras of one image size in {capture.path}; got {sorted(sizes)}. Use --path orbit.")
    renderer = loaded.renderer(cameras[0].width, cameras[0].height)
    folder = Path(command.output) if command.output else loaded.run.path / "renders" / command.path
    check_writable(folder)
    with progress_bar("rendering", len(frames)) as bar:
        drawn = draw_along(loaded.avatar, capture, frames, cameras, renderer, loaded.occlusion())
        if command.format == "mp4":
            output = folder.with_suffix(".mp4")
            write_video(output, (picture.on_backdrop() for picture in _counted(drawn, bar)), fps=12.0)
            return output
        for shot, picture in zip(shots, _counted(drawn, bar), strict=True):
            path = folder / f"{shot.camera}_{capture.frames[shot.frame].number:06d}.{command.format}"
            if command.format == "exr":
                write_exr(path, picture.layers())
            elif command.format == "ply":
                with atomic_path(path) as temporary:
                    trimesh.Trimesh(picture.vertices, loaded.run.rig.topology.faces, process=False).export(temporary)
            else:
                save_image(path, picture.on_backdrop())
    return folder


def _counted(items, bar):  # noqa: ANN001, ANN202 - any iterable
    for done, item in enumerate(items):
        yield item
        bar.update(done + 1)


if __name__ == "__main__":
    sys.exit(main())
