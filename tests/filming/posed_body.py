"""A dressed body in a dozen poses: what tests of stage, cameras and light film, without motion or simulation."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float32

from mitsuba_avatar.body.anny_rig import build_anny_rig, facial_action_displacements
from mitsuba_avatar.body.rig import Rig
from mitsuba_avatar.body.skeleton import Skeleton
from mitsuba_avatar.body.skinning import pose_vertices
from mitsuba_avatar.filming.anatomy import Anatomy
from mitsuba_avatar.filming.clothing import DressedBody, dress, hair, shirt, trousers

FRAMES = 12


@dataclass(frozen=True, eq=False)
class PosedBody:
    """[N, V, 3] vertices in the world, with facial actions; `transforms` [N, J, 4, 4] of the joints."""

    rig: Rig
    anatomy: Anatomy
    body: DressedBody
    vertices: Float32[np.ndarray, "N V 3"]
    transforms: Float32[np.ndarray, "N J 4 4"]


@lru_cache(maxsize=1)
def posed_body() -> PosedBody:
    """Random poses near rest, arms away from the trunk, turned and shifted a little."""
    rig = build_anny_rig()
    anatomy = Anatomy.of(rig)
    top = shirt(anatomy)
    body = dress(anatomy, (trousers(anatomy, top), top, hair(anatomy)))
    rng = np.random.default_rng(0)
    share = rng.uniform(-0.3, 0.3, (FRAMES, len(rig.dofs.names)))
    theta = np.where(share > 0, share * rig.dofs.upper, -share * rig.dofs.lower).astype(np.float32)
    root = np.tile(np.eye(4, dtype=np.float32), (FRAMES, 1, 1))
    angle = rng.uniform(-0.4, 0.4, FRAMES)
    root[:, :2, :2] = np.stack([np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)], axis=-1).reshape(-1, 2, 2)
    root[:, :2, 3] = rng.uniform(-0.1, 0.1, (FRAMES, 2))
    displacements = facial_action_displacements()[1]
    actions = rng.uniform(0, 0.3, (FRAMES, len(displacements)))
    rest = (body.vertices + np.einsum("na,avc->nvc", actions, displacements, optimize=True)).astype(np.float32)
    transforms = Skeleton(rig)(torch.from_numpy(theta), torch.from_numpy(root))
    vertices = pose_vertices(torch.from_numpy(rest), transforms, torch.from_numpy(rig.skinning_weights)).numpy()
    return PosedBody(rig, anatomy, body, vertices, transforms.numpy())
