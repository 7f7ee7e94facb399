"""A short video of a capture: two cameras side by side, take after take."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from mitsuba_avatar.captures.folder import Capture
from mitsuba_avatar.reporting.figures import to_bytes
from mitsuba_avatar.reporting.video import write_video

MOST_FRAMES = 300


def write_capture_video(capture: Capture, path: Path) -> None:
    """Encode the capture's frames (every k-th of a long one) as seen by the first training and the first held-out camera."""
    held_out = capture.camera_names(held_out=True)
    names = [capture.camera_names(held_out=False)[0], *held_out[:1]]
    step = -(-len(capture.frames) // MOST_FRAMES)

    def pictures() -> Iterator[UInt8[np.ndarray, "H W2 3"]]:
        for index in range(0, len(capture.frames), step):
            pictures = [to_bytes(capture.display_image(name, index)) for name in names]
            height = max(len(picture) for picture in pictures)
            # A smaller camera's picture gets black rows below.
            yield np.concatenate([np.pad(picture, ((0, height - len(picture)), (0, 0), (0, 0))) for picture in pictures], axis=1)

    write_video(path, pictures(), fps=capture.description.fps)
