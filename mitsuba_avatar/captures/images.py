"""Image files as they are stored: 8-bit colour (png, jpg, avif), float colour (exr), masks (8-bit grey png). No colour curve is applied.

Every complaint names the file. `is_complete` finds truncated files from a few bytes, so that thousands can be checked in seconds.
"""

import io
import struct
from pathlib import Path
from typing import Literal

import numpy as np
import OpenEXR
from jaxtyping import Float32, UInt8
from PIL import Image, UnidentifiedImageError

from mitsuba_avatar.files import atomic_path

ImageExtension = Literal["png", "jpg", "avif", "exr"]
IMAGE_EXTENSIONS: tuple[ImageExtension, ...] = ("png", "jpg", "avif", "exr")
# Lossy formats at a quality where the error stays below the noise of a camera.
SAVE_OPTIONS = {".png": {"compress_level": 4}, ".jpg": {"quality": 95, "subsampling": 0}, ".avif": {"quality": 90, "subsampling": "4:4:4"}}
# Modes whose values are 8 bits a channel; Pillow would silently squeeze the others (16-bit grey, float) into 8.
EIGHT_BIT_MODES = ("1", "L", "LA", "P", "PA", "RGB", "RGBA", "RGBX")
PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
PNG_DEPTH_BYTE = 24  # of the header chunk: bits a channel
HEADER_BYTES = PNG_DEPTH_BYTE + 1

EncodedImage = UInt8[np.ndarray, "H W 3"] | Float32[np.ndarray, "H W 3"]


def read_image(path: Path | str) -> EncodedImage:
    """Read a colour image as stored: [H, W, 3], uint8 (png, jpg, avif) or float32 (exr).

    Grey becomes three equal channels, alpha is dropped.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: for a truncated file, one that is no image, one with more than 8 bits a channel outside exr, or inks (CMYK).
    """
    path = _existing(path, "read_image")
    if path.suffix == ".exr":
        return _read_exr(path)
    return _read_eight_bits(path, "RGB", "read_image")


def read_mask(path: Path | str) -> UInt8[np.ndarray, "H W"]:
    """Read a mask as stored: [H, W], 0 background to 255 person. Raises as `read_image`."""
    return _read_eight_bits(_existing(path, "read_mask"), "L", "read_mask")


def image_size(path: Path | str) -> tuple[int, int]:
    """(width, height) in pixels from the file's header alone. Raises as `read_image`."""
    path = _existing(path, "image_size")
    try:
        if path.suffix == ".exr":
            box = OpenEXR.File(str(path), header_only=True).header()["dataWindow"]
            return int(box[1][0] - box[0][0] + 1), int(box[1][1] - box[0][1] + 1)
        with Image.open(path) as image:
            return image.size
    except (OSError, RuntimeError, ValueError, SyntaxError) as error:
        raise _unreadable(path, error, "image_size") from error


def write_image(path: Path | str, pixels: EncodedImage) -> None:
    """Write a colour image [H, W, 3], whole or absent; the ending of `path` decides the format.

    Raises:
        ValueError: for float values outside exr, bytes in an exr, or an unknown ending.
    """
    path = Path(path)
    expected = np.float32 if path.suffix == ".exr" else np.uint8
    if path.suffix[1:] not in IMAGE_EXTENSIONS or pixels.dtype != expected:
        raise ValueError(
            f"write_image(): expected uint8 pixels for png, jpg and avif, float32 for exr; got {pixels.dtype} for {path}. "
            "Encode with captures.colour.encode_bytes()."
        )
    with atomic_path(path) as temporary:
        if path.suffix == ".exr":
            header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
            with OpenEXR.File(header, {"RGB": np.ascontiguousarray(pixels)}) as exr:
                exr.write(str(temporary))
        else:
            Image.fromarray(pixels).save(temporary, **SAVE_OPTIONS[path.suffix])


def write_mask(path: Path | str, mask: UInt8[np.ndarray, "H W"]) -> None:
    """Write a mask [H, W], 0 background to 255 person, whole or absent."""
    with atomic_path(path) as temporary:
        Image.fromarray(mask).save(temporary, **SAVE_OPTIONS[".png"])


def is_complete(path: Path | str) -> bool:
    """Whether the file ends where its format says it must. Reads a few bytes; exr files are read whole.

    A file that passes may still hold damaged pixels in its middle.
    """
    path = _existing(path, "is_complete")
    if path.suffix == ".exr":
        try:
            _read_exr(path)
        except ValueError:
            return False
        return True
    with path.open("rb") as file:
        return _ends_well(file)


def is_whole(data: bytes) -> bool:
    """`is_complete` of the contents of a png, jpg or avif."""
    return _ends_well(io.BytesIO(data))


def _ends_well(file: io.BufferedIOBase) -> bool:
    """Whether a png, jpg or avif, told by its first bytes, ends as it must."""
    signature = file.read(12)
    size = file.seek(0, 2)
    if signature[4:8] == b"ftyp":
        return _boxes_fill_file(file, size)
    tail_length = min(size, 64)
    file.seek(size - tail_length)
    tail = file.read(tail_length)
    # PNG ends with its IEND chunk; JPEG with an end-of-image marker, after which some cameras pad.
    return tail[-8:-4] == b"IEND" if signature.startswith(PNG_SIGNATURE) else b"\xff\xd9" in tail


def require_eight_bits(image: Image.Image, header: bytes, where: Path | str, caller: str) -> None:
    """Refuse an opened image that a conversion to 8-bit grey or RGB would squeeze, or whose inks it would take for colours.

    Args:
        image: opened by Pillow.
        header: the file's first `HEADER_BYTES` bytes or more: Pillow opens 16-bit colour PNG as 8-bit RGB without a word.
        where, caller: for the message.

    Raises:
        ValueError: for more than 8 bits a channel, CMYK, or a mode of neither grey nor RGB.
    """
    depth = header[PNG_DEPTH_BYTE] if header.startswith(PNG_SIGNATURE) and len(header) >= HEADER_BYTES else 8
    if image.mode not in EIGHT_BIT_MODES or depth > 8:
        raise ValueError(
            f"{caller}(): expected 8 bits a channel of grey or RGB in {where}; got Pillow mode {image.mode!r}, {depth} bits. "
            "Store deeper images as linear exr or as 8 bits, CMYK as RGB, masks as 8-bit grey."
        )


def _boxes_fill_file(file: io.BufferedIOBase, size: int) -> bool:
    """Walk the top-level boxes of an ISO base media file (ISO/IEC 14496-12): they must end exactly at the file's end."""
    position = 0
    while position < size:
        file.seek(position)
        header = file.read(16)
        if len(header) < 8:
            return False
        length = struct.unpack(">I", header[:4])[0]
        if length == 1 and len(header) == 16:  # a 64-bit length follows the box's type
            length = struct.unpack(">Q", header[8:])[0]
        elif length == 0:  # the last box reaches to the file's end, wherever that is
            return True
        if length < 8:
            return False
        position += length
    return position == size and size > 0


def _read_eight_bits(path: Path, mode: str, caller: str) -> UInt8[np.ndarray, "H W *channels"]:
    """Decode with Pillow into `mode`, refusing what would lose bits."""
    try:
        with path.open("rb") as file, Image.open(path) as image:
            require_eight_bits(image, file.read(HEADER_BYTES), path, caller)
            return np.array(image.convert(mode))
    except (OSError, SyntaxError, Image.DecompressionBombError) as error:
        raise _unreadable(path, error, caller) from error


def _read_exr(path: Path) -> Float32[np.ndarray, "H W 3"]:
    """The RGB channels of an OpenEXR file in float32."""
    try:
        channels = OpenEXR.File(str(path), separate_channels=True).channels()
    except (RuntimeError, ValueError, TypeError) as error:
        raise _unreadable(path, error, "read_image") from error
    if not {"R", "G", "B"} <= set(channels):
        raise ValueError(f"read_image(): expected the channels R, G, B in {path}; got {sorted(channels)}. Write plain RGB.")
    return np.stack([np.asarray(channels[name].pixels, dtype=np.float32) for name in "RGB"], axis=-1)


def _existing(path: Path | str, caller: str) -> Path:
    """The path, if a file is there."""
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(
            f"{caller}(): expected an image at {path}; got none. Restore the file, or remove its frame from frames.csv."
        )
    return path


def _unreadable(path: Path, error: Exception, caller: str) -> ValueError:
    """The complaint about a file that is there and cannot be decoded."""
    reason = "it is no image" if isinstance(error, UnidentifiedImageError) else str(error)
    return ValueError(f"{caller}(): expected a whole image in {path}; got {path.stat().st_size} bytes: {reason}. Copy or export it again.")
