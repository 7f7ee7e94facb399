"""Interior of the surface: radiance of the samples that hit it, and the adjoint of that radiance to texels and vertices.

For a ray fixed in its pixel, a face with vertices v0, v1, v2, edges e1 = v1 - v0, e2 = v2 - v0 and barycentric weights b1, b2 of its
last two vertices: moving the face by q at the hit point changes the weights so that the point stays on the ray d,

    db1 = -q . (e2 x d) / D,   db2 = -q . (d x e1) / D,   D = e1 . (e2 x d).

With L(u(b1, b2)) the texture at the hit, the adjoint of the loss reaches q, and from there each vertex by its weight. Silhouettes are
not covered by this: `contour` has their share.
"""

from mitsuba_avatar.rendering.backend import loaded_mitsuba
from mitsuba_avatar.rendering.batch import SurfaceBatch
from mitsuba_avatar.rendering.surface_tables import SurfaceTables
from mitsuba_avatar.rendering.texture_lookup import Footprint
from mitsuba_avatar.rendering.views import View
from mitsuba_avatar.rendering.visibility import Hits


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


def scatter_image(batch: SurfaceBatch, hits: Hits, radiance):
    """Image packets [B * H * W, 4]: radiance premultiplied by coverage, and the coverage (mask)."""
    import drjit as dr

    mi = loaded_mitsuba()
    image = dr.zeros(mi.Float, batch.num_pixels * 4)
    packet = mi.Vector4f(radiance.x, radiance.y, radiance.z, 1.0)
    if batch.samples_per_pixel == 1:  # no two lanes share a pixel
        dr.scatter(image, packet, hits.pixel)
    else:
        dr.scatter_add(image, packet * (1.0 / batch.samples_per_pixel), hits.pixel)
    return image


def scatter_shading_adjoint(batch: SurfaceBatch, hits: Hits, adjoint_image, vertex_gradient, texture_gradient) -> None:
    """Add the interior's share to the gradients of vertices and textures.

    Args:
        adjoint_image: packets [B * H * W, 4]; the mask's entry has no interior derivative.
        vertex_gradient, texture_gradient: packets [P * V, 4] and [B * h * w, 4], accumulated in place; None where not wanted.
    """
    import drjit as dr

    mi = loaded_mitsuba()
    height, width = batch.texture_size
    view = View.gather(batch.views, hits.view)
    packet = dr.gather(mi.Vector4f, adjoint_image, hits.pixel) * (1.0 / batch.samples_per_pixel)
    adjoint = mi.Color3f(packet.x, packet.y, packet.z)
    uv0, uv1, uv2 = corner_uv(batch.tables, hits.face)
    b1, b2 = hits.barycentric.x, hits.barycentric.y
    footprint = Footprint.at(uv0 + (uv1 - uv0) * b1 + (uv2 - uv0) * b2, hits.view, height, width)
    if texture_gradient is not None:
        footprint.scatter_adjoint(texture_gradient, adjoint)
    if vertex_gradient is None:
        return
    along_u, along_v = footprint.derivative(batch.textures, height, width)
    gradient_u, gradient_v = dr.dot(adjoint, along_u), dr.dot(adjoint, along_v)
    gradient_b1 = gradient_u * (uv1.x - uv0.x) + gradient_v * (uv1.y - uv0.y)
    gradient_b2 = gradient_u * (uv2.x - uv0.x) + gradient_v * (uv2.y - uv0.y)

    corners = dr.gather(mi.Vector4u, batch.tables.faces, hits.face)
    base = view.mesh * batch.num_vertices
    index = (base + corners.x, base + corners.y, base + corners.z)
    v0, v1, v2 = (mi.Vector3f(p.x, p.y, p.z) for p in (dr.gather(mi.Vector4f, batch.vertices, i) for i in index))
    e1, e2 = v1 - v0, v2 - v0
    # The ray's direction from the hit itself, scaled to unit depth: no random numbers need repeating.
    hit = view.to_camera(v0 + e1 * b1 + e2 * b2)
    direction = view.to_world_direction(hit / hit.z)
    across_e2, across_e1 = dr.cross(e2, direction), dr.cross(direction, e1)
    volume = dr.dot(e1, across_e2)
    # A face seen exactly edge-on covers no area: it has no interior derivative.
    inverse = dr.select(dr.abs(volume) > 1e-20, dr.rcp(volume), 0.0)
    moved = -(gradient_b1 * across_e2 + gradient_b2 * across_e1) * inverse
    for i, weight in zip(index, (1.0 - b1 - b2, b1, b2), strict=True):
        dr.scatter_add(vertex_gradient, mi.Vector4f(moved.x * weight, moved.y * weight, moved.z * weight, 0.0), i)
