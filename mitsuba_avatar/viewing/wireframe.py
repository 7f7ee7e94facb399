"""The mesh's edges drawn over a picture: those of faces that are turned to the camera and not hidden behind others."""

import numpy as np
from jaxtyping import Float, Int, UInt8

from mitsuba_avatar.captures.cameras import Camera

MOST_SAMPLES = 48  # points along an edge: longer lines become dotted
TOLERANCE = 0.004  # metres that an edge may lie behind the first surface of its pixel
INK = 0.5  # what a line leaves of the picture's light


def draw_wireframe(
    image: UInt8[np.ndarray, "H W 3"],
    depth: Float[np.ndarray, "H W"],
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    camera: Camera,
) -> UInt8[np.ndarray, "H W 3"]:
    """A copy of the picture, darker along the visible edges.

    Args:
        image: of the camera's size.
        depth: metres along the camera's axis of the surface in each pixel, 0 where there is none.
        vertices: [V, 3] metres, world axes.
        faces: counter-clockwise seen from outside.
        camera: without distortion.
    """
    seen = vertices @ camera.camera_from_world[:3, :3].T + camera.camera_from_world[:3, 3]  # [V, 3]
    corners = seen[faces]  # [F, 3, 3]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    is_facing = ((normals * corners[:, 0]).sum(axis=1) < 0) & (corners[..., 2] > 0).all(axis=1)
    edges = np.sort(faces[is_facing][:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    edges = np.unique(edges[:, 0] * len(vertices) + edges[:, 1])
    start, end = seen[edges // len(vertices)], seen[edges % len(vertices)]
    pixels = max(camera.fx, camera.fy) * np.linalg.norm(end - start, axis=1) / np.minimum(start[:, 2], end[:, 2])
    samples = int(np.clip(np.ceil(np.percentile(pixels, 98)) + 1, 2, MOST_SAMPLES)) if len(pixels) else 2
    share = np.linspace(0, 1, samples)[:, None, None]
    points = (start + share * (end - start)).reshape(-1, 3)
    column = np.floor(camera.fx * points[:, 0] / points[:, 2] + camera.cx).astype(np.int64)
    row = np.floor(camera.fy * points[:, 1] / points[:, 2] + camera.cy).astype(np.int64)
    is_inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    column, row, behind = column[is_inside], row[is_inside], points[is_inside, 2]
    surface = depth[row, column]
    is_visible = (surface > 0) & (behind < surface + TOLERANCE)
    drawn = np.zeros(image.shape[:2], bool)
    drawn[row[is_visible], column[is_visible]] = True
    result = image.copy()
    result[drawn] = (INK * image[drawn]).astype(np.uint8)
    return result
