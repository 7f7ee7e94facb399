"""The differentiable surface renderer: meshes and UV textures in, radiance and mask of many views out, gradients back, through torch.

Shading and its adjoint are written by hand in Dr.Jit (`visibility`, `shading`, `contour`); Mitsuba supplies the scene, its ray-tracing
hierarchy and the rays. the `bridge` carries tensors between torch and Dr.Jit, a `dr.CustomOp` hangs the adjoint into the graph.

The surface has no emitter and no bsdf here: the texture *is* outgoing radiance (paper, section 3.2), one texture per view.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mitsuba_avatar.body.rig import Topology
from mitsuba_avatar.rendering import contour, shading, visibility
from mitsuba_avatar.rendering.backend import loaded_mitsuba
from mitsuba_avatar.rendering.batch import SurfaceBatch
from mitsuba_avatar.rendering.bridge import differentiable
from mitsuba_avatar.rendering.cameras import CameraBatch
from mitsuba_avatar.rendering.scene import MeshScene
from mitsuba_avatar.rendering.surface_tables import SurfaceTables
from mitsuba_avatar.rendering.views import Placement, place


class SurfaceRenderer:
    """Renders one topology on one film size. Scenes are built once per number of meshes and then updated.

    Args:
        topology: welded faces and per-corner texture coordinates.
        width, height: film size in pixels; crops are made by shifting principal points (`CameraBatch.shifted`), never the film.
        samples_per_pixel: primal rays a pixel, jittered inside it (box filter).
        boundary_samples_per_edge: stratified positions on every contour edge; silhouette noise falls like its reciprocal.
    """

    def __init__(self, topology: Topology, width: int, height: int, samples_per_pixel: int = 1, boundary_samples_per_edge: int = 2):
        if min(width, height, samples_per_pixel, boundary_samples_per_edge) < 1:
            raise ValueError(
                f"SurfaceRenderer(): width, height and sample counts must be at least 1; got {width}, {height}, {samples_per_pixel}, "
                f"{boundary_samples_per_edge}."
            )
        self.topology = topology
        self.film = (width, height)
        self.samples_per_pixel = samples_per_pixel
        self.boundary_samples_per_edge = boundary_samples_per_edge
        self.tables = SurfaceTables(topology.faces, topology.uv, topology.uv_faces)
        self._scenes: dict[int, MeshScene] = {}
        self._operation = _make_operation()
        self._wrapped = differentiable(self._render_drjit)

    def render(
        self,
        vertices: Float[Tensor, "P V 3"],
        textures: Float[Tensor, "B 3 h w"],
        cameras: CameraBatch,
        mesh_index: Int[Tensor, " B"] | None = None,
        seed: int = 0,
    ) -> tuple[Float[Tensor, "B 3 H W"], Float[Tensor, "B 1 H W"]]:
        """Draw B views, each of one of P meshes.

        Args:
            vertices: [P, V, 3] metres, world axes.
            textures: [B, 3, h, w] linear radiance, one per view, row 0 at v = 1.
            cameras: B cameras.
            mesh_index: [B] which mesh each view shows; by default B / P consecutive views share a mesh.
            seed: pixel jitter and boundary samples derive from it, decorrelated; equal seeds give equal images.

        Returns:
            radiance [B, 3, H, W], premultiplied by coverage (add `(1 - mask) * background` to composite), and mask [B, 1, H, W], the
            share of each pixel that the surface covers.

        Gradients: flow to vertices (shading and silhouettes, for radiance and mask) and textures; cameras are constants. One backward
        pass per render: combine the losses first.

        Raises:
            ValueError: shapes that do not match the topology or each other, or vertices that are not finite.
        """
        mesh_index = self._check(vertices, textures, cameras, mesh_index)
        with torch.no_grad():
            placement = place(vertices.detach(), cameras, mesh_index)
        # Texels as packets of four floats: one 16-byte gather and one atomic add a texel.
        packed = torch.nn.functional.pad(textures.permute(0, 2, 3, 1), (0, 1)).contiguous()
        image = self._call(vertices, packed, placement, seed)
        image = image.view(len(textures), self.film[1], self.film[0], 4).permute(0, 3, 1, 2)
        return image[:, :3], image[:, 3:]

    def scene(self, num_meshes: int) -> MeshScene:
        """The scene for P meshes; made on first use."""
        if num_meshes not in self._scenes:
            self._scenes[num_meshes] = MeshScene(self.topology.faces, self.topology.num_vertices, num_meshes)
        return self._scenes[num_meshes]

    def _check(self, vertices: Tensor, textures: Tensor, cameras: CameraBatch, mesh_index: Tensor | None) -> Tensor:
        num_meshes, num_views, num_vertices = len(vertices), len(textures), self.topology.num_vertices
        if vertices.shape[1] != num_vertices:
            raise ValueError(
                f"render(): vertices must be [P, {num_vertices}, 3] for this topology; got {list(vertices.shape)}. "
                "Load mesh and capture from the same rig file."
            )
        if len(cameras) != num_views:
            raise ValueError(f"render(): expected one texture per camera; got {num_views} textures and {len(cameras)} cameras.")
        if mesh_index is None:
            if num_meshes == 0 or num_views % num_meshes:
                raise ValueError(f"render(): {num_views} views cannot be shared evenly by {num_meshes} meshes. Pass mesh_index.")
            mesh_index = torch.arange(num_meshes).repeat_interleave(num_views // num_meshes)
        if len(mesh_index) != num_views or (num_views and not 0 <= int(mesh_index.min()) <= int(mesh_index.max()) < num_meshes):
            raise ValueError(f"render(): mesh_index must hold {num_views} values in 0..{num_meshes - 1}; got {mesh_index.tolist()}.")
        finite = torch.isfinite(vertices.detach()).all(dim=2).all(dim=1)
        if not bool(finite.all()):
            bad = [i for i, ok in enumerate(finite.tolist()) if not ok]
            raise ValueError(f"render(): vertices of mesh {bad} are not finite. Look for a diverged decoder or a damaged frame.")
        return mesh_index

    def _call(self, vertices: Tensor, textures: Tensor, placement: Placement, seed: int) -> Tensor:
        return self._wrapped(vertices, textures, placement.scene_vertices, placement.offset, placement.views, placement.centers, seed)

    def _render_drjit(self, vertices, textures, scene_vertices, offset, views, centers, seed):
        import drjit as dr

        return dr.custom(self._operation, vertices, textures, scene_vertices, offset, views, centers, seed, self)


def _make_operation():
    """The custom operation as a class; made late, because drjit must not be imported before libLLVM is chosen."""
    import drjit as dr

    class SurfaceOperation(dr.CustomOp):
        """Radiance and mask of a batch, with a hand-written backward pass."""

        def eval(self, vertices, textures, scene_vertices, offset, views, centers, seed, renderer):
            mi = loaded_mitsuba()
            self.renderer = renderer
            self.shapes = (vertices.shape, textures.shape)
            num_meshes, num_vertices, num_views = vertices.shape[0], vertices.shape[1], textures.shape[0]
            scene = renderer.scene(num_meshes)
            self.scene_vertices = scene_vertices.array  # `vertices` itself only receives the gradient
            scene.update(self.scene_vertices)
            self.version = scene.version
            first, second = (dr.opaque(mi.UInt32, value) for value in decorrelated_seeds(seed))
            batch = SurfaceBatch(
                scene=scene,
                tables=renderer.tables,
                vertices=local_packets(self.scene_vertices, offset.array, num_vertices),
                textures=textures.array,
                views=views.array,
                centers=centers.array,
                num_views=num_views,
                texture_size=(textures.shape[1], textures.shape[2]),
                film=renderer.film,
                samples_per_pixel=renderer.samples_per_pixel,
                seed=first,
                seed_gradient=second,
            )
            batch.boxes = visibility.bound_views(batch)
            self.hits = visibility.trace_views(batch)
            self.batch = batch
            if self.hits is None:
                image = dr.zeros(mi.Float, batch.num_pixels * 4)
            else:
                image = shading.scatter_image(batch, self.hits, shading.shade(batch, self.hits))
            dr.eval(image)
            return mi.TensorXf(image, (num_views, renderer.film[1], renderer.film[0], 4))

        def backward(self):
            mi = loaded_mitsuba()
            batch = self.batch
            adjoint_image = self.grad_out().array
            vertex_shape, texture_shape = self.shapes
            vertex_gradient = dr.zeros(mi.Float, vertex_shape[0] * vertex_shape[1] * 4)
            texture_gradient = dr.zeros(mi.Float, batch.num_views * texture_shape[1] * texture_shape[2] * 4)
            if self.hits is not None:
                shading.scatter_shading_adjoint(batch, self.hits, adjoint_image, vertex_gradient, texture_gradient)
            if batch.scene.version != self.version:  # another batch was rendered since: bring this one's meshes back
                batch.scene.update(self.scene_vertices)
                self.version = batch.scene.version
            planes = contour.face_planes(batch)
            lanes = contour.contour_edges(batch, planes)
            if len(lanes[0]) > 0:
                contour.scatter_contour_adjoint(
                    batch, planes, lanes, self.renderer.boundary_samples_per_edge, adjoint_image, vertex_gradient
                )
            self.set_grad_in("vertices", mi.TensorXf(unpack_gradient(vertex_gradient), vertex_shape))
            self.set_grad_in("textures", mi.TensorXf(texture_gradient, texture_shape))

        def name(self):
            return "mitsuba_avatar.surface"

    return SurfaceOperation


def decorrelated_seeds(seed: int) -> tuple[int, int]:
    """Seeds of the pixel jitter and of the boundary samples of one call: never equal to each other or to a neighbouring call's."""
    return (2 * seed) & 0xFFFFFFFF, (2 * seed + 1) & 0xFFFFFFFF


def local_packets(scene_vertices, offset, num_vertices: int):
    """Flat scene vertices [P * V * 3] to packets [P * V, 4] in local coordinates: minus each mesh's offset [P * 3], exactly."""
    import drjit as dr

    mi = loaded_mitsuba()
    lane = dr.arange(mi.UInt32, len(scene_vertices) // 3)
    point = dr.gather(mi.Point3f, scene_vertices, lane) - dr.gather(mi.Vector3f, offset, lane // num_vertices)
    packets = dr.empty(mi.Float, len(lane) * 4)
    dr.scatter(packets, mi.Vector4f(point.x, point.y, point.z, 0.0), lane)
    return packets


def unpack_gradient(packets):
    """Packets [N, 4] to flat [N * 3]."""
    import drjit as dr

    mi = loaded_mitsuba()
    lane = dr.arange(mi.UInt32, len(packets) // 4)
    packet = dr.gather(mi.Vector4f, packets, lane)
    flat = dr.empty(mi.Float, len(packets) // 4 * 3)
    dr.scatter(flat, mi.Vector3f(packet.x, packet.y, packet.z), lane)
    return flat
