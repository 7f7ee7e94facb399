"""Ambient occlusion in UV space: how much of the hemisphere over each texel is open, ray-traced by Mitsuba.

The avatar's shadow branch reads the occlusion of the *posed template* (paper, section 3.4.2), which depends on the
pose angles alone: it carries no gradient and is computed once per frame. 1 is open, 0 is enclosed. The same rays give the bent normal
and the irradiance under an environment map, for captures whose light is not uniform (paper, footnote to section 3.4.2).

Directions are cosine-distributed, so the open share is the mean over rays; they form a lattice that every texel shifts at
random, which halves the error of independent directions.
"""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from torch import Tensor

from mitsuba_avatar.body.mesh import vertex_normals
from mitsuba_avatar.body.rig import Rig, Topology
from mitsuba_avatar.body.skeleton import Skeleton
from mitsuba_avatar.body.skinning import pose_vertices
from mitsuba_avatar.body.uv import UvAtlas
from mitsuba_avatar.files import atomic_path, cache_folder
from mitsuba_avatar.rendering.backend import loaded_mitsuba
from mitsuba_avatar.rendering.bridge import flat_array, torch_tensor
from mitsuba_avatar.rendering.environment_map import EnvironmentMap
from mitsuba_avatar.rendering.pixel_sampling import TEXELS, golden_lattice, random_shift
from mitsuba_avatar.rendering.scene import MeshScene

LIFT = 1e-3  # metres from the surface to a ray's start: past the surface itself, below any real crevice


@dataclass(frozen=True)
class SurfaceLighting:
    """What light from far away finds at each texel; empty texels continue the nearest covered one.

    Attributes:
        ambient_occlusion: [S, S], 1 where open.
        bent_normal: [3, S, S] mean unoccluded direction, unit length, world axes; the normal itself where nothing is open.
        irradiance: [3, S, S] under the environment map, in its radiance times pi at most.
    """

    ambient_occlusion: Float[Tensor, "S S"]
    bent_normal: Float[Tensor, "3 S S"]
    irradiance: Float[Tensor, "3 S S"]


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
            ValueError: vertices are not finite, or not those of the topology.
        """
        is_open, _, _ = self._trace(vertices, seed)
        return self._map(self._mean([is_open]), beyond=1.0)[0]

    def bake_lighting(self, vertices: Float[Tensor, "V 3"], environment: EnvironmentMap, seed: int = 0) -> SurfaceLighting:
        """Occlusion, bent normal and irradiance of one posed mesh, all from the same rays.

        Args:
            vertices: [V, 3] metres.
            environment: light from far away.
            seed: shifts the ray directions of every texel.

        Raises:
            ValueError: vertices are not finite, or not those of the topology.
        """
        import drjit as dr

        is_open, direction, normal = self._trace(vertices, seed)
        light = environment.radiance_from(direction) * (is_open * dr.pi)  # cosine-distributed: the mean times pi is the integral
        means = self._mean([is_open, *(direction * is_open), *light])  # [C, 7]
        bent = torch.where(means[:, :1] > 0, means[:, 1:4], normal)
        bent = torch.nn.functional.normalize(bent, dim=1)
        maps = self._map(torch.cat([means[:, :1], bent, means[:, 4:]], dim=1), beyond=0.0)
        return SurfaceLighting(ambient_occlusion=maps[0], bent_normal=maps[1:4], irradiance=maps[4:])

    def _trace(self, vertices: Float[Tensor, "V 3"], seed: int) -> tuple:
        """Per ray, texel by texel: 1 where nothing is hit (Float) and its direction (Vector3f); per texel, the normal [C, 3] in torch."""
        import drjit as dr

        if len(vertices) != self.scene.num_vertices:
            raise ValueError(f"bake(): vertices must be [{self.scene.num_vertices}, 3] for this topology; got {list(vertices.shape)}.")
        if not bool(torch.isfinite(vertices).all()):
            raise ValueError("bake(): vertices are not finite. Check the pose that they come from.")
        mi = loaded_mitsuba()
        self.scene.update(flat_array(vertices))
        normals = vertex_normals(vertices[None], self.faces)
        surface = self.atlas.texels_from_vertices(torch.cat([vertices[None], normals], dim=2))[0]  # [6, S, S]
        surface = surface.flatten(1)[:, self.covered].t()  # [C, 6]
        points = flat_array(surface)
        lane = dr.arange(mi.UInt32, len(self.covered) * self.rays)
        texel, ray_index = lane // self.rays, lane % self.rays
        origin = dr.gather(mi.Point3f, points, texel * 2)
        normal = dr.normalize(dr.gather(mi.Normal3f, points, texel * 2 + 1))
        position = golden_lattice(ray_index, self.rays, random_shift(texel, TEXELS, dr.opaque(mi.UInt32, seed), self.rays))
        direction = mi.Frame3f(normal).to_world(mi.warp.square_to_cosine_hemisphere(position))
        ray = mi.Ray3f(origin + normal * LIFT, direction)
        ray.maxt = self.distance
        is_open = dr.select(self.scene.scene.ray_test(ray), mi.Float(0.0), mi.Float(1.0))
        return is_open, direction, surface[:, 3:]

    def _mean(self, columns: list) -> Float[Tensor, "C N"]:
        """Means over the rays of every covered texel."""
        import drjit as dr

        sums = [dr.block_reduce(dr.ReduceOp.Add, column, self.rays) * (1.0 / self.rays) for column in columns]
        dr.eval(sums)
        return torch.stack([torch_tensor(total, (len(self.covered),)).cpu() for total in sums], dim=1)

    def _map(self, values: Float[Tensor, "C N"], beyond: float) -> Float[Tensor, "N S S"]:
        """Values of covered texels as maps, continued into empty ones; `beyond` is what an atlas without a covered neighbour would hold."""
        maps = torch.full((values.shape[1], self.size * self.size), beyond)
        maps[:, self.covered] = values.t()
        return self.atlas.inpaint(maps.view(1, -1, self.size, self.size))[0]


class FrameOcclusion:
    """Occlusion maps of every frame of a sequence of poses, baked on first need and kept on disk, a file a pose.

    A folder's name is a hash of everything but the pose that a map depends on, a file's name a hash of the pose: a stale map is never
    read, frames with the same pose share one, and a bake that was interrupted goes on where it stopped. Maps are stored as bytes: a step
    of 1/255 is far below the noise of the rays.

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
        self.skeleton = Skeleton(rig)
        self.skinning_weights = torch.from_numpy(rig.skinning_weights)
        digest = hashlib.sha256(rig.fingerprint.encode())
        digest.update(rig.skinning_weights.tobytes() + rig.joint_positions.tobytes())
        digest.update(self.template_vertices.numpy().tobytes())
        digest.update(f"{occlusion.size} {occlusion.rays} {occlusion.distance}".encode())
        self.folder = (folder or cache_folder() / "ambient_occlusion") / digest.hexdigest()[:24]

    def bake(self, progress: Callable[[int, int], None] = lambda done, total: None) -> None:
        """Bake what is not on disk yet; `progress(done, total)` is called after every frame."""
        for frame in range(len(self.theta)):
            self.prepare(frame)
            progress(frame + 1, len(self.theta))

    def prepare(self, frame: int) -> None:
        """Bake a frame's map if it is not on disk yet."""
        if not self.is_baked(frame):
            self._bake(frame)

    def is_baked(self, frame: int) -> bool:
        """Whether a frame's map is on disk."""
        return self._path(frame).exists()

    def recipe(self) -> "OcclusionRecipe":
        """What another process needs to bake the same maps into the same folder."""
        baker = self.occlusion
        theta = np.array(self.theta, np.float32)
        return OcclusionRecipe(self.rig, baker.size, baker.rays, baker.distance, self.template_vertices.numpy(), theta, self.folder.parent)

    def maps(self, frames: list[int]) -> Float[Tensor, "P 1 S S"]:
        """Occlusion of the given rows of theta, [P, 1, S, S]; what is not on disk yet is baked."""
        return torch.from_numpy(np.stack([self._read(frame) for frame in frames]).astype(np.float32) / 255.0)[:, None]

    def _path(self, frame: int) -> Path:
        return self.folder / f"{self._pose_digest(frame)[:24]}.npy"

    def _pose_digest(self, frame: int) -> str:
        return hashlib.sha256(np.ascontiguousarray(self.theta[frame], np.float32).tobytes()).hexdigest()

    def _read(self, frame: int) -> UInt8[np.ndarray, "S S"]:
        return np.load(self._path(frame)) if self.is_baked(frame) else self._bake(frame)

    def _bake(self, frame: int) -> UInt8[np.ndarray, "S S"]:
        angles = torch.from_numpy(np.array(self.theta[frame], np.float32))
        with torch.no_grad():
            posed_from_rest = self.skeleton(angles[None], torch.eye(4)[None])
            vertices = pose_vertices(self.template_vertices[None], posed_from_rest, self.skinning_weights)[0]
        share = self.occlusion.bake(vertices, seed=int(self._pose_digest(frame)[:8], 16))
        stored = (share.clamp(0, 1) * 255 + 0.5).to(torch.uint8).numpy()
        with atomic_path(self._path(frame)) as temporary:
            np.save(temporary, stored)
        return stored


@dataclass(frozen=True)
class OcclusionRecipe:
    """A `FrameOcclusion` that can be sent to another process: its arguments, and those of its baker.

    Attributes:
        rig: skeleton, skinning and topology.
        size, rays, distance: texels of a side, rays a texel, metres; as `AmbientOcclusion` takes them.
        template_vertices: [V, 3] metres.
        theta: [N, D] radians.
        folder: where maps are kept.
    """

    rig: Rig
    size: int
    rays: int
    distance: float
    template_vertices: Float32[np.ndarray, "V 3"]
    theta: Float32[np.ndarray, "N D"]
    folder: Path

    def frames(self) -> FrameOcclusion:
        """The sequence, with a baker of this process."""
        baker = AmbientOcclusion(self.rig.topology, self.size, self.rays, self.distance)
        return FrameOcclusion(baker, self.rig, torch.from_numpy(self.template_vertices), self.theta, self.folder)
