"""What a reader says of the data set that it opened: one place for what all data sets without a body of ours say alike."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from mitsuba_avatar.captures.cameras import Camera
from mitsuba_avatar.captures.formats.source import MissingFrame, SourceInfo, SourceOptions, timed_frames, turned_camera, up_notes
from mitsuba_avatar.captures.images import ImageExtension
from mitsuba_avatar.captures.undistortion import Lens


@dataclass(frozen=True, eq=False)
class Contents:
    """What a reader found in a folder.

    Attributes:
        native: cameras at the images' size, in metres and the data set's own world.
        world_from_native: [4, 4] rotation that turns that world upright.
        numbers: of the frames that every camera has.
        missing: of those left out.
        image_extension: of the image files.
        has_masks: whether there are masks.
        lenses: of the cameras, as stored.
        notes: what a user should know.
    """

    native: Mapping[str, Camera]
    world_from_native: Float64[np.ndarray, "4 4"]
    numbers: Sequence[int]
    missing: tuple[MissingFrame, ...]
    image_extension: ImageExtension
    has_masks: bool
    lenses: Mapping[str, Lens] = field(default_factory=dict)
    notes: Sequence[str] = ()


@dataclass(frozen=True)
class DataSet:
    """A data set without a body of ours.

    Attributes:
        name: of the data set.
        fps: of its frame numbers, unless the user says otherwise.
        body: what it has instead of a rig.
        licence: of the data set.
        folders: so many of the path's last folders name a capture of it.
        test_frames: of a sequence of more than twice as many, unless the user says otherwise; -1 for a tenth.
    """

    name: str
    fps: float
    body: str
    licence: str = ""
    folders: int = 1
    test_frames: int = -1

    def info(self, path: Path, options: SourceOptions, contents: Contents) -> SourceInfo:
        """What a source of this data set is; its cameras stand upright, and lenses are those that bend something and are not ignored."""
        fps, parts = options.fps or self.fps, path.resolve().parts[-self.folders :]
        is_long = len(contents.numbers) > 2 * self.test_frames
        test_frames = self.test_frames if options.test_frames < 0 and is_long else options.test_frames
        lenses = contents.lenses if options.distortion != "ignore" else {}
        return SourceInfo(
            name="_".join(parts),
            fps=fps,
            cameras={name: turned_camera(camera, contents.world_from_native) for name, camera in contents.native.items()},
            lenses={name: lens for name, lens in lenses.items() if not lens.is_pinhole},
            frames=timed_frames(contents.numbers, fps, test_frames),
            missing=contents.missing,
            image_extension=contents.image_extension,
            has_masks=contents.has_masks,
            lacks=(f"the body: rig.npz, pose.npy, root.npy, face.npy, vertices.npy ({self.body})",),
            notes=(*contents.notes, *up_notes(contents.native.values(), contents.world_from_native, options, path)),
            licence=self.licence,
            source=f"{self.name} {'/'.join(parts)}",
        )
