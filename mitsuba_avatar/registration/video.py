"""Reading videos with PyAV, one frame at a time."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import av
import numpy as np
from jaxtyping import UInt8


@dataclass(frozen=True)
class VideoInfo:
    """What a video's header and packets tell: pixels, frames that can be shown, frames per second."""

    width: int
    height: int
    num_frames: int
    fps: float


def probe_video(path: Path | str) -> VideoInfo:
    """Size, number and rate of the frames. Packets are counted where the header does not say; none is decoded.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it cannot be read as video, or holds no frame.
    """
    path = Path(path)
    try:
        with av.open(str(path)) as container:
            if not container.streams.video:
                raise ValueError(f"probe_video(): expected a video stream in {path}; got none. Name a video.")
            stream = container.streams.video[0]
            count = stream.frames or sum(1 for packet in container.demux(stream) if packet.size)
            info = VideoInfo(stream.width, stream.height, count, float(stream.average_rate or 0))
    except av.error.FileNotFoundError as error:
        raise FileNotFoundError(f"probe_video(): expected a video at {path}; got none. Check the path.") from error
    except av.error.FFmpegError as error:
        raise _unreadable("probe_video", path, error) from error
    if info.num_frames < 1 or info.fps <= 0:
        raise ValueError(f"probe_video(): expected frames and a frame rate in {path}; got {info}. Encode the video again.")
    return info


def read_video(path: Path | str) -> Iterator[UInt8[np.ndarray, "H W 3"]]:
    """Frames [H, W, 3], sRGB-encoded bytes, in the order in which they are shown.

    Raises:
        ValueError: if a frame cannot be decoded; names the file and how far it went.
    """
    count = 0
    try:
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            stream.thread_type = "AUTO"
            for frame in container.decode(stream):
                yield frame.to_ndarray(format="rgb24")
                count += 1
    except av.error.FFmpegError as error:
        raise ValueError(
            f"read_video(): expected a whole video in {path}; got {count} frames, then: {error}. Copy or encode it again."
        ) from error


def _unreadable(function: str, path: Path, error: Exception) -> ValueError:
    return ValueError(f"{function}(): expected a video in {path}; got: {error}. Copy or encode it again.")
