"""`capture convert`: other formats into our layout, and our layout into Goliath's."""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import torch
import tyro
from jaxtyping import Float32
from rich.console import Console

from mitsuba_avatar.body.momentum_rig import momentum_from_rig, momentum_poses
from mitsuba_avatar.body.rig import Rig, load_rig
from mitsuba_avatar.body.skinning import posed_rest_surface
from mitsuba_avatar.body.source_captures import capture_folder, convert_with_body, images_in_place
from mitsuba_avatar.captures.cameras import UpAxis
from mitsuba_avatar.captures.description import Distortion
from mitsuba_avatar.captures.folder import Capture
from mitsuba_avatar.captures.formats.conversion import ConversionOptions, read_report, with_frames
from mitsuba_avatar.captures.formats.goliath_writer import GoliathBody, write_goliath
from mitsuba_avatar.captures.formats.opening import FormatName, open_source
from mitsuba_avatar.captures.formats.source import Source, SourceOptions
from mitsuba_avatar.captures.images import ImageExtension
from mitsuba_avatar.progress import tracked
from mitsuba_avatar.rendering.backend import select_variant

OCCLUSION_RAYS = 32  # per texel
OCCLUSION_METRES = 0.5  # what is farther away does not occlude


@dataclass(frozen=True)
class ConvertCommand:
    """Convert a data set into a capture (--from), or a capture into a Goliath body capture (--to goliath).

    Attributes:
        source: Folder to read.
        destination: Folder to write; an interrupted conversion resumes there.
        from_format: Format of the source.
        to_format: Format of the destination.
        cameras: Read only these; default: all that have calibration and images.
        held_out_cameras: Cameras that no training may look at.
        first_frame: Leave out frames with lower numbers.
        last_frame: Leave out frames with higher numbers.
        every: Keep each so-manieth frame.
        scale: Make images smaller by this factor.
        image_extension: Of the images to write; default: as the source's.
        fps: Frames per second; default: the format's.
        test_frames: So many of the last frames are for testing; default: the data set's own split, else a tenth.
        up: Axis of the data set's world that points up; default: the one along which the cameras stand ("cameras": just as they stand).
        distortion: Apply or ignore the stored lens coefficients; default: as the data set's own tools do.
        assets: Body model of Goliath captures (static_assets_body.pt or .npz); default: in or beside the capture.
        own_sizes: Keep the size of each camera's images; default: all become as small as the smallest.
        in_place: Write everything but images and masks, which are then read, and straightened, where they lie; the source must stay there.
        links: Link to image files that need no change instead of copying them; the source must stay where it is.
        occlusion_size: Texels of the ambient occlusion maps written with --to goliath; 0 leaves them out.
    """

    source: tyro.conf.Positional[Path]
    destination: tyro.conf.Positional[Path]
    from_format: Annotated[FormatName | None, tyro.conf.arg(name="from")] = None
    to_format: Annotated[Literal["goliath"] | None, tyro.conf.arg(name="to")] = None
    cameras: tuple[str, ...] = ()
    held_out_cameras: tuple[str, ...] = ()
    first_frame: int | None = None
    last_frame: int | None = None
    every: int = 1
    scale: float = 1.0
    image_extension: ImageExtension | None = None
    fps: float = 0.0
    test_frames: int = -1
    up: UpAxis = "auto"
    distortion: Distortion = "auto"
    assets: Path | None = None
    own_sizes: bool = False
    in_place: bool = False
    links: bool = False
    occlusion_size: int = 0


def run_conversion(command: ConvertCommand) -> None:
    """Convert, and print what was written, left out, and is still missing for a fit.

    Raises:
        ValueError, FileNotFoundError, FileExistsError: the command or a file cannot be used; the destination stays unfinished.
    """
    if (command.from_format is None) == (command.to_format is None):
        raise ValueError(
            f"convert(): expected --from FORMAT or --to goliath; got {command.from_format} and {command.to_format}. Give one of them."
        )
    if command.to_format is not None:
        if command.in_place:
            raise ValueError("convert(): expected --in-place with --from FORMAT; got it with --to goliath, which has its own layout.")
        _export(command)
    else:
        _import(command)


def _import(command: ConvertCommand) -> None:
    """Another format into ours."""
    options = SourceOptions(command.cameras, command.fps, command.test_frames, command.up, command.distortion, command.assets)
    source = with_frames(open_source(command.from_format, command.source, options), command.first_frame, command.last_frame)
    conversion = ConversionOptions(
        command.scale,
        command.held_out_cameras,
        command.image_extension,
        command.every,
        own_sizes=command.own_sizes or command.in_place,
        links=command.links,
        images_from=images_in_place(command.from_format, command.source, source, options) if command.in_place else None,
    )
    _print_summary(convert_with_body(source, command.destination, conversion, tracked), source)


def _export(command: ConvertCommand) -> None:
    """Ours into Goliath's."""
    capture = Capture.open(capture_folder(command.source, tracked), command.scale)
    body = None
    if capture.rig_path.is_file() and capture.theta is not None and capture.root is not None:
        rig = load_rig(capture.rig_path)
        occlusion = _occlusion(capture, rig, command.occlusion_size) if command.occlusion_size else None
        body = GoliathBody(momentum_from_rig(rig), momentum_poses(np.array(capture.theta), np.array(capture.root)), occlusion)
    path = write_goliath(capture, command.destination, body, tracked)
    console = Console()
    console.print(f"Wrote {len(capture.cameras)} cameras and {len(capture.frames)} frames to {path}.", highlight=False, soft_wrap=True)
    if body is None:
        console.print("Left out: body model and poses, because the capture has no rig.npz, pose.npy or root.npy.", highlight=False)


def _occlusion(capture: Capture, rig: Rig, size: int) -> Callable[[int], Float32[np.ndarray, "S S"]]:
    """Frame index -> ambient occlusion [S, S] of the registered mesh, or of the posed template."""
    # Imported here, because it loads Mitsuba, which no other conversion needs; a variant that is set already stays.
    loaded = sys.modules.get("mitsuba")
    if loaded is None or loaded.variant() is None:
        select_variant("auto")
    from mitsuba_avatar.rendering.ambient_occlusion import AmbientOcclusion

    tracer = AmbientOcclusion(rig.topology, size, OCCLUSION_RAYS, OCCLUSION_METRES)

    def occlusion(index: int) -> Float32[np.ndarray, "S S"]:
        if capture.vertices is not None:
            vertices = np.array(capture.vertices[index])
        else:
            vertices = posed_rest_surface(rig, capture.theta[index], capture.root[index])
        with torch.no_grad():
            return tracer.bake(torch.from_numpy(vertices)).cpu().numpy()

    return occlusion


def _print_summary(capture: Capture, source: Source) -> None:
    """What was converted, left out, and is missing."""
    console = Console()
    report = read_report(capture.path)

    def say(text: str) -> None:
        console.print(text, highlight=False, soft_wrap=True, markup=False)

    say(f"Wrote {len(capture.cameras)} cameras and {len(capture.frames)} frames to {capture.path}.")
    if capture.description.images_from is not None:
        say(f"Images stay in {capture.description.images_from.path}, and are straightened when they are read.")
    if report["remapped_cameras"]:
        say(f"Undistorted or resized: images of {len(report['remapped_cameras'])} cameras.")
    for reason, count in source.info.missing_reasons().items():
        say(f"Left out: {count} frames, {reason}.")
    for note in report["notes"]:
        say(f"Note: {note}.")
    lacks = list(report["lacks"]) + ([] if source.info.has_masks else ["masks of the person"])
    for what in lacks:
        say(f"Missing for a fit: {what}.")
    if lacks:
        say("`python -m mitsuba_avatar.register` makes masks and a body from images and keypoints.")
