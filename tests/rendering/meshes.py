"""Small meshes, textures and cameras for the renderer's tests; nothing here is square, symmetric or centred."""

import numpy as np
import torch
from torch import Tensor

from mitsuba_avatar.body.rig import Topology
from mitsuba_avatar.rendering.cameras import CameraBatch

SIDES = (  # corners of each side of a unit cube, counter-clockwise from outside; corner index = 4 * x + 2 * y + z
    (4, 6, 7, 5),
    (0, 1, 3, 2),
    (2, 3, 7, 6),
    (0, 4, 5, 1),
    (1, 5, 7, 3),
    (0, 2, 6, 4),
)


def cube() -> tuple[np.ndarray, Topology]:
    """A cube of 0.8 metres: 8 welded vertices, one chart a side, so that every edge of the cube is a seam."""
    vertices = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.float64) * 0.8 - 0.4
    faces, uv, uv_faces = [], [], []
    for side, (a, b, c, d) in enumerate(SIDES):
        faces += [[a, b, c], [a, c, d]]
        left, low = side % 3 / 3, side // 3 / 2
        uv += [[left + 0.04, low + 0.06], [left + 0.29, low + 0.06], [left + 0.29, low + 0.44], [left + 0.04, low + 0.44]]
        first = 4 * side
        uv_faces += [[first, first + 1, first + 2], [first, first + 2, first + 3]]
    return vertices, _topology(len(vertices), faces, uv, uv_faces)


def sphere(subdivisions: int = 2, radius: float = 0.5) -> tuple[np.ndarray, Topology]:
    """An icosphere; the upper and the lower half are charts of their own (faces across the equator belong to the upper)."""
    import trimesh

    mesh = trimesh.creation.icosphere(subdivisions)
    vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    is_upper = vertices[faces].mean(axis=1)[:, 2] >= 0
    upper = vertices[:, :2] * 0.2 + [0.25, 0.5]
    lower = vertices[:, :2] * 0.2 + [0.75, 0.5]
    uv_faces = np.where(is_upper[:, None], faces, faces + len(vertices))
    return vertices * radius, _topology(len(vertices), faces, np.concatenate([upper, lower]), uv_faces)


def arms_before_torso() -> tuple[np.ndarray, Topology]:
    """Two thin boxes before a wide one, as closed parts of one mesh: contours with surface behind them. The front is -y."""
    box, topology = cube()
    parts = [
        box * [1.2, 0.4, 1.5],
        box * [0.25, 0.2, 0.9] + [-0.3, -0.45, 0.1],
        box * [0.2, 0.25, 0.8] + [0.22, -0.5, -0.15],
    ]
    faces = np.concatenate([topology.faces + 8 * part for part in range(3)])
    uv = np.concatenate([topology.uv * [1 / 3, 1.0] + [part / 3, 0.0] for part in range(3)])
    uv_faces = np.concatenate([topology.uv_faces + len(topology.uv) * part for part in range(3)])
    return np.concatenate(parts), _topology(24, faces, uv, uv_faces)


def open_sheet() -> tuple[np.ndarray, Topology]:
    """A bent quadrilateral of two triangles: every edge but one is open."""
    vertices = np.array([[-0.5, 0.0, -0.4], [0.45, 0.1, -0.35], [0.5, -0.1, 0.4], [-0.4, 0.05, 0.45]])
    uv = [[0.1, 0.1], [0.9, 0.1], [0.9, 0.9], [0.1, 0.9]]
    faces = [[0, 1, 2], [0, 2, 3]]
    return vertices, _topology(4, faces, uv, faces)


def orbit(count: int, width: int, height: int, distance: float = 3.0, focal: float = 1.6) -> CameraBatch:
    """Cameras around the origin at different heights, first before the mesh (-y); principal points off the centre.

    Args:
        focal: in film heights.
    """
    poses = []
    for i in range(count):
        angle = -np.pi / 2 + 0.35 + 2 * np.pi * i / count
        center = distance * np.array([np.cos(angle), np.sin(angle), 0.3 - 0.15 * i])
        forward = -center / np.linalg.norm(center)
        right = np.cross(forward, [0, 0, 1])
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, -rotation @ center
        poses.append(pose)
    intrinsics = torch.tensor([[focal * height, focal * height, width / 2 + 1.3, height / 2 - 0.7]]).repeat(count, 1)
    return CameraBatch(intrinsics, torch.tensor(np.array(poses), dtype=torch.float32))


def waves(count: int, height: int, width: int) -> Tensor:
    """[count, 3, height, width] textures in 0.1..0.9, different for every view, without any symmetry."""
    y, x = np.meshgrid(np.linspace(0, 1, height), np.linspace(0, 1, width), indexing="ij")
    phase = np.arange(count)[:, None, None]
    channels = [0.5 + 0.4 * np.sin(9 * x + 3 * y + phase), 0.5 + 0.4 * np.cos(7 * y + 4 * x * x - phase), 0.3 + 0.5 * x * y + 0 * phase]
    return torch.tensor(np.stack(channels, axis=1), dtype=torch.float32)


def pixel_weights(count: int, channels: int, height: int, width: int, seed: int = 0) -> Tensor:
    """[count, channels, height, width] smooth random weights of a loss that differs from pixel to pixel."""
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.rand(count, channels, 4, 3, generator=generator)
    return torch.nn.functional.interpolate(coarse, size=(height, width), mode="bilinear")


def _topology(num_vertices: int, faces, uv, uv_faces) -> Topology:
    return Topology(
        num_vertices=num_vertices,
        faces=np.asarray(faces, np.int64),
        uv=np.asarray(uv, np.float32),
        uv_faces=np.asarray(uv_faces, np.int64),
    )
