"""Which faces a view may show, and where: the bounding boxes of their projections on the film.

Rays of a camera differ in two dimensions only, so where a face projects to tells which rays can meet it, and no ray-tracing hierarchy is
needed: `rasterization` goes through the samples under each box.

Of a closed mesh, wound outwards, only faces seen from the front are listed: nothing else can be met first from outside. Views whose camera
may be inside, and open meshes, list all.
"""

from dataclasses import dataclass
from math import log2

from mitsuba_avatar.rendering.backend import loaded_mitsuba
from mitsuba_avatar.rendering.batch import FaceBoxes, SurfaceBatch
from mitsuba_avatar.rendering.facing import is_front
from mitsuba_avatar.rendering.views import NEAR, View

BINS_ACROSS = 256
OFF_FILM = 1 << 24  # more rows than any film has
ROUNDING = 1e-5  # of the film's longer side: by more than this the projection of a vertex and the ray towards it never disagree


@dataclass(frozen=True)
class FilmUnits:
    """How boxes, bins and pixels of a film measure it, in powers of two.

    Boxes are measured in units of 2^-pixel_bits pixels; a bin is 2^bin_bits units wide.
    """

    width: int
    height: int
    pixel_bits: int
    bin_bits: int

    @staticmethod
    def of(film: tuple[int, int]) -> "FilmUnits":
        """Those of a film (width, height)."""
        finer = round(log2(BINS_ACROSS / max(film)))
        return FilmUnits(*film, max(finer, 0), max(-finer, 0))

    @property
    def bins(self) -> tuple[int, int]:
        """Bins across and down."""
        return tuple(-(-(pixels << self.pixel_bits) >> self.bin_bits) for pixels in (self.width, self.height))

    def measure(self, position) -> tuple:
        """The unit (UInt32) that a position (Point2f, pixels) lies in, across and down; the nearest one of the film for one beside it."""
        import drjit as dr

        mi = loaded_mitsuba()
        scale = float(1 << self.pixel_bits)
        return tuple(
            mi.UInt32(dr.clip(value * scale, 0.0, limit * scale - 1.0))
            for value, limit in ((position.x, self.width), (position.y, self.height))
        )


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


def list_faces(batch: SurfaceBatch) -> FaceBoxes | None:
    """The faces that the views may show; None where no view shows any."""
    import drjit as dr

    listed = _listed_faces(batch)
    if len(listed) == 0:
        return None
    view_index = listed // batch.tables.num_faces
    face = listed - view_index * batch.tables.num_faces
    boxes = FaceBoxes(view_index, face, *_bounds(batch, view_index, face))
    dr.eval(boxes)
    return boxes


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


def _bounds(batch: SurfaceBatch, view_index, face) -> tuple:
    """First and last unit across and down under the bounding box of a face; beside the film the first row is OFF_FILM."""
    import drjit as dr

    mi = loaded_mitsuba()
    points = batch.corner_points(view_index, face)
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
    units = FilmUnits.of(batch.film)
    (first_x, first_y), (last_x, last_y) = units.measure(low), units.measure(high)
    return first_x, dr.select(is_seen, first_y, OFF_FILM), last_x, last_y
