"""Cameras as the renderer takes them: one row a view, in torch."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mitsuba_avatar.captures.cameras import Camera


@dataclass(frozen=True)
class CameraBatch:
    """B pinhole cameras, OpenCV axes, pixel origin at the image's corner. Cameras carry no gradient.

    Attributes:
        intrinsics: [B, 4] fx, fy, cx, cy in pixels.
        camera_from_world: [B, 4, 4] rigid, metres.
    """

    intrinsics: Float[Tensor, "B 4"]
    camera_from_world: Float[Tensor, "B 4 4"]

    @staticmethod
    def from_cameras(cameras: Sequence[Camera]) -> "CameraBatch":
        """Stack cameras of a capture. They must be free of distortion: images are undistorted where they are read.

        Raises:
            ValueError: a camera has distortion.
        """
        for camera in cameras:
            if any(camera.distortion):
                raise ValueError(
                    f"CameraBatch.from_cameras(): expected pinhole cameras; {camera.name!r} has distortion {tuple(camera.distortion)}. "
                    "Undistort its images and set the distortion to zero."
                )
        intrinsics = np.array([[camera.fx, camera.fy, camera.cx, camera.cy] for camera in cameras], np.float32)
        poses = np.stack([camera.camera_from_world for camera in cameras]).astype(np.float32)
        return CameraBatch(torch.from_numpy(intrinsics), torch.from_numpy(poses))

    def __len__(self) -> int:
        return len(self.intrinsics)

    @property
    def centers(self) -> Float[Tensor, "B 3"]:
        """[B, 3] camera centres in world axes, metres."""
        rotation, translation = self.camera_from_world[:, :3, :3], self.camera_from_world[:, :3, 3]
        return -(rotation.transpose(1, 2) @ translation[:, :, None])[:, :, 0]

    def shifted(self, corner: Float[Tensor, "B 2"]) -> "CameraBatch":
        """Views of a crop whose upper left corner lies at `corner` (x, y pixels): only the principal points move, no kernel recompiles."""
        intrinsics = self.intrinsics.clone()
        intrinsics[:, 2:] -= corner
        return CameraBatch(intrinsics, self.camera_from_world)

    def repeat_interleave(self, repeats: int) -> "CameraBatch":
        """Every camera `repeats` times in a row."""
        return CameraBatch(self.intrinsics.repeat_interleave(repeats, 0), self.camera_from_world.repeat_interleave(repeats, 0))
