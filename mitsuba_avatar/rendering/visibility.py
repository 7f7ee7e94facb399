"""Primary visibility: which face, and where on it, every sample of every pixel of every view sees. One launch for all views.

Only cells of the film that list faces (`face_grid`) are looked at: a lane is one sample of one pixel of such a cell, so that neighbouring
lanes test the same faces.
"""

from dataclasses import dataclass

from mitsuba_avatar.rendering.backend import loaded_mitsuba
from mitsuba_avatar.rendering.batch import SurfaceBatch
from mitsuba_avatar.rendering.facing import Triangle
from mitsuba_avatar.rendering.views import View

TEA_ROUNDS = 6  # fewer rounds leave correlations that bias gradients by tens of per cent (measured with 3)


@dataclass
class Sight:
    """What a camera ray meets first, one per lane.

    Attributes:
        is_hit: whether it meets anything.
        face: of the topology, 0..F-1; 0 for a miss.
        barycentric: Point2f, weights of the face's second and third vertex.
        depth: metres along the camera's z axis; infinite for a miss.
    """

    is_hit: object
    face: object
    barycentric: object
    depth: object


@dataclass
class Hits:
    """Foreground samples, one per lane: only those that hit their own mesh.

    Attributes:
        count: number of lanes.
        pixel: [count] index into the B * H * W pixels of the batch.
        view: [count] row of the camera table.
        slot: [count] which of the samples looked at this is, those of a pixel one after the other; num_slots: how many there are.
        face: [count] face of the topology, 0..F-1.
        barycentric: Point2f, weights of the face's second and third vertex.
        depth: [count] metres along the camera's z axis.
        cells: [N] cells that list faces.
    """

    count: int
    pixel: object
    view: object
    slot: object
    num_slots: int
    face: object
    barycentric: object
    depth: object
    cells: object

    def columns(self) -> list:
        """The arrays, to evaluate them together with what is computed from them."""
        return [self.pixel, self.view, self.slot, self.face, self.barycentric, self.depth]


def nearest_face(batch: SurfaceBatch, view: View, view_index, position, active=True) -> Sight:
    """What the ray through a position on the film (Point2f, pixels) of a view meets first: all faces of its cell are tested.

    The test is that of Moeller and Trumbore ("Fast, minimum storage ray/triangle intersection", 1997), with normals computed beforehand.
    """
    import drjit as dr

    mi = loaded_mitsuba()
    grid, (width, height) = batch.grid, batch.film
    column = mi.UInt32(dr.clip(position.x, 0.0, width - 1.0)) // grid.cell
    row = mi.UInt32(dr.clip(position.y, 0.0, height - 1.0)) // grid.cell
    cell = (view_index * grid.down + row) * grid.across + column
    end = dr.gather(mi.UInt32, grid.end, cell, active)
    start = end - dr.gather(mi.UInt32, grid.count, cell, active)
    direction, center, first = view.direction(position), view.center, batch.mesh_of(view_index) * batch.tables.num_faces

    def test(entry, depth, b1, b2, nearest):
        face = dr.gather(mi.UInt32, grid.faces, entry)
        triangle = Triangle.gather(batch.triangles, first + face)
        towards = triangle.corner - center
        volume = dr.dot(triangle.normal, direction)
        across = dr.cross(direction, towards)
        inverse = dr.rcp(volume)
        u, v = -dr.dot(across, triangle.edge2) * inverse, dr.dot(across, triangle.edge1) * inverse
        t = dr.dot(triangle.normal, towards) * inverse
        # The order of a cell's faces varies from run to run: where two are equally near, the first of the topology counts.
        is_nearer = (t < depth) | ((t == depth) & (face < nearest))
        is_met = (volume != 0) & (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0) & is_nearer
        return (
            entry + 1,
            dr.select(is_met, t, depth),
            dr.select(is_met, u, b1),
            dr.select(is_met, v, b2),
            dr.select(is_met, face, nearest),
        )

    _, depth, b1, b2, face = dr.while_loop(
        state=(start, mi.Float(dr.inf), mi.Float(0.0), mi.Float(0.0), mi.UInt32(0)),
        cond=lambda entry, *_: entry < end,
        body=test,
        labels=("entry", "depth", "b1", "b2", "nearest"),
    )
    return Sight(depth < dr.inf, face, mi.Point2f(b1, b2), depth)


def jitter(pixel, sample, seed, samples_per_pixel: int):
    """Position of a sample inside its pixel, in [0, 1)^2: a sequence over the samples, shifted randomly per pixel and seed."""
    mi = loaded_mitsuba()
    first, second = mi.sample_tea_32(pixel, seed, TEA_ROUNDS)
    shift = mi.Point2f(mi.Float(first) * 2.0**-32, mi.Float(second) * 2.0**-32)
    return shift if samples_per_pixel == 1 else golden_lattice(sample, samples_per_pixel, shift)


def golden_lattice(index, count: int, shift):
    """Point `index` of `count` evenly spread ones, moved by `shift` on the torus, in [0, 1)^2: i / count against i times the golden ratio.

    As a set of fixed size it is spread more evenly than an open-ended sequence (occlusion at 64 rays: error 13 % below the R2 sequence's).
    """
    import drjit as dr

    mi = loaded_mitsuba()
    step = mi.Float(index)
    point = shift + mi.Point2f(step * (1.0 / count), step * 0.6180339887)
    return point - dr.floor(point)


def trace_views(batch: SurfaceBatch) -> Hits | None:
    """Look through all samples of all cells that list faces and keep those that meet one; None when there is none. Not evaluated."""
    import drjit as dr

    if batch.grid is None:
        return None
    mi = loaded_mitsuba()
    cells = dr.compress(batch.grid.count > 0)
    num_slots = len(cells) * batch.grid.cell**2 * batch.samples_per_pixel
    lane = dr.arange(mi.UInt32, num_slots)
    pixel, view_index, x, y = pixel_of_slot(batch, cells, lane // batch.samples_per_pixel)
    position = mi.Point2f(x, y) + jitter(pixel, lane % batch.samples_per_pixel, batch.seed, batch.samples_per_pixel)
    is_on_film = (x < batch.film[0]) & (y < batch.film[1])
    sight = nearest_face(batch, View.gather(batch.views, view_index), view_index, position, is_on_film)
    # One packet a hit: compaction then reads one cache line instead of four.
    packets = dr.empty(mi.Float, num_slots * 4)
    packet = mi.Vector4f(*sight.barycentric, sight.depth, dr.reinterpret_array(mi.Float, sight.face))
    dr.scatter(packets, packet, lane, sight.is_hit, mode=dr.ReduceMode.NoConflicts)
    dr.eval(packets, sight.is_hit)
    slot = dr.compress(sight.is_hit)
    if len(slot) == 0:
        return None
    pixel, view_index, _, _ = pixel_of_slot(batch, cells, slot // batch.samples_per_pixel)
    packet = dr.gather(mi.Vector4f, packets, slot)
    face, barycentric = dr.reinterpret_array(mi.UInt32, packet.w), mi.Point2f(packet.x, packet.y)
    return Hits(len(slot), pixel, view_index, slot, num_slots, face, barycentric, packet.z, cells)


def pixel_of_slot(batch: SurfaceBatch, cells, slot) -> tuple:
    """Index of a pixel among all of the batch, its view, and its x and y, from its number among the pixels of `cells`."""
    import drjit as dr

    mi = loaded_mitsuba()
    grid, (width, height) = batch.grid, batch.film
    listed = slot // grid.cell**2
    within = slot - listed * grid.cell**2
    cell = dr.gather(mi.UInt32, cells, listed)
    view_index = cell // (grid.across * grid.down)
    cell -= view_index * (grid.across * grid.down)
    row = cell // grid.across
    x = (cell - row * grid.across) * grid.cell + within % grid.cell
    y = row * grid.cell + within // grid.cell
    return (view_index * height + y) * width + x, view_index, x, y
