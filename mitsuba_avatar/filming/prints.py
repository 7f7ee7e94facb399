"""How the attires are painted in which captures are filmed: striped, and the same without stripes.

Prints are asymmetric on purpose: a mirrored or shifted reconstruction must show.

The person's left is +X, front is -Y; heights on the shirt count from the pelvis, 0, to the base of the neck, 1. Metres.
"""

import numpy as np

from mitsuba_avatar.filming.anatomy import SIDES, smooth_step
from mitsuba_avatar.filming.canvas import Canvas, Map, Paint, bands, within
from mitsuba_avatar.filming.fabric import EDGE, dyed, on_leg, on_sleeve, weave

DARK_HAIR = (0.046, 0.027, 0.018)
SHIRT = (0.50, 0.46, 0.36)
STRIPES = (0.085, 0.16, 0.27)
EMBLEM = (0.55, 0.13, 0.055)
TROUSERS = (0.060, 0.078, 0.118)
WORN = (0.132, 0.172, 0.260)
PIPING = (0.52, 0.34, 0.10)
PATCH = (0.41, 0.098, 0.041)


def paint_shirt(canvas: Canvas) -> Paint:
    """Light cloth: stripes below the chest and on the right sleeve, a dark left sleeve, an emblem on the left chest, a print behind."""
    anatomy, points = canvas.anatomy, canvas.points
    base, top = _span(canvas)
    height = (points[..., 2] - base) / (top - base)
    sleeve = {side: on_sleeve(canvas, side) for side in SIDES}
    paint = _light_cloth(canvas)
    paint = paint.over(STRIPES, bands(height, period=0.16, fill=0.42) * smooth_step(height, 0.66, 0.645) * _torso(canvas))
    start, direction, length = anatomy.axis("upperarm01.R", "lowerarm01.R")
    paint = paint.over(STRIPES, bands((points - start) @ direction / length, period=0.25, fill=0.4) * sleeve["R"])
    return _printed(canvas, paint.over(STRIPES, sleeve["L"]))


def paint_plain_shirt(canvas: Canvas) -> Paint:
    """Light cloth with the emblem on the left chest and the print behind, and nothing else.

    For captures whose image error is to tell of shading: a stripe that is a pixel off adds to it as a shadow does.
    """
    return _printed(canvas, _light_cloth(canvas))


def paint_trousers(canvas: Canvas) -> Paint:
    """Dark cloth, worn lighter on thighs and knees, piping down the left leg, a patch on the right knee."""
    anatomy, points = canvas.anatomy, canvas.points
    paint = dyed(weave(canvas, (0.09, 0.007), (0.05, 0.08)), TROUSERS, 0.85)
    for side in SIDES:
        leg = on_leg(canvas, side)
        hip, knee = (anatomy.joint(f"{name}.{side}") for name in ("upperleg01", "lowerleg01"))
        worn = canvas.blob(hip + np.array([0, -0.1, -0.22]), 0.11) + canvas.blob(knee + np.array([0, -0.06, 0.0]), 0.07)
        paint = paint.over(WORN, 0.55 * np.clip(worn, 0, 1) * leg)
        angle = _angle_around_leg(canvas, side)
        if side == "L":
            paint = paint.over(PIPING, within(np.abs(angle - 0.95), 0.19, 0.14) * leg)
        else:
            height = np.abs(points[..., 2] - knee[2] + 0.01)
            paint = paint.over(PATCH, within(height, 0.060, EDGE) * within(np.abs(angle), 0.72, 0.06) * leg)
    return paint


def _light_cloth(canvas: Canvas) -> Paint:
    return dyed(weave(canvas, (0.05, 0.006), (0.03, 0.05)), SHIRT, 0.78)


def _span(canvas: Canvas) -> tuple[float, float]:
    """Height of the pelvis and of the base of the neck, metres."""
    base, top = (float(canvas.anatomy.joint(name)[2]) for name in ("spine05", "neck01"))
    return base, top


def _torso(canvas: Canvas) -> Map:
    """1 on the shirt's trunk, 0 on its sleeves."""
    return 1 - np.maximum(on_sleeve(canvas, "L"), on_sleeve(canvas, "R"))


def _printed(canvas: Canvas, paint: Paint) -> Paint:
    """A shirt with the emblem on the left chest and the print behind."""
    points, torso = canvas.points, _torso(canvas)
    base, top = _span(canvas)
    paint = paint.over(EMBLEM, _emblem(points, 0.075, base + 0.80 * (top - base)) * (points[..., 1] < 0.0) * torso)
    return paint.over(EMBLEM, _back_print(points, -0.035, base + 0.76 * (top - base)) * (points[..., 1] > 0.03) * torso)


def _emblem(points: np.ndarray, x: float, z: float) -> Map:
    """A ring with a slanted bar through it."""
    across, up = points[..., 0] - x, points[..., 2] - z
    radius = np.hypot(across, up)
    bar = within(np.abs(across + 0.5 * up), 0.008, EDGE)
    return within(radius, 0.046, EDGE) * (1 - within(radius, 0.031, EDGE) * (1 - bar))


def _back_print(points: np.ndarray, x: float, z: float) -> Map:
    """A slanted bar on a foot, and a disc."""
    across, up = points[..., 0] - x, points[..., 2] - z
    bar = within(np.abs(across + 0.5 * up), 0.021, EDGE) * within(np.abs(up), 0.084, EDGE)
    foot = within(np.abs(up + 0.068), 0.017, EDGE) * within(np.abs(across - 0.045), 0.084, EDGE)
    disc = within(np.hypot(across - 0.085, up - 0.045), 0.033, EDGE)
    return np.maximum(np.maximum(bar, foot), disc)


def _angle_around_leg(canvas: Canvas, side: str) -> Map:
    """Angle about the leg's bones at the texel's height: 0 in front, a quarter turn on the outer side. Radians."""
    hip, knee, ankle = (canvas.anatomy.joint(f"{name}.{side}") for name in ("upperleg01", "lowerleg01", "foot"))
    down = np.clip(hip[2] - canvas.points[..., 2], 0, hip[2] - ankle[2])
    heights = np.array([0, hip[2] - knee[2], hip[2] - ankle[2]])
    bone = np.stack([np.interp(down, heights, [hip[axis], knee[axis], ankle[axis]]) for axis in (0, 1)], axis=-1)
    offset = canvas.points[..., :2] - bone
    return np.arctan2(offset[..., 0] if side == "L" else -offset[..., 0], -offset[..., 1])
