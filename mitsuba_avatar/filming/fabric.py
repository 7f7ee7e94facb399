"""What the prints of all attires are painted with: woven cloth, parts of garments, strands of hair.

Metres; the person's left is +X, front is -Y.
"""

import numpy as np

from mitsuba_avatar.filming.anatomy import ARM, LEG, smooth_step
from mitsuba_avatar.filming.canvas import Canvas, Colour, Map, Paint

EDGE = 0.006  # metres: softness of printed edges, about a texel and a half of a 512 x 512 atlas


def weave(canvas: Canvas, *noise: tuple[float, float]) -> Map:
    """How much lighter or darker than its dye a cloth is: one and noise of some (strength, wavelength in metres)."""
    return 1 + sum(strength * canvas.noise(wavelength) for strength, wavelength in noise)


def dyed(fibres: Map, colour: Colour, roughness: float) -> Paint:
    """Cloth of one colour, as light and dark as its fibres (`weave`)."""
    return Paint(np.array(colour) * fibres[..., None], np.full_like(fibres, roughness))


def on_sleeve(canvas: Canvas, side: str) -> Map:
    """1 on a sleeve, 0 on the torso."""
    return smooth_step(canvas.field(canvas.anatomy.weight(ARM, side)), 0.42, 0.58)


def on_leg(canvas: Canvas, side: str) -> Map:
    """1 on a trouser leg, 0 elsewhere."""
    return (canvas.field(canvas.anatomy.weight(LEG, side)) > 0.5).astype(np.float64)


def strands(canvas: Canvas, colour: Colour) -> Paint:
    """Strands that fan out from the crown over the head, in locks."""
    anatomy, points = canvas.anatomy, canvas.points
    centre = 0.5 * (anatomy.joint("eye.L") + anatomy.joint("eye.R")) + np.array([0, 0.085, 0.03])
    crown = np.array([0.1, 0.45, 1.0]) / np.linalg.norm([0.1, 0.45, 1.0])
    offset = points - centre
    offset /= np.linalg.norm(offset, axis=-1, keepdims=True).clip(1e-6)
    sideways = offset - (offset @ crown)[..., None] * crown
    meridian = sideways / np.linalg.norm(sideways, axis=-1, keepdims=True).clip(1e-6)
    along = np.arccos(np.clip(offset @ crown, -1, 1))[..., None] * crown
    # On a sphere of the head's size, 0.1 metres; along a strand the pattern changes thirty times more slowly than across it.
    parted = smooth_step(np.linalg.norm(sideways, axis=-1), 0.15, 0.6)  # at the crown, meridians run together
    fine = parted * canvas.noise(0.0055, places=0.1 * (meridian + 0.05 * along))
    locks = canvas.noise(0.013, places=0.1 * (meridian + 0.15 * along)) + 0.5 * canvas.noise(0.03)
    shade = np.clip(1 + 0.26 * fine + 0.18 * locks, 0.35, 2.2)
    # Rough, or the dome would shine grey on the whole outline of the head.
    return Paint(np.array(colour) * shade[..., None], np.clip(0.80 - 0.10 * fine - 0.05 * locks, 0.55, 1))
