"""The per-frame arrays of a capture: one .npy file each, float32, first axis the frame index, opened memory-mapped.

| name | file | shape | holds |
|---|---|---|---|
| theta | pose.npy | [N, D] | joint angles, radians, in the order of the rig's dof table |
| root | root.npy | [N, 4, 4] | world_from_root, rigid, metres |
| face | face.npy | [N, F] | face signal, see CaptureDescription.face_signal |
| keypoints | keypoints.npy | [N, K, 4] | x, y, z in metres (world), confidence |
| vertices | vertices.npy | [N, V, 3] | registered mesh in the rig's topology, metres (world) |
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from mitsuba_avatar.files import atomic_path


@dataclass(frozen=True)
class FrameArray:
    """Where an array lies and which shape it has behind the frame axis; None is a free size."""

    file_name: str
    row_shape: tuple[int | None, ...]

    def describe(self, num_frames: int) -> str:
        """The expected shape in words, "[30, any, 3]" say."""
        return "[" + ", ".join([str(num_frames), *("any" if size is None else str(size) for size in self.row_shape)]) + "]"

    def fits(self, shape: tuple[int, ...], num_frames: int) -> bool:
        """Whether an array of this shape may lie here."""
        expected = (num_frames, *self.row_shape)
        return len(shape) == len(expected) and all(size is None or size == got for size, got in zip(expected, shape, strict=True))


FRAME_ARRAYS = {
    "theta": FrameArray("pose.npy", (None,)),
    "root": FrameArray("root.npy", (4, 4)),
    "face": FrameArray("face.npy", (None,)),
    "keypoints": FrameArray("keypoints.npy", (None, 4)),
    "vertices": FrameArray("vertices.npy", (None, 3)),
}


def open_frame_array(folder: Path, name: str, num_frames: int) -> Float32[np.ndarray, "N *row"] | None:
    """Map an array of a capture into memory, read-only; rows are read when touched.

    Args:
        folder: of the capture.
        name: key of FRAME_ARRAYS.
        num_frames: N, rows of frames.csv.

    Returns:
        [N, ...], or None if the capture has no such file.

    Raises:
        ValueError: for a truncated file, one that is no plain array, another shape, or a type other than float32.
    """
    kind = FRAME_ARRAYS[name]
    path = folder / kind.file_name
    if not path.is_file():
        return None
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except (ValueError, EOFError) as error:
        raise ValueError(
            f"open_frame_array(): expected a whole array in {path}; got {path.stat().st_size} bytes: {error}. Write it again."
        ) from error
    if array.dtype != np.float32 or not kind.fits(array.shape, num_frames):
        raise ValueError(
            f"open_frame_array(): expected float32 {kind.describe(num_frames)} ({name}, a row for each frame of frames.csv) in {path}; "
            f"got {array.dtype} {list(array.shape)}. Save it as float32 with np.save() and list the same frames."
        )
    return array


def save_frame_array(folder: Path, name: str, values: np.ndarray, num_frames: int) -> None:
    """Write an array of a capture as float32; the file is whole or absent.

    Raises:
        ValueError: for an unknown name or another shape.
    """
    if name not in FRAME_ARRAYS or not FRAME_ARRAYS[name].fits(values.shape, num_frames):
        expected = {key: kind.describe(num_frames) for key, kind in FRAME_ARRAYS.items()}
        raise ValueError(
            f"save_frame_array(): expected one of {expected}; got {name!r} with {list(values.shape)}. Give a row for each frame."
        )
    with atomic_path(folder / FRAME_ARRAYS[name].file_name) as temporary:
        np.save(temporary, np.asarray(values, dtype=np.float32))
