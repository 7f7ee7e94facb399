"""How clothes and hair are painted. Prints are asymmetric on purpose: a mirrored or shifted reconstruction must show.

The person's left is +X, front is -Y; heights on the shirt count from the pelvis, 0, to the base of the neck, 1. Metres.
"""

import numpy as np

from mitsuba_avatar.filming.anatomy import ARM, LEG, SIDES, smooth_step
from mitsuba_avatar.filming.canvas import Canvas, Colour, Map, Paint, bands, within

HAIR = (0.046, 0.027, 0.018)
SHIRT = (0.50, 0.46, 0.36)
STRIPES = (0.085, 0.16, 0.27)
EMBLEM = (0.55, 0.13, 0.055)
TROUSERS = (0.060, 0.078, 0.118)
WORN = (0.132, 0.172, 0.260)
PIPING = (0.52, 0.34, 0.10)
PATCH = (0.41, 0.098, 0.041)
EDGE = 0.006  # metres: softness of printed edges, about a texel and a half of a 512 x 512 atlas


def paint_shirt(canvas: Canvas) -> Paint:
    """Light cloth: stripes below the chest and on the right sleeve, a dark left sleeve, an emblem on the left chest, a print behind."""
    anatomy, points = canvas.anatomy, canvas.points
    base, top = anatomy.joint("spine05")[2], anatomy.joint("neck01")[2]
    height = (points[..., 2] - base) / (top - base)
    sleeve = {side: smooth_step(canvas.field(anatomy.weight(ARM, side)), 0.42, 0.58) for side in SIDES}
    torso = 1 - np.maximum(sleeve["L"], sleeve["R"])
    weave = 1 + 0.05 * canvas.noise(0.006) + 0.03 * canvas.noise(0.05)
    paint = Paint(np.array(SHIRT) * weave[..., None], np.full_like(weave, 0.78))
    paint = paint.over(STRIPES, bands(height, period=0.16, fill=0.42) * smooth_step(height, 0.66, 0.645) * torso)
    start, direction, length = anatomy.axis("upperarm01.R", "lowerarm01.R")
    paint = paint.over(STRIPES, bands((points - start) @ direction / length, period=0.25, fill=0.4) * sleeve["R"])
    paint = paint.over(STRIPES, sleeve["L"])
    paint = paint.over(EMBLEM, _emblem(points, 0.075, base + 0.80 * (top - base)) * (points[..., 1] < 0.0) * torso)
    return paint.over(EMBLEM, _back_print(points, -0.035, base + 0.76 * (top - base)) * (points[..., 1] > 0.03) * torso)


def paint_trousers(canvas: Canvas) -> Paint:
    """Dark cloth, worn lighter on thighs and knees, piping down the left leg, a patch on the right knee."""
    anatomy, points = canvas.anatomy, canvas.points
    weave = 1 + 0.09 * canvas.noise(0.007) + 0.05 * canvas.noise(0.08)
    paint = Paint(np.array(TROUSERS) * weave[..., None], np.full_like(weave, 0.85))
    for side in SIDES:
        leg = canvas.field(anatomy.weight(LEG, side)) > 0.5
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


def paint_skirt(canvas: Canvas) -> Paint:
    """Dark cloth with upright pinstripes, a broad light band above the hem, a patch on the left."""
    angle, height = around_pelvis(canvas)
    weave = 1 + 0.08 * canvas.noise(0.007)
    paint = Paint(np.array(TROUSERS) * weave[..., None], np.full_like(weave, 0.85))
    paint = paint.over(WORN, 0.7 * bands(angle, period=2 * np.pi / 22, fill=0.18))
    paint = paint.over(PIPING, within(np.abs(height + 0.36), 0.02, EDGE))
    return paint.over(PATCH, within(np.abs(height + 0.16), 0.055, EDGE) * within(np.abs(angle - 0.6), 0.3, 0.04))


def paint_hair(canvas: Canvas) -> Paint:
    """Dark strands."""
    return strands(canvas, HAIR)


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


def around_pelvis(canvas: Canvas) -> tuple[Map, Map]:
    """Angle about the vertical through the pelvis, 0 in front and positive towards the person's left, and height above it, metres."""
    offset = canvas.points - canvas.anatomy.joint("spine05")
    return np.arctan2(offset[..., 0], -offset[..., 1]), offset[..., 2]


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
