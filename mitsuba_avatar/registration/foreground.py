"""Foreground masks of one person before a static background: the projected body says where, the plate and colours say exactly where.

Well inside the body's projection, or inside it and unlike the plate, the person is certain, far outside impossible; between the two,
graph cuts on colours (GrabCut) decide, started by how much a pixel differs from the plate. Other people and moving things away from the
body never enter.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8
from scipy import ndimage

GRAB_CUT_ITERATIONS = 3
DIFFERENT = 30.0  # levels of 255, largest channel: differs from the plate for sure
EQUAL = 10.0  # levels: within noise and compression of the plate
BLUR = 0.8  # pixels, before comparing with the plate: noise of single pixels says nothing
UNSEEN_BAND = 2  # pixels: the uncertain band on either side of the outline where the plate is unknown
SMALLEST_PIECE = 0.02  # of the person's pixels; smaller islands and holes are noise
SHADOW_CHROMA = 0.035  # change of colour shares below which darker is a shadow
DARKEST_SHADOW = 0.45  # of the plate's brightness


@dataclass(frozen=True)
class ForegroundBands:
    """Widths in pixels: how far outside the projected body the person may reach, and how far inside it is certain."""

    margin: int
    certain: int


def bands_of(body: Bool[np.ndarray, "H W"], margin: float, certain: float) -> ForegroundBands:
    """Bands as shares of the height at which the person appears."""
    rows = np.flatnonzero(body.any(axis=1))
    height = rows[-1] - rows[0] + 1 if len(rows) else 0
    return ForegroundBands(max(2, round(margin * height)), max(1, round(certain * height)))


def widened(body: Bool[np.ndarray, "H W"], pixels: int) -> Bool[np.ndarray, "H W"]:
    """The body and what lies within so many pixels of it."""
    return cv2.dilate(body.astype(np.uint8), _disc(pixels)).astype(bool)


def foreground_mask(
    image: UInt8[np.ndarray, "H W 3"],
    plate: UInt8[np.ndarray, "H W 3"],
    is_known: Bool[np.ndarray, "H W"],
    body: Bool[np.ndarray, "H W"],
    bands: ForegroundBands,
) -> Bool[np.ndarray, "H W"]:
    """Pixels of the person.

    Args:
        image: sRGB bytes.
        plate: the background, see `background_plate`.
        is_known: where the plate can be trusted.
        body: pixels that the projected body covers.
        bands: widths of the uncertain band.

    Returns:
        [H, W]; empty where the body is out of view.
    """
    if not body.any():
        return np.zeros_like(body)
    # Where no plate can speak, the projection is believed nearly up to its outline.
    inside, nearly = (cv2.erode(body.astype(np.uint8), _disc(pixels)).astype(bool) for pixels in (bands.certain, UNSEEN_BAND))
    inside |= nearly & ~is_known
    outside = ~widened(body, bands.margin)
    difference, is_shadow = _compare(image, plate)
    is_like_plate = is_known & ((difference < EQUAL) | is_shadow)
    is_unlike_plate = is_known & (difference > DIFFERENT) & ~is_shadow
    near = widened(body, max(1, bands.margin // 3))
    labels = np.where(body, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    labels[is_unlike_plate & near] = cv2.GC_PR_FGD
    labels[is_like_plate & ~body] = cv2.GC_BGD
    # Both witnesses agree: this holds thin limbs, which graph cuts would rather cut off than go around.
    labels[(inside & ~is_like_plate) | (body & is_known & (difference > DIFFERENT))] = cv2.GC_FGD
    labels[outside | (~is_known & ~widened(body, UNSEEN_BAND))] = cv2.GC_BGD
    box = _box(widened(body, bands.margin + 4))
    cut = np.ascontiguousarray(labels[box])
    if not ((cut == cv2.GC_BGD) | (cut == cv2.GC_PR_BGD)).any() or not ((cut == cv2.GC_FGD) | (cut == cv2.GC_PR_FGD)).any():
        return body.copy()  # no colours of one side to learn from: the projection has to do
    models = np.zeros((1, 65)), np.zeros((1, 65))
    cv2.setRNGSeed(0)  # GrabCut's clusters start at random
    cv2.grabCut(np.ascontiguousarray(image[box]), cut, None, *models, GRAB_CUT_ITERATIONS, cv2.GC_INIT_WITH_MASK)
    mask = np.zeros_like(body)
    mask[box] = (cut == cv2.GC_FGD) | (cut == cv2.GC_PR_FGD)
    return _without_specks(mask, body)


def soft_mask(mask: Bool[np.ndarray, "H W"]) -> Float32[np.ndarray, "H W"]:
    """Coverage 0..1 with an edge about a pixel wide, as a camera's own blur makes it."""
    return cv2.GaussianBlur(mask.astype(np.float32), (0, 0), 0.7)


def _compare(image: UInt8[np.ndarray, "H W 3"], plate: UInt8[np.ndarray, "H W 3"]) -> tuple[Float32[np.ndarray, "H W"], np.ndarray]:
    """Largest difference of a channel in levels, and whether a pixel is just the plate in shadow: darker, of the same colour."""
    new, old = (cv2.GaussianBlur(picture, (0, 0), BLUR).astype(np.float32) for picture in (image, plate))
    brightness, before = new.sum(axis=-1) + 1, old.sum(axis=-1) + 1
    chroma = np.abs(new / brightness[..., None] - old / before[..., None]).max(axis=-1)
    share = brightness / before
    is_shadow = (chroma < SHADOW_CHROMA) & (share < 1) & (share > DARKEST_SHADOW) & (before > 150)
    return np.abs(new - old).max(axis=-1), is_shadow


def _without_specks(mask: Bool[np.ndarray, "H W"], body: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """Without small islands and small holes; an island must touch the projected body."""
    smallest = SMALLEST_PIECE * body.sum()
    pieces, count = ndimage.label(mask)
    if count:
        sizes = np.bincount(pieces.ravel(), minlength=count + 1)
        touching = np.isin(np.arange(count + 1), np.unique(pieces[body]))
        keep = (sizes >= smallest) & touching
        keep[0] = False
        mask = keep[pieces]
    holes, count = ndimage.label(~mask)
    sizes = np.bincount(holes.ravel(), minlength=count + 1)
    fill = sizes < 0.2 * smallest
    fill[0] = False
    return mask | fill[holes]


def _disc(radius: int) -> UInt8[np.ndarray, "D D"]:
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))


def _box(region: Bool[np.ndarray, "H W"]) -> tuple[slice, slice]:
    rows, columns = np.flatnonzero(region.any(axis=1)), np.flatnonzero(region.any(axis=0))
    return slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
