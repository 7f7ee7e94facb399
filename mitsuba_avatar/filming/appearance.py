"""What the person is painted with: base colour and roughness in the rig's texture atlas.

Everything is a function of the texel's point on the bare rest surface, so that no texture seam shows. Base colours are linear
reflectances between 0.02 and 0.8, chosen so that 8-bit images under the dome neither clip nor crush them.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from mitsuba_avatar.filming.anatomy import Anatomy, smooth_step
from mitsuba_avatar.filming.canvas import Canvas, Map
from mitsuba_avatar.filming.clothing import DressedBody, hairline
from mitsuba_avatar.filming.prints import paint_hair, paint_shirt, paint_trousers
from mitsuba_avatar.filming.skin import paint_skin


@dataclass(frozen=True)
class Appearance:
    """Textures of a person, rows from the top of the atlas.

    Attributes:
        base_colour: [S, S, 3] linear reflectance.
        roughness: [S, S] of the principled BSDF, 1 is matt.
    """

    base_colour: Float32[np.ndarray, "S S 3"]
    roughness: Float32[np.ndarray, "S S"]


def paint(anatomy: Anatomy, body: DressedBody, size: int, seed: int) -> Appearance:
    """Paint a dressed person.

    Args:
        anatomy: of the bare rig.
        body: what is worn.
        size: S, texels along a side.
        seed: decides the pattern of skin tone, fibres and strands.
    """
    canvas = Canvas(anatomy, body, size, seed)
    layers = {"trousers": paint_trousers, "shirt": paint_shirt, "hair": paint_hair}
    result = paint_skin(canvas)
    for name, layer in layers.items():
        if name in body.coverage:
            result = result.under(layer(canvas), _coverage(canvas, name))
    return Appearance(
        base_colour=np.clip(result.colour, 0.02, 0.8).astype(np.float32), roughness=np.clip(result.roughness, 0.05, 1).astype(np.float32)
    )


def _coverage(canvas: Canvas, name: str) -> Map:
    """Where a garment covers the skin, 0..1. Hair begins finer than the mesh, in tufts."""
    cover = canvas.field(canvas.body.coverage[name])
    if name != "hair":
        return smooth_step(cover, 0.35, 0.65)
    tufts = hairline(canvas.anatomy, canvas.points) + 0.0025 * canvas.noise(0.006)
    return smooth_step(tufts, -0.003, 0.003) * (cover > 0)
