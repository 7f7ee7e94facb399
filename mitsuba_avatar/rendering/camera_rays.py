"""Camera rays made by ourselves, where Mitsuba's film would trace pixels that nobody needs or in an order that changes.

Any pinhole camera is exact, off-centre and with pixels that are not square too. Every camera goes through the same kernel: intrinsics and
pose are values, not constants of the code. Symbols: P pixels, S samples a pixel; a launch has P * S lanes. Pixels and metres.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Int

from mitsuba_avatar.captures.cameras import Camera
from mitsuba_avatar.rendering.backend import loaded_mitsuba

LARGEST_LAUNCH = 1 << 22  # lanes; 2 GB of memory at most, far above where launches cost time
NEAR = 0.05  # metres; a vertex nearer to the camera's plane has no place in the image


def camera_row(camera: Camera) -> list[Any]:
    """Intrinsics, then the rows right, down, forward and the centre of the camera in the world, as values that kernels do not contain."""
    import drjit as dr

    mi = loaded_mitsuba()
    return [dr.opaque(mi.Float, value) for value in _row_values(camera)]


def camera_rows(cameras: Sequence[Camera]) -> list[Any]:
    """The values of `camera_row`, in its order, each as an array of one entry per camera."""
    import drjit as dr

    mi = loaded_mitsuba()
    rows = [mi.Float(list(column)) for column in zip(*map(_row_values, cameras), strict=True)]
    dr.make_opaque(rows)  # a single camera's would be literals
    return rows


def rows_of_lanes(rows: list[Any], cameras: Int[np.ndarray, "P"], samples: int) -> list[Any]:  # noqa: F821
    """The row of each lane's camera, for `jittered_rays`.

    Args:
        rows: of `camera_rows`.
        cameras: [P] index of each pixel's camera.
        samples: S consecutive lanes a pixel.
    """
    import drjit as dr

    mi = loaded_mitsuba()
    indices = mi.UInt32(np.ascontiguousarray(cameras, dtype=np.uint32)) + dr.opaque(mi.UInt32, 0)
    dr.eval(indices)
    of_lane = dr.gather(mi.UInt32, indices, dr.arange(mi.UInt32, len(cameras) * samples) // samples)
    return [dr.gather(mi.Float, row, of_lane) for row in rows]


def jittered_rays(row: list[Any], width: int, pixels: Int[np.ndarray, "P"], samples: int, sampler: Any, seed: int) -> Any:  # noqa: F821
    """Rays (`mi.RayDifferential3f`) through random points of pixels, `samples` consecutive lanes a pixel.

    Args:
        row: of `camera_row`, `mi.Float` each, or of `rows_of_lanes`.
        width: of the image.
        pixels: [P] their indices, row by row.
        samples: S.
        sampler: `mi.Sampler`, seeded here for all lanes; its next numbers are the path's.
        seed: equal seeds give equal rays.
    """
    import drjit as dr

    mi, count = loaded_mitsuba(), len(pixels) * samples
    sampler.seed(dr.opaque(mi.UInt32, seed), count)  # opaque: a literal seed or width would be compiled into the kernel
    # A sum with an opaque zero, for memory that Dr.Jit allocated: numpy's alignment varies, and with it the kernel.
    indices = mi.UInt32(np.ascontiguousarray(pixels, dtype=np.uint32)) + dr.opaque(mi.UInt32, 0)
    dr.eval(indices)
    pixel = dr.gather(mi.UInt32, indices, dr.arange(mi.UInt32, count) // samples)
    columns = dr.opaque(mi.UInt32, width)
    y = pixel // columns
    x = pixel - y * columns
    focal_x, focal_y, principal_x, principal_y, *pose = row
    jitter = sampler.next_2d()
    right = (mi.Float(x) + jitter.x - principal_x) / focal_x
    down = (mi.Float(y) + jitter.y - principal_y) / focal_y
    direction = mi.Vector3f(*(pose[axis] * right + pose[3 + axis] * down + pose[6 + axis] for axis in range(3)))
    return mi.RayDifferential3f(mi.Ray3f(mi.Point3f(*pose[9:]), dr.normalize(direction)))


def _row_values(camera: Camera) -> list[float]:
    """What `camera_row` says of a camera."""
    pose = camera.world_from_camera
    values = [camera.fx, camera.fy, camera.cx, camera.cy, *pose[:3, 0], *pose[:3, 1], *pose[:3, 2], *pose[:3, 3]]
    return [float(value) for value in values]
