"""Which face each of many positions on the films shows first: every face asks the positions under its bounding box.

A face is a lane. It goes through the samples of the pixels under its box (`visibility.rasterize_pixels`), or through any positions at
all, sorted into rows of bins beforehand (`nearest_faces`), and where it covers one it enters itself by an atomic maximum of (closeness,
face). Faces of a body are many and small, so this is little work for a lane, the face stays in registers, and a test reads two numbers;
where instead a position goes through the faces near it, a test reads twelve, from anywhere.
"""

from dataclasses import dataclass

from mitsuba_avatar.rendering.backend import loaded_mitsuba
from mitsuba_avatar.rendering.batch import SurfaceBatch
from mitsuba_avatar.rendering.face_boxes import FilmUnits
from mitsuba_avatar.rendering.views import View


@dataclass
class ProjectedFace:
    """What a face is to the rays of its camera: three linear functions of the ray's direction (x, y, 1) in camera axes.

    With corners p0, p1, p2, edges e1, e2 and normal n = e1 x e2, the ray d meets the face's plane at depth t where

        1 / t = n . d / n . p0,   b1 / t = (e2 x p0) . d / n . p0,   b2 / t = (p0 x e1) . d / n . p0.

    They are evaluated relative to where the corner farthest from the camera's plane projects to, so that small faces keep their
    precision far from the film's middle. Faces that cross the camera's plane need no clipping.
    """

    anchor: object  # Point2f
    first: tuple  # value at the anchor, slope x, slope y of b1 / t
    second: tuple  # of b2 / t
    closeness: tuple  # of 1 / t

    @staticmethod
    def of(points) -> "ProjectedFace":
        """From its corners in camera axes."""
        import drjit as dr

        mi = loaded_mitsuba()
        p0, p1, p2 = points
        e1, e2 = p1 - p0, p2 - p0
        normal = dr.cross(e1, e2)
        inverse = dr.rcp(dr.dot(normal, p0))
        first, second, closeness = dr.cross(e2, p0) * inverse, dr.cross(p0, e1) * inverse, normal * inverse
        is_p0 = (p0.z >= p1.z) & (p0.z >= p2.z)
        is_p1 = ~is_p0 & (p1.z >= p2.z)
        anchor = dr.select(is_p0, p0, dr.select(is_p1, p1, p2))
        near = dr.rcp(anchor.z)
        return ProjectedFace(
            mi.Point2f(anchor.x * near, anchor.y * near),
            (dr.select(is_p1, near, 0.0), first.x, first.y),
            (dr.select(is_p0 | is_p1, 0.0, near), second.x, second.y),
            (near, closeness.x, closeness.y),
        )

    def at(self, x, y) -> tuple:
        """1 / t, b1 / t and b2 / t on the ray (x, y, 1)."""
        import drjit as dr

        dx, dy = x - self.anchor.x, y - self.anchor.y
        return tuple(
            dr.fma(along_x, dx, dr.fma(along_y, dy, value)) for value, along_x, along_y in (self.closeness, self.first, self.second)
        )

    def meets(self, x, y) -> tuple:
        """Whether the ray (x, y, 1) meets the face before the camera, and 1 / t."""
        closeness, first, second = self.at(x, y)
        return (first >= 0) & (second >= 0) & (first + second <= closeness) & (closeness > 0), closeness


@dataclass
class NearestFaces:
    """The winner at each of many positions, as 64-bit numbers that order by closeness (1 / depth) first; 0 where there is none.

    Of faces equally near the first of the topology wins, so that nothing depends on the order of lanes.
    """

    keys: object

    @staticmethod
    def none(count: int) -> "NearestFaces":
        """No winners yet."""
        import drjit as dr

        return NearestFaces(dr.zeros(_key_type(), count))

    def enter(self, slot, face, closeness, active) -> None:
        """Let a face win a position if nothing nearer has."""
        import drjit as dr

        mi = loaded_mitsuba()
        key = (_key_type()(dr.reinterpret_array(mi.UInt32, closeness)) << 32) | _key_type()(~face)
        dr.scatter_reduce(dr.ReduceOp.Max, self.keys, key, slot, active, mode=dr.ReduceMode.Direct)

    def at(self, slot, active=True) -> tuple:
        """Whether there is a winner, and its face (0 where there is none)."""
        import drjit as dr

        mi = loaded_mitsuba()
        key = dr.gather(_key_type(), self.keys, slot, active)
        is_met = key != 0
        return is_met, dr.select(is_met, ~mi.UInt32(key & 0xFFFFFFFF), 0)


def _key_type():
    import drjit as dr

    return dr.uint64_array_t(loaded_mitsuba().UInt32)


def normalized(view: View, position) -> tuple:
    """Direction (x, y, 1) in camera axes of the ray through a position (Point2f, pixels): x and y."""
    return (position.x - view.principal[0]) / view.focal[0], (position.y - view.principal[1]) / view.focal[1]


def nearest_faces(batch: SurfaceBatch, view_index, position, active) -> tuple:
    """Whether the rays through positions on the film (Point2f, pixels) of views meet a face, and which first: Bool and UInt32."""
    import drjit as dr

    mi = loaded_mitsuba()
    units = FilmUnits.of(batch.film)
    across, down = units.bins
    column, row = (unit >> units.bin_bits for unit in units.measure(position))
    bin_index = (view_index * down + row) * across + column
    x, y = normalized(View.gather(batch.views, view_index), position)
    start = dr.zeros(mi.UInt32, batch.num_views * across * down + 1)
    rank = dr.scatter_inc(start, bin_index, active)
    dr.eval(x, y, bin_index, active, rank, start)
    start = dr.prefix_sum(start)  # exclusive: the positions of bin k are start[k]..start[k + 1] - 1
    slot = dr.gather(mi.UInt32, start, bin_index, active) + rank
    rays = dr.empty(mi.Float, dr.width(x) * 2)
    dr.scatter(rays, mi.Vector2f(x, y), slot, active, mode=dr.ReduceMode.NoConflicts)
    dr.eval(slot, rays)
    nearest = NearestFaces.none(dr.width(x))
    boxes = batch.boxes
    projected = ProjectedFace.of(batch.corner_points(boxes.view_index, boxes.face))
    first_column, last_column, first_row, last_row = boxes.coarser(units.bin_bits)
    first_bin = boxes.view_index * (across * down)

    def rays_of(row, active) -> tuple:
        """The positions in the bins of a row that lie under the box: they follow each other."""
        base = first_bin + row * across
        return dr.gather(mi.UInt32, start, base + first_column, active), dr.gather(mi.UInt32, start, base + last_column + 1, active)

    def test(row, ray, end):
        is_ray = ray < end
        direction = dr.gather(mi.Vector2f, rays, ray, is_ray)
        is_met, closeness = projected.meets(direction.x, direction.y)
        nearest.enter(ray, boxes.face, closeness, is_ray & is_met)
        ray += 1
        is_row_done = ray >= end
        row = dr.select(is_row_done, row + 1, row)
        ray_of_next, end_of_next = rays_of(row, is_row_done & (row <= last_row))
        return row, dr.select(is_row_done, ray_of_next, ray), dr.select(is_row_done, end_of_next, end)

    dr.while_loop(
        state=(mi.UInt32(first_row), *rays_of(first_row, first_row <= last_row)),
        cond=lambda row, *_: row <= last_row,
        body=test,
        labels=("row", "ray", "end"),
    )
    is_met, face = nearest.at(slot, active)
    return is_met & active, face
