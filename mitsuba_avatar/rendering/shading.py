"""Interior of the surface: radiance of the samples that hit it, and the adjoint of that radiance to texels and vertices.

For a ray fixed in its pixel, a face with vertices v0, v1, v2, edges e1 = v1 - v0, e2 = v2 - v0 and barycentric weights b1, b2 of its
last two vertices: moving the face by q at the hit point changes the weights so that the point stays on the ray d,

    db1 = -q . (e2 x d) / D,   db2 = -q . (d x e1) / D,   D = e1 . (e2 x d).

With L(u(b1, b2)) the texture at the hit, the adjoint of the loss reaches q, and from there each vertex by its weight; the derivative
along a motion of the vertices runs the other way. Silhouettes are not covered by this: `contour` has their share.
"""

from dataclasses import dataclass

from mitsuba_avatar.rendering.backend import loaded_mitsuba
from mitsuba_avatar.rendering.batch import SurfaceBatch
from mitsuba_avatar.rendering.surface_tables import SurfaceTables
from mitsuba_avatar.rendering.texture_lookup import Footprint
from mitsuba_avatar.rendering.views import View
from mitsuba_avatar.rendering.visibility import Hits


def face_corners(batch: SurfaceBatch, view_index, face) -> tuple:
    """Packet indices of a face's three vertices in the mesh of its view, and their local positions (Vector3f)."""
    import drjit as dr

    mi = loaded_mitsuba()
    corners = dr.gather(mi.Vector4u, batch.tables.faces, face)
    base = batch.mesh_of(view_index) * batch.num_vertices
    index = (base + corners.x, base + corners.y, base + corners.z)
    return index, tuple(batch.vertex(i) for i in index)


def corner_uv(tables: SurfaceTables, face):
    """Texture coordinates of a face's three corners, Point2f each."""
    import drjit as dr

    mi = loaded_mitsuba()
    first = dr.gather(mi.Vector4f, tables.face_uv, face * 2)
    last = dr.gather(mi.Vector4f, tables.face_uv, face * 2 + 1)
    return mi.Point2f(first.x, first.y), mi.Point2f(first.z, first.w), mi.Point2f(last.x, last.y)


def interpolated_uv(tables: SurfaceTables, face, barycentric):
    """Texture coordinates (Point2f) at barycentric weights of a face's second and third corner."""
    uv0, uv1, uv2 = corner_uv(tables, face)
    return uv0 + (uv1 - uv0) * barycentric.x + (uv2 - uv0) * barycentric.y


def shade(batch: SurfaceBatch, hits: Hits):
    """Outgoing radiance (Color3f) of every hit: a bilinear lookup in the texture of its view."""
    uv = interpolated_uv(batch.tables, hits.face, hits.barycentric)
    return Footprint.at(uv, hits.view, *batch.texture_size).value(batch.textures)


def scatter_image(batch: SurfaceBatch, hits: Hits, radiance, image, mask) -> None:
    """Write to image [B, 3, H, W] the radiance premultiplied by coverage, and to mask [B, H, W] the coverage; both flat.

    The samples of a pixel are added in their own order, not as they come: equal seeds give equal images, to the last bit.
    """
    import drjit as dr

    mi = loaded_mitsuba()
    count = batch.samples_per_pixel
    if count == 1:  # no two lanes share a pixel
        _write_pixels(batch, hits.pixel, hits.view, mi.Vector4f(*radiance, 1.0), image, mask)
        return
    samples = dr.zeros(mi.Float, hits.num_slots * 4)
    dr.scatter(samples, mi.Vector4f(*radiance, 1.0), hits.slot, mode=dr.ReduceMode.NoConflicts)
    lane = dr.arange(mi.UInt32, hits.num_slots // count)
    _, total = dr.while_loop(
        state=(mi.UInt32(0), mi.Vector4f(0.0)),
        cond=lambda sample, _: sample < count,
        body=lambda sample, total: (sample + 1, total + dr.gather(mi.Vector4f, samples, lane * count + sample)),
        labels=("sample", "total"),
    )
    view_index, x, y = hits.tiles.pixel_of_slot(lane)
    pixel = batch.pixel_index(view_index, x, y)
    is_on_film = (x < batch.film[0]) & (y < batch.film[1])
    _write_pixels(batch, pixel, view_index, total * (1.0 / count), image, mask, is_on_film)


def _write_pixels(batch: SurfaceBatch, pixel, view_index, value, image, mask, active=True) -> None:
    """Set radiance and coverage (Vector4f) of pixels, each written once."""
    import drjit as dr

    plane = batch.film[0] * batch.film[1]
    first = pixel + view_index * (2 * plane)
    targets = [(image, first + channel * plane, value[channel]) for channel in range(3)]
    for target, index, channel in (*targets, (mask, pixel, value.w)):
        # NoConflicts: otherwise each scatter to one image is a kernel of its own.
        dr.scatter(target, channel, index, active, mode=dr.ReduceMode.NoConflicts)


@dataclass(frozen=True)
class AdjointImage:
    """Derivative of the loss by radiance [B, 3, H, W] and mask [B, H, W], both flat, as the backward pass receives them."""

    radiance: object
    mask: object
    plane: int  # pixels of one view

    def at(self, pixel, view, active=True) -> tuple:
        """The entries of a pixel (index into B * H * W) of a view: Color3f and Float."""
        import drjit as dr

        mi = loaded_mitsuba()
        first = pixel + view * (2 * self.plane)
        channels = [dr.gather(mi.Float, self.radiance, first + channel * self.plane, active) for channel in range(3)]
        return mi.Color3f(*channels), dr.gather(mi.Float, self.mask, pixel, active)


@dataclass(frozen=True)
class HitDerivatives:
    """How a hit's radiance follows the surface that moves under its ray.

    Attributes:
        vertices: packet indices of the face's corners; weights: barycentric.
        footprint: of the texture lookup.
        slope_u, slope_v: Vector3f, derivatives of u and v by the motion of the hit point, in world axes.
    """

    vertices: tuple
    weights: tuple
    footprint: Footprint
    slope_u: object
    slope_v: object


def hit_derivatives(batch: SurfaceBatch, hits: Hits) -> HitDerivatives:
    """See the module for the equations."""
    import drjit as dr

    view = View.gather(batch.views, hits.view)
    b1, b2 = hits.barycentric.x, hits.barycentric.y
    uv0, uv1, uv2 = corner_uv(batch.tables, hits.face)
    uv_e1, uv_e2 = uv1 - uv0, uv2 - uv0
    index, (v0, v1, v2) = face_corners(batch, hits.view, hits.face)
    e1, e2 = v1 - v0, v2 - v0
    # The ray's direction from the hit itself, scaled to unit depth: no random numbers need repeating.
    hit = view.to_camera(v0 + e1 * b1 + e2 * b2)
    direction = view.to_world_direction(hit / hit.z)
    across_e2, across_e1 = dr.cross(e2, direction), dr.cross(direction, e1)
    volume = dr.dot(e1, across_e2)
    # A face seen exactly edge-on covers no area: it has no interior derivative.
    inverse = dr.select(dr.abs(volume) > 1e-20, dr.rcp(volume), 0.0)
    slope_u = (across_e2 * uv_e1.x + across_e1 * uv_e2.x) * -inverse
    slope_v = (across_e2 * uv_e1.y + across_e1 * uv_e2.y) * -inverse
    footprint = Footprint.at(uv0 + uv_e1 * b1 + uv_e2 * b2, hits.view, *batch.texture_size)
    return HitDerivatives(index, (1.0 - b1 - b2, b1, b2), footprint, slope_u, slope_v)


def scatter_shading_adjoint(batch: SurfaceBatch, hits: Hits, adjoint_image: AdjointImage, vertex_gradient, texture_gradient) -> None:
    """Add the interior's share to the gradients of vertices and textures.

    Args:
        adjoint_image: derivative of the loss; the mask has none in the interior.
        vertex_gradient, texture_gradient: packets [P * V, 4] and [B * h * w, 4], accumulated in place; None where not wanted.
    """
    import drjit as dr

    mi = loaded_mitsuba()
    adjoint = adjoint_image.at(hits.pixel, hits.view)[0] * (1.0 / batch.samples_per_pixel)
    hit = hit_derivatives(batch, hits)
    if texture_gradient is not None:
        hit.footprint.scatter_adjoint(texture_gradient, adjoint)
    if vertex_gradient is None:
        return
    along_u, along_v = hit.footprint.derivative(batch.textures, *batch.texture_size)
    moved = hit.slope_u * dr.dot(adjoint, along_u) + hit.slope_v * dr.dot(adjoint, along_v)
    for index, weight in zip(hit.vertices, hit.weights, strict=True):
        dr.scatter_add(vertex_gradient, mi.Vector4f(moved.x * weight, moved.y * weight, moved.z * weight, 0.0), index)


def scatter_shading_derivative(batch: SurfaceBatch, hits: Hits, motion, radiance) -> None:
    """Add the interior's share to the derivative of the image along a motion of the vertices.

    Args:
        motion: packets [P * V, 4], metres a unit.
        radiance: packets [B * H * W, 4], accumulated in place.
    """
    import drjit as dr

    mi = loaded_mitsuba()
    hit = hit_derivatives(batch, hits)
    moved = mi.Vector3f(0.0)
    for index, weight in zip(hit.vertices, hit.weights, strict=True):
        packet = dr.gather(mi.Vector4f, motion, index)
        moved += mi.Vector3f(packet.x, packet.y, packet.z) * weight
    along_u, along_v = hit.footprint.derivative(batch.textures, *batch.texture_size)
    gain = (along_u * dr.dot(hit.slope_u, moved) + along_v * dr.dot(hit.slope_v, moved)) * (1.0 / batch.samples_per_pixel)
    dr.scatter_add(radiance, mi.Vector4f(gain.x, gain.y, gain.z, 0.0), hits.pixel)
