"""What `bench` times: this project's renderer, Mitsuba's `direct_projective`, its primary rays alone; ambient occlusion of three libraries.

Peers are set up in their favour where there is a choice: the integrator's scene is built once and updated, its mesh has the texture
coordinates it needs, and no second bounce is sampled (sppi = 0).
"""

from collections.abc import Callable

import numpy as np
import torch

from mitsuba_avatar.benchmarking.workload import Workload
from mitsuba_avatar.body.mesh import vertex_normals
from mitsuba_avatar.body.rig import Rig
from mitsuba_avatar.body.split_mesh import split_at_seams
from mitsuba_avatar.rendering.ambient_occlusion import LIFT, AmbientOcclusion
from mitsuba_avatar.rendering.backend import loaded_mitsuba
from mitsuba_avatar.rendering.bridge import flat_array, torch_tensor
from mitsuba_avatar.rendering.surface import SurfaceRenderer


class Ours:
    """The surface renderer as training calls it: torch tensors in, a loss over radiance and mask, gradients to vertices and textures."""

    def __init__(self, workload: Workload):
        self.workload = workload
        self.renderer = SurfaceRenderer(
            workload.rig.topology, workload.width, workload.height, samples_per_pixel=1, boundary_samples_per_edge=2
        )
        self.seed = 0

    def forward(self) -> None:
        """Images only."""
        self.seed += 1
        with torch.no_grad():
            self.renderer.render(self.workload.vertices, self.workload.textures, self.workload.cameras, seed=self.seed)

    def forward_and_backward(self) -> None:
        """Images, loss and gradients."""
        self.seed += 1
        work = self.workload
        vertices, textures = work.vertices.clone().requires_grad_(), work.textures.clone().requires_grad_()
        radiance, mask = self.renderer.render(vertices, textures, work.cameras, seed=self.seed)
        ((radiance * work.weights[:, :3]).sum() + (mask * work.weights[:, 3:]).sum()).backward()


class DirectProjective:
    """Mitsuba's `direct_projective` on the same mesh, poses and cameras; the texture is the radiance that the mesh emits. No mask."""

    def __init__(self, workload: Workload):
        import drjit as dr

        mi = loaded_mitsuba()
        self.workload, self.seed = workload, 0
        topology = workload.rig.topology
        split = split_at_seams(topology)  # Mitsuba keeps texture coordinates at vertices
        self.source = torch.from_numpy(split.welded)
        # Mitsuba's bitmaps have row 0 at v = 0.
        self.textures = [mi.TensorXf(texture.flip(1).permute(1, 2, 0).contiguous()) for texture in workload.textures]
        emission = {
            "type": "area",
            "radiance": {"type": "bitmap", "data": mi.TensorXf(self.textures[0].array, self.textures[0].shape), "raw": True},
        }
        properties = mi.Properties()
        properties["emitter"] = mi.load_dict(emission)
        mesh = mi.Mesh("body", len(split.uv), len(split.faces), has_vertex_texcoords=True, props=properties)
        tables = mi.traverse(mesh)
        tables["faces"] = mi.UInt(split.faces.reshape(-1).astype(np.uint32))
        tables["vertex_texcoords"] = mi.Float(split.uv.ravel())
        tables["vertex_positions"] = flat_array(workload.vertices[0][self.source])
        tables.update()
        self.scene = mi.load_dict({"type": "scene", "body": mesh})
        self.integrator = mi.load_dict({"type": "direct_projective", "sppc": 1, "sppp": 1, "sppi": 0})
        self.parameters = mi.traverse(self.scene)
        (self.positions_key,) = [key for key in self.parameters.keys() if key.endswith("vertex_positions")]  # noqa: SIM118 (iteration gives pairs)
        (self.texture_key,) = [key for key in self.parameters.keys() if key.endswith("radiance.data")]  # noqa: SIM118
        self.sensors = [mi.load_dict(sensor) for sensor in _sensors(workload)]
        self.place(workload.vertices)
        self.weights = [mi.TensorXf(np.ascontiguousarray(weights[:3].permute(1, 2, 0).numpy())) for weights in workload.weights]
        dr.eval(self.positions, self.textures, self.weights)

    def place(self, vertices: torch.Tensor) -> None:
        """Set the vertices [P, V, 3] of the welded meshes that the next call draws."""
        self.positions = [flat_array(mesh[self.source]) for mesh in vertices]

    def forward(self) -> None:
        """Images only."""
        self._draw(with_gradients=False)

    def forward_and_backward(self) -> None:
        """Images, loss and gradients."""
        self._draw(with_gradients=True)

    def vertex_gradients(self) -> torch.Tensor:
        """Gradient of the loss with respect to the vertices of the welded meshes, [P, V, 3]."""
        gradients = torch.zeros_like(self.workload.vertices)
        for gradient, split in zip(gradients, self._draw(with_gradients=True), strict=True):
            gradient.index_add_(0, self.source, torch_tensor(split, (len(self.source), 3)))
        return gradients

    def _draw(self, with_gradients: bool) -> list:
        """Draw all views; returns the gradient (flat mi.Float) of every mesh's vertices where wanted."""
        import drjit as dr

        mi = loaded_mitsuba()
        views_per_mesh, gradients = len(self.sensors) // len(self.positions), []
        for mesh, positions in enumerate(self.positions):
            moved = mi.Float(positions)
            if with_gradients:
                dr.enable_grad(moved)
            self.parameters[self.positions_key] = moved
            for view in range(mesh * views_per_mesh, (mesh + 1) * views_per_mesh):
                self.seed += 1
                texture = mi.TensorXf(self.textures[view])
                if with_gradients:
                    dr.enable_grad(texture)
                self.parameters[self.texture_key] = texture
                self.parameters.update()
                parameters = self.parameters if with_gradients else None
                image = mi.render(self.scene, parameters, sensor=self.sensors[view], integrator=self.integrator, seed=self.seed, spp=1)
                if with_gradients:
                    loss = dr.sum(image[:, :, :3] * self.weights[view])
                    dr.backward(
                        loss,
                        flags=dr.ADFlag.ClearInterior | dr.ADFlag.ClearEdges
                        if view + 1 == (mesh + 1) * views_per_mesh
                        else dr.ADFlag.ClearInterior,
                    )
                    dr.eval(dr.grad(texture), dr.grad(moved))
                else:
                    dr.eval(image)
            dr.sync_thread()
            if with_gradients:
                gradients.append(dr.grad(moved))
        return gradients


class PrimaryRays:
    """One camera ray a pixel through Mitsuba's own hierarchy of the first mesh, all views in one launch, nothing else: a floor."""

    def __init__(self, workload: Workload):
        mi = loaded_mitsuba()
        topology = workload.rig.topology
        mesh = mi.Mesh("body", topology.num_vertices, len(topology.faces))
        tables = mi.traverse(mesh)
        tables["faces"] = mi.UInt(topology.faces.astype(np.uint32).ravel())
        tables["vertex_positions"] = flat_array(workload.vertices[0])
        tables.update()
        self.scene = mi.load_dict({"type": "scene", "body": mesh})
        self.rays = _camera_rays(workload)

    def trace(self) -> None:
        """Trace them."""
        import drjit as dr

        found = self.scene.ray_intersect_preliminary(self.rays, coherent=True)
        dr.eval(found.t, found.prim_index)
        dr.sync_thread()


def _sensors(workload: Workload) -> list[dict]:
    """Mitsuba sensors of the workload's cameras (z forward, x left, y up there)."""
    mi = loaded_mitsuba()
    sensors = []
    for (fx, _, cx, cy), camera_from_world in zip(
        workload.cameras.intrinsics.tolist(), workload.cameras.camera_from_world.double().numpy(), strict=True
    ):
        width, height = workload.width, workload.height
        film = {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}, "sample_border": True}
        sensors.append(
            {
                "type": "perspective",
                "fov": float(np.rad2deg(2 * np.arctan(width / (2 * fx)))),
                "fov_axis": "x",
                "principal_point_offset_x": 0.5 - cx / width,
                "principal_point_offset_y": 0.5 - cy / height,
                "to_world": mi.ScalarTransform4f(np.linalg.inv(camera_from_world) @ np.diag([-1.0, -1.0, 1.0, 1.0])),
                "film": film,
                "sampler": {"type": "independent", "sample_count": 1},
            }
        )
    return sensors


def _camera_rays(workload: Workload):
    """Rays through all pixel centres of all views."""
    mi = loaded_mitsuba()
    y, x = torch.meshgrid(torch.arange(workload.height) + 0.5, torch.arange(workload.width) + 0.5, indexing="ij")
    intrinsics, rotation = workload.cameras.intrinsics[:, :, None, None], workload.cameras.camera_from_world[:, :3, :3]
    in_camera = torch.stack([(x - intrinsics[:, 2]) / intrinsics[:, 0], (y - intrinsics[:, 3]) / intrinsics[:, 1]], dim=-1)
    in_camera = torch.nn.functional.pad(in_camera, (0, 1), value=1.0)  # [B, H, W, 3]
    directions = torch.einsum("bji,bhwj->bhwi", rotation, in_camera)
    origins = workload.cameras.centers[:, None, None].expand_as(directions)
    columns = [[flat_array(array[..., axis].contiguous()) for axis in range(3)] for array in (origins, directions)]
    return mi.Ray3f(mi.Point3f(*columns[0]), mi.Vector3f(*columns[1]))


def occlusion_contenders(rig: Rig, size: int, rays: int) -> dict[str, Callable[[], object] | None]:
    """Calls that make the occlusion map of the rest pose, unlimited in distance; None for libraries that are not installed."""
    vertices = torch.from_numpy(rig.rest_vertices)
    ours = AmbientOcclusion(rig.topology, size, rays=rays, distance=100.0)
    normals = vertex_normals(vertices[None], ours.faces)
    texels = ours.atlas.texels_from_vertices(torch.cat([vertices[None], normals], dim=2))[0].flatten(1)[:, ours.covered].t()
    normals = torch.nn.functional.normalize(texels[:, 3:], dim=1).numpy()
    points = texels[:, :3].numpy() + LIFT * normals
    return {
        "ours": lambda: ours.bake(vertices),
        "trimesh and embreex": _trimesh_occlusion(rig, points, normals, rays),
        "libigl and Embree": _libigl_occlusion(rig, points, normals, rays),
    }


def _trimesh_occlusion(rig: Rig, points: np.ndarray, normals: np.ndarray, rays: int) -> Callable[[], np.ndarray] | None:
    try:
        import embreex  # noqa: F401
        import trimesh
    except ImportError:
        return None

    def bake() -> np.ndarray:
        mesh = trimesh.Trimesh(rig.rest_vertices, rig.topology.faces, process=False)
        origins = np.repeat(points, rays, axis=0)
        random = np.random.default_rng(0).normal(size=origins.shape)
        # A normal plus a point on the unit sphere is cosine-distributed around the normal.
        directions = np.repeat(normals, rays, axis=0) + random / np.linalg.norm(random, axis=1, keepdims=True)
        return 1 - mesh.ray.intersects_any(origins, directions).reshape(-1, rays).mean(axis=1)

    return bake


def _libigl_occlusion(rig: Rig, points: np.ndarray, normals: np.ndarray, rays: int) -> Callable[[], np.ndarray] | None:
    try:
        from igl import embree
    except ImportError:
        return None
    vertices, faces = rig.rest_vertices.astype(np.float64), rig.topology.faces.astype(np.int64)
    points, normals = points.astype(np.float64), normals.astype(np.float64)
    return lambda: 1 - embree.ambient_occlusion(vertices, faces, points, normals, rays)
