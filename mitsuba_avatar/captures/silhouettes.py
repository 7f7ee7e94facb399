"""Silhouettes of triangle meshes as pixel masks: exact coverage of pixel centres, numpy only.

This serves checks and pictures. It has no depth, no anti-aliasing and no gradient; the renderer proper is in `rendering/`.
"""

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from mitsuba_avatar.captures.cameras import Camera

CANDIDATES = 1 << 19  # triangle-pixel pairs tested at once: bounds memory to some tens of megabytes
NEAREST_DEPTH = 1e-3  # metres; triangles that reach nearer or behind the camera are left out rather than clipped


def silhouette(camera: Camera, vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> Bool[np.ndarray, "H W"]:
    """Pixels whose centre is covered by a projected triangle, front- or back-facing.

    Args:
        camera: gives the size and the projection (with distortion, at vertices).
        vertices: [V, 3] metres, world axes.
        faces: [F, 3].

    Returns:
        [H, W] True inside.
    """
    pixels, depth = camera.project(vertices)
    is_in_front = (depth[faces] > NEAREST_DEPTH).all(axis=1)
    return covered_pixels(pixels[faces[is_in_front]], camera.width, camera.height)


def covered_pixels(triangles: Float[np.ndarray, "F 3 2"], width: int, height: int) -> Bool[np.ndarray, "H W"]:
    """Pixels whose centre lies in a triangle or on its border.

    Large triangles go first, and a triangle is skipped when all pixels of its box are covered already. So the interior of a dense mesh
    costs little, and a wrong camera, for which every triangle may fill the image, stays cheap.

    Args:
        triangles: [F, 3, 2] corners in pixels, origin at the image's corner.
        width, height: of the image.

    Returns:
        [H, W] True inside.
    """
    covered = np.zeros((height, width), dtype=bool)
    limit = np.array([width, height], dtype=np.float64)
    # First and last pixel centre within each triangle's box; clipped before the conversion, because far corners overflow integers.
    first = np.ceil(triangles.min(axis=1) - 0.5).clip(0, limit).astype(np.int64)
    last = np.floor(triangles.max(axis=1) - 0.5).clip(-1, limit - 1).astype(np.int64)
    area = np.prod((last - first + 1).clip(0), axis=1)
    order = np.argsort(-area, kind="stable")[: np.count_nonzero(area)]
    while len(order):
        order = order[_is_open(covered, first[order], last[order])]
        count = max(1, int(np.searchsorted(np.cumsum(area[order]), CANDIDATES)))
        chunk, order = order[:count], order[count:]
        _cover(covered, triangles[chunk], first[chunk], last[chunk])
    return covered


def outline(mask: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """Pixels of a mask that touch its outside; where it meets the image's border it is open."""
    return mask & ~ndimage.binary_erosion(mask, border_value=1)


def _is_open(covered: Bool[np.ndarray, "H W"], first: Int[np.ndarray, "F 2"], last: Int[np.ndarray, "F 2"]) -> Bool[np.ndarray, "F"]:
    """Whether a box still has a pixel that is not covered, by a summed-area table."""
    table = np.zeros((covered.shape[0] + 1, covered.shape[1] + 1), dtype=np.int64)
    table[1:, 1:] = (~covered).cumsum(axis=0).cumsum(axis=1)
    (left, top), (right, bottom) = first.T, last.T + 1
    return table[bottom, right] - table[top, right] - table[bottom, left] + table[top, left] > 0


def _cover(
    covered: Bool[np.ndarray, "H W"], triangles: Float[np.ndarray, "F 3 2"], first: Int[np.ndarray, "F 2"], last: Int[np.ndarray, "F 2"]
) -> None:
    """Test all pixel centres of the boxes against their triangles; writes into `covered`."""
    size = last - first + 1
    counts = size[:, 0] * size[:, 1]
    owner = np.repeat(np.arange(len(counts)), counts)
    within = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
    x = first[owner, 0] + within % size[owner, 0]
    y = first[owner, 1] + within // size[owner, 0]
    points = np.stack([x, y], axis=-1) + 0.5
    sides = []
    for start, end in ((0, 1), (1, 2), (2, 0)):
        a, b = triangles[owner, start], triangles[owner, end]
        sides.append((b[:, 0] - a[:, 0]) * (points[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (points[:, 0] - a[:, 0]))
    is_inside = np.all(np.array(sides) >= 0, axis=0) | np.all(np.array(sides) <= 0, axis=0)
    covered[y[is_inside], x[is_inside]] = True
