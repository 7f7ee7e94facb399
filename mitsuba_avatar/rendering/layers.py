"""Geometry behind the image: depth, normal, position and texture coordinates of the first sample of every pixel."""

from mitsuba_avatar.rendering.backend import loaded_mitsuba
from mitsuba_avatar.rendering.batch import SurfaceBatch
from mitsuba_avatar.rendering.shading import face_corners, interpolated_uv
from mitsuba_avatar.rendering.visibility import Hits


def scatter_layers(batch: SurfaceBatch, hits: Hits, layers) -> None:
    """Write packets [B * H * W, 12]: normal, depth | position in local coordinates, 0 | u, v, 0, 0."""
    import drjit as dr

    mi = loaded_mitsuba()
    is_first = hits.slot % batch.samples_per_pixel == 0
    b1, b2 = hits.barycentric.x, hits.barycentric.y
    _, (v0, v1, v2) = face_corners(batch, hits.view, hits.face)
    e1, e2 = v1 - v0, v2 - v0
    normal = dr.normalize(dr.cross(e1, e2))
    position = v0 + e1 * b1 + e2 * b2
    uv = interpolated_uv(batch.tables, hits.face, hits.barycentric)
    dr.scatter(layers, mi.Vector4f(normal.x, normal.y, normal.z, hits.depth), hits.pixel * 3, is_first)
    dr.scatter(layers, mi.Vector4f(position.x, position.y, position.z, 0.0), hits.pixel * 3 + 1, is_first)
    dr.scatter(layers, mi.Vector4f(uv.x, uv.y, 0.0, 0.0), hits.pixel * 3 + 2, is_first)
