"""What the person is painted with: base colour and roughness in texture atlases, attire by attire.

Everything is a function of the texel's point on the resting body, so that no texture seam shows. Base colours are linear reflectances
between 0.02 and 0.8, chosen so that 8-bit images under the dome neither clip nor crush them.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from mitsuba_avatar.captures.images import write_image
from mitsuba_avatar.filming.anatomy import Anatomy, smooth_step
from mitsuba_avatar.filming.canvas import Canvas, Map, Paint, Surface
from mitsuba_avatar.filming.clothing import DressedBody, hairline
from mitsuba_avatar.filming.fabric import strands
from mitsuba_avatar.filming.leafy_prints import FAIR_HAIR, paint_leafy_shirt, paint_light_trousers
from mitsuba_avatar.filming.prints import DARK_HAIR, paint_plain_shirt, paint_shirt, paint_trousers
from mitsuba_avatar.filming.skin import paint_skin

SPECULAR = 0.35  # of skin
# Garment -> painter. "striped" is what captures are filmed in, "plain" the same person's shirt without stripes, "leafy" the other attire of
# the paper's unmatched setting.
ATTIRES: dict[str, dict[str, Callable[[Canvas], Paint]]] = {
    "striped": {
        "trousers": paint_trousers,
        "shorts": paint_trousers,
        "shirt": paint_shirt,
        "hair": partial(strands, colour=DARK_HAIR),
    },
    "plain": {
        "trousers": paint_trousers,
        "shorts": paint_trousers,
        "shirt": paint_plain_shirt,
        "hair": partial(strands, colour=DARK_HAIR),
    },
    "leafy": {
        "trousers": paint_light_trousers,
        "shorts": paint_light_trousers,
        "shirt": paint_leafy_shirt,
        "hair": partial(strands, colour=FAIR_HAIR),
    },
}


@dataclass(frozen=True)
class Appearance:
    """Textures of a surface, rows from the top of the atlas.

    Attributes:
        base_colour: [S, S, 3] linear reflectance.
        roughness: [S, S] of the principled BSDF, 1 is matt.
        specular: of the principled BSDF; its reflectance at normal incidence is 0.08 times this.
    """

    base_colour: Float32[np.ndarray, "S S 3"]
    roughness: Float32[np.ndarray, "S S"]
    specular: float = SPECULAR

    @classmethod
    def of(cls, paint: Paint, specular: float = SPECULAR) -> "Appearance":
        """Textures of what was painted, within the range of real materials."""
        colour, roughness = np.clip(paint.colour, 0.02, 0.8), np.clip(paint.roughness, 0.05, 1)
        return cls(colour.astype(np.float32), roughness.astype(np.float32), specular)

    def save(self, folder: Path | str) -> None:
        """Write `albedo.exr` and `roughness.exr` (grey, three equal channels) into a folder: the truth about a filmed surface."""
        folder = Path(folder)
        write_image(folder / "albedo.exr", self.base_colour)
        write_image(folder / "roughness.exr", np.repeat(self.roughness[..., None], 3, axis=-1))


def paint(anatomy: Anatomy, body: DressedBody, size: int, seed: int, attire: str = "striped") -> Appearance:
    """Paint a dressed body in the rig's atlas: skin, and over it the garments that are part of the body's own surface.

    Args:
        anatomy: of the bare rig.
        body: what is worn.
        size: S, texels along a side.
        seed: decides the pattern of skin tone, fibres and strands.
        attire: a key of `ATTIRES`.

    Raises:
        ValueError: for an unknown attire.
    """
    painters = _painters(attire)
    canvas = Canvas(anatomy, Surface.of_body(anatomy, body), size, seed)
    result = paint_skin(canvas)
    for name in [name for name in painters if name in body.coverage]:
        result = result.under(painters[name](canvas), _coverage(canvas, name, body.coverage[name]))
    return Appearance.of(result)


def paint_garment(anatomy: Anatomy, name: str, surface: Surface, size: int, seed: int, attire: str = "striped") -> Appearance:
    """Paint a garment that is a mesh of its own: cloth all over the surface's atlas.

    Args:
        anatomy: of the bare rig.
        name: "shirt", "trousers" or "shorts".
        surface: the garment's mesh at rest (`Surface.of_garment`).
        size: S, texels along a side.
        seed: decides the pattern of fibres.
        attire: a key of `ATTIRES`.

    Raises:
        ValueError: for an unknown attire or garment.
    """
    painters = _painters(attire)
    if name not in painters:
        raise ValueError(f"paint_garment(): expected a garment of {', '.join(painters)}; got {name!r}. Choose one of them.")
    return Appearance.of(painters[name](Canvas(anatomy, surface, size, seed)))


def _painters(attire: str) -> dict[str, Callable[[Canvas], Paint]]:
    if attire not in ATTIRES:
        raise ValueError(f"paint(): expected an attire of {', '.join(ATTIRES)}; got {attire!r}. Choose one of them.")
    return ATTIRES[attire]


def _coverage(canvas: Canvas, name: str, covered: Float32[np.ndarray, "V"]) -> Map:
    """Where a garment covers the skin, 0..1. Hair begins finer than the mesh, in tufts."""
    cover = canvas.field(covered)
    if name != "hair":
        return smooth_step(cover, 0.35, 0.65)
    tufts = hairline(canvas.anatomy, canvas.points) + 0.0025 * canvas.noise(0.006)
    return smooth_step(tufts, -0.003, 0.003) * (cover > 0)
