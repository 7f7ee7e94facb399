"""Where a capture's images and masks come from: one interface, and the folders of our own layout.

A store speaks of cameras by name and of frames by number, and gives pixels as they are stored. Curves and scales are the capture's.
"""

import os
from abc import ABC, abstractmethod
from pathlib import Path

import numpy as np
from jaxtyping import Float32, UInt8

from mitsuba_avatar.captures.cameras import Camera
from mitsuba_avatar.captures.colour import ColourCurve, decode, decode_bytes
from mitsuba_avatar.captures.images import EncodedImage, ImageExtension, image_size, is_complete, read_image, read_mask

IMAGES_FOLDER = "images"
MASKS_FOLDER = "masks"


class ImageStore(ABC):
    """Images, masks and plates of a capture, read when asked for and never kept."""

    @property
    @abstractmethod
    def has_masks(self) -> bool:
        """Whether there are masks of the person; opens no image."""

    @property
    @abstractmethod
    def masks_place(self) -> str:
        """Where masks lie or would lie, as messages name it."""

    @abstractmethod
    def require(self) -> None:
        """Check, without reading images, that they can be read.

        Raises:
            FileNotFoundError, ValueError: they cannot; says why.
        """

    @abstractmethod
    def image(self, camera: Camera, number: int) -> EncodedImage:
        """Pixels [H, W, 3] of an image: uint8 or, for exr, float32.

        Raises:
            FileNotFoundError: if it is missing.
            ValueError: if it is damaged or its size is not the camera's.
        """

    def linear(self, camera: Camera, number: int, curve: ColourCurve) -> Float32[np.ndarray, "H W 3"]:
        """Linear values [H, W, 3] of an image whose pixels are on `curve`. Raises as `image`."""
        return decoded(self.image(camera, number), curve)

    @abstractmethod
    def mask(self, camera: Camera, number: int) -> UInt8[np.ndarray, "H W"]:
        """Coverage of the person [H, W], 0 to 255. Raises as `image`."""

    @abstractmethod
    def background(self, camera: Camera) -> EncodedImage | None:
        """What a camera sees without the person; None if there is no plate. Raises as `image`."""

    @abstractmethod
    def check_image(self, camera: Camera, number: int) -> None:
        """Check existence, size and end of an image, without decoding it where that can be had. Raises as `image`."""

    def check_mask(self, camera: Camera, number: int) -> None:
        """Check a mask, and that it is no image of labels 0 and 1. Raises as `image`."""
        if int(self.mask(camera, number).max()) == 1:
            where = self.where_mask(camera, number)
            raise ValueError(f"check_images(): expected a mask from 0 to 255 in {where}; got labels 0 and 1. Multiply by 255.")

    @abstractmethod
    def amount(self, kind: str, camera_name: str) -> tuple[int, int]:
        """Number of a camera's "images" or "masks", and their bytes on disk as far as they are the capture's own."""

    @abstractmethod
    def where_mask(self, camera: Camera, number: int) -> str:
        """A mask, as messages name it."""


class FolderImages(ImageStore):
    """images/<camera>/<frame:06d>.<extension>, masks/<camera>/<frame:06d>.png, backgrounds/<camera>.<extension> in a capture's folder."""

    def __init__(self, path: Path, extension: ImageExtension):
        self.path, self.extension = path, extension

    def image_path(self, camera_name: str, number: int) -> Path:
        """File of an image, present or not."""
        return image_path(self.path, camera_name, number, self.extension)

    def mask_path(self, camera_name: str, number: int) -> Path:
        """File of a mask, present or not."""
        return mask_path(self.path, camera_name, number)

    @property
    def has_masks(self) -> bool:
        """Whether there is a folder of masks."""
        return (self.path / MASKS_FOLDER).is_dir()

    @property
    def masks_place(self) -> str:
        """The folder of masks."""
        return str(self.path / MASKS_FOLDER)

    def require(self) -> None:
        """Files are missed when they are read: nothing to check."""

    def image(self, camera: Camera, number: int) -> EncodedImage:
        """Decode an image file. Raises as `ImageStore.image`."""
        path = self.image_path(camera.name, number)
        return _of_size(read_image(path), camera, path)

    def mask(self, camera: Camera, number: int) -> UInt8[np.ndarray, "H W"]:
        """Decode a mask file. Raises as `image`."""
        path = self.mask_path(camera.name, number)
        return _of_size(read_mask(path), camera, path)

    def background(self, camera: Camera) -> EncodedImage | None:
        """Decode a plate. Raises as `image`."""
        path = self.path / "backgrounds" / f"{camera.name}.{self.extension}"
        return _of_size(read_image(path), camera, path) if path.is_file() else None

    def check_image(self, camera: Camera, number: int) -> None:
        """Existence, size and end of an image file."""
        _check_file(self.image_path(camera.name, number), camera)

    def check_mask(self, camera: Camera, number: int) -> None:
        """Existence, size and end of a mask file, and its values."""
        _check_file(self.mask_path(camera.name, number), camera)
        super().check_mask(camera, number)

    def amount(self, kind: str, camera_name: str) -> tuple[int, int]:
        """Number and bytes of the files in a camera's folder; temporary files, whose names start with a dot, do not count."""
        folder = self.path / kind / camera_name
        if not folder.is_dir():
            return 0, 0
        with os.scandir(folder) as entries:
            sizes = [entry.stat().st_size for entry in entries if entry.is_file() and not entry.name.startswith(".")]
        return len(sizes), sum(sizes)

    def where_mask(self, camera: Camera, number: int) -> str:
        """The mask's file."""
        return str(self.mask_path(camera.name, number))


def image_path(folder: Path, camera_name: str, frame_number: int, extension: str) -> Path:
    """Where an image lies; by frame number, not index."""
    return folder / IMAGES_FOLDER / camera_name / f"{frame_number:06d}.{extension}"


def mask_path(folder: Path, camera_name: str, frame_number: int) -> Path:
    """Where a mask lies; by frame number, not index."""
    return folder / MASKS_FOLDER / camera_name / f"{frame_number:06d}.png"


def decoded(pixels: EncodedImage, curve: ColourCurve) -> Float32[np.ndarray, "H W 3"]:
    """Linear values of pixels as they are stored."""
    return decode_bytes(pixels, curve) if pixels.dtype == np.uint8 else decode(pixels, curve)


def _check_file(path: Path, camera: Camera) -> None:
    """Existence, size and end of one file."""
    size = image_size(path)
    if size != (camera.width, camera.height):
        raise ValueError(
            f"check_images(): expected {camera.width}x{camera.height} pixels, the size of {camera.name} in cameras.json, in {path}; "
            f"got {size[0]}x{size[1]}. Export it at the camera's size, or correct the camera."
        )
    if not is_complete(path):
        raise ValueError(f"check_images(): expected a whole image in {path}; got a truncated one. Copy or export it again.")


def _of_size(pixels: np.ndarray, camera: Camera, path: Path) -> np.ndarray:
    """The pixels, if their size is the camera's."""
    if pixels.shape[:2] != (camera.height, camera.width):
        raise ValueError(
            f"Capture: expected {camera.width}x{camera.height} pixels, the size of {camera.name} in cameras.json, in {path}; got "
            f"{pixels.shape[1]}x{pixels.shape[0]}. Store the camera at the images' size (Camera.resized scales the intrinsics)."
        )
    return pixels
