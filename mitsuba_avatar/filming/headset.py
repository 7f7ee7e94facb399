"""A virtual-reality headset, for the setting in which it hides the upper face: a visor with a strap around the head and one over it.

It is rigid, follows the skull, and has one layer and one atlas (a strip each for visor, strap and top strap). Metres.
"""

import numpy as np
from jaxtyping import Float, Float64

from mitsuba_avatar.filming.anatomy import Anatomy, smooth_step
from mitsuba_avatar.filming.appearance import Appearance
from mitsuba_avatar.filming.canvas import Paint
from mitsuba_avatar.filming.clothing import DressedBody
from mitsuba_avatar.filming.face_parts import skull
from mitsuba_avatar.filming.grids import grid_topology, stacked
from mitsuba_avatar.filming.props import RigidProp
from mitsuba_avatar.filming.stage import Layer

VISOR_CENTRE = (0.0, -0.062, -0.004)  # from between the eyes
VISOR_HALF = (0.092, 0.046, 0.050)
VISOR_ROUNDING = 0.35  # exponent of the superellipsoid: 1 is an ellipsoid, 0 a box
STRAP_HALF_HEIGHT, TOP_STRAP_HALF_WIDTH = 0.016, 0.014
STRAP_GAP = 0.004  # between strap and hair
SHELL = (0.16, 0.165, 0.175)
FRONT = (0.03, 0.03, 0.034)
FOAM = (0.045, 0.045, 0.045)
LENS = (0.02, 0.02, 0.02)
MARK = (0.42, 0.44, 0.46)
WEBBING = (0.06, 0.06, 0.065)


def headset(anatomy: Anatomy, body: DressedBody) -> RigidProp:
    """The headset, worn by a dressed body."""
    eyes = 0.5 * (anatomy.joint("eye.L") + anatomy.joint("eye.R"))
    head = body.vertices[(anatomy.weight(("head",)) > 0.9) & (anatomy.piece == 0)].astype(np.float64)
    visor, visor_shape = _visor(eyes), (25, 64)
    strap, strap_shape = _strap(head, eyes), (3, 72)
    top, top_shape = _top_strap(head, eyes), (3, 40)
    topology = stacked(
        [grid_topology(*visor_shape, is_closed=True), grid_topology(*strap_shape, is_closed=True), grid_topology(*top_shape)]
    )
    rest = np.concatenate([visor, strap, top]).astype(np.float32)
    anchors = skull(anatomy)
    return RigidProp(Layer("headset", topology, _paint(), is_two_sided=True), rest, anchors, body.vertices[anchors])


def _visor(eyes: Float[np.ndarray, "3"]) -> Float64[np.ndarray, "P 3"]:
    """A rounded box: rows from top to bottom, columns around from behind."""
    polar, azimuth = np.meshgrid(np.linspace(0, np.pi, 25), np.linspace(0, 2 * np.pi, 65)[:-1], indexing="ij")

    def power(value: np.ndarray, exponent: float) -> np.ndarray:
        return np.sign(value) * np.abs(value) ** exponent

    # The front is flatter than the sides seen from above, the outline from in front rounder.
    around = power(np.sin(polar), VISOR_ROUNDING)
    points = np.stack([around * power(np.sin(azimuth), 0.6), around * power(np.cos(azimuth), 0.45), power(np.cos(polar), 0.5)], axis=-1)
    points[..., 1] += 0.25 * np.abs(points[..., 0]) ** 2.5  # bends around the face
    return (eyes + np.array(VISOR_CENTRE) + points * np.array(VISOR_HALF)).reshape(-1, 3)


def _strap(head: Float64[np.ndarray, "N 3"], eyes: Float[np.ndarray, "3"]) -> Float64[np.ndarray, "P 3"]:
    """A band around the head at the height of the eyes, rising a little to the back; in front it runs inside the visor."""
    azimuth = np.linspace(0, 2 * np.pi, 73)[:-1]
    centre = eyes + np.array([0, 0.085, 0.012])
    outwards = np.stack([np.sin(azimuth), -np.cos(azimuth), np.zeros_like(azimuth)], axis=-1)
    rise = 0.02 * (1 - np.cos(azimuth)) / 2
    near = head[np.abs(head[:, 2] - centre[2] - 0.015) < 0.03] - centre
    radius = _hull_radius(near[:, :2], outwards[:, :2]) + STRAP_GAP
    rows = [
        centre + outwards * radius[:, None] + np.stack([0 * rise, 0 * rise, rise + height], axis=-1)
        for height in (STRAP_HALF_HEIGHT, 0.0, -STRAP_HALF_HEIGHT)
    ]
    return np.concatenate(rows)


def _top_strap(head: Float64[np.ndarray, "N 3"], eyes: Float[np.ndarray, "3"]) -> Float64[np.ndarray, "P 3"]:
    """A band over the head from the visor to the back of the strap."""
    angle = np.linspace(-1.50, 1.50, 40)  # from the vertical, to the front negative
    centre = eyes + np.array([0, 0.085, 0.03])
    outwards = np.stack([np.zeros_like(angle), np.sin(angle), np.cos(angle)], axis=-1)
    near = head[np.abs(head[:, 0]) < 0.03] - centre
    radius = _hull_radius(near[:, 1:], outwards[:, 1:]) + STRAP_GAP
    sideways = np.array([1.0, 0, 0])
    rows = [centre + outwards * radius[:, None] + offset * sideways for offset in (TOP_STRAP_HALF_WIDTH, 0.0, -TOP_STRAP_HALF_WIDTH)]
    return np.concatenate(rows)


def _hull_radius(points: Float64[np.ndarray, "N 2"], directions: Float64[np.ndarray, "D 2"]) -> Float64[np.ndarray, "D"]:
    """How far a taut band around points lies from the origin along each direction: where the ray leaves the convex hull."""
    around = np.linspace(0, 2 * np.pi, 361)[:-1]
    normals = np.stack([np.cos(around), np.sin(around)], axis=-1)
    reach = (points @ normals.T).max(axis=0)  # each normal's supporting line
    facing = directions @ normals.T
    return np.where(facing > 0.05, reach / np.maximum(facing, 0.05), np.inf).min(axis=1)


def _paint(size: int = 384) -> Appearance:
    """Atlas: visor on top, its front in the middle; then the strap, then the top strap."""
    down, across = np.meshgrid((np.arange(size) + 0.5) / size, (np.arange(size) + 0.5) / size, indexing="ij")
    row = np.clip(down * 3, 0, 1)  # 0..1 down the visor
    azimuth = np.abs(across - 0.5)  # 0 in front
    paint = Paint(np.broadcast_to(np.array(SHELL), (size, size, 3)).copy(), np.full((size, size), 0.45))
    front = smooth_step(azimuth, 0.20, 0.19) * smooth_step(np.abs(row - 0.5), 0.27, 0.25)
    paint = paint.over(FRONT, front, roughness=0.16)
    for place, height in ((0.40, 0.36), (0.60, 0.36), (0.37, 0.63), (0.63, 0.63)):
        paint = paint.over(SHELL, smooth_step(np.hypot((across - place) * 3, row - height), 0.062, 0.052), roughness=0.3)
        paint = paint.over(LENS, smooth_step(np.hypot((across - place) * 3, row - height), 0.042, 0.034), roughness=0.06)
    paint = paint.over(MARK, smooth_step(np.abs(across - 0.535), 0.012, 0.009) * smooth_step(np.abs(row - 0.57), 0.012, 0.008))
    paint = paint.over(FOAM, smooth_step(azimuth, 0.40, 0.41), roughness=0.95)
    return Appearance.of(paint.over(WEBBING, smooth_step(down, 1 / 3 - 1e-3, 1 / 3 + 1e-3), roughness=0.9))
