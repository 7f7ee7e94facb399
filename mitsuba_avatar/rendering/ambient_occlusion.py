"""Ambient occlusion in UV space: how much of the hemisphere over each texel is open, ray-traced by Mitsuba.

The avatar's shadow branch reads the occlusion of the *posed template* (paper, section 3.4.2), which depends on the
pose angles alone: it carries no gradient and is computed once per frame. 1 is open, 0 is enclosed.

Directions are cosine-distributed, so the open share is the mean over rays; they follow an R2 sequence that every texel shifts at
random, which halves the error of independent directions.
"""

import hashlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from mitsuba_avatar.body.mesh import vertex_normals
from mitsuba_avatar.body.rig import Rig, Topology
from mitsuba_avatar.body.skeleton import Skeleton
from mitsuba_avatar.body.skinning import pose_vertices
from mitsuba_avatar.body.uv import UvAtlas
from mitsuba_avatar.files import atomic_path, cache_folder
from mitsuba_avatar.rendering.backend import loaded_mitsuba
from mitsuba_avatar.rendering.bridge import flat_array, torch_tensor
from mitsuba_avatar.rendering.scene import MeshScene
from mitsuba_avatar.rendering.visibility import TEA_ROUNDS, r2_sequence

LIFT = 1e-3  # metres from the surface to a ray's start: past the surface itself, below any real crevice


class AmbientOcclusion:
    """Occlusion maps of one topology.

    Args:
        topology: mesh and atlas.
        size: texels of the map's sides.
        rays: per texel.
        distance: metres; what is farther away does not occlude.
    """

    def __init__(self, topology: Topology, size: int, rays: int = 64, distance: float = 0.6):
        if rays < 1 or distance <= 0:
            raise ValueError(f"AmbientOcclusion(): expected rays >= 1 and distance > 0 metres; got {rays} and {distance}.")
        self.size, self.rays, self.distance = size, rays, distance
        self.atlas = UvAtlas(topology, size)
        self.faces = torch.from_numpy(topology.faces)
        self.scene = MeshScene(topology.faces, topology.num_vertices)
        self.covered = torch.nonzero(self.atlas.covered.flatten())[:, 0]

    def bake(self, vertices: Float[Tensor, "V 3"], seed: int = 0) -> Float[Tensor, "S S"]:
        """Occlusion of one posed mesh, [S, S], 1 where open; empty texels continue the nearest covered one.

        Args:
            vertices: [V, 3] metres.
            seed: shifts the ray directions of every texel.

        Raises:
            ValueError: vertices are not finite.
        """
        import drjit as dr

        if not bool(torch.isfinite(vertices).all()):
            raise ValueError("bake(): vertices are not finite. Check the pose that they come from.")
        mi = loaded_mitsuba()
        self.scene.update(flat_array(vertices))
        normals = vertex_normals(vertices[None], self.faces)
        surface = self.atlas.texels_from_vertices(torch.cat([vertices[None], normals], dim=2))[0]  # [6, S, S]
        points = flat_array(surface.flatten(1)[:, self.covered].t())
        lane = dr.arange(mi.UInt32, len(self.covered) * self.rays)
        texel, ray_index = lane // self.rays, lane % self.rays
        origin = dr.gather(mi.Point3f, points, texel * 2)
        normal = dr.normalize(dr.gather(mi.Normal3f, points, texel * 2 + 1))
        first, second = mi.sample_tea_32(texel, dr.opaque(mi.UInt32, seed), TEA_ROUNDS)
        position = r2_sequence(ray_index, mi.Point2f(mi.Float(first) * 2.0**-32, mi.Float(second) * 2.0**-32))
        direction = mi.Frame3f(normal).to_world(mi.warp.square_to_cosine_hemisphere(position))
        ray = mi.Ray3f(origin + normal * LIFT, direction)
        ray.maxt = self.distance
        is_open = ~self.scene.scene.ray_test(ray)
        share = dr.block_reduce(dr.ReduceOp.Add, dr.select(is_open, mi.Float(1.0 / self.rays), 0.0), self.rays)
        occlusion = torch.ones(self.size * self.size)
        occlusion[self.covered] = torch_tensor(share, (len(self.covered),)).cpu()
        return self.atlas.inpaint(occlusion.view(1, 1, self.size, self.size))[0, 0]


class FrameOcclusion:
    """Occlusion maps of every frame of a sequence of poses, baked on first need and kept on disk.

    The file's name is a hash of everything the maps depend on, so that a stale one is never read. Maps are stored as bytes: a step of
    1/255 is far below the noise of the rays. A bake that is interrupted leaves nothing behind but a temporary file.

    Args:
        occlusion: the baker.
        rig: skeleton and skinning.
        template_vertices: [V, 3] rest shape that is posed, metres.
        theta: [N, D] pose angles; the root pose does not matter.
        folder: where maps are kept; by default in the project's cache.
    """

    def __init__(
        self,
        occlusion: AmbientOcclusion,
        rig: Rig,
        template_vertices: Float[Tensor, "V 3"],
        theta: Float[np.ndarray, "N D"],
        folder: Path | None = None,
    ):
        self.occlusion, self.rig, self.theta = occlusion, rig, theta
        self.template_vertices = template_vertices.detach().cpu()
        digest = hashlib.sha256(rig.fingerprint.encode())
        digest.update(self.template_vertices.numpy().tobytes())
        digest.update(np.ascontiguousarray(theta).tobytes())
        digest.update(f"{occlusion.size} {occlusion.rays} {occlusion.distance}".encode())
        self.path = (folder or cache_folder() / "ambient_occlusion") / f"{digest.hexdigest()[:24]}.npy"
        self._maps: UInt8[np.ndarray, "N S S"] | None = None

    def bake(self, progress: Callable[[int, int], None] = lambda done, total: None) -> None:
        """Bake what is not on disk yet; `progress(done, total)` is called after every frame."""
        if self._maps is None and not self.path.exists():
            size = self.occlusion.size
            skeleton = Skeleton(self.rig)
            weights = torch.from_numpy(self.rig.skinning_weights)
            rest = self.template_vertices[None]
            with atomic_path(self.path) as temporary:
                maps = np.lib.format.open_memmap(temporary, mode="w+", dtype=np.uint8, shape=(len(self.theta), size, size))
                for i, angles in enumerate(self.theta):
                    posed_from_rest = skeleton(torch.from_numpy(np.array(angles))[None], torch.eye(4)[None])
                    share = self.occlusion.bake(pose_vertices(rest, posed_from_rest, weights)[0], seed=i)
                    maps[i] = (share.clamp(0, 1) * 255 + 0.5).to(torch.uint8).numpy()
                    progress(i + 1, len(self.theta))
                maps.flush()
                del maps
        self._maps = np.load(self.path, mmap_mode="r")

    def maps(self, frames: list[int]) -> Float[Tensor, "P 1 S S"]:
        """Occlusion of the given rows of theta, [P, 1, S, S]."""
        if self._maps is None:
            self.bake()
        return torch.from_numpy(np.stack([self._maps[i] for i in frames]).astype(np.float32) / 255.0)[:, None]

