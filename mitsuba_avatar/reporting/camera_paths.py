"""Cameras that nobody built: paths around a person for videos and novel views."""

import math

import numpy as np
from jaxtyping import Float

from mitsuba_avatar.captures.cameras import Camera, look_at

HALF_FIELD = 0.25  # radians from the optical axis to the edge of what must be seen: a portrait lens


def orbit(
    points: Float[np.ndarray, "N 3"], count: int, width: int, height: int, elevation: float = 0.12, turns: float = 1.0
) -> list[Camera]:
    """Cameras on a circle that see all points from every side.

    Args:
        points: [N, 3] metres, for instance all vertices of a sequence, thinned.
        count: cameras.
        width, height: image size in pixels.
        elevation: radians above the horizon.
        turns: times around; the last camera stops one step short of the first, so that a video loops.
    """
    if count < 1:
        raise ValueError(f"orbit(): expected at least one camera; got {count}.")
    low, high = points.min(axis=0).astype(np.float64), points.max(axis=0).astype(np.float64)
    target = 0.5 * (low + high)
    radius = float(np.linalg.norm(points - target, axis=1).max())
    distance = radius / math.sin(HALF_FIELD)
    cameras = []
    for i in range(count):
        azimuth = 2 * math.pi * turns * i / count
        direction = np.array([math.sin(azimuth) * math.cos(elevation), -math.cos(azimuth) * math.cos(elevation), math.sin(elevation)])
        camera_from_world = look_at(target + distance * direction, target)
        focal = _focal_that_frames(points, camera_from_world, width, height)
        cameras.append(
            Camera(
                name=f"orbit_{i:04d}",
                width=width,
                height=height,
                fx=focal,
                fy=focal,
                cx=width / 2,
                cy=height / 2,
                camera_from_world=camera_from_world,
            )
        )
    tightest = min(camera.fx for camera in cameras)  # one lens for the whole path: a focal length that breathes makes viewers seasick
    return [Camera(**{**camera.__dict__, "fx": tightest, "fy": tightest}) for camera in cameras]


def _focal_that_frames(points: np.ndarray, camera_from_world: np.ndarray, width: int, height: int) -> float:
    """Longest focal length in pixels that keeps all points inside the image, less a margin of 4 %."""
    seen = points @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]
    slope = np.abs(seen[:, :2] / seen[:, 2:]).max(axis=0)
    return float(0.96 * min(0.5 * width / slope[0], 0.5 * height / slope[1]))
