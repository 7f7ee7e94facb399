"""The differentiable surface renderer: meshes and UV textures in, radiance and mask of many views out, gradients back, through torch.

Shading and its adjoint are written by hand in Dr.Jit (`visibility`, `shading`, `contour`); Mitsuba supplies the scene, its ray-tracing
hierarchy and the rays. The `bridge` carries tensors between torch and Dr.Jit, a `dr.CustomOp` hangs the adjoint into the graph.

The surface has no emitter and no bsdf here: the texture *is* outgoing radiance (paper, section 3.2), one texture per view.
"""

from dataclasses import dataclass
from typing import no_type_check

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mitsuba_avatar.body.rig import Topology
from mitsuba_avatar.rendering import contour, face_boxes, facing, shading, visibility
from mitsuba_avatar.rendering.backend import loaded_mitsuba
from mitsuba_avatar.rendering.batch import SurfaceBatch
from mitsuba_avatar.rendering.bridge import differentiable, flat_array, torch_tensor
from mitsuba_avatar.rendering.cameras import CameraBatch
from mitsuba_avatar.rendering.layers import scatter_layers
from mitsuba_avatar.rendering.surface_tables import SurfaceTables
from mitsuba_avatar.rendering.texture_lookup import planar_texels, texel_packets
from mitsuba_avatar.rendering.views import place


@dataclass(frozen=True)
class SurfaceLayers:
    """Images of a batch and the geometry behind them.

    Radiance and mask average all samples of a pixel and carry gradients. The others show its *first* sample, are 0 where that misses the
    surface, and carry none.

    Attributes:
        radiance: [B, 3, H, W] premultiplied by coverage.
        mask: [B, 1, H, W] coverage in 0..1.
        normal: [B, 3, H, W] unit face normal, outwards by winding, world axes.
        depth: [B, 1, H, W] metres along the camera's z axis.
        position: [B, 3, H, W] metres, world axes.
        uv: [B, 2, H, W] texture coordinates.
    """

    radiance: Float[Tensor, "B 3 H W"]
    mask: Float[Tensor, "B 1 H W"]
    normal: Float[Tensor, "B 3 H W"]
    depth: Float[Tensor, "B 1 H W"]
    position: Float[Tensor, "B 3 H W"]
    uv: Float[Tensor, "B 2 H W"]


class SurfaceRenderer:
    """Renders one topology on one film size. Scenes are built once per number of meshes and then updated.

    Args:
        topology: welded faces and per-corner texture coordinates.
        width, height: film size in pixels; crops are made by shifting principal points (`CameraBatch.shifted`), never the film.
        samples_per_pixel: primal rays a pixel, jittered inside it (box filter).
        boundary_samples_per_edge: stratified positions on a contour edge, on average (long edges get more); silhouette noise falls like
            its reciprocal.
    """

    def __init__(self, topology: Topology, width: int, height: int, samples_per_pixel: int = 1, boundary_samples_per_edge: int = 4):
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
        self._operation = _make_operation()
        self._wrapped = differentiable(self._render_drjit)

    def render(
        self,
        vertices: Float[Tensor, "P V 3"],
        textures: Float[Tensor, "B 3 h w"],
        cameras: CameraBatch,
        mesh_index: Int[Tensor, " B"] | None = None,
        seed: int = 0,
        background: Float[Tensor, "..."] | None = None,
    ) -> tuple[Float[Tensor, "B 3 H W"], Float[Tensor, "B 1 H W"]]:
        """Draw B views, each of one of P meshes.

        Args:
            vertices: [P, V, 3] metres, world axes.
            textures: [B, 3, h, w] linear radiance, one per view, row 0 at v = 1.
            cameras: B cameras.
            mesh_index: [B] which mesh each view shows; by default B / P consecutive views share a mesh.
            seed: pixel jitter and boundary samples derive from it; equal seeds give equal images, and those of consecutive seeds
                complement each other (`pixel_sampling`): an optimizer counts up.
            background: linear radiance behind the surface: [3] one colour, [B, 3] one a view, or plates [B, 3, H, W]. None is black.

        Returns:
            radiance [B, 3, H, W] over the background (over black it is premultiplied by coverage), and mask [B, 1, H, W], the share of
            each pixel that the surface covers.

        Gradients: flow to vertices (shading and silhouettes, for radiance and mask), textures and background; cameras are constants.
        One backward pass per render: combine the losses first.

        Raises:
            ValueError: shapes that do not match the topology or each other; vertices or cameras that are not finite. What textures
                hold is not looked at: one that is not finite shows in the image.
            TypeError: another element type than float32.
        """
        radiance, mask, _ = self._draw(vertices, textures, cameras, mesh_index, self._call(vertices, textures, seed, has_layers=False))
        return (radiance, mask) if background is None else (_over(background, radiance, mask), mask)

    def render_layers(
        self,
        vertices: Float[Tensor, "P V 3"],
        textures: Float[Tensor, "B 3 h w"],
        cameras: CameraBatch,
        mesh_index: Int[Tensor, " B"] | None = None,
        seed: int = 0,
    ) -> SurfaceLayers:
        """What `render` draws, and the geometry behind it, from the same pass; arguments and errors are those of `render`."""
        radiance, mask, layers = self._draw(vertices, textures, cameras, mesh_index, self._call(vertices, textures, seed, has_layers=True))
        normal, depth, position, uv = layers[:, :3], layers[:, 3:4], layers[:, 4:7], layers[:, 8:10]
        return SurfaceLayers(radiance, mask, normal, depth, position, uv)

    def derivative(
        self,
        vertices: Float[Tensor, "P V 3"],
        textures: Float[Tensor, "B 3 h w"],
        cameras: CameraBatch,
        motion: Float[Tensor, "P V 3"],
        mesh_index: Int[Tensor, " B"] | None = None,
        seed: int = 0,
    ) -> tuple[Float[Tensor, "B 3 H W"], Float[Tensor, "B 1 H W"]]:
        """How fast every pixel of radiance and mask changes where the vertices move along `motion`: the forward derivative.

        Its products with a loss's adjoint image are those of the loss's vertex gradient (same seed) with the motion. Arguments and
        errors are those of `render`; nothing carries gradients here.
        """
        import drjit as dr

        mi = loaded_mitsuba()
        mesh_index = self._check(vertices, textures, cameras, mesh_index)
        with torch.no_grad():
            placement = place(vertices, cameras, mesh_index)
            packets = flat_array(torch.nn.functional.pad(motion, (0, 1)))
        tables = tuple(mi.TensorXf(table) for table in (placement.vertices, placement.views, placement.centers))
        batch = self.batch(mi.TensorXf(textures.detach().contiguous()), tables, seed)
        hits = visibility.trace_views(batch)
        radiance, mask = dr.zeros(mi.Float, batch.num_pixels * 4), dr.zeros(mi.Float, batch.num_pixels)
        if hits is not None:
            shading.scatter_shading_derivative(batch, hits, packets, radiance)
        samples = contour.sample_contours(batch, self.boundary_samples_per_edge)
        if samples is not None:
            contour.scatter_contour_derivative(samples, packets, radiance, mask)
        shape = (batch.num_views, self.film[1], self.film[0])
        radiance = torch_tensor(radiance, (*shape, 4)).permute(0, 3, 1, 2)[:, :3]
        return radiance, torch_tensor(mask, shape)[:, None]

    def batch(self, textures, tables: tuple, seed: int) -> SurfaceBatch:
        """What one launch renders, from Dr.Jit tensors: textures [B, 3, h, w] and the tables of a `Placement`."""
        import drjit as dr

        mi = loaded_mitsuba()
        vertices, views, centers = tables
        batch = SurfaceBatch(
            tables=self.tables,
            vertices=vertices.array,
            textures=texel_packets(textures),
            views=views.array,
            centers=centers.array,
            num_meshes=vertices.shape[0],
            num_vertices=vertices.shape[1],
            num_views=textures.shape[0],
            texture_size=(textures.shape[2], textures.shape[3]),
            film=self.film,
            samples_per_pixel=self.samples_per_pixel,
            seed=dr.opaque(mi.UInt32, seed & 0xFFFFFFFF),
        )
        batch.triangles = facing.pack_triangles(batch)
        batch.front = facing.views_from_front(batch)
        batch.points = face_boxes.camera_points(batch)
        batch.boxes = face_boxes.list_faces(batch)
        return batch

    @staticmethod
    def _call(vertices: Tensor, textures: Tensor, seed: int, has_layers: bool) -> "Call":
        is_recording = torch.is_grad_enabled()
        return Call(seed, has_layers, is_recording and vertices.requires_grad, is_recording and textures.requires_grad)

    def _check(self, vertices: Tensor, textures: Tensor, cameras: CameraBatch, mesh_index: Tensor | None) -> Tensor:
        num_meshes, num_views, num_vertices = len(vertices), len(textures), self.topology.num_vertices
        for name, tensor in (("vertices", vertices), ("textures", textures)):
            if tensor.dtype != torch.float32:
                raise TypeError(f"render(): {name} must be float32; got {tensor.dtype}. Convert with .float().")
        if num_meshes == 0 or num_views == 0:
            raise ValueError(f"render(): expected at least one view and one mesh; got {num_views} and {num_meshes}.")
        if textures.ndim != 4 or textures.shape[1] != 3 or 0 in textures.shape:
            raise ValueError(f"render(): textures must be [B, 3, h, w]; got {list(textures.shape)}.")
        if vertices.shape[1] != num_vertices:
            raise ValueError(
                f"render(): vertices must be [P, {num_vertices}, 3] for this topology; got {list(vertices.shape)}. "
                "Load mesh and capture from the same rig file."
            )
        if len(cameras) != num_views:
            raise ValueError(f"render(): expected one texture per camera; got {num_views} textures and {len(cameras)} cameras.")
        if mesh_index is None:
            if num_views % num_meshes:
                raise ValueError(f"render(): {num_views} views cannot be shared evenly by {num_meshes} meshes. Pass mesh_index.")
            mesh_index = torch.arange(num_meshes).repeat_interleave(num_views // num_meshes)
        if len(mesh_index) != num_views or not 0 <= int(mesh_index.min()) <= int(mesh_index.max()) < num_meshes:
            raise ValueError(f"render(): mesh_index must hold {num_views} values in 0..{num_meshes - 1}; got {mesh_index.tolist()}.")
        for name, values in (
            ("vertices of mesh", vertices.detach()),
            ("cameras of view", torch.cat([cameras.intrinsics, cameras.camera_from_world.flatten(1)], dim=1)),
        ):
            if bool(torch.isfinite(values.sum())):  # a fifth of the time of looking at each
                continue
            is_finite = torch.isfinite(values.flatten(1)).all(dim=1).tolist()
            if not all(is_finite):
                bad = [i for i, finite in enumerate(is_finite) if not finite]
                raise ValueError(f"render(): {name} {bad} are not finite. Look for a diverged decoder or a damaged frame.")
        return mesh_index

    def _draw(
        self, vertices: Tensor, textures: Tensor, cameras: CameraBatch, mesh_index: Tensor | None, call: "Call"
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Radiance, mask, and layers [B, 12, H, W] where the call asks for them."""
        mesh_index = self._check(vertices, textures, cameras, mesh_index)
        with torch.no_grad():
            placement = place(vertices.detach(), cameras, mesh_index)
        tables = (placement.vertices, placement.views, placement.centers)
        radiance, mask, layers = self._wrapped(vertices, textures.contiguous(), tables, call)
        if not call.has_layers:
            return radiance, mask, layers
        width, height = self.film
        layers = layers.detach().view(len(textures), height, width, 12).permute(0, 3, 1, 2).clone()
        is_hit = layers[:, 3:4] > 0
        layers[:, 4:7] += is_hit * vertices.detach().mean(dim=1)[mesh_index][:, :, None, None]  # from local to world coordinates
        return radiance, mask, layers

    def _render_drjit(self, vertices, textures, tables, call):
        import drjit as dr

        return dr.custom(self._operation, vertices, textures, tables, call, self)


class Call:
    """What distinguishes one call from the next beside its tensors. No dataclass: Dr.Jit would look for gradients in its fields.

    Args:
        seed: of the whole call.
        has_layers: whether depth, normal, position and texture coordinates are drawn too.
        moves_vertices, moves_textures: whose gradients are wanted.
    """

    def __init__(self, seed: int, has_layers: bool, moves_vertices: bool, moves_textures: bool):
        self.seed, self.has_layers, self.moves_vertices, self.moves_textures = seed, has_layers, moves_vertices, moves_textures


def _over(background: Tensor, radiance: Float[Tensor, "B 3 H W"], mask: Float[Tensor, "B 1 H W"]) -> Float[Tensor, "B 3 H W"]:
    """Premultiplied radiance over a background of one of the shapes that `render` takes."""
    count, _, height, width = radiance.shape
    if tuple(background.shape) not in ((3,), (count, 3), (count, 3, height, width)):
        raise ValueError(
            f"render(): background must be [3], [{count}, 3] or [{count}, 3, {height}, {width}] for these views; got "
            f"{list(background.shape)}. Resize or crop plates as the film."
        )
    plates = background if background.ndim == 4 else background[..., None, None]
    return radiance + (1 - mask) * plates.to(radiance)


def _make_operation():
    """The custom operation as a class; made late, because drjit must not be imported before libLLVM is chosen."""
    import drjit as dr

    @no_type_check  # Dr.Jit finds inputs by the names in `eval`'s own code; a wrapper that checks types hides them, and gradients with them
    class SurfaceOperation(dr.CustomOp):
        """Radiance and mask of a batch, with a hand-written backward pass."""

        def eval(self, vertices, textures, tables, call, renderer):
            mi = loaded_mitsuba()
            self.renderer, self.call, self.shapes = renderer, call, (vertices.shape, textures.shape)
            self.batch = renderer.batch(textures, tables, call.seed)  # `vertices` itself only receives the gradient
            self.hits = visibility.trace_views(self.batch)
            batch, (width, height) = self.batch, renderer.film
            radiance, mask = dr.zeros(mi.Float, batch.num_pixels * 3), dr.zeros(mi.Float, batch.num_pixels)
            layers = dr.zeros(mi.Float, batch.num_pixels * 12 if call.has_layers else 1)
            if self.hits is not None:
                shading.scatter_image(batch, self.hits, shading.shade(batch, self.hits), radiance, mask)
                if call.has_layers:
                    scatter_layers(batch, self.hits, layers)
            dr.eval(radiance, mask, layers, self.hits.columns() if self.hits is not None else [])
            return (
                mi.TensorXf(radiance, (batch.num_views, 3, height, width)),
                mi.TensorXf(mask, (batch.num_views, 1, height, width)),
                mi.TensorXf(layers, (len(layers),)),
            )

        def backward(self):
            mi = loaded_mitsuba()
            batch, call = self.batch, self.call
            radiance_adjoint, mask_adjoint, _ = self.grad_out()
            adjoint_image = shading.AdjointImage(radiance_adjoint.array, mask_adjoint.array, batch.film[0] * batch.film[1])
            vertex_shape, texture_shape = self.shapes
            vertex_gradient = dr.zeros(mi.Float, vertex_shape[0] * vertex_shape[1] * 4) if call.moves_vertices else None
            texture_gradient = dr.zeros(mi.Float, batch.num_texels * 4) if call.moves_textures else None
            if self.hits is not None:
                shading.scatter_shading_adjoint(batch, self.hits, adjoint_image, vertex_gradient, texture_gradient)
            if call.moves_vertices:
                samples = contour.sample_contours(batch, self.renderer.boundary_samples_per_edge)
                if samples is not None:
                    contour.scatter_contour_adjoint(samples, adjoint_image, vertex_gradient)
                self.set_grad_in("vertices", mi.TensorXf(unpack_gradient(vertex_gradient), vertex_shape))
            if call.moves_textures:
                self.set_grad_in("textures", mi.TensorXf(planar_texels(texture_gradient, texture_shape), texture_shape))

        def name(self):
            return "mitsuba_avatar.surface"

    return SurfaceOperation


def unpack_gradient(packets):
    """Packets [N, 4] to flat [N * 3]."""
    import drjit as dr

    mi = loaded_mitsuba()
    lane = dr.arange(mi.UInt32, len(packets) // 4)
    packet = dr.gather(mi.Vector4f, packets, lane)
    flat = dr.empty(mi.Float, len(packets) // 4 * 3)
    dr.scatter(flat, mi.Vector3f(packet.x, packet.y, packet.z), lane)
    return flat
