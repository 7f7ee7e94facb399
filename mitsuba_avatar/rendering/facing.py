"""Triangles ready for rays, and which views see them from the front: needed to list what a view can show and to find its contours.

A triangle is three packets of four floats: corner v0, edges e1 = v1 - v0 and e2 = v2 - v0, and the normal e1 x e2 (not normalised). A
point is in front of it where n . (point - v0) > 0.
"""

from dataclasses import dataclass

from mitsuba_avatar.rendering.backend import loaded_mitsuba
from mitsuba_avatar.rendering.batch import SurfaceBatch

VIEWS_PER_WORD = 32  # bits of an integer


@dataclass
class Triangle:
    """One triangle per lane, Vector3f each, local coordinates in metres."""

    corner: object
    edge1: object
    edge2: object
    normal: object

    @staticmethod
    def gather(triangles, index) -> "Triangle":
        """Triangle mesh * F + face of the packets that `pack_triangles` makes."""
        import drjit as dr

        mi = loaded_mitsuba()
        a, b, c = (dr.gather(mi.Vector4f, triangles, index * 3 + k) for k in range(3))
        return Triangle(mi.Vector3f(a.x, a.y, a.z), mi.Vector3f(a.w, b.x, b.y), mi.Vector3f(b.z, b.w, c.x), mi.Vector3f(c.y, c.z, c.w))

    def height(self, point):
        """Height of a point over the triangle's plane, times the normal's length."""
        import drjit as dr

        return dr.dot(self.normal, point - self.corner)


def pack_triangles(batch: SurfaceBatch):
    """Packets [P * F, 3, 4] of all meshes' triangles."""
    import drjit as dr

    mi = loaded_mitsuba()
    num_faces = batch.tables.num_faces
    lane = dr.arange(mi.UInt32, batch.num_meshes * num_faces)
    mesh = lane // num_faces
    base = mesh * batch.num_vertices
    corners = dr.gather(mi.Vector4u, batch.tables.faces, lane - mesh * num_faces)
    v0, v1, v2 = (batch.vertex(base + corner) for corner in (corners.x, corners.y, corners.z))
    e1, e2 = v1 - v0, v2 - v0
    normal = dr.cross(e1, e2)
    triangles = dr.empty(mi.Float, len(lane) * 12)
    packets = ((*v0, e1.x), (e1.y, e1.z, e2.x, e2.y), (e2.z, *normal))
    for k, packet in enumerate(packets):
        dr.scatter(triangles, mi.Vector4f(*packet), lane * 3 + k, mode=dr.ReduceMode.NoConflicts)
    return triangles


def views_from_front(batch: SurfaceBatch):
    """Bits [words * P * F]: bit k of word w says whether view 32 w + k looks at the face's mesh and sees the face from the front."""
    import drjit as dr

    mi = loaded_mitsuba()
    num_triangles = batch.num_meshes * batch.tables.num_faces
    lane = dr.arange(mi.UInt32, num_words(batch) * num_triangles)
    word = lane // num_triangles
    index = lane - word * num_triangles
    triangle = Triangle.gather(batch.triangles, index)
    mesh = mi.Float(index // batch.tables.num_faces)
    bits = mi.UInt32(0)
    for k in range(min(VIEWS_PER_WORD, batch.num_views)):
        view = word * VIEWS_PER_WORD + k
        center = dr.gather(mi.Vector4f, batch.centers, view, view < batch.num_views)
        is_front = triangle.height(mi.Vector3f(center.x, center.y, center.z)) > 0
        bits |= dr.select((view < batch.num_views) & (center.w == mesh) & is_front, mi.UInt32(1 << k), 0)
    dr.eval(bits)
    return bits


def is_front(batch: SurfaceBatch, view_index, face):
    """Whether a view sees a face (0..F-1) of its mesh from the front."""
    import drjit as dr

    mi = loaded_mitsuba()
    word = view_index // VIEWS_PER_WORD * batch.num_meshes + batch.mesh_of(view_index)
    bits = dr.gather(mi.UInt32, batch.front, word * batch.tables.num_faces + face)
    return (bits >> (view_index % VIEWS_PER_WORD)) & 1 == 1


def num_words(batch: SurfaceBatch) -> int:
    """Words that hold a bit for every view."""
    return -(-batch.num_views // VIEWS_PER_WORD)
