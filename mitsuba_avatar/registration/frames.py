"""Frames of the videos as the registration sees them: undistorted, cut and resized in linear light once, kept as files."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float32, UInt8

from mitsuba_avatar.captures.cameras import Camera
from mitsuba_avatar.captures.colour import decode_bytes, encode_bytes
from mitsuba_avatar.captures.images import is_complete, read_image, read_mask, write_image, write_mask
from mitsuba_avatar.captures.undistortion import undistorted_camera, undistortion
from mitsuba_avatar.registration.recording import Recording
from mitsuba_avatar.registration.video import read_video


@dataclass(frozen=True, eq=False)
class FrameFolder:
    """Where frames lie and which cameras see them.

    Attributes:
        path: folder.
        cameras: name -> undistorted camera of the capture.
        num_frames: of every camera.
    """

    path: Path
    cameras: dict[str, Camera]
    num_frames: int

    def image(self, camera: str, frame: int) -> UInt8[np.ndarray, "H W 3"]:
        """An image of the capture's size, sRGB bytes."""
        return read_image(self.image_path(camera, frame))

    def given_mask(self, camera: str, frame: int) -> Float32[np.ndarray, "H W"]:
        """A mask that came with the videos, coverage 0..1."""
        return read_mask(self.mask_path(camera, frame)).astype(np.float32) / np.float32(255)

    def image_path(self, camera: str, frame: int) -> Path:
        """File of an image."""
        return self.path / "images" / camera / f"{frame:06d}.png"

    def mask_path(self, camera: str, frame: int) -> Path:
        """File of a mask that came with the videos, undistorted."""
        return self.path / "given_masks" / camera / f"{frame:06d}.png"


def capture_cameras(recording: Recording, width: int, height: int) -> dict[str, Camera]:
    """Undistorted cameras of one size: each sees as much of its video as fits that shape.

    Raises:
        ValueError: if a lens model cannot be inverted; names the camera.
    """
    return {name: undistorted_camera(view.camera, width=width, height=height) for name, view in recording.views.items()}


def full_cameras(recording: Recording, cameras: dict[str, Camera]) -> dict[str, Camera]:
    """The same views with as many rows as their videos have: in their pixels errors are reported."""
    return {name: camera.resized(recording.views[name].camera.height / camera.height) for name, camera in cameras.items()}


def undistort_videos(recording: Recording, folder: FrameFolder, progress: Callable[[int, int], None]) -> None:
    """Write what is missing of all frames (and of masks that came along).

    Raises:
        ValueError: if a video ends early or cannot be decoded.
    """
    total = recording.num_frames * len(recording.views)
    for index, (name, view) in enumerate(recording.views.items()):
        target = folder.cameras[name]
        # Corrections of the calibration move cameras; lens and image stay what they are.
        straight = undistortion(replace(view.camera, camera_from_world=target.camera_from_world), target)
        missing = {frame for frame in range(recording.num_frames) if not _is_there(folder, name, frame, recording.has_masks)}
        count = 0
        for frame, pixels in enumerate(read_video(view.video) if missing else ()):
            count = frame + 1
            if frame in missing:
                write_image(folder.image_path(name, frame), encode_bytes(straight.image(decode_bytes(pixels, "srgb")), "srgb"))
                if recording.has_masks:
                    coverage = straight.mask(read_mask(view.masks[frame]).astype(np.float32) / np.float32(255))
                    write_mask(folder.mask_path(name, frame), np.rint(255 * coverage).astype(np.uint8))
            progress(index * recording.num_frames + min(count, recording.num_frames), total)
        if missing and count < recording.num_frames:
            raise ValueError(
                f"undistort_videos(): expected {recording.num_frames} frames in {view.video}; got {count}. "
                "The file is cut short: copy or encode it again."
            )


def _is_there(folder: FrameFolder, name: str, frame: int, has_masks: bool) -> bool:
    paths = [folder.image_path(name, frame)] + ([folder.mask_path(name, frame)] if has_masks else [])
    return all(path.is_file() and is_complete(path) for path in paths)
