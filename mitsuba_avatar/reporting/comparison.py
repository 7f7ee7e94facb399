"""The comparison that a paper shows: every method beside the capture, enlarged where they differ most, with maps of both errors.

Three lines a view: the pictures, cut out around the person, each with enlarged insets; the absolute error; FLIP. All methods share the
cut, the insets and the colour scales. Images are display-encoded (sRGB), [H, W, 3] in 0..1.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw
from scipy.ndimage import uniform_filter

from mitsuba_avatar.reporting.figures import Tile, View, compose, error_map, heat_map, to_bytes
from mitsuba_avatar.reporting.metrics import mean_over, mse_in_mask, psnr_from_mse
from mitsuba_avatar.reporting.protocols import flip_map

MARGIN = 0.06  # of the person's height, around the cut
INSET_SHARE = 0.2  # of the cut's height that the side of an inset shows
INSETS = 2
INSET_COLOURS = ((255, 90, 70), (80, 170, 255))
FLIP_MAXIMUM = 0.6  # that the map draws brightest
ABSOLUTE_MAXIMUM = 0.25
_GAP = 3  # pixels between a picture and its insets


@dataclass(frozen=True)
class Cut:
    """A rectangle of a picture, in pixels: rows top..bottom, columns left..right, ends excluded."""

    top: int
    bottom: int
    left: int
    right: int

    def of(self, image: Float[np.ndarray, "H W *C"]) -> Float[np.ndarray, "h w *C"]:
        """What lies in the rectangle."""
        return image[self.top : self.bottom, self.left : self.right]


def person_cut(mask: Float[np.ndarray, "H W"]) -> Cut:
    """The rectangle around a person, with a margin, inside the picture; the whole picture where there is nobody."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    height, width = mask.shape
    if not len(rows):
        return Cut(0, height, 0, width)
    margin = max(1, round(MARGIN * (rows[-1] + 1 - rows[0])))
    return Cut(
        max(0, int(rows[0]) - margin),
        min(height, int(rows[-1]) + 1 + margin),
        max(0, int(columns[0]) - margin),
        min(width, int(columns[-1]) + 1 + margin),
    )


def inset_cuts(difference: Float[np.ndarray, "H W"], side: int, count: int = INSETS) -> list[Cut]:
    """Squares that hold the most difference, largest first, that do not overlap; fewer where the map has no room for more.

    Args:
        difference: what to look for, 0 where nothing is to be shown.
        side: of a square, pixels.
    """
    side = min(side, *difference.shape)
    sums = uniform_filter(np.asarray(difference, np.float64), side, mode="constant")
    half = side // 2
    inside = np.zeros_like(sums, dtype=bool)  # centres of squares that lie in the picture as a whole
    inside[half : difference.shape[0] - (side - half) + 1, half : difference.shape[1] - (side - half) + 1] = True
    sums = np.where(inside, sums, -1.0)
    cuts: list[Cut] = []
    while len(cuts) < count and sums.max() > 0:
        row, column = np.unravel_index(int(sums.argmax()), sums.shape)
        top, left = int(row) - half, int(column) - half
        cuts.append(Cut(top, top + side, left, left + side))
        sums[max(0, row - side + 1) : row + side, max(0, column - side + 1) : column + side] = -1.0
    return cuts


def inset_grid(
    views: Sequence[View], methods: Mapping[str, Sequence[Float[np.ndarray, "H W 3"]]], height: int = 320
) -> UInt8[np.ndarray, "h w 3"]:
    """The comparison of some views: columns are the capture and the methods, see the module.

    Args:
        views: of the capture.
        methods: name -> pictures of the same views; insets show where the first method is worst.
        height: of every picture, in pixels.

    Raises:
        ValueError: if a method has more or fewer pictures than there are views.
    """
    for name, images in methods.items():
        if len(images) != len(views):
            raise ValueError(f"inset_grid(): expected {len(views)} pictures of {name}; got {len(images)}. Render the same views.")
    rows = []
    for index, view in enumerate(views):
        pictures = {name: images[index] for name, images in methods.items()}
        rows += _view_rows(view, pictures, height)
    return compose(rows, height)


def _view_rows(view: View, pictures: Mapping[str, Float[np.ndarray, "H W 3"]], height: int) -> list[list[Tile]]:
    """Pictures with insets, absolute errors, FLIP errors."""
    cut, flips = person_cut(view.mask), {name: flip_map(picture, view.image) for name, picture in pictures.items()}
    worst = next(iter(flips.values()), np.zeros_like(view.mask)) * view.mask
    insets = inset_cuts(cut.of(worst), max(4, round(INSET_SHARE * (cut.bottom - cut.top))))

    def tile(label: str, image: Float[np.ndarray, "H W 3"]) -> Tile:
        return Tile(label, _with_insets(cut.of(image), insets, height))

    def scores(name: str) -> tuple[str, str]:
        if not view.mask.any():
            return "absolute", "FLIP"
        decibels = psnr_from_mse(mse_in_mask(pictures[name], view.image, view.mask))
        return f"absolute, {decibels:.1f} dB", f"FLIP, {mean_over(flips[name], view.mask):.3f}"

    top = [tile(f"capture {view.label}", view.image)] + [tile(name, picture) for name, picture in pictures.items()]
    absolute = [_scale_tile("absolute error", "inferno", ABSOLUTE_MAXIMUM)]
    flip = [_scale_tile("FLIP error", "magma", FLIP_MAXIMUM)]
    for name, picture in pictures.items():
        absolute.append(tile(scores(name)[0], error_map(picture, view.image, ABSOLUTE_MAXIMUM)))
        flip.append(tile(scores(name)[1], heat_map(flips[name], FLIP_MAXIMUM, "magma")))
    return [top, absolute, flip]


def _with_insets(image: Float[np.ndarray, "h w 3"], insets: Sequence[Cut], height: int) -> Float[np.ndarray, "H W 3"]:
    """The picture scaled to a height, frames around the insets, and the insets enlarged in a column to its right."""
    scale = height / image.shape[0]
    picture = Image.fromarray(to_bytes(image)).resize((max(1, round(image.shape[1] * scale)), height), Image.Resampling.LANCZOS)
    side = (height - _GAP * (INSETS - 1)) // INSETS
    canvas = Image.new("RGB", (picture.width + (_GAP + side if insets else 0), height), (24, 24, 28))
    draw = ImageDraw.Draw(picture)
    for number, (inset, colour) in enumerate(zip(insets, INSET_COLOURS, strict=False)):
        draw.rectangle(
            [round(scale * edge) for edge in (inset.left, inset.top, inset.right - 1, inset.bottom - 1)], outline=colour, width=2
        )
        enlarged = Image.fromarray(to_bytes(inset.of(image))).resize((side, side), Image.Resampling.NEAREST)
        ImageDraw.Draw(enlarged).rectangle((0, 0, side - 1, side - 1), outline=colour, width=2)
        canvas.paste(enlarged, (picture.width + _GAP, number * (side + _GAP)))
    canvas.paste(picture, (0, 0))
    return np.asarray(canvas, np.float32) / 255


def _scale_tile(label: str, name: str, maximum: float) -> Tile:
    """The colours of an error map from 0 below to its maximum above."""
    ramp = np.repeat(np.linspace(maximum, 0, 256)[:, None], 24, axis=1)
    return Tile(f"{label}: 0 (below) to {maximum:g}", heat_map(ramp, maximum, name))
