"""Clothes and hair as a displacement of the body's own surface: real thickness, hems, one topology.

A garment covers the part of the skin where the fields of its *hems* are positive; a hem is a plane across a limb or an ellipsoid around
the neck. Vertices next to a hem slide along the skin onto it, so that a hem is a clean line and a step of the cloth's thickness instead
of the mesh's zigzag. Cloth hangs across hollows (the covered skin, smoothed) and keeps at least its thickness from the skin; it is moved
along normals only, so that texels stay where they were painted. Metres, rest space.

It knows nothing of movement (see `filming.wrinkles`) or colour (`filming.appearance`).
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32

from mitsuba_avatar.body.mesh import vertex_normals
from mitsuba_avatar.body.rig import Topology
from mitsuba_avatar.filming.anatomy import ARM, LEG, NECK_AND_HEAD, SIDES, Anatomy, smooth_step

HEM_STEP = 0.004  # metres along the skin between a hem's outer edge and the bare skin under it
LARGEST_SLIDE = 0.022  # metres that a vertex may slide onto a hem: about an edge's length

Field = Callable[[np.ndarray], np.ndarray]  # points [..., 3] -> metres [...], about the distance inwards from a hem


@dataclass(frozen=True)
class Hem:
    """One opening of a garment: cloth lies where `field` is positive."""

    field: Field
    part: Bool[np.ndarray, "V"]  # noqa: F821 - vertices that this hem may cut


@dataclass(frozen=True)
class Garment:
    """A piece of clothing on the rest surface.

    Attributes:
        name: "shirt", "trousers" or "hair".
        covered: [V] whether a vertex is cloth.
        hems: its openings.
        thickness: [V] metres between skin and cloth.
        level: [V] where draping moves cloth in the horizontal plane instead of along normals.
        drape: rounds of smoothing and pushing out; more lets the cloth span wider hollows.
    """

    name: str
    covered: Bool[np.ndarray, "V"]  # noqa: F821
    hems: tuple[Hem, ...]
    thickness: Float32[np.ndarray, "V"]  # noqa: F821
    level: Bool[np.ndarray, "V"]  # noqa: F821
    drape: int


@dataclass(frozen=True)
class DressedBody:
    """The person as dressed, at rest.

    Attributes:
        vertices: [V, 3] rest surface with clothes and hair.
        skin: [V, 3] the same without their thickness: bare, vertices in line with the hems.
        normals: [V, 3] outward unit normals, smoothed; the directions in which cloth is displaced.
        coverage: garment name -> [V], 1 on the garment.
    """

    vertices: Float32[np.ndarray, "V 3"]
    skin: Float32[np.ndarray, "V 3"]
    normals: Float32[np.ndarray, "V 3"]
    coverage: dict[str, Float32[np.ndarray, "V"]]  # noqa: F821


def plane(point: Float[np.ndarray, "3"], inward: Float[np.ndarray, "3"]) -> Field:
    """Distance from a plane, positive on the side that `inward` points to."""
    direction = inward / np.linalg.norm(inward)
    return lambda points: (points - point) @ direction


def around(centre: Float[np.ndarray, "3"], radii: tuple[float, float, float]) -> Field:
    """Positive outside an ellipsoid with semi-axes along world axes, metres."""
    return lambda points: (np.linalg.norm((points - centre) / np.array(radii), axis=-1) - 1) * float(np.mean(radii))


def shirt(anatomy: Anatomy) -> Garment:
    """A T-shirt: torso from the base of the neck to the hips, arms to three quarters of the upper arm."""
    vertices = anatomy.rig.rest_vertices.astype(np.float64)
    arms = {side: anatomy.weight(ARM, side) > 0.5 for side in SIDES}
    torso = (anatomy.piece == 0) & ~arms["L"] & ~arms["R"]
    neck, pelvis = anatomy.joint("neck01"), anatomy.joint("spine05")
    hems = [
        Hem(around(neck + np.array([0, -0.02, 0.012]), (0.082, 0.095, 0.062)), torso & (vertices[:, 2] > neck[2] - 0.2)),
        Hem(plane(pelvis + np.array([0, 0, -0.05]), np.array([0, 0, 1.0])), torso & (vertices[:, 2] < pelvis[2] + 0.2)),
    ]
    loose = np.zeros(len(vertices))
    for side in SIDES:
        start, direction, length = anatomy.axis(f"upperarm01.{side}", f"lowerarm01.{side}")
        hems.append(Hem(plane(start + 0.78 * length * direction, -direction), arms[side]))
        loose += arms[side] * smooth_step((vertices - start) @ direction / length, 0.0, 0.7)
    waist = smooth_step(vertices[:, 2], pelvis[2] + 0.25, pelvis[2])
    thickness = 0.009 + 0.010 * np.maximum(loose, np.where(torso, waist, 0))
    below_jaw = anatomy.weight(("head",)) < 0.2
    candidates = (torso & below_jaw) | arms["L"] | arms["R"]
    about_hips = torso & (vertices[:, 2] < anatomy.joint("spine04")[2])
    return Garment("shirt", _inside(hems, vertices, candidates), tuple(hems), thickness.astype(np.float32), about_hips, drape=30)


def trousers(anatomy: Anatomy, under: Garment) -> Garment:
    """Long trousers from under the shirt to the ankles."""
    vertices = anatomy.rig.rest_vertices.astype(np.float64)
    legs = {side: anatomy.weight(LEG, side) > 0.5 for side in SIDES}
    hips = (anatomy.piece == 0) & (vertices[:, 2] < anatomy.joint("spine05")[2] + 0.06) & (anatomy.weight(ARM) < 0.5)
    hems = []
    loose = np.zeros(len(vertices))
    for side in SIDES:
        start, direction, length = anatomy.axis(f"lowerleg01.{side}", f"foot.{side}")
        hems.append(Hem(plane(start + 0.93 * length * direction, -direction), legs[side]))
        loose += legs[side] * smooth_step((vertices - start) @ direction / length, -0.6, 0.8)
    covered = _inside(hems, vertices, hips | legs["L"] | legs["R"]) & ~under.covered
    thickness = (0.006 + 0.012 * loose).astype(np.float32)
    return Garment("trousers", covered, tuple(hems), thickness, np.zeros_like(covered), drape=16)


def hair(anatomy: Anatomy) -> Garment:
    """Short hair as a cap on the scalp, fuller on top; it begins without a step."""
    line = hairline(anatomy, anatomy.rig.rest_vertices.astype(np.float64))
    scalp = (anatomy.weight(NECK_AND_HEAD) > 0.9) & (anatomy.piece == 0)
    thickness = 0.001 + 0.015 * smooth_step(line, -0.004, 0.05)
    return Garment("hair", scalp & (line > -0.004), (), thickness.astype(np.float32), np.zeros_like(scalp), drape=3)


def hairline(anatomy: Anatomy, points: Float[np.ndarray, "*shape 3"]) -> Float[np.ndarray, "*shape"]:
    """Height above the hairline, metres, positive where hair grows; for points of the head, at rest.

    Seen from the side the line falls from the forehead along the temple to before the ear, passes over the ear and falls to the nape.
    """
    eyes = 0.5 * (anatomy.joint("eye.L") + anatomy.joint("eye.R"))
    across, back, up = np.moveaxis(points - eyes, -1, 0)  # metres from between the eyes
    line_back = np.array([-0.03, 0.00, 0.020, 0.036, 0.048, 0.057, 0.064, 0.085, 0.100, 0.108, 0.125, 0.18])
    line_up = np.array([0.066, 0.062, 0.054, 0.036, -0.008, -0.012, 0.012, 0.018, 0.004, -0.040, -0.066, -0.070])
    return up - np.interp(back, line_back, line_up) + 0.25 * (0.06 - np.abs(across)) * smooth_step(back, 0.03, 0.0) * (up > 0.03) * 0.3


def dress(anatomy: Anatomy, garments: tuple[Garment, ...]) -> DressedBody:
    """Put garments on: slide vertices onto hems, drape, push out. Of garments that cover the same vertex the last shows."""
    rig = anatomy.rig
    skin = rig.rest_vertices.astype(np.float64)
    normals = _normals(anatomy.smooth(skin, 8), rig.topology)
    for garment in garments:
        for hem in garment.hems:
            skin = _slide_onto(hem, garment.covered, skin, normals, anatomy)
    dressed = skin
    for garment in garments:
        dressed = np.where(garment.covered[:, None], _draped(garment, skin, normals, anatomy), dressed)
    return DressedBody(
        vertices=dressed.astype(np.float32),
        skin=skin.astype(np.float32),
        normals=_normals(anatomy.smooth(dressed, 4), rig.topology).astype(np.float32),
        coverage={garment.name: garment.covered.astype(np.float32) for garment in garments},
    )


def _inside(hems: list[Hem], vertices: Float[np.ndarray, "V 3"], candidates: Bool[np.ndarray, "V"]) -> Bool[np.ndarray, "V"]:  # noqa: F821
    """Candidates on the inner side of every hem that may cut them."""
    covered = candidates.copy()
    for hem in hems:
        covered &= ~hem.part | (hem.field(vertices) > 0)
    return covered


def _draped(garment: Garment, skin: np.ndarray, normals: np.ndarray, anatomy: Anatomy) -> Float[np.ndarray, "V 3"]:
    """The garment's surface: smoothed and pushed out of the skin again, in turns. Hollows fill; what sticks out holds the cloth up.

    Cloth moves along normals, so that what is painted on it stays put; where the garment is level it moves in the horizontal plane,
    which closes hollows whose normals cross. Hems stay where they are, except level ones.
    """
    inner = anatomy.smoothing @ garment.covered.astype(np.float64) > 0.999
    free = garment.covered & (inner | garment.level)
    horizontal = normals * [1, 1, 0]
    horizontal = horizontal / np.linalg.norm(horizontal, axis=1, keepdims=True).clip(0.3)  # a normal that points up or down stays short
    outwards = np.where(garment.level[:, None], horizontal, normals)
    cloth = skin + np.where(garment.covered, garment.thickness, 0)[:, None] * outwards
    for _ in range(garment.drape):
        step = anatomy.smooth(cloth, 3, free=free) - cloth
        step = np.where(garment.level[:, None], step * [1, 1, 0], (step * normals).sum(axis=1, keepdims=True) * normals)
        missing = garment.thickness - ((cloth + step - skin) * outwards).sum(axis=1)
        cloth = np.where(free[:, None], cloth + step + np.maximum(missing, 0)[:, None] * outwards, cloth)
    return cloth


def _slide_onto(hem: Hem, covered: np.ndarray, vertices: np.ndarray, normals: np.ndarray, anatomy: Anatomy) -> Float[np.ndarray, "V 3"]:
    """Move the two rings of vertices at a hem along the skin: the covered one onto the hem, the bare one just beyond it."""
    share = anatomy.smoothing @ covered.astype(np.float64)
    edge = hem.part & covered & (share < 0.999)
    bare = hem.part & ~covered & (share > 0.001)
    target = np.where(edge, 0.0, -HEM_STEP)
    for _ in range(2):  # the field is not linear around the neck
        height = hem.field(vertices)
        gradient = np.stack([(hem.field(vertices + step) - hem.field(vertices - step)) / 2e-3 for step in 1e-3 * np.eye(3)], axis=1)
        along = gradient - (gradient * normals).sum(axis=1, keepdims=True) * normals  # within the skin
        slope = np.maximum((along**2).sum(axis=1), 0.2)  # where the field hardly changes along the skin a vertex would slide without end
        slide = np.clip((target - height) / slope, -LARGEST_SLIDE, LARGEST_SLIDE)
        vertices = vertices + np.where(edge | bare, slide, 0)[:, None] * along
    return vertices


def _normals(vertices: Float[np.ndarray, "V 3"], topology: Topology) -> Float[np.ndarray, "V 3"]:
    return vertex_normals(torch.from_numpy(vertices)[None], torch.from_numpy(topology.faces))[0].numpy()
