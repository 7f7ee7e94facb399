"""What the body's atlas is too coarse for, or the body lacks: eyes with an atlas of their own, and teeth."""

import numpy as np

from mitsuba_avatar.filming.anatomy import Anatomy, smooth_step
from mitsuba_avatar.filming.appearance import Appearance
from mitsuba_avatar.filming.canvas import Canvas, Paint, Surface
from mitsuba_avatar.filming.clothing import DressedBody, hairline
from mitsuba_avatar.filming.grids import grid_topology
from mitsuba_avatar.filming.props import BodyPart, RigidProp
from mitsuba_avatar.filming.skin import eye_pieces, paint_eyes
from mitsuba_avatar.filming.stage import Layer

EYE_SPECULAR = 0.5  # the cornea's: water
ENAMEL = (0.60, 0.55, 0.46)
GUMS = (0.33, 0.115, 0.10)
GAP = (0.16, 0.10, 0.075)
TEETH = 12  # of each jaw, that are seen
ARCH_HALF_WIDTH, ARCH_DEPTH, TOOTH_HEIGHT = 0.0235, 0.034, 0.0095  # metres
COLUMNS = 41


def eyes(anatomy: Anatomy, seed: int, size: int = 256) -> BodyPart:
    """The eyeballs, which fill an atlas of `size` x `size` texels."""
    faces = np.isin(anatomy.piece, eye_pieces(anatomy))[anatomy.rig.topology.faces].all(axis=1)
    surface = Surface.of_part(anatomy, faces)
    appearance = Appearance.of(paint_eyes(Canvas(anatomy, surface, size, seed)), EYE_SPECULAR)
    return BodyPart(Layer("eyes", surface.topology, appearance), faces, surface.body_vertices[:, 0])


def teeth(anatomy: Anatomy, body: DressedBody) -> tuple[RigidProp, RigidProp]:
    """Upper teeth, which follow the skull, and lower ones, which follow the chin."""
    eyes_middle = 0.5 * (anatomy.joint("eye.L") + anatomy.joint("eye.R"))
    bite = eyes_middle + np.array([0.0, -0.0228, -0.0715])  # where the front teeth meet, behind the lips
    chin = eyes_middle + np.array([0.0, -0.020, -0.113])
    on_chin = np.linalg.norm(anatomy.rig.rest_vertices - chin, axis=1) < 0.022
    return _row("upper_teeth", bite, +1, skull(anatomy), body), _row("lower_teeth", bite, -1, np.flatnonzero(on_chin), body)


def skull(anatomy: Anatomy) -> np.ndarray:
    """[A] vertices of the head that no facial action moves: the hairy part."""
    above = hairline(anatomy, anatomy.rig.rest_vertices.astype(np.float64)) > 0.01
    return np.flatnonzero(above & (anatomy.weight(("head",)) > 0.95) & (anatomy.piece == 0))


def _row(name: str, bite: np.ndarray, up: int, anchors: np.ndarray, body: DressedBody) -> RigidProp:
    """One jaw's teeth: a sheet along an arch from the gums to the edges, and back a little."""
    along = np.linspace(-1.35, 1.35, COLUMNS)
    # The lower arch is the smaller one, and closes behind the upper.
    scale = 1.0 if up > 0 else 0.93
    arch = bite + np.stack(
        [ARCH_HALF_WIDTH * scale * np.sin(along), ARCH_DEPTH * (1 - scale * np.cos(along)), np.zeros_like(along)], axis=-1
    )
    inwards = np.stack([-np.sin(along), np.cos(along), np.zeros_like(along)], axis=-1)
    upwards = np.array([0, 0, up])
    lip = 0.0015 if up > 0 else -0.0005  # the upper teeth hang a little over the lower ones
    edge = arch - lip * upwards * up
    rows = [edge + TOOTH_HEIGHT * upwards + 0.002 * inwards, edge + 0.5 * TOOTH_HEIGHT * upwards, edge, edge + 0.003 * inwards]
    vertices = np.concatenate(rows).astype(np.float32)
    layer = Layer(name, grid_topology(len(rows), COLUMNS), _enamel(), is_two_sided=True)
    return RigidProp(layer, vertices, anchors, body.vertices[anchors])


def _enamel(size: int = 128) -> Appearance:
    """Gums above, teeth with dark gaps between below."""
    down, across = np.meshgrid((np.arange(size) + 0.5) / size, (np.arange(size) + 0.5) / size, indexing="ij")
    paint = Paint(np.broadcast_to(np.array(ENAMEL), (size, size, 3)).copy(), np.full((size, size), 0.18))
    from_gap = 0.5 - np.abs((across * TEETH) % 1 - 0.5)
    paint = paint.over(GAP, 0.8 * smooth_step(from_gap, 0.12, 0.02))
    gum_line = 0.22 - 0.40 * from_gap**2  # lower between teeth
    return Appearance.of(paint.over(GUMS, smooth_step(down - gum_line, 0.04, -0.04), roughness=0.3), EYE_SPECULAR)
