"""H.264 video that every browser and player shows: yuv420p, Rec. 709, even sizes, index at the front of the file."""

from collections.abc import Iterable
from fractions import Fraction
from itertools import chain
from pathlib import Path

import av
import numpy as np
from jaxtyping import UInt8

from mitsuba_avatar.files import atomic_path

_CODEC = "libx264"
_REC_709 = 1  # ITU-T H.273 code of the primaries, the transfer curve and the matrix alike
_LIMITED_RANGE = 1  # FFmpeg's AVCOL_RANGE_MPEG: 16..235


def write_video(path: Path | str, frames: Iterable[UInt8[np.ndarray, "H W 3"]], fps: float, quality: int = 18) -> int:
    """Encode frames to MP4, whole or not at all; frames are taken one at a time, so memory does not grow with their number.

    Args:
        path: file to write, ending in `.mp4`.
        frames: display-encoded (sRGB) pictures of one size. An odd height or width is made even by repeating the last row or column.
        fps: frames per second.
        quality: x264's constant rate factor, 0 (lossless) to 51; 18 looks like the original.

    Returns:
        How many frames were written.

    Raises:
        ValueError: no frames, a change of size, or a frame rate that is not positive.
        OSError: if PyAV's FFmpeg lacks the encoder; the message says what to install.
        OSError: if the file cannot be written.
    """
    if not 0 < fps < float("inf"):
        raise ValueError(f"write_video(): expected a positive frame rate; got {fps}. Give frames per second.")
    iterator = iter(frames)
    first = next(iterator, None)
    if first is None:
        raise ValueError(f"write_video(): expected at least one frame for {path}; got none. Render one.")
    with atomic_path(path) as temporary, av.open(str(temporary), "w", format="mp4", options={"movflags": "faststart"}) as container:
        stream = _video_stream(container, _even(first).shape, fps, quality)
        count = 0
        for picture in chain([first], iterator):
            if picture.shape != first.shape:
                raise ValueError(
                    f"write_video(): expected every frame to be {first.shape}; got {picture.shape} for frame {count}. Resize it."
                )
            frame = av.VideoFrame.from_ndarray(_even(picture), format="rgb24")
            container.mux(stream.encode(frame.reformat(format="yuv420p", dst_colorspace="ITU709", dst_color_range="MPEG")))
            count += 1
        container.mux(stream.encode(None))
    return count


def centred(picture: UInt8[np.ndarray, "h w 3"], width: int, height: int, colour: UInt8[np.ndarray, "3"]) -> UInt8[np.ndarray, "H W 3"]:
    """A picture in the middle of a larger one of one colour: frames of several sizes make a video of the largest."""
    larger = np.empty((height, width, 3), np.uint8)
    larger[:] = colour
    top, left = (height - picture.shape[0]) // 2, (width - picture.shape[1]) // 2
    larger[top : top + picture.shape[0], left : left + picture.shape[1]] = picture
    return larger


def _video_stream(container: av.container.OutputContainer, shape: tuple[int, ...], fps: float, quality: int) -> av.VideoStream:
    try:
        stream = container.add_stream(_CODEC, rate=Fraction(fps).limit_denominator(1001))
    except av.codec.codec.UnknownCodecError as error:
        raise OSError(
            f"write_video(): expected an FFmpeg with the {_CODEC} encoder; this PyAV has none. "
            "Install PyAV's own wheel: pip install --force-reinstall av."
        ) from error
    stream.height, stream.width = shape[:2]
    stream.pix_fmt = "yuv420p"
    stream.options = {"crf": str(quality)}
    context = stream.codec_context
    context.color_primaries = context.color_trc = context.colorspace = _REC_709
    context.color_range = _LIMITED_RANGE
    return stream


def _even(picture: np.ndarray) -> np.ndarray:
    height, width = picture.shape[:2]
    return np.ascontiguousarray(np.pad(picture, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge"))
