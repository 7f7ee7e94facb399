"""Captures of other formats with their bodies: converted, or as a small capture that reads its images in place.

The readers know files, the rig knows poses; here they meet.
"""

import hashlib
import os
import shutil
import uuid
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from mitsuba_avatar.body.momentum_rig import face_signal, rig_from_momentum
from mitsuba_avatar.body.rig import save_rig
from mitsuba_avatar.captures.arrays import open_frame_array
from mitsuba_avatar.captures.description import ImagesFrom
from mitsuba_avatar.captures.folder import DESCRIPTION_FILE, Capture
from mitsuba_avatar.captures.formats.conversion import ConversionOptions, Track, convert
from mitsuba_avatar.captures.formats.goliath import GoliathSource, find_assets
from mitsuba_avatar.captures.formats.opening import FormatName, SourceName, open_source
from mitsuba_avatar.captures.formats.source import Source, SourceOptions
from mitsuba_avatar.captures.formats.source_state import source_state
from mitsuba_avatar.captures.writer import CaptureWriter
from mitsuba_avatar.files import cache_folder

LAYOUT_VERSION = 1  # of the captures in the cache; another one is made anew


def convert_with_body(source: Source, path: Path, options: ConversionOptions, track: Track = lambda items, _: items) -> Capture:
    """`captures.formats.conversion.convert`, with rig, poses and face signal where the source has a body model that we know."""
    if not isinstance(source, GoliathSource) or not source.tracking_is_there:
        return convert(source, path, options, track=track)
    return convert(source, path, replace(options, writes_vertices=True), _MomentumBody(source).add, track)


def images_in_place(format_name: FormatName, path: Path, source: Source, options: SourceOptions) -> ImagesFrom:
    """Where a capture finds the images of this source."""
    return ImagesFrom(format_name, str(path.resolve()), source_state(path), source.info.has_masks, options.up, options.distortion)


def capture_folder(name: str | Path, track: Track = lambda items, _: items) -> Path:
    """Folder of a capture as commands name it.

    Args:
        name: the folder itself, or FORMAT:DIR, a data set of another format. For that, a capture which reads its images in place is made in
            the cache on first use, and again when the data set has changed; it holds cameras, frames, poses and meshes.
        track: called with a sequence and a description, yields its items; a progress bar.

    Raises:
        FileNotFoundError, ValueError: the format is unknown, or the data set cannot be read.
    """
    source_name = SourceName.parse(str(name))
    if source_name is None:
        return Path(name)
    place, leaf = cache_folder() / "in_place" / _digest(source_name), source_name.path.resolve().name
    # A body model may be laid beside a capture later.
    has_body = source_name.format == "goliath" and find_assets(source_name.path) is not None
    current = place / (source_state(source_name.path) + ("-body" if has_body else ""))
    if (current / leaf / DESCRIPTION_FILE).is_file():
        return current / leaf
    source = open_source(source_name.format, source_name.path)
    images_from = images_in_place(source_name.format, source_name.path, source, SourceOptions())
    building = place / f".{uuid.uuid4().hex[:8]}"
    try:
        convert_with_body(source, building / leaf, ConversionOptions(own_sizes=True, images_from=images_from), track)
        for older in place.iterdir():  # of earlier states of the data set
            if older.name != current.name and not older.name.startswith("."):
                shutil.rmtree(older)
        try:
            os.rename(building, current)
        except OSError:
            if not (current / leaf / DESCRIPTION_FILE).is_file():  # otherwise another process was as fast
                raise
    finally:
        shutil.rmtree(building, ignore_errors=True)
    return current / leaf


def _digest(source_name: SourceName) -> str:
    """What tells data sets apart, whatever their folders are called."""
    text = f"{LAYOUT_VERSION} {source_name.format} {source_name.path.resolve()}"
    return f"{source_name.format}-{hashlib.sha256(text.encode()).hexdigest()[:12]}"


class _MomentumBody:
    """Adds the rig of a Goliath capture, its poses, and the face signal of its registered meshes."""

    def __init__(self, source: GoliathSource):
        self.source = source

    def add(self, writer: CaptureWriter, indices: tuple[int, ...]) -> Sequence[str]:
        """Write rig, poses and face; returns what the rig cannot do."""
        tracking = self.source.tracking()
        tracked = rig_from_momentum(tracking)
        rows = list(indices)
        theta, root = tracked.theta[rows], tracked.root[rows]
        with TemporaryDirectory() as folder:
            save_rig(Path(folder) / "rig.npz", tracked.rig)
            writer.write_rig(Path(folder) / "rig.npz")
        writer.write_arrays(theta=theta, root=root)
        vertices = open_frame_array(writer.path, "vertices", len(rows))
        if vertices is None:
            return (*tracked.notes, "no registered meshes: no face signal, and model.use_latent must be false")
        if vertices.shape[1] != tracked.rig.topology.num_vertices:
            raise ValueError(
                f"convert(): expected {tracked.rig.topology.num_vertices} registered vertices, those of {self.source.assets_path}; got "
                f"{vertices.shape[1]}. Take model and capture of one release."
            )
        writer.write_arrays(face=face_signal(tracked.rig, theta, root, vertices))
        return tracked.notes
