"""From any `Source` to a capture in our layout: straight images of one size, arrays, and a list of what is missing.

Image files that need no change are copied byte for byte after they were decoded once, so that none is damaged; others are undistorted and
resized in linear light. An interrupted conversion resumes; `capture.yaml` comes last.
"""

import json
import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from mitsuba_avatar.captures.arrays import FRAME_ARRAYS
from mitsuba_avatar.captures.description import CaptureDescription, ImagesFrom
from mitsuba_avatar.captures.folder import Capture
from mitsuba_avatar.captures.formats.files import FileSource
from mitsuba_avatar.captures.formats.source import Source
from mitsuba_avatar.captures.formats.straightening import CameraPlan, straight_cameras
from mitsuba_avatar.captures.image_store import image_path
from mitsuba_avatar.captures.images import ImageExtension, write_image
from mitsuba_avatar.captures.writer import CaptureWriter
from mitsuba_avatar.files import atomic_path

REPORT_FILE = "conversion.json"
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
        images_from: writes everything but images, masks and plates, which are then read there; None writes them too.
    """

    scale: float = 1.0
    held_out_cameras: tuple[str, ...] = ()
    image_extension: ImageExtension | None = None
    every: int = 1
    writes_vertices: bool = False
    own_sizes: bool = False
    links: bool = False
    images_from: ImagesFrom | None = None

    def __post_init__(self) -> None:
        if not 0 < self.scale <= 1 or self.every < 1:
            raise ValueError(
                f"ConversionOptions(): expected 0 < scale <= 1 and every >= 1; got {self.scale} and {self.every}. Correct them."
            )
        if self.images_from is not None and (self.links or self.image_extension not in (None, "exr")):
            raise ValueError(
                "ConversionOptions(): expected neither links nor another image format where images are read in place; got "
                f"links {self.links}, image_extension {self.image_extension}. Leave them out."
            )


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
        images_from=options.images_from,
        licence=info.licence,
        source=info.source,
    )
    writer = CaptureWriter(path, description, cameras, [info.frames[index] for index in indices])
    plans = [CameraPlan.of(source, camera) for camera in cameras.values()] if options.images_from is None else []
    with ThreadPoolExecutor(max_workers=os.cpu_count()) as pool:
        for row in track(range(len(indices)), "Converting images") if plans else ():
            # A list, so that the first complaint of a camera is raised here.
            list(pool.map(partial(_convert_pair, source, writer, (row, indices[row]), options.links), plans))
    for plan in plans:
        _write_background(source, writer, plan)
    _write_arrays(source, writer, indices, options.writes_vertices, track)
    notes = [*info.notes, *add_body(writer, indices)]
    _write_report(source, writer.path, notes, [plan.camera.name for plan in plans if plan.remap is not None])
    return writer.finish()


def _convert_pair(source: Source, writer: CaptureWriter, place: tuple[int, int], links: bool, plan: CameraPlan) -> None:
    """Image and mask of one camera in one frame, unless they are there; `place` is the frame's row here and its index in the source."""
    name, (row, index) = plan.camera.name, place
    if source.info.has_masks and not writer.has_mask(name, row):
        mask = source.mask(name, index)
        if mask is None:
            raise FileNotFoundError(f"convert(): expected masks of every camera; got none of {name}. Name the cameras that have masks.")
        writer.write_mask(name, row, plan.mask(mask))
    if writer.has_image(name, row):
        return
    pixels = source.image(name, index)  # decoded even where it is copied, so that a damaged file is found here
    extension = writer.description.image_extension
    if plan.remap is not None or extension != source.info.image_extension:
        writer.write_image(name, row, plan.image(pixels, is_float=extension == "exr"))
        return
    with atomic_path(image_path(writer.path, name, writer.frames[row].number, extension)) as temporary:
        if links and isinstance(source, FileSource):
            temporary.symlink_to(Path(source.where(name, index)).resolve())
        else:
            temporary.write_bytes(source.encoded_image(name, index))


def _write_background(source: Source, writer: CaptureWriter, plan: CameraPlan) -> None:
    """The plate of a camera, if the source has one."""
    plate = source.background(plan.camera.name)
    if plate is not None:
        extension = writer.description.image_extension
        path = writer.path / "backgrounds" / f"{plan.camera.name}.{extension}"
        write_image(path, plan.image(plate, is_float=extension == "exr"))


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
