"""The camera of a browser's window, as the renderer takes it: pictures keep one of a few sizes, the window stretches them to its own."""

import math

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from mitsuba_avatar.captures.cameras import Camera
from mitsuba_avatar.captures.rigid import inverse_rigid

FILM_STEP = 32  # pixels: films come in such widths, because each new one compiles kernels


def camera_of_view(camera_from_world: Float[np.ndarray, "4 4"], vertical_field: float, aspect: float, width: int, height: int) -> Camera:
    """The camera of a window: a picture of width x height pixels that the window stretches to its own aspect.

    Args:
        camera_from_world: rigid, OpenCV axes.
        vertical_field: radians between the window's upper and lower edge.
        aspect: width by height of the window.
        width, height: of the picture, pixels.
    """
    fy = 0.5 * height / math.tan(0.5 * vertical_field)
    fx = 0.5 * width / (math.tan(0.5 * vertical_field) * aspect)
    return Camera("view", width, height, fx, fy, 0.5 * width, 0.5 * height, np.asarray(camera_from_world, np.float64))


def pose_of_view(position: Float[np.ndarray, "3"], wxyz: Float[np.ndarray, "4"]) -> Float[np.ndarray, "4 4"]:
    """camera_from_world of a camera's centre (metres) and unit quaternion world_from_camera, real part first, OpenCV axes."""
    world_from_camera = np.eye(4)
    world_from_camera[:3, :3] = Rotation.from_quat(np.roll(np.asarray(wxyz, np.float64), -1)).as_matrix()  # scipy has the real part last
    world_from_camera[:3, 3] = position
    return inverse_rigid(world_from_camera)


def film_of_window(aspect: float, height: int) -> tuple[int, int]:
    """Width and height of the pictures for a window of an aspect (width by height)."""
    return FILM_STEP * max(2, min(round(height * aspect / FILM_STEP), 3 * height // FILM_STEP)), height
