"""Slow float64 twins of the renderer: rays against every triangle, and exact coverage by clipping polygons. They share no code with it."""

import numpy as np

from mitsuba_avatar.body.rig import Topology
from mitsuba_avatar.rendering.cameras import CameraBatch


def rows(cameras: CameraBatch, view: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rotation [3, 3], translation [3] and fx, fy, cx, cy of one view."""
    pose = cameras.camera_from_world[view].double().numpy()
    return pose[:3, :3], pose[:3, 3], cameras.intrinsics[view].double().numpy()


def traced_image(vertices, topology: Topology, texture, cameras: CameraBatch, view: int, size: tuple[int, int]):
    """Radiance [3, H, W] and mask [H, W] by the 233 rays of a Fibonacci lattice in every pixel.

    Args:
        vertices: [V, 3] float64; texture: [3, h, w]; size: (width, height) of the film.
    """
    width, height = size
    point = np.arange(233)
    inside = np.stack([(point + 0.5) / 233, (point * 144 / 233 + 0.5 / 233) % 1], axis=1)
    corner = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1)  # [H, W, 2]
    depth, face, b1, b2 = nearest_hits(vertices, topology.faces, cameras, view, (corner[:, :, None] + inside).reshape(-1, 2))
    is_hit = np.isfinite(depth)
    corner_uv = topology.uv.astype(np.float64)[topology.uv_faces[face]]  # [N, 3, 2]
    uv = corner_uv[:, 0] + b1[:, None] * (corner_uv[:, 1] - corner_uv[:, 0]) + b2[:, None] * (corner_uv[:, 2] - corner_uv[:, 0])
    radiance = np.where(is_hit[:, None], bilinear(np.asarray(texture, np.float64), uv), 0.0)
    mask = is_hit.reshape(height, width, -1).mean(axis=2)
    return radiance.reshape(height, width, -1, 3).mean(axis=2).transpose(2, 0, 1), mask


def nearest_hits(vertices, faces, cameras: CameraBatch, view: int, pixels):
    """Depth (inf for a miss), face and the weights of its second and third corner along rays through pixels [N, 2]."""
    rotation, translation, (fx, fy, cx, cy) = rows(cameras, view)
    direction = np.stack([(pixels[:, 0] - cx) / fx, (pixels[:, 1] - cy) / fy, np.ones(len(pixels))], axis=1)
    depth, face = np.full(len(pixels), np.inf), np.zeros(len(pixels), np.int64)
    first, second = np.zeros(len(pixels)), np.zeros(len(pixels))
    for index, (v0, v1, v2) in enumerate((vertices @ rotation.T + translation)[faces]):
        e1, e2 = v1 - v0, v2 - v0
        across = np.cross(direction, e2)
        volume = across @ e1
        with np.errstate(divide="ignore", invalid="ignore"):
            b1 = -(across @ v0) / volume
            beside = np.cross(-v0, e1)
            b2 = (direction @ beside) / volume
            t = (e2 @ beside) / volume
        is_nearer = (b1 >= 0) & (b2 >= 0) & (b1 + b2 <= 1) & (t > 0) & (t < depth)
        depth[is_nearer], face[is_nearer] = t[is_nearer], index
        first[is_nearer], second[is_nearer] = b1[is_nearer], b2[is_nearer]
    return depth, face, first, second


def bilinear(texture, uv):
    """[N, 3] from texture [3, h, w] at uv [N, 2]; texel (i, j) has its centre at u = (j + 0.5) / w, v = 1 - (i + 0.5) / h."""
    height, width = texture.shape[1:]
    x, y = uv[:, 0] * width - 0.5, (1 - uv[:, 1]) * height - 0.5
    x0, y0 = np.floor(x).astype(int), np.floor(y).astype(int)
    fx, fy = x - x0, y - y0
    left, right = np.clip(x0, 0, width - 1), np.clip(x0 + 1, 0, width - 1)
    top, bottom = np.clip(y0, 0, height - 1), np.clip(y0 + 1, 0, height - 1)
    above = texture[:, top, left] * (1 - fx) + texture[:, top, right] * fx
    below = texture[:, bottom, left] * (1 - fx) + texture[:, bottom, right] * fx
    return (above * (1 - fy) + below * fy).T


def convex_image(vertices, faces, colours, cameras: CameraBatch, view: int, size: tuple[int, int]):
    """Exact image [4, H, W] (radiance, mask) of a convex mesh with one colour a face [F, 3]: areas of clipped polygons."""
    width, height = size
    rotation, translation, (fx, fy, cx, cy) = rows(cameras, view)
    points = vertices @ rotation.T + translation
    pixels = points[:, :2] / points[:, 2:] * [fx, fy] + [cx, cy]
    image = np.zeros((4, height, width))
    for face, colour in zip(faces, colours, strict=True):
        polygon = pixels[face]
        if _signed_area(polygon) >= 0:  # y points down: faces that are counter-clockwise from outside turn clockwise on the film
            continue
        x_range = range(max(int(polygon[:, 0].min()), 0), min(int(polygon[:, 0].max()) + 1, width))
        for y in range(max(int(polygon[:, 1].min()), 0), min(int(polygon[:, 1].max()) + 1, height)):
            band = _clip(_clip(polygon, 1, y, 1), 1, y + 1, -1)
            for x in x_range:
                area = -_signed_area(_clip(_clip(band, 0, x, 1), 0, x + 1, -1))
                image[:, y, x] += area * np.append(colour, 1.0)
    return image


def _clip(polygon, axis: int, value: float, sign: int):
    """The part of a polygon [N, 2] where sign * (p[axis] - value) >= 0."""
    kept = []
    for i in range(len(polygon)):
        a, b = polygon[i - 1], polygon[i]
        height_a, height_b = sign * (a[axis] - value), sign * (b[axis] - value)
        if (height_a >= 0) != (height_b >= 0):
            kept.append(a + (b - a) * height_a / (height_a - height_b))
        if height_b >= 0:
            kept.append(b)
    return np.array(kept).reshape(-1, 2)


def _signed_area(polygon) -> float:
    x, y = polygon[:, 0], polygon[:, 1]
    return float(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))) / 2
