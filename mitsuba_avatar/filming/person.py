"""Who stands on the stage: body, clothes and everything worn, as layers to film and as the registered mesh that a capture hands out.

The *registered* surface has the body's own topology: clothes and hair are displacements of the skin, and where a garment is simulated its
coarse vertices take the place of the body's. The *layers* are what cameras see: the body, the fine garment over it, eyes, teeth, and a
headset if one is worn.
"""

import dataclasses
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32

from mitsuba_avatar.body.anny_rig import build_anny_rig, facial_action_displacements
from mitsuba_avatar.body.rig import Rig
from mitsuba_avatar.filming.anatomy import Anatomy
from mitsuba_avatar.filming.appearance import paint, paint_garment
from mitsuba_avatar.filming.canvas import Surface
from mitsuba_avatar.filming.clothing import DressedBody, dress, hair, shirt, trousers
from mitsuba_avatar.filming.face_parts import eyes, teeth
from mitsuba_avatar.filming.garment_layers import BodyUnderCloth, body_under_cloth
from mitsuba_avatar.filming.headset import headset
from mitsuba_avatar.filming.props import BodyPart, RigidProp
from mitsuba_avatar.filming.settings import StudioSettings
from mitsuba_avatar.filming.stage import Layer
from mitsuba_avatar.filming.wardrobe import Outfit, choose_outfit
from mitsuba_avatar.filming.wrinkles import KinematicCloth


@dataclass(frozen=True, eq=False)  # arrays have no truth value to compare by
class Person:
    """A dressed person.

    Attributes:
        anatomy: of the bare rig.
        outfit: with its simulated garment; None where all cloth is displaced.
        registered: the body as the registered mesh has it, at rest, with the garment as cut.
        filmed: the body without the simulated garment, at rest.
        under: what of it hides beneath that garment; None without one.
        cloth: how the displaced clothes move.
        layers: what is filmed: the body, the simulated garment if there is one, then `parts`.
        parts: small things that follow the body.
        action_names: A facial actions; action_displacements: [A, V, 3] metres at full strength.
    """

    anatomy: Anatomy
    outfit: Outfit | None
    registered: DressedBody
    filmed: DressedBody
    under: BodyUnderCloth | None
    cloth: KinematicCloth
    layers: tuple[Layer, ...]
    parts: tuple[BodyPart | RigidProp, ...]
    action_names: tuple[str, ...]
    action_displacements: Float32[np.ndarray, "A V 3"]

    @property
    def rig(self) -> Rig:
        """The bare body's."""
        return self.anatomy.rig


def dress_person(settings: StudioSettings) -> Person:
    """Dress and paint the person that settings ask for.

    Raises:
        ValueError: for an outfit that exists only simulated, asked for without simulation.
    """
    anatomy = Anatomy.of(build_anny_rig())
    clothing, seed = settings.clothing, settings.seed
    names, displacements = facial_action_displacements()
    outfit = choose_outfit(anatomy, clothing.outfit) if clothing.is_simulated else None
    if outfit is None:
        top = shirt(anatomy)
        registered = filmed = dress(anatomy, (trousers(anatomy, top), top, hair(anatomy)))
        under = None
    else:
        registered, filmed = outfit.registered_body(anatomy), outfit.filmed_body(anatomy)
        under = body_under_cloth(anatomy, outfit)
    parts: list[BodyPart | RigidProp] = [eyes(anatomy, seed), *teeth(anatomy, filmed)] if clothing.has_details else []
    if clothing.headset:
        parts.append(headset(anatomy, filmed))
    body = Layer(
        "person",
        anatomy.rig.topology,
        paint(anatomy, filmed, clothing.texture_size, seed, clothing.attire),
        is_two_sided=True,  # one can look into trouser legs and sleeves
        hidden_faces=_replaced_faces(parts, under),
    )
    garments = [] if outfit is None else [_garment_layer(anatomy, outfit, settings)]
    return Person(
        anatomy=anatomy,
        outfit=outfit,
        registered=registered,
        filmed=filmed,
        under=under,
        cloth=KinematicCloth(anatomy, filmed, seed),
        layers=(body, *garments, *(part.layer for part in parts)),
        parts=tuple(parts),
        action_names=tuple(names),
        action_displacements=displacements,
    )


def _garment_layer(anatomy: Anatomy, outfit: Outfit, settings: StudioSettings) -> Layer:
    """The simulated garment, painted."""
    surface = Surface.of_garment(anatomy, outfit.mesh.topology, outfit.mesh.rest_vertices)
    clothing = settings.clothing
    appearance = paint_garment(anatomy, outfit.garment.name, surface, clothing.texture_size, settings.seed, clothing.attire)
    return Layer("garment", outfit.mesh.topology, appearance, is_two_sided=True)


def _replaced_faces(parts: list[BodyPart | RigidProp], under: BodyUnderCloth | None) -> Bool[np.ndarray, "F"] | None:
    """Faces of the body that are filmed as parts of their own, or never seen under cloth."""
    flags = [part.faces for part in parts if isinstance(part, BodyPart)] + ([] if under is None else [under.hidden_faces])
    return np.logical_or.reduce(flags) if flags else None


def with_template(rig: Rig, rest_vertices: Float32[np.ndarray, "V 3"]) -> Rig:
    """The rig with another rest surface: skinning the template alone then fits the clothes as they hang on average."""
    return dataclasses.replace(rig, rest_vertices=rest_vertices)
