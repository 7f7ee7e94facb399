"""What the contenders of the bench draw: the Anny body at rest, from all sides."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from mitsuba_avatar.body.rig import Rig
from mitsuba_avatar.captures.cameras import Camera, look_at
from mitsuba_avatar.rendering.cameras import CameraBatch

TEXTURE_SIZE = 256  # texels


@dataclass(frozen=True)
class Workload:
    """What every contender draws.

    Attributes:
        vertices: [P, V, 3] the body, and copies of it bent by a little.
        textures: [B, 3, h, w], weights: [B, 4, H, W] of the loss, the mask's last.
    """

    rig: Rig
    vertices: Tensor
    textures: Tensor
    weights: Tensor
    cameras: CameraBatch
    width: int
    height: int


def make_workload(rig: Rig, width: int, height: int, views: int, meshes: int) -> Workload:
    """The rest pose in the middle of the film, seen from all sides; textures, weights and poses are random but the same every time."""
    generator = torch.Generator().manual_seed(0)
    rest = torch.from_numpy(rig.rest_vertices)
    rest = rest - (rest.amin(dim=0) + rest.amax(dim=0)) / 2
    lean = 0.05 * torch.arange(meshes)[:, None] * rest[:, 2]
    vertices = rest.repeat(meshes, 1, 1)
    vertices[..., 0] += lean
    coarse = torch.rand(views, 3, TEXTURE_SIZE // 8, TEXTURE_SIZE // 8, generator=generator)
    textures = torch.nn.functional.interpolate(coarse, size=(TEXTURE_SIZE, TEXTURE_SIZE), mode="bilinear")
    cameras = orbit(views, width, height)
    return Workload(rig, vertices, textures, torch.rand(views, 4, height, width, generator=generator), cameras, width, height)


def orbit(views: int, width: int, height: int) -> CameraBatch:
    """Cameras on a circle of 3 metres around the origin that see the whole body."""
    cameras = []
    for angle in 2 * np.pi * np.arange(views) / views + 0.3:
        pose = look_at(np.array([3.0 * np.cos(angle), 3.0 * np.sin(angle), 0.3]), np.zeros(3))
        cameras.append(Camera(f"view_{len(cameras)}", width, height, 1.5 * height, 1.5 * height, width / 2, height / 2, pose))
    return CameraBatch.from_cameras(cameras)
