"""Images that stay in a data set of another format: found there by camera and frame number, straightened when they are read.

A capture that reads in place is one of ours in everything but images, masks and plates; its capture.yaml says where those are
(`images_from`), its cameras.json how they are to be straightened. Nothing is unpacked, and what is read is what `capture convert` would
have written, before compression.
"""

from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
from jaxtyping import Float32, UInt8

from mitsuba_avatar.captures.cameras import Camera
from mitsuba_avatar.captures.colour import ColourCurve
from mitsuba_avatar.captures.description import CaptureDescription
from mitsuba_avatar.captures.formats.decoding import encoded_size
from mitsuba_avatar.captures.formats.opening import open_source
from mitsuba_avatar.captures.formats.source import Source, SourceOptions
from mitsuba_avatar.captures.formats.source_state import source_state
from mitsuba_avatar.captures.formats.straightening import CameraPlan
from mitsuba_avatar.captures.image_store import ImageStore
from mitsuba_avatar.captures.images import EncodedImage, is_whole

MAP_BYTES = 1 << 29  # of undistortion maps that are kept; those of a camera of 4 megapixels take 33 MB
BYTES_A_SAMPLE = 8  # of the maps: two float32 coordinates


class SourceImages(ImageStore):
    """Images of a capture that lie in another format's data set. The data set is opened when the first one is asked for.

    Args:
        path: the capture's folder, for messages and for a relative `images_from.path`.
        description: of the capture, with `images_from`.
        cameras: the capture's straight cameras.
    """

    def __init__(self, path: Path, description: CaptureDescription, cameras: dict[str, Camera]):
        self._where, self._description, self._cameras = path / "capture.yaml", description, cameras
        self._images_from = description.images_from
        self._folder = path / self._images_from.path
        largest = max(camera.width * camera.height for camera in cameras.values())
        self._plan = lru_cache(max(1, MAP_BYTES // (BYTES_A_SAMPLE * largest)))(self._make_plan)

    @property
    def has_masks(self) -> bool:
        """As the data set had them when the capture was made."""
        return self._images_from.has_masks

    @property
    def masks_place(self) -> str:
        """The data set."""
        return str(self._folder)

    def require(self) -> None:
        """Open the data set, and check that it has the capture's cameras and frames."""
        if self._source.info.has_masks != self.has_masks:
            raise self._changed("masks", "some" if self.has_masks else "none")

    def image(self, camera: Camera, number: int) -> EncodedImage:
        """Read an image where it lies, and straighten it. Raises as `ImageStore.image`."""
        is_float = self._description.image_extension == "exr"
        return self._plan(camera.name).image(self._source.image(camera.name, self._index(number)), is_float)

    def linear(self, camera: Camera, number: int, curve: ColourCurve) -> Float32[np.ndarray, "H W 3"]:
        """Read and straighten an image, not rounded to bytes again: faster, and closer to the data set than a conversion."""
        return self._plan(camera.name).image(self._source.image(camera.name, self._index(number)), is_float=True)

    def mask(self, camera: Camera, number: int) -> UInt8[np.ndarray, "H W"]:
        """Read a mask where it lies, and straighten it. Raises as `image`."""
        mask = self._source.mask(camera.name, self._index(number))
        if mask is None:
            raise FileNotFoundError(
                f"SourceImages: expected masks of every camera in {self._folder}; got none of {camera.name}. Name the cameras that have "
                "masks when the capture is made."
            )
        return self._plan(camera.name).mask(mask)

    def background(self, camera: Camera) -> EncodedImage | None:
        """Read a plate where it lies, and straighten it. Raises as `image`."""
        plate = self._source.background(camera.name)
        is_float = self._description.image_extension == "exr"
        return None if plate is None else self._plan(camera.name).image(plate, is_float)

    def check_image(self, camera: Camera, number: int) -> None:
        """Size and end of the encoded image; a zip compares its checksum as well."""
        index, native = self._index(number), self._source.info.cameras[camera.name]
        where, data = self._source.where(camera.name, index), self._source.encoded_image(camera.name, index)
        size = encoded_size(data, where)
        if size != (native.width, native.height):
            raise ValueError(
                f"check_images(): expected {native.width}x{native.height} pixels, the size of {camera.name}, in {where}; got "
                f"{size[0]}x{size[1]}. Take images and calibration of one release."
            )
        if not is_whole(data):
            raise ValueError(f"check_images(): expected a whole image in {where}; got a truncated one. Copy or export it again.")

    def amount(self, kind: str, camera_name: str) -> tuple[int, int]:
        """As many as the capture has frames, for the data set lists them; no bytes of the capture's own."""
        return (len(self._numbers) if kind == "images" or self.has_masks else 0), 0

    def where_mask(self, camera: Camera, number: int) -> str:
        """The mask, by the image that it belongs to."""
        return f"the mask of {self._source.where(camera.name, self._index(number))}"

    @cached_property
    def _source(self) -> Source:
        """The data set, opened, if it still is what the capture was made of."""
        wanted = self._images_from
        if not self._folder.is_dir():
            raise FileNotFoundError(
                f"SourceImages: expected the data set that {self._where} reads its images from at {self._folder}; got none. Bring it back, "
                "or correct images_from.path if it was moved."
            )
        if wanted.state and source_state(self._folder) != wanted.state:
            raise self._changed("files", f"those that it was made of (images_from.state {wanted.state})")
        options = SourceOptions(tuple(self._cameras), up=wanted.up, distortion=wanted.distortion, images_only=True)
        return open_source(wanted.format, self._folder, options)

    @cached_property
    def _numbers(self) -> dict[int, int]:
        """Frame number -> index in the data set."""
        return {frame.number: index for index, frame in enumerate(self._source.info.frames)}

    def _index(self, number: int) -> int:
        """A frame's index in the data set."""
        if number not in self._numbers:
            raise self._changed("frames", f"number {number} for every camera")
        return self._numbers[number]

    def _make_plan(self, camera_name: str) -> CameraPlan:
        """How a camera's images are straightened; maps of the cameras used last are kept."""
        return CameraPlan.of(self._source, self._cameras[camera_name])

    def _changed(self, what: str, expected: str) -> ValueError:
        """The complaint about a data set that is another one now."""
        return ValueError(
            f"SourceImages: expected {what} in {self._folder} as when {self._where} was made: {expected}; got others. Restore the data "
            "set, or make the capture again with `capture convert --in-place`."
        )
