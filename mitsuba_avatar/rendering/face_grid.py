"""The faces that each small square of each view's film may show: what takes the place of a ray-tracing hierarchy for camera rays.

Rays of a camera differ in two dimensions only: where a face projects to tells which rays can meet it. So the faces of all views are sorted
into cells of the film, by the bounding boxes of their projections, and a ray tests the faces of its cell, a dozen on average
(`visibility.nearest_face`). Sorting the faces of eight views costs half of what rebuilding Embree's hierarchy of one mesh does, that of
one view next to nothing, and further meshes cost no more than further views.

Of a closed mesh, wound outwards, only faces seen from the front are listed: nothing else can be met first from outside. Views whose camera
may be inside, and open meshes, list all.
"""

from math import log2

from mitsuba_avatar.rendering.backend import loaded_mitsuba
from mitsuba_avatar.rendering.batch import FaceGrid, SurfaceBatch
from mitsuba_avatar.rendering.facing import is_front
from mitsuba_avatar.rendering.views import NEAR, View

CELLS_ACROSS = 128  # of a film's longer side, about: cells much smaller list faces many times, much larger ones list many faces
ROUNDING = 1e-5  # of the film's longer side: by more than this the projection of a vertex and the ray towards it never disagree


def cell_size(film: tuple[int, int]) -> int:
    """Pixels on a side of the cells of a film (width, height): a power of two."""
    return 2 ** max(0, round(log2(max(film) / CELLS_ACROSS)))


def camera_points(batch: SurfaceBatch):
    """Packets [B * V, 4]: the vertices of every view's mesh in its camera axes, metres."""
    import drjit as dr

    mi = loaded_mitsuba()
    num_vertices = batch.num_vertices
    lane = dr.arange(mi.UInt32, batch.num_views * num_vertices)
    view_index = lane // num_vertices
    vertex = batch.vertex(batch.mesh_of(view_index) * num_vertices + lane - view_index * num_vertices)
    point = View.gather(batch.views, view_index).to_camera(vertex)
    points = dr.empty(mi.Float, len(lane) * 4)
    dr.scatter(points, mi.Vector4f(*point, 0.0), lane, mode=dr.ReduceMode.NoConflicts)
    dr.eval(points)
    return points


def build_face_grid(batch: SurfaceBatch) -> FaceGrid | None:
    """Sort the faces of all views into cells: count them, reserve room, fill it. None where no view lists a face."""
    import drjit as dr

    mi = loaded_mitsuba()
    cell = cell_size(batch.film)
    across, down = (-(-pixels // cell) for pixels in batch.film)
    listed = _listed_faces(batch)
    if len(listed) == 0:
        return None
    view_index = listed // batch.tables.num_faces
    face = listed - view_index * batch.tables.num_faces
    first_x, first_y, last_x, last_y = _covered_cells(batch, view_index, face, cell)
    start = view_index * (across * down)
    dr.eval(face, start, first_x, first_y, last_x, last_y)

    def visit(action):
        """Call `action` with the index of every cell under each face's bounding box."""

        def body(x, y):
            action(start + y * across + x)
            is_row_done = x >= last_x
            return dr.select(is_row_done, first_x, x + 1), dr.select(is_row_done, y + 1, y)

        # Copies: a loop changes its state in place.
        state = (mi.UInt32(first_x), mi.UInt32(first_y))
        dr.while_loop(state=state, cond=lambda x, y: y <= last_y, body=body, labels=("x", "y"))

    count = dr.zeros(mi.UInt32, batch.num_views * across * down)
    visit(lambda index: dr.scatter_add(count, mi.UInt32(1), index, mode=dr.ReduceMode.Direct))
    dr.eval(count)
    total = int(dr.sum(count)[0])
    if total == 0:
        return None
    end = dr.prefix_sum(count)  # exclusive: where a cell's faces begin; filling moves it to where they end
    faces = dr.empty(mi.UInt32, total)
    visit(lambda index: dr.scatter(faces, face, dr.scatter_inc(end, index), mode=dr.ReduceMode.NoConflicts))
    dr.eval(faces, end)
    return FaceGrid(cell, across, down, count, end, faces)


def _listed_faces(batch: SurfaceBatch):
    """Lanes (view * F + face) that a view can show."""
    import drjit as dr

    mi = loaded_mitsuba()
    num_faces = batch.tables.num_faces
    lane = dr.arange(mi.UInt32, batch.num_views * num_faces)
    if not batch.tables.is_closed:
        return lane
    view_index = lane // num_faces
    depth = dr.gather(mi.Float, batch.points, dr.arange(mi.UInt32, batch.num_views * batch.num_vertices) * 4 + 2)
    # A camera with the whole mesh before it is outside of it.
    is_outside = dr.block_reduce(dr.ReduceOp.Min, depth, batch.num_vertices) > NEAR
    dr.eval(is_outside)
    return dr.compress(is_front(batch, view_index, lane - view_index * num_faces) | ~dr.gather(mi.Bool, is_outside, view_index))


def _covered_cells(batch: SurfaceBatch, view_index, face, cell: int) -> tuple:
    """First and last cell across and down under the bounding box of a face; the last row is before the first where it is off the film."""
    import drjit as dr

    mi = loaded_mitsuba()
    corners = dr.gather(mi.Vector4u, batch.tables.faces, face)
    points = [batch.point(view_index, corner) for corner in (corners.x, corners.y, corners.z)]
    view = View.gather(batch.views, view_index)
    low, high = mi.Point2f(dr.inf), mi.Point2f(-dr.inf)
    for k in range(3):
        point, after = points[k], points[(k + 1) % 3]
        # The part before the camera: corners there, and where sides cross the near plane.
        share = (NEAR - point.z) / (after.z - point.z)
        for candidate, counts in ((point, point.z > NEAR), (dr.lerp(point, after, share), (point.z > NEAR) != (after.z > NEAR))):
            pixel = view.project(candidate)
            low = dr.select(counts, dr.minimum(low, pixel), low)
            high = dr.select(counts, dr.maximum(high, pixel), high)
    width, height = batch.film
    margin = ROUNDING * max(width, height)
    low, high = low - margin, high + margin
    is_seen = (high.x >= 0) & (high.y >= 0) & (low.x < width) & (low.y < height)
    first_x, first_y = (mi.UInt32(dr.clip(value, 0.0, limit - 1.0)) // cell for value, limit in ((low.x, width), (low.y, height)))
    last_x, last_y = (mi.UInt32(dr.clip(value, 0.0, limit - 1.0)) // cell for value, limit in ((high.x, width), (high.y, height)))
    return first_x, dr.select(is_seen, first_y, last_y + 1), last_x, last_y
