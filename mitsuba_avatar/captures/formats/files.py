"""Data sets whose images lie as single files, a folder for each camera: what their readers share."""

import re
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from mitsuba_avatar.captures.cameras import Camera
from mitsuba_avatar.captures.formats.decoding import decode_grey, decode_labels, encoded_size, require_file
from mitsuba_avatar.captures.formats.source import Source, SourceInfo
from mitsuba_avatar.captures.images import ImageExtension

EXTENSIONS: Mapping[str, ImageExtension] = {".jpg": "jpg", ".jpeg": "jpg", ".JPG": "jpg", ".png": "png", ".avif": "avif"}
FilesByFrame = dict[str, dict[int, Path]]  # camera -> frame number -> file


class FileSource(Source):
    """A source of plain image files.

    Attributes:
        images, masks: camera -> frame number -> file.
        mask_is_label: whether masks hold labels (anything but 0 is the person) instead of coverage.
    """

    def __init__(self, info: SourceInfo, images: FilesByFrame, masks: FilesByFrame, mask_is_label: bool = False):
        self.info, self.images, self.masks, self.mask_is_label = info, images, masks, mask_is_label

    def where(self, camera_name: str, frame_index: int) -> str:
        """The image file."""
        return str(self.images[camera_name][self.info.frames[frame_index].number])

    def encoded_image(self, camera_name: str, frame_index: int) -> bytes:
        """Bytes of the image file. Raises as `Source.encoded_image`."""
        return require_file(self.images[camera_name][self.info.frames[frame_index].number]).read_bytes()

    def mask(self, camera_name: str, frame_index: int) -> UInt8[np.ndarray, "H W"] | None:
        """Coverage of the person; None if the data set has none. Raises as `image`."""
        path = self.masks.get(camera_name, {}).get(self.info.frames[frame_index].number)
        if path is None:
            return None
        data = require_file(path).read_bytes()
        if self.mask_is_label:
            mask = np.where(decode_labels(data, str(path)) != 0, np.uint8(255), np.uint8(0))
        else:
            mask = decode_grey(data, str(path))
        self._check_size(mask, camera_name, str(path))
        return mask


def files_by_number(folder: Path, pattern: str = r"(\d+)") -> dict[int, Path]:
    """Image files of a folder by frame number; the number is the first group of `pattern`, which the name without ending must match."""
    if not folder.is_dir():
        return {}
    found = {}
    for path in sorted(folder.iterdir()):
        match = re.fullmatch(pattern, path.stem)
        if match and path.suffix in EXTENSIONS:
            found[int(match.group(1))] = path
    return found


def first_size(files: Mapping[int, Path]) -> tuple[int, int]:
    """(width, height) of the first of a camera's images."""
    path = files[min(files)]
    return encoded_size(path.read_bytes(), str(path))


def extension_of(images: FilesByFrame) -> ImageExtension:
    """The ending that a source's images have."""
    files = next(iter(images.values()))
    return EXTENSIONS[files[min(files)].suffix]


def needed(images: FilesByFrame, masks: FilesByFrame) -> dict[str, Iterable[int]]:
    """What each frame needs, as `common_frames` takes it: an image of every camera, and a mask if any camera has masks."""
    available: dict[str, Iterable[int]] = {f"image of {name}": files for name, files in images.items()}
    if any(masks.values()):
        available |= {f"mask of {name}": masks.get(name, {}) for name in images}
    return available


def camera_from_matrices(
    name: str, size: tuple[int, int], intrinsics: np.ndarray, rotation: np.ndarray, translation: np.ndarray, where: Path
) -> Camera:
    """A camera of OpenCV's matrices: world to camera, metres, pixel centres at integers.

    Raises:
        ValueError: for matrices of another shape, or that are no camera's; names file and camera.
    """
    if intrinsics.shape != (3, 3) or rotation.shape != (3, 3) or translation.size != 3:
        raise ValueError(
            f"camera_from_matrices(): expected K and R of 3x3 and T of 3 numbers for {name} in {where}; got {list(intrinsics.shape)}, "
            f"{list(rotation.shape)} and {translation.size}. Calibrate again, or correct the file."
        )
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, translation.ravel()
    try:
        return Camera(
            name,
            *size,
            float(intrinsics[0, 0]),
            float(intrinsics[1, 1]),
            float(intrinsics[0, 2]) + 0.5,
            float(intrinsics[1, 2]) + 0.5,
            pose,
        )
    except ValueError as error:
        raise ValueError(f"camera_from_matrices(): {name} of {where} is not usable. {error}") from error
