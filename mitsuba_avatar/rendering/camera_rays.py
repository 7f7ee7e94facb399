"""Camera rays made by ourselves, where Mitsuba's film would trace pixels that nobody needs or in an order that changes.

Any pinhole camera is exact, off-centre and with pixels that are not square too. Every camera goes through the same kernel: intrinsics and
pose are values, not constants of the code. Symbols: P pixels, S samples a pixel; a launch has P * S lanes. Pixels and metres.
"""

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

    mi, pose = loaded_mitsuba(), camera.world_from_camera
    values = [camera.fx, camera.fy, camera.cx, camera.cy, *pose[:3, 0], *pose[:3, 1], *pose[:3, 2], *pose[:3, 3]]
    return [dr.opaque(mi.Float, float(value)) for value in values]


def jittered_rays(row: list[Any], width: int, pixels: Int[np.ndarray, "P"], samples: int, sampler: Any, seed: int) -> Any:  # noqa: F821
    """Rays (`mi.RayDifferential3f`) through random points of pixels, `samples` consecutive lanes a pixel.

    Args:
        row: of `camera_row`, `mi.Float` each.
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
