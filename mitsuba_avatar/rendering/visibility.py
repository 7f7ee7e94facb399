"""Primary visibility: which face, and where on it, every sample of every pixel of every view sees. One launch for all views.

Only tiles of the film that a face's bounding box touches have slots for samples: memory follows what the body covers, not the film.
"""

from dataclasses import dataclass
from math import log2

from mitsuba_avatar.rendering.backend import loaded_mitsuba
from mitsuba_avatar.rendering.batch import SurfaceBatch
from mitsuba_avatar.rendering.face_boxes import FilmUnits
from mitsuba_avatar.rendering.pixel_sampling import PIXELS, jitter, random_shift
from mitsuba_avatar.rendering.rasterization import NearestFaces, ProjectedFace, normalized
from mitsuba_avatar.rendering.views import View

TILES_ACROSS = 128  # of a film's longer side, about
SAMPLES_AT_ONCE = 4  # of a pixel, tested in one turn of the loop


@dataclass(frozen=True)
class Tiles:
    """The tiles of all views' films that faces may touch; a tile is a square of pixels.

    Attributes:
        bits: a tile is 2^bits pixels wide.
        across, down: tiles of one film.
        index: [N] of those touched among all B * down * across.
        rank: [B * down * across] their place in `index`; undefined for others.
    """

    bits: int
    across: int
    down: int
    index: object
    rank: object

    def first_slot(self, view_index, x, y):
        """Slot of a pixel of a touched tile: slots number the pixels of touched tiles, tile after tile."""
        import drjit as dr

        tile = (view_index * self.down + (y >> self.bits)) * self.across + (x >> self.bits)
        within = (1 << self.bits) - 1
        rank = dr.gather(loaded_mitsuba().UInt32, self.rank, tile)
        return (rank << (2 * self.bits)) + ((y & within) << self.bits) + (x & within)

    def pixel_of_slot(self, slot) -> tuple:
        """View, x and y of a slot's pixel, which may lie beyond the right or lower border of the film."""
        import drjit as dr

        within = (1 << self.bits) - 1
        tile = dr.gather(loaded_mitsuba().UInt32, self.index, slot >> (2 * self.bits))
        view_index = tile // (self.across * self.down)
        tile -= view_index * (self.across * self.down)
        row = tile // self.across
        x = ((tile - row * self.across) << self.bits) + (slot & within)
        return view_index, x, (row << self.bits) + ((slot >> self.bits) & within)


@dataclass
class Hits:
    """Foreground samples, one per lane: only those that hit their own mesh.

    Attributes:
        count: number of lanes.
        pixel: [count] index into the B * H * W pixels of the batch.
        view: [count] row of the camera table.
        slot: [count] which of the samples of touched tiles this is, those of a pixel one after the other; num_slots: how many there are.
        face: [count] face of the topology, 0..F-1.
        barycentric: Point2f, weights of the face's second and third vertex.
        depth: [count] metres along the camera's z axis.
        tiles: those touched.
    """

    count: int
    pixel: object
    view: object
    slot: object
    num_slots: int
    face: object
    barycentric: object
    depth: object
    tiles: Tiles

    def columns(self) -> list:
        """The arrays, to evaluate them together with what is computed from them."""
        return [self.pixel, self.view, self.slot, self.face, self.barycentric, self.depth]


def tile_bits(film: tuple[int, int]) -> int:
    """Tiles of a film (width, height) are 2^bits pixels wide."""
    return max(0, round(log2(max(film) / TILES_ACROSS)))


def find_tiles(batch: SurfaceBatch) -> Tiles:
    """Those that the bounding boxes of listed faces touch."""
    import drjit as dr

    mi = loaded_mitsuba()
    bits, boxes = tile_bits(batch.film), batch.boxes
    across, down = (-(-pixels >> bits) for pixels in batch.film)
    first_x, last_x, first_y, last_y = boxes.coarser(FilmUnits.of(batch.film).pixel_bits + bits)
    first_tile = boxes.view_index * (across * down)
    touched = dr.zeros(mi.Bool, batch.num_views * across * down)

    def touch(x, y):
        dr.scatter(touched, mi.Bool(True), first_tile + y * across + x)
        is_row_done = x >= last_x
        return dr.select(is_row_done, first_x, x + 1), dr.select(is_row_done, y + 1, y)

    # Copies: a loop changes its state in place.
    dr.while_loop(state=(mi.UInt32(first_x), mi.UInt32(first_y)), cond=lambda x, y: y <= last_y, body=touch, labels=("x", "y"))
    index = dr.compress(touched)
    rank = dr.empty(mi.UInt32, len(touched))
    dr.scatter(rank, dr.arange(mi.UInt32, len(index)), index)
    dr.eval(rank)
    return Tiles(bits, across, down, index, rank)


def rasterize_pixels(batch: SurfaceBatch, tiles: Tiles) -> NearestFaces:
    """The nearest face at every sample of the pixels of touched tiles."""
    import drjit as dr

    mi = loaded_mitsuba()
    boxes, count = batch.boxes, batch.samples_per_pixel
    nearest = NearestFaces.none((len(tiles.index) << (2 * tiles.bits)) * count)
    projected = ProjectedFace.of(batch.corner_points(boxes.view_index, boxes.face))
    view = View.gather(batch.views, boxes.view_index)
    first_x, last_x, first_y, last_y = boxes.coarser(FilmUnits.of(batch.film).pixel_bits)
    at_once = next(number for number in range(min(count, SAMPLES_AT_ONCE), 0, -1) if count % number == 0)

    def test(x, y, sample):
        slot = tiles.first_slot(boxes.view_index, x, y) * count + sample
        pixel_offset = random_shift(batch.pixel_index(boxes.view_index, x, y), PIXELS, batch.seed, count)
        for k in range(at_once):
            position = mi.Point2f(x, y) + jitter(pixel_offset, sample + k, count)
            is_met, closeness = projected.meets(*normalized(view, position))
            nearest.enter(slot + k, boxes.face, closeness, is_met)
        sample += at_once
        is_pixel_done = sample >= count
        is_row_done = is_pixel_done & (x >= last_x)
        x = dr.select(is_row_done, first_x, dr.select(is_pixel_done, x + 1, x))
        return x, dr.select(is_row_done, y + 1, y), dr.select(is_pixel_done, 0, sample)

    dr.while_loop(
        state=(mi.UInt32(first_x), mi.UInt32(first_y), dr.zeros(mi.UInt32, dr.width(first_x))),
        cond=lambda x, y, sample: y <= last_y,
        body=test,
        labels=("x", "y", "sample"),
    )
    dr.eval(nearest.keys)
    return nearest


def trace_views(batch: SurfaceBatch) -> Hits | None:
    """What all samples of all views see; None when no sample meets its mesh. Only `slot` is evaluated."""
    import drjit as dr

    if batch.boxes is None:
        return None
    tiles = find_tiles(batch)
    if len(tiles.index) == 0:
        return None
    nearest, count = rasterize_pixels(batch, tiles), batch.samples_per_pixel
    slot = dr.compress(nearest.keys != 0)
    if len(slot) == 0:
        return None
    mi = loaded_mitsuba()
    view_index, x, y = tiles.pixel_of_slot(slot // count)
    _, face = nearest.at(slot)
    pixel = batch.pixel_index(view_index, x, y)
    position = mi.Point2f(x, y) + jitter(random_shift(pixel, PIXELS, batch.seed, count), slot % count, count)
    barycentric, depth = meeting_point(batch, View.gather(batch.views, view_index), view_index, face, position)
    return Hits(len(slot), pixel, view_index, slot, len(nearest.keys), face, barycentric, depth, tiles)


def meeting_point(batch: SurfaceBatch, view: View, view_index, face, position) -> tuple:
    """Where the ray through a position on the film (Point2f) meets a face's plane: weights of its last two corners (Point2f), and depth."""
    import drjit as dr

    closeness, first, second = ProjectedFace.of(batch.corner_points(view_index, face)).at(*normalized(view, position))
    depth = dr.rcp(closeness)
    return loaded_mitsuba().Point2f(first * depth, second * depth), depth
