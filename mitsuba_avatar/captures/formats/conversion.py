"""From any `Source` to a capture in our layout: straight images of one size, arrays, and a list of what is missing.

Image files that need no change are copied byte for byte after they were decoded once, so that none is damaged; others are undistorted and
resized in linear light. An interrupted conversion resumes; `capture.yaml` comes last.
"""

import json
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float32, UInt8

from mitsuba_avatar.captures.arrays import FRAME_ARRAYS
from mitsuba_avatar.captures.cameras import Camera
from mitsuba_avatar.captures.colour import decode_bytes, encode_bytes
from mitsuba_avatar.captures.description import CaptureDescription
from mitsuba_avatar.captures.folder import Capture, image_path
from mitsuba_avatar.captures.formats.files import FileSource
from mitsuba_avatar.captures.formats.source import Source
from mitsuba_avatar.captures.images import ImageExtension, write_image
from mitsuba_avatar.captures.undistortion import Lens, Undistortion, undistorted_camera, undistortion
from mitsuba_avatar.captures.writer import CaptureWriter
from mitsuba_avatar.files import atomic_path

REPORT_FILE = "conversion.json"
SAME_PIXELS = 1e-6  # pixels by which a camera may move before its images are remapped
Track = Callable[[Sequence, str], Iterable]


@dataclass(frozen=True)
class ConversionOptions:
    """How to convert.

    Attributes:
        scale: 0 < scale <= 1; images become smaller by it.
        held_out_cameras: cameras that no training may look at.
        image_extension: of the images to write; empty keeps the source's.
        every: keep each so-manieth frame.
        writes_vertices: whether registered meshes are written; their topology must come with a rig.
        own_sizes: whether every camera keeps the size of its images; otherwise all get that of the smallest.
        links: whether image files that need no change are linked to instead of copied, where the source has them as files.
    """

    scale: float = 1.0
    held_out_cameras: tuple[str, ...] = ()
    image_extension: ImageExtension | None = None
    every: int = 1
    writes_vertices: bool = False
    own_sizes: bool = False
    links: bool = False


def convert(
    source: Source,
    path: Path | str,
    options: ConversionOptions = ConversionOptions(),  # noqa: B008 - frozen
    add_body: Callable[[CaptureWriter, tuple[int, ...]], Sequence[str]] = lambda writer, indices: (),
    track: Track = lambda items, _: items,
) -> Capture:
    """Write a source as a capture of ours; `conversion.json` in it lists dropped frames and what a fit still needs.

    Args:
        source: read from.
        path: folder of the capture, new or left unfinished by an equal conversion.
        options: how.
        add_body: called with the writer, when everything else is written, and the source's indices of the frames that were kept;
            writes rig, poses and face signal, and returns notes for the report.
        track: called with a sequence and a description, yields its items; a progress bar.

    Returns:
        the capture, opened.

    Raises:
        FileExistsError: if the folder holds a finished capture or something else.
        FileNotFoundError, ValueError: for a damaged or missing file; the message names it, and the capture stays unfinished.
    """
    if not 0 < options.scale <= 1 or options.every < 1:
        raise ValueError(f"convert(): expected 0 < scale <= 1 and every >= 1; got {options.scale} and {options.every}. Correct them.")
    info = source.info
    indices = tuple(range(0, len(info.frames), options.every))
    cameras = straight_cameras(info.cameras, info.lenses, options.scale, options.own_sizes)
    description = CaptureDescription(
        name=info.name,
        fps=info.fps / options.every,
        colour_curve=info.colour_curve,
        keypoint_names=info.keypoint_names,
        held_out_cameras=options.held_out_cameras,
        image_extension=options.image_extension or info.image_extension,
        licence=info.licence,
        source=info.source,
    )
    writer = CaptureWriter(path, description, cameras, [info.frames[index] for index in indices])
    plans = [_plan(source, name, cameras[name]) for name in cameras]
    with ThreadPoolExecutor(max_workers=os.cpu_count()) as pool:
        for row in track(range(len(indices)), "Converting images"):
            # A list, so that the first complaint of a camera is raised here.
            list(pool.map(partial(_convert_pair, source, writer, (row, indices[row]), options.links), plans))
    for plan in plans:
        _write_background(source, writer, plan)
    _write_arrays(source, writer, indices, options.writes_vertices, track)
    notes = [*info.notes, *add_body(writer, indices)]
    _write_report(source, writer.path, notes, [plan.camera.name for plan in plans if plan.remap is not None])
    return writer.finish()


def straight_cameras(
    cameras: Mapping[str, Camera], lenses: Mapping[str, Lens], scale: float = 1.0, own_sizes: bool = True
) -> dict[str, Camera]:
    """Cameras of the converted images: without distortion, each at its own size times `scale`, or all at one.

    One size is that of the smallest image; larger ones are resized and cut to its shape, so that every pixel has a source.
    """
    if own_sizes:
        sizes = {name: (max(1, round(scale * camera.width)), max(1, round(scale * camera.height))) for name, camera in cameras.items()}
        return {name: undistorted_camera(camera, lenses.get(name, Lens()), *sizes[name]) for name, camera in cameras.items()}
    smallest = min(cameras.values(), key=lambda camera: camera.width * camera.height)
    width, height = max(1, round(scale * smallest.width)), max(1, round(scale * smallest.height))
    return {name: undistorted_camera(camera, lenses.get(name, Lens()), width, height) for name, camera in cameras.items()}


@dataclass(frozen=True, eq=False)
class _CameraPlan:
    """What happens to the images of one camera; without a remap they stay as they are."""

    camera: Camera
    remap: Undistortion | None


def _plan(source: Source, name: str, target: Camera) -> _CameraPlan:
    """Prepare a camera's remap, where it needs one."""
    camera, lens = source.info.cameras[name], source.info.lenses.get(name, Lens())
    moved = [getattr(camera, key) - getattr(target, key) for key in ("width", "height", "fx", "fy", "cx", "cy")]
    if lens.is_pinhole and np.abs(moved).max() < SAME_PIXELS:
        return _CameraPlan(target, None)
    return _CameraPlan(target, undistortion(camera, target, lens))


def _convert_pair(source: Source, writer: CaptureWriter, place: tuple[int, int], links: bool, plan: _CameraPlan) -> None:
    """Image and mask of one camera in one frame, unless they are there; `place` is the frame's row here and its index in the source."""
    name, (row, index) = plan.camera.name, place
    if source.info.has_masks and not writer.has_mask(name, row):
        mask = source.mask(name, index)
        if mask is None:
            raise FileNotFoundError(f"convert(): expected masks of every camera; got none of {name}. Name the cameras that have masks.")
        writer.write_mask(name, row, _remapped_mask(mask, plan.remap))
    if writer.has_image(name, row):
        return
    pixels = source.image(name, index)  # decoded even where it is copied, so that a damaged file is found here
    extension = writer.description.image_extension
    if plan.remap is not None or extension != source.info.image_extension:
        writer.write_image(name, row, _remapped_image(pixels, plan.remap, writer.description, extension))
        return
    with atomic_path(image_path(writer.path, name, writer.frames[row].number, extension)) as temporary:
        if links and isinstance(source, FileSource):
            temporary.symlink_to(Path(source.where(name, index)).resolve())
        else:
            temporary.write_bytes(source.encoded_image(name, index))


def _remapped_image(
    pixels: UInt8[np.ndarray, "h w 3"], remap: Undistortion | None, description: CaptureDescription, extension: str
) -> UInt8[np.ndarray, "H W 3"] | Float32[np.ndarray, "H W 3"]:
    """An image through the remap in linear light, in the capture's curve."""
    if remap is None and extension != "exr":
        return pixels
    linear = decode_bytes(pixels, description.colour_curve)
    linear = linear if remap is None else remap.image(linear)
    return linear if extension == "exr" else encode_bytes(linear, description.colour_curve)


def _remapped_mask(mask: UInt8[np.ndarray, "h w"], remap: Undistortion | None) -> UInt8[np.ndarray, "H W"]:
    """A mask through the remap."""
    if remap is None:
        return mask
    return np.rint(255 * remap.mask(mask.astype(np.float32) / np.float32(255)).clip(0, 1)).astype(np.uint8)


def _write_background(source: Source, writer: CaptureWriter, plan: _CameraPlan) -> None:
    """The plate of a camera, if the source has one."""
    plate = source.background(plan.camera.name)
    if plate is not None:
        extension = writer.description.image_extension
        path = writer.path / "backgrounds" / f"{plan.camera.name}.{extension}"
        write_image(path, _remapped_image(plate, plan.remap, writer.description, extension))


def _write_arrays(source: Source, writer: CaptureWriter, indices: tuple[int, ...], writes_vertices: bool, track: Track) -> None:
    """Keypoints and registered meshes, row by row: memory does not grow with the number of frames."""
    readers = {"keypoints": source.keypoints}
    if writes_vertices:
        readers["vertices"] = source.vertices
    for name, read in readers.items():
        path = writer.path / FRAME_ARRAYS[name].file_name
        first = read(indices[0])
        if first is None or path.is_file():
            continue
        with atomic_path(path) as temporary:
            rows = np.lib.format.open_memmap(temporary, mode="w+", dtype=np.float32, shape=(len(indices), *first.shape))
            for row in track(range(len(indices)), f"Converting {name}"):
                values = read(indices[row])
                if values is None or values.shape != first.shape:
                    got = "none" if values is None else list(values.shape)
                    raise ValueError(
                        f"convert(): expected {list(first.shape)} {name} in every frame; got {got} in frame "
                        f"{writer.frames[row].number}. Take all frames of one release."
                    )
                rows[row] = values
            rows.flush()
            del rows


def _write_report(source: Source, path: Path, notes: Sequence[str], remapped: Sequence[str]) -> None:
    """conversion.json: what was left out and why."""
    info = source.info
    document = {
        "source": info.source,
        "missing_frames": {str(frame.number): frame.reason for frame in info.missing},
        "remapped_cameras": list(remapped),
        "lacks": list(info.lacks),
        "notes": list(notes),
    }
    with atomic_path(path / REPORT_FILE) as temporary:
        temporary.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


def read_report(path: Path | str) -> dict:
    """Contents of a capture's conversion.json; empty if it was not converted."""
    file = Path(path) / REPORT_FILE
    return json.loads(file.read_text(encoding="utf-8")) if file.is_file() else {}


def with_frames(source: Source, first: int | None, last: int | None) -> Source:
    """The source without the frames whose numbers lie before `first` or after `last`; changes it in place.

    Raises:
        ValueError: if no frame is left.
    """
    kept = tuple(
        frame for frame in source.info.frames if (first is None or frame.number >= first) and (last is None or frame.number <= last)
    )
    if not kept:
        raise ValueError(
            f"with_frames(): expected frame numbers between {source.info.frames[0].number} and {source.info.frames[-1].number}; got "
            f"{first}..{last}. Correct them."
        )
    source.info = replace(source.info, frames=kept)
    return source
