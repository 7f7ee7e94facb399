"""Background plates: what a static camera sees without the person, from frames in which the person stands elsewhere.

The median over time of each pixel, taken only of frames in which the projected body, widened, does not cover it: someone who stays in
place too long would leave a ghost in a plain median. Pixels that are covered always, or nearly, stay unknown.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

FEWEST_SIGHTS = 4  # frames that must see a pixel's background
ROWS_AT_ONCE = 64  # the median works on bands of rows, which bounds its memory
INPAINTING_RADIUS = 3.0  # pixels


def background_plate(
    frames: Sequence[UInt8[np.ndarray, "H W 3"]], covered: Sequence[Bool[np.ndarray, "H W"]]
) -> tuple[UInt8[np.ndarray, "H W 3"], Bool[np.ndarray, "H W"]]:
    """Plate and where it is known.

    Args:
        frames: of one static camera, at least one.
        covered: where each frame may show the person.

    Returns:
        plate [H, W, 3], with unknown places filled from their surroundings, and [H, W] True where it is known.

    Raises:
        ValueError: if no pixel is ever uncovered.
    """
    height, width = covered[0].shape
    stack, hidden = np.stack(frames), np.stack(covered)
    is_known = (~hidden).sum(axis=0) >= min(FEWEST_SIGHTS, len(stack))
    if not is_known.any():
        raise ValueError(
            "background_plate(): expected a background beside the person; the projected body covers the whole image. "
            "Check the fit to the keypoints, or give masks."
        )
    plate = np.zeros((height, width, 3), np.uint8)
    for top in range(0, height, ROWS_AT_ONCE):
        band = slice(top, top + ROWS_AT_ONCE)
        plate[band] = _median_of_uncovered(stack[:, band], hidden[:, band])
    unknown = (~is_known).astype(np.uint8)
    if unknown.any():
        plate = cv2.inpaint(plate, unknown, INPAINTING_RADIUS, cv2.INPAINT_TELEA)
    return plate, is_known


def _median_of_uncovered(stack: UInt8[np.ndarray, "N H W 3"], hidden: Bool[np.ndarray, "N H W"]) -> UInt8[np.ndarray, "H W 3"]:
    """Lower median of the uncovered values: sorted to the front, covered ones behind."""
    values = np.where(hidden[..., None], np.uint16(256), stack.astype(np.uint16))
    values.sort(axis=0)
    middle = np.maximum((~hidden).sum(axis=0) - 1, 0) // 2
    return np.take_along_axis(values, middle[None, ..., None].repeat(3, axis=-1), axis=0)[0].clip(0, 255).astype(np.uint8)
