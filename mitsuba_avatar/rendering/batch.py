"""What one launch renders: meshes, textures and views as Dr.Jit holds them. Kernels of the renderer read it, none changes it."""

from dataclasses import dataclass

from mitsuba_avatar.rendering.backend import loaded_mitsuba
from mitsuba_avatar.rendering.surface_tables import SurfaceTables


@dataclass
class FaceBoxes:
    """Faces that views may show, one per lane, with the bounding boxes of their projections in units of the film (`face_boxes`).

    Attributes:
        view_index, face: 0..B-1 and 0..F-1.
        first_x, first_y, last_x, last_y: units under the box.
    """

    view_index: object
    face: object
    first_x: object
    first_y: object
    last_x: object
    last_y: object

    def coarser(self, bits: int) -> tuple:
        """First and last column, first and last row under the boxes, in squares of 2^bits units."""
        return tuple(edge >> bits for edge in (self.first_x, self.last_x, self.first_y, self.last_y))


@dataclass
class SurfaceBatch:
    """B views of P meshes.

    Attributes:
        vertices: packets [P * V, 4], local coordinates in metres (see `views` for the frames).
        textures: packets [B * h * w, 4], linear radiance, one texture a view.
        views: flat table of camera rows (`views.place`).
        centers: packets [B, 4], local camera centres and the mesh index.
        texture_size: (h, w) texels.
        film: (width, height) pixels.
        seed: opaque UInt32.
        triangles, front: what `facing` finds.
        points, boxes: what `face_boxes` finds; boxes is None where no view shows a face.
    """

    tables: SurfaceTables
    vertices: object
    textures: object
    views: object
    centers: object
    num_meshes: int
    num_vertices: int
    num_views: int
    texture_size: tuple[int, int]
    film: tuple[int, int]
    samples_per_pixel: int
    seed: object
    triangles: object = None
    front: object = None
    points: object = None
    boxes: FaceBoxes | None = None

    @property
    def num_pixels(self) -> int:
        """Pixels of all views together."""
        return self.num_views * self.film[0] * self.film[1]

    @property
    def num_texels(self) -> int:
        """Texels of all textures together."""
        return self.num_views * self.texture_size[0] * self.texture_size[1]

    def pixel_index(self, view_index, x, y):
        """Index of a view's pixel among all B * H * W."""
        return (view_index * self.film[1] + y) * self.film[0] + x

    def mesh_of(self, view_index):
        """Which mesh (UInt32) a view shows; a literal where there is but one, so that kernels do not look it up."""
        import drjit as dr

        mi = loaded_mitsuba()
        return mi.UInt32(0) if self.num_meshes == 1 else mi.UInt32(dr.gather(mi.Float, self.centers, view_index * 4 + 3))

    def vertex(self, packet_index):
        """Local position (Vector3f) of a vertex; packet_index is mesh * V + vertex."""
        return packet_vector(self.vertices, packet_index)

    def point(self, view_index, vertex):
        """Position (Vector3f) of vertex 0..V-1 of a view's mesh in the view's camera axes."""
        return packet_vector(self.points, view_index * self.num_vertices + vertex)

    def corner_points(self, view_index, face) -> tuple:
        """Positions (Vector3f) of a face's corners in the view's camera axes."""
        import drjit as dr

        corners = dr.gather(loaded_mitsuba().Vector4u, self.tables.faces, face)
        return tuple(self.point(view_index, corner) for corner in (corners.x, corners.y, corners.z))


def packet_vector(packets, index):
    """First three numbers (Vector3f) of packets [N, 4]."""
    import drjit as dr

    mi = loaded_mitsuba()
    packet = dr.gather(mi.Vector4f, packets, index)
    return mi.Vector3f(packet.x, packet.y, packet.z)
