"""Images and masks of a source as straight cameras see them: undistorted and resized in linear light, or left as they are."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, UInt8

from mitsuba_avatar.captures.cameras import Camera
from mitsuba_avatar.captures.colour import ColourCurve, decode_bytes, encode_bytes
from mitsuba_avatar.captures.formats.source import Source
from mitsuba_avatar.captures.images import EncodedImage
from mitsuba_avatar.captures.undistortion import Lens, Undistortion, undistorted_camera, undistortion

SAME_PIXELS = 1e-6  # pixels by which a camera may move before its images are remapped


def straight_cameras(
    cameras: Mapping[str, Camera], lenses: Mapping[str, Lens], scale: float = 1.0, own_sizes: bool = True
) -> dict[str, Camera]:
    """Cameras of the straight images: without distortion, each at its own size times `scale`, or all at one.

    One size is that of the smallest image; larger ones are resized and cut to its shape, so that every pixel has a source.
    """
    if own_sizes:
        sizes = {name: (max(1, round(scale * camera.width)), max(1, round(scale * camera.height))) for name, camera in cameras.items()}
        return {name: undistorted_camera(camera, lenses.get(name, Lens()), *sizes[name]) for name, camera in cameras.items()}
    smallest = min(cameras.values(), key=lambda camera: camera.width * camera.height)
    width, height = max(1, round(scale * smallest.width)), max(1, round(scale * smallest.height))
    return {name: undistorted_camera(camera, lenses.get(name, Lens()), width, height) for name, camera in cameras.items()}


@dataclass(frozen=True, eq=False)
class CameraPlan:
    """What happens to the images of one camera.

    Attributes:
        camera: the straight camera.
        remap: None where images stay as they are.
        colour_curve: of the images' values, before and after.
    """

    camera: Camera
    remap: Undistortion | None
    colour_curve: ColourCurve

    @staticmethod
    def of(source: Source, target: Camera) -> "CameraPlan":
        """Prepare a camera's remap, where it needs one.

        Raises:
            ValueError: if the target stands elsewhere than the source's camera of its name.
        """
        camera, lens = source.info.cameras[target.name], source.info.lenses.get(target.name, Lens())
        moved = [getattr(camera, key) - getattr(target, key) for key in ("width", "height", "fx", "fy", "cx", "cy")]
        is_same = lens.is_pinhole and np.abs(moved).max() < SAME_PIXELS
        return CameraPlan(target, None if is_same else undistortion(camera, target, lens), source.info.colour_curve)

    def image(self, pixels: UInt8[np.ndarray, "h w 3"], is_float: bool = False) -> EncodedImage:
        """An image as the straight camera sees it, in the same curve; bytes, or the linear values themselves."""
        if self.remap is None and not is_float:
            return pixels
        linear = decode_bytes(pixels, self.colour_curve)
        linear = linear if self.remap is None else self.remap.image(linear)
        return linear if is_float else encode_bytes(linear, self.colour_curve)

    def mask(self, mask: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "H W"]:
        """A mask as the straight camera sees it."""
        if self.remap is None:
            return mask
        coverage: Float32[np.ndarray, "H W"] = self.remap.mask(mask.astype(np.float32) / np.float32(255))
        return np.rint(255 * coverage.clip(0, 1)).astype(np.uint8)
