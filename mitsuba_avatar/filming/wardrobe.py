"""Outfits with one simulated garment: what is simulated and how it is cut, of what fabric, and what is worn beneath.

Garments beneath (and hair) are displacements of the body's own surface, complete under the simulated one: when cloth slides up, the
waistband shows. Names of garments are those of the textures that paint them. Metres, seconds, rest space.
"""

import dataclasses
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32

from mitsuba_avatar.filming.anatomy import ARM, FOOT, LEG, SIDES, Anatomy, smooth_step
from mitsuba_avatar.filming.clothing import DressedBody, Garment, Hem, dress, hair, plane, shirt, trousers
from mitsuba_avatar.filming.garment_mesh import GarmentMesh, cut_garment

LINING = 0.001  # metres between skin and the surface that stops cloth, which spans hollows as cloth does


@dataclass(frozen=True)
class Fabric:
    """How cloth behaves.

    Attributes:
        fit: threads relative to the garment's cut; below 1 it is tight.
        stretch_time, bend_time: seconds in which a stretched thread, a fold swings back (one over the angular frequency); shorter is
            stiffer. Independent of the time step, but not of the mesh.
        damping: 1/s by which movement relative to the skin beneath dies away.
        friction: Coulomb's coefficient between cloth and skin.
        gap: metres between skin and cloth that lies on it.
    """

    fit: float
    stretch_time: float
    bend_time: float
    damping: float
    friction: float
    gap: float


@dataclass(frozen=True, eq=False)  # arrays have no truth value to compare by
class Outfit:
    """What a person wears who wears one simulated garment.

    Attributes:
        garment: the part of the body that the simulated garment covers.
        mesh: the simulated garment at rest.
        fabric: what it is made of.
        beneath: other clothes and hair, displacements of the body.
        obstacle: [V, 3] rest surface that stops the cloth: the body with what is worn beneath, hollows filled.
        is_obstacle: [V] vertices of the body whose triangles stop cloth; head, fingers and feet never meet it.
    """

    garment: Garment
    mesh: GarmentMesh
    fabric: Fabric
    beneath: tuple[Garment, ...]
    obstacle: Float32[np.ndarray, "V 3"]
    is_obstacle: Bool[np.ndarray, "V"]

    def registered_body(self, anatomy: Anatomy) -> DressedBody:
        """The body in its own topology with the garment as cut: template of the registered mesh, and where the garment's paint lies."""
        return dress(anatomy, (*self.beneath, self.garment))

    def filmed_body(self, anatomy: Anatomy) -> DressedBody:
        """The body without the simulated garment: what is in front of the cameras beneath it."""
        return dress(anatomy, self.beneath)


# The shirt is a little tight and damped, so that pose explains most of its shape and history the rest.
FABRICS = {
    "shirt": Fabric(fit=0.975, stretch_time=5e-4, bend_time=6e-3, damping=6.0, friction=0.25, gap=0.004),
    "loose_shirt": Fabric(fit=1.0, stretch_time=5e-4, bend_time=8e-3, damping=3.0, friction=0.3, gap=0.004),
    "shorts": Fabric(fit=1.0, stretch_time=5e-4, bend_time=6e-3, damping=3.0, friction=0.3, gap=0.004),
}


def choose_outfit(anatomy: Anatomy, name: str) -> Outfit:
    """The outfit of a name: "shirt" (T-shirt over trousers), "loose_shirt" (the same, wider) or "shorts" (loose ones over a tucked-in top).

    Raises:
        ValueError: for another name.
    """
    if name not in FABRICS:
        raise ValueError(f"choose_outfit(): expected one of {sorted(FABRICS)}; got {name!r}. Choose one of them.")
    if name == "shorts":
        garment, below = _shorts(anatomy), _tucked_shirt(anatomy)
    else:
        garment, below = _long_shirt(anatomy, 0.014 if name == "loose_shirt" else 0.004), _full_trousers(anatomy)
    fabric = FABRICS[name]
    lining = np.where(below.covered, below.thickness, 0) + np.float32(LINING)
    lined = dataclasses.replace(garment, thickness=lining.astype(np.float32))
    far = anatomy.weight(("head", "eye", "finger", "metacarpal", *FOOT)) > 0.5
    return Outfit(
        garment=garment,
        mesh=cut_garment(anatomy, garment, 0, fabric.fit, rounds=2 if name == "shorts" else 1),  # the body is coarser at the hips
        fabric=fabric,
        beneath=(below, hair(anatomy)),
        obstacle=dress(anatomy, (below, lined)).vertices,
        is_obstacle=(anatomy.piece == 0) & ~far,
    )


def _long_shirt(anatomy: Anatomy, width: float) -> Garment:
    """The T-shirt of `clothing`, held by its neck, cut longer and `width` metres wider at the waist: this one can ride up."""
    short = shirt(anatomy)
    vertices = anatomy.rig.rest_vertices.astype(np.float64)
    pelvis = anatomy.joint("spine05")
    arms = anatomy.weight(ARM) > 0.5
    hem = Hem(plane(pelvis + np.array([0, 0, -0.065]), np.array([0, 0, 1.0])), short.hems[1].part)
    hips = (anatomy.piece == 0) & ~arms & (vertices[:, 2] < pelvis[2]) & (hem.field(vertices) > 0)
    waist = smooth_step(vertices[:, 2], pelvis[2] + 0.35, pelvis[2])
    thickness = short.thickness + np.where(arms, 0.5, waist) * width
    level = short.level | hips
    return dataclasses.replace(
        short,
        covered=short.covered | hips,
        hems=(short.hems[0], hem, *short.hems[2:]),
        thickness=thickness.astype(np.float32),
        level=level,
    )


def _full_trousers(anatomy: Anatomy) -> Garment:
    """Trousers with a waistband of their own, which a shirt may uncover."""
    bare = dataclasses.replace(shirt(anatomy), covered=np.zeros(anatomy.rig.topology.num_vertices, dtype=bool))
    garment = trousers(anatomy, bare)
    waist = anatomy.joint("spine05")[2] + 0.045
    upright = (anatomy.piece == 0) & (anatomy.weight(ARM) < 0.5)
    hem = Hem(plane(np.array([0, 0, waist]), np.array([0, 0, -1.0])), upright)
    covered = garment.covered & (hem.field(anatomy.rig.rest_vertices.astype(np.float64)) > 0)
    return dataclasses.replace(garment, covered=covered, hems=(*garment.hems, hem))


def _tucked_shirt(anatomy: Anatomy) -> Garment:
    """A close-fitting shirt that ends beneath the shorts."""
    garment = shirt(anatomy)
    return dataclasses.replace(garment, thickness=(0.4 * garment.thickness).astype(np.float32))


def _shorts(anatomy: Anatomy) -> Garment:
    """Loose shorts from the waist to above the knees; the first hem is the waist."""
    vertices = anatomy.rig.rest_vertices.astype(np.float64)
    legs = {side: anatomy.weight(LEG, side) > 0.5 for side in SIDES}
    waist = anatomy.joint("spine05")[2] + 0.05
    hips = (anatomy.piece == 0) & (anatomy.weight(ARM) < 0.5)
    hems = [Hem(plane(np.array([0, 0, waist]), np.array([0, 0, -1.0])), hips & (vertices[:, 2] > waist - 0.2))]
    covered = hips & (vertices[:, 2] < waist)
    loose = np.zeros(len(vertices))
    for side in SIDES:
        start, direction, length = anatomy.axis(f"upperleg01.{side}", f"lowerleg01.{side}")
        hem = Hem(plane(start + 0.68 * length * direction, -direction), legs[side])
        hems.append(hem)
        covered &= ~legs[side] | (hem.field(vertices) > 0)
        loose += legs[side] * smooth_step((vertices - start) @ direction / length, -0.2, 0.6)
    thickness = 0.014 + 0.018 * loose
    return Garment("shorts", covered, tuple(hems), thickness.astype(np.float32), np.zeros_like(covered), drape=16)
