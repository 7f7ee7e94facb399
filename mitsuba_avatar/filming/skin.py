"""How the body is painted under its clothes: skin tone, lips, brows, eyes, mouth and nails.

Face coordinates are metres from between the eyes: across (to the person's left), back, up.
"""

import numpy as np

from mitsuba_avatar.filming.anatomy import HAND, SIDES, Anatomy, smooth_step
from mitsuba_avatar.filming.canvas import Canvas, Map, Paint

SKIN = (0.50, 0.295, 0.205)
BLOOD = (0.46, 0.165, 0.125)  # where skin is thin: cheeks, nose, ears, hands
LIPS = (0.40, 0.145, 0.125)
LIDS = (0.345, 0.124, 0.094)
MOUTH = (0.20, 0.055, 0.050)
NAILS = (0.56, 0.36, 0.29)
BROWS = (0.055, 0.033, 0.022)
SCLERA = (0.48, 0.44, 0.41)
IRIS = (0.042, 0.024, 0.013)
PUPIL = (0.008, 0.008, 0.008)
IRIS_EDGE, PUPIL_EDGE = 0.56, 0.22  # radians from the direction of sight; a little larger than life, so that gaze shows in small images


def paint_skin(canvas: Canvas) -> Paint:
    """The whole body, bare."""
    anatomy = canvas.anatomy
    across, back, up = np.moveaxis(canvas.points - _between_eyes(anatomy), -1, 0)
    head = canvas.field((anatomy.weight(("head",)) > 0.5).astype(np.float64))
    hands = canvas.field(anatomy.weight(HAND))
    tone = 1 + 0.045 * canvas.noise(0.11) + 0.03 * canvas.noise(0.022)
    paint = Paint(np.array(SKIN) * tone[..., None], 0.48 + 0.03 * canvas.noise(0.03) + 0.06 * hands)
    paint = paint.over(BLOOD, _flush(canvas, head, hands))
    beard = smooth_step(up, -0.052, -0.075) * smooth_step(np.abs(across), 0.085, 0.05) * smooth_step(back, 0.075, 0.05) * (up > -0.16)
    paint = paint.over((0.0, 0.0, 0.0), 0.18 * beard * head)
    rim_of_lids = np.hypot(np.abs(across) - 0.0315, up + 0.001) - 0.0165
    paint = paint.over(LIDS, 0.25 * head * np.exp(-((rim_of_lids / 0.005) ** 2)) * (back < 0.03))
    paint = paint.over(BROWS, 0.9 * head * _lash_line(canvas))
    paint = paint.over(BROWS, 0.95 * head * _brows(canvas, across, back, up))
    paint = paint.over(LIPS, 0.65 * canvas.mask("lips"), roughness=0.38)
    paint = paint.over(NAILS, 0.8 * np.maximum(canvas.mask("fingernails"), canvas.mask("toenails")), roughness=0.3)
    paint = paint.over(MOUTH, np.maximum(canvas.mask("inside-mouth"), canvas.field((anatomy.piece == 1).astype(np.float64))))
    is_eye = np.isin(anatomy.piece, eye_pieces(anatomy))
    return paint.under(paint_eyes(canvas), canvas.field(is_eye.astype(np.float64)))


def _between_eyes(anatomy: Anatomy) -> np.ndarray:
    return 0.5 * (anatomy.joint("eye.L") + anatomy.joint("eye.R"))


def _flush(canvas: Canvas, head: Map, hands: Map) -> Map:
    """Where blood shows."""
    eyes = _between_eyes(canvas.anatomy)
    cheeks = sum(canvas.blob(eyes + np.array([side * 0.043, 0.005, -0.043]), 0.020) for side in (-1, 1))
    nose = canvas.blob(eyes + np.array([0, -0.045, -0.040]), 0.014)
    knuckles = hands * (1 + 0.5 * canvas.noise(0.02))
    return 0.45 * cheeks * head + 0.45 * nose + 0.5 * canvas.mask("ears") + 0.22 * knuckles


def _brows(canvas: Canvas, across: Map, back: Map, up: Map) -> Map:
    """Two arcs of strands above the eyes, the left one a little higher."""
    side = np.abs(across)
    rise = 0.006 * np.sin(np.clip((side - 0.012) / 0.045, 0, 1) * np.pi * 0.75)
    arc = 0.0235 + 0.0011 * np.sign(across) + rise - 0.06 * np.clip(side - 0.043, 0, None)
    width = 0.0054 * smooth_step(side, 0.064, 0.030) + 0.0010
    along = smooth_step(side, 0.010, 0.019) * smooth_step(side, 0.062, 0.050)
    # Hairs lean outwards: they run across and up.
    lean = np.stack([side - 0.9 * up, np.zeros_like(side), 0.15 * (up + 0.9 * side)], axis=-1)
    strands = 0.84 + 0.20 * canvas.noise(0.0028, places=lean)
    return np.clip(along * np.exp(-(((up - arc) / width) ** 2)) * strands * (back < 0.04), 0, 1)


def _lash_line(canvas: Canvas) -> Map:
    """The eyelids' rims: skin that nearly touches the eyeball's front."""
    rim = np.zeros((canvas.size, canvas.size))
    for side in SIDES:
        offset = canvas.points - canvas.anatomy.joint(f"eye.{side}")
        rim = np.maximum(rim, smooth_step(np.linalg.norm(offset, axis=-1), 0.0188, 0.0172) * (offset[..., 1] < -0.004))
    return rim


def paint_eyes(canvas: Canvas) -> Paint:
    """Both eyeballs: white, iris and pupil by the angle from the direction of sight, which at rest is -Y."""
    left, right = (canvas.anatomy.joint(f"eye.{side}") for side in SIDES)
    centre = np.where(canvas.points[..., :1] > 0, left, right)
    offset = canvas.points - centre
    distance = np.maximum(np.linalg.norm(offset, axis=-1), 1e-6)  # of the centre itself the angle means nothing
    angle = np.arccos(np.clip(-offset[..., 1] / distance, -1, 1))
    spokes = np.stack([offset[..., 0], 0.1 * angle, offset[..., 2]], axis=-1) / np.hypot(offset[..., 0], offset[..., 2])[..., None].clip(
        1e-5
    )
    eye = Paint(np.array(SCLERA) * (1 - 0.12 * smooth_step(angle, 0.6, 1.3))[..., None], np.full_like(angle, 0.16))
    eye = eye.over(LIDS, 0.35 * smooth_step(angle, 0.75, 1.35))  # vessels towards the lids
    streaks = np.clip(1 + 0.35 * canvas.noise(0.35, places=spokes), 0.4, 1.8)
    iris = np.array(IRIS) * (streaks * (1.35 - 0.7 * smooth_step(angle, 0.30, IRIS_EDGE)))[..., None]
    eye = eye.over(iris, smooth_step(angle, IRIS_EDGE + 0.03, IRIS_EDGE - 0.03))
    return eye.over(PUPIL, smooth_step(angle, PUPIL_EDGE + 0.02, PUPIL_EDGE - 0.02))


def eye_pieces(anatomy: Anatomy) -> tuple[int, ...]:
    """Which pieces of the surface are eyeballs."""
    centres = [anatomy.joint(f"eye.{side}") for side in SIDES]
    middles = {piece: anatomy.rig.rest_vertices[anatomy.piece == piece].mean(axis=0) for piece in range(1, anatomy.piece.max() + 1)}
    return tuple(piece for piece, middle in middles.items() if min(np.linalg.norm(middle - centre) for centre in centres) < 0.02)
