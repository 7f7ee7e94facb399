"""The second attire, for the setting where the person wears other clothes than in training. Asymmetric as the first (`filming.prints`)."""

import numpy as np

from mitsuba_avatar.filming.anatomy import SIDES
from mitsuba_avatar.filming.canvas import Canvas, Map, Paint, bands, within
from mitsuba_avatar.filming.fabric import EDGE, dyed, on_leg, on_sleeve, weave

FAIR_HAIR = (0.34, 0.185, 0.075)
GROUND = (0.055, 0.125, 0.085)
LEAF = (0.50, 0.52, 0.20)
FLOWER = (0.62, 0.33, 0.40)
SLEEVE = (0.42, 0.30, 0.07)
SAND = (0.40, 0.31, 0.205)
SEAM = (0.23, 0.165, 0.10)
POCKET = (0.28, 0.21, 0.135)
NUM_LEAVES = 90


def paint_leafy_shirt(canvas: Canvas) -> Paint:
    """Dark green, leaves scattered more densely on the right half, a row of flowers down the left, an ochre right sleeve."""
    anatomy, points = canvas.anatomy, canvas.points
    base, top = anatomy.joint("spine05"), anatomy.joint("neck01")
    right_sleeve = on_sleeve(canvas, "R")
    fibres = weave(canvas, (0.06, 0.006), (0.04, 0.06))
    paint = dyed(fibres, GROUND, 0.74)
    paint = paint.over(LEAF, _leaves(canvas, base, top))
    for height in (0.15, 0.34, 0.53, 0.72):
        centre = base + height * (top - base)
        paint = paint.over(FLOWER, _flower(points, centre[0] + 0.085, centre[2]) * (points[..., 1] < 0.0) * (1 - right_sleeve))
    ochre = dyed(fibres, SLEEVE, 0.74)
    start, direction, length = anatomy.axis("upperarm01.R", "lowerarm01.R")
    ochre = ochre.over(GROUND, bands((points - start) @ direction / length, period=0.5, fill=0.25))
    return paint.under(ochre, right_sleeve)


def paint_light_trousers(canvas: Canvas) -> Paint:
    """Sand-coloured, with seams down the outer sides, a pocket on the left thigh and a darker right cuff."""
    anatomy, points = canvas.anatomy, canvas.points
    paint = dyed(weave(canvas, (0.06, 0.006), (0.05, 0.09)), SAND, 0.88)
    for side in SIDES:
        leg = on_leg(canvas, side)
        hip, knee, ankle = (anatomy.joint(f"{name}.{side}") for name in ("upperleg01", "lowerleg01", "foot"))
        outwards = (points[..., 0] - hip[0]) * (1 if side == "L" else -1)
        paint = paint.over(SEAM, within(np.abs(points[..., 1] - hip[1]), 0.006, EDGE) * (outwards > 0.0) * leg)
        if side == "L":
            thigh = 0.5 * (hip + knee)
            pocket = within(np.abs(points[..., 2] - thigh[2]), 0.075, EDGE) * within(np.abs(points[..., 1] - thigh[1] + 0.01), 0.055, EDGE)
            paint = paint.over(POCKET, pocket * (outwards > 0.03) * leg)
        else:
            paint = paint.over(SEAM, within(np.abs(points[..., 2] - ankle[2] - 0.05), 0.035, EDGE) * leg)
    return paint


def _leaves(canvas: Canvas, base: np.ndarray, top: np.ndarray) -> Map:
    """Slender ellipses at random places and slants, in front and behind alike where x and z say so."""
    rng = np.random.default_rng(7)  # the print is the attire's, whatever the person's seed
    across = rng.uniform(-0.26, 0.26, NUM_LEAVES)
    across = np.where(rng.uniform(size=NUM_LEAVES) < 0.45, -np.abs(across), across)
    up = rng.uniform(base[2] - 0.1, top[2] + 0.03, NUM_LEAVES)
    slants, sizes, fronts = rng.uniform(0, np.pi, NUM_LEAVES), rng.uniform(0.011, 0.018, NUM_LEAVES), rng.uniform(size=NUM_LEAVES) < 0.5
    is_front = canvas.points[..., 1] < base[1]
    total = np.zeros((canvas.size, canvas.size))
    for x, z, slant, size, front in zip(across, up, slants, sizes, fronts, strict=True):
        right, high = canvas.points[..., 0] - x, canvas.points[..., 2] - z
        along, beside = right * np.cos(slant) + high * np.sin(slant), high * np.cos(slant) - right * np.sin(slant)
        total = np.maximum(total, within(np.hypot(along / 2.2, beside), size * 0.6, 0.5 * EDGE) * (is_front == front))
    return total


def _flower(points: np.ndarray, x: float, z: float) -> Map:
    """Five petals."""
    across, up = points[..., 0] - x, points[..., 2] - z
    radius, angle = np.hypot(across, up), np.arctan2(up, across)
    return within(radius - 0.007 * np.cos(5 * angle), 0.022, EDGE)
