"""Small corrections of a calibration from the keypoints of a whole recording: bundle adjustment of the cameras' poses.

Cameras sag, are touched, and are calibrated with another tool than the one that reads them; a few tenths of a degree are ten pixels. All
landmarks of all frames are moved together with all cameras until they agree, robustly; priors keep the cameras near the calibration and
with it the world's place and size. Lenses are left alone.

Symbols: C cameras, P points (landmarks of all frames). Pixels of the full cameras; metres, radians.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from mitsuba_avatar.captures.cameras import Camera
from mitsuba_avatar.registration.body_sequence import rotation_matrices
from mitsuba_avatar.registration.keypoints_3d import REFERENCE_HEIGHT, PersonKeypoints

STEPS = 300
POINT_STEP, CAMERA_STEP = 3e-3, 6e-4  # of Adam: metres, and radians or metres
DEVIATION = 12.0  # reference pixels of a detection
ROBUSTNESS = 3.0  # deviations from which a detection is an outlier
MOST_POINTS = 1500  # evenly chosen: more do not sharpen six numbers a camera


@dataclass(frozen=True, eq=False)
class RefinedCameras:
    """Corrected cameras.

    Attributes:
        camera_from_world: name -> [4, 4].
        turned: name -> radians from the calibration. shifted: name -> metres of its centre.
    """

    camera_from_world: dict[str, Float64[np.ndarray, "4 4"]]
    turned: dict[str, float]
    shifted: dict[str, float]

    def apply(self, cameras: Mapping[str, Camera]) -> dict[str, Camera]:
        """Cameras of the same names with corrected poses; images need no change, because only extrinsics move."""
        return {name: replace(camera, camera_from_world=self.camera_from_world[name]) for name, camera in cameras.items()}


def unrefined(cameras: Mapping[str, Camera]) -> RefinedCameras:
    """The calibration as it is."""
    zeros = dict.fromkeys(cameras, 0.0)
    return RefinedCameras({name: camera.camera_from_world for name, camera in cameras.items()}, zeros, dict(zeros))


def refine_cameras(cameras: Mapping[str, Camera], keypoints: PersonKeypoints, turn: float, shift: float) -> RefinedCameras:
    """Bring cameras to agree on a person's keypoints.

    Args:
        cameras: full cameras by name, in the order of the observations.
        keypoints: with points triangulated by those cameras.
        turn, shift: standard deviations of the corrections, radians and metres.
    """
    flat = keypoints.observations.transpose(1, 0, 2, 3).reshape(len(cameras), -1, 3)
    points = keypoints.positions.reshape(-1, 4)
    known = np.flatnonzero(points[:, 3] > 0)
    known = known[np.unique(np.linspace(0, len(known) - 1, min(MOST_POINTS, len(known))).round().astype(int))]
    problem = _Bundle(list(cameras.values()), np.nan_to_num(flat[:, known]), points[known, :3])
    optimizer = torch.optim.Adam(
        [{"params": [problem.points], "lr": POINT_STEP}, {"params": [problem.turns, problem.shifts], "lr": CAMERA_STEP}]
    )
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, STEPS)
    for _ in range(STEPS):
        optimizer.zero_grad()
        priors = (problem.turns / turn).square().sum() + (problem.shifts / shift).square().sum()
        (problem.energy() + priors / len(known)).backward()
        optimizer.step()
        schedule.step()
    return problem.result(list(cameras))


class _Bundle:
    """Points, and cameras turned about their own centres and shifted."""

    def __init__(self, cameras: list[Camera], observations: Float64[np.ndarray, "C P 3"], points: Float64[np.ndarray, "P 3"]):
        self.cameras = cameras
        self.rotations = torch.from_numpy(np.stack([camera.camera_from_world[:3, :3] for camera in cameras]))
        self.centres = torch.from_numpy(np.stack([camera.center_world for camera in cameras]))
        self.intrinsics = torch.tensor([[c.fx, c.fy, c.cx, c.cy] for c in cameras], dtype=torch.float64)
        self.pixels, self.confidence = torch.from_numpy(observations[..., :2]), torch.from_numpy(observations[..., 2])
        self.deviation = DEVIATION * cameras[0].height / REFERENCE_HEIGHT
        self.points = torch.from_numpy(points.copy()).requires_grad_()
        self.turns = torch.zeros(len(cameras), 3, dtype=torch.float64, requires_grad=True)
        self.shifts = torch.zeros(len(cameras), 3, dtype=torch.float64, requires_grad=True)

    def extrinsics(self) -> tuple[Float[Tensor, "C 3 3"], Float[Tensor, "C 3"]]:
        """Rotations camera_from_world, and centres in the world."""
        return rotation_matrices(self.turns) @ self.rotations, self.centres + self.shifts

    def energy(self) -> Tensor:
        """Mean robust error per unit of confidence."""
        rotations, centres = self.extrinsics()
        seen = torch.einsum("cij,cpj->cpi", rotations, self.points - centres[:, None])
        pixels = seen[..., :2] / seen[..., 2:].clamp(min=1e-2) * self.intrinsics[:, None, :2] + self.intrinsics[:, None, 2:]
        squared = ((pixels - self.pixels) / self.deviation).square().sum(-1)
        return (self.confidence * squared / (1 + squared / ROBUSTNESS**2)).sum() / self.confidence.sum()

    def result(self, names: list[str]) -> RefinedCameras:
        with torch.no_grad():
            rotations, centres = (part.numpy() for part in self.extrinsics())
        poses = {}
        for index, name in enumerate(names):
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = rotations[index], -rotations[index] @ centres[index]
            poses[name] = pose
        turned = torch.linalg.vector_norm(self.turns.detach(), dim=1).tolist()
        shifted = torch.linalg.vector_norm(self.shifts.detach(), dim=1).tolist()
        return RefinedCameras(poses, dict(zip(names, turned, strict=True)), dict(zip(names, shifted, strict=True)))
