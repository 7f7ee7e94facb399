"""Where the dome's cameras stand: rings of calibrated cameras around the person, framed so that nothing is ever cut.

Cameras differ a little in focal length and principal point, as real ones do, and images are portrait. Held-out cameras stand between
training cameras: in front, at the side, behind and above. Metres, radians, pixels; the person faces -Y, world Z is up.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64

from mitsuba_avatar.captures.cameras import Camera, look_at
from mitsuba_avatar.filming.settings import StudioSettings

DISTANCE = 3.6  # metres from the dome's axis
RINGS = (-0.10, 0.22, 0.55)  # elevation of the rings, radians, seen from the person's middle; the middle ring holds every other camera
HELD_OUT = (
    (0.16, 0.08),
    (1.75, 0.30),
    (3.50, 0.72),
    (5.30, -0.02),
    (0.95, 0.45),
    (2.60, 0.10),
)  # azimuth, elevation; azimuth 0 is in front
MARGIN = 0.035  # share of the image that stays empty on each side
FOCAL_JITTER = 0.02
PRINCIPAL_JITTER = 0.015  # of the image's width; a few pixels


@dataclass(frozen=True)
class DomeCameras:
    """The cameras of a capture, training cameras first.

    Attributes:
        cameras: name -> camera.
        held_out: names that no training may look at.
    """

    cameras: dict[str, Camera]
    held_out: tuple[str, ...]


def place_cameras(vertices: Float[np.ndarray, "N V 3"], settings: StudioSettings) -> DomeCameras:
    """Stand cameras around a person and frame the whole performance tightly.

    Args:
        vertices: [N, V, 3] the surface in every frame (or a subset of its vertices that spans it), metres, world axes.
        settings: counts, image size, seed.
    """
    points = vertices.reshape(-1, 3).astype(np.float64)
    low, high = points.min(axis=0), points.max(axis=0)
    target = 0.5 * (low + high)
    rng = np.random.default_rng([settings.seed, 77])
    positions = _train_positions(settings.cameras.train) + _held_out_positions(settings.cameras.held_out)
    counts = {"train": settings.cameras.train, "held_out": settings.cameras.held_out}
    names = [f"{kind}_{index:02d}" for kind, count in counts.items() for index in range(count)]
    cameras = {}
    for name, (azimuth, elevation) in zip(names, positions, strict=True):
        distance = DISTANCE * rng.uniform(0.97, 1.03)
        direction = np.array([np.sin(azimuth) * np.cos(elevation), -np.cos(azimuth) * np.cos(elevation), np.sin(elevation)])
        centre = target + distance * direction
        # Look at the middle of what is seen from here, not of the box.
        towards_middle = np.append(_bounds(look_at(centre, target), points).mean(axis=0), 1.0) @ look_at(centre, target)[:3, :3]
        cameras[name] = _framed(name, look_at(centre, centre + towards_middle), points, settings, rng)
    return DomeCameras(cameras, tuple(names[settings.cameras.train :]))


def _train_positions(count: int) -> list[tuple[float, float]]:
    """Azimuth and elevation of each training camera: even steps around, heights alternating between the rings."""
    order = (1, 2, 1, 0)
    return [(2 * np.pi * (index + 0.5) / count, RINGS[order[index % len(order)]]) for index in range(count)]


def _held_out_positions(count: int) -> list[tuple[float, float]]:
    """Azimuth and elevation of each held-out camera; beyond the list, rounds of it turned by a fraction of its steps."""
    rounds, places = np.divmod(np.arange(count), len(HELD_OUT))
    return [(HELD_OUT[place][0] + 0.31 * turn, HELD_OUT[place][1]) for turn, place in zip(rounds, places, strict=True)]


def _bounds(camera_from_world: np.ndarray, points: np.ndarray) -> Float64[np.ndarray, "2 2"]:
    """Least and greatest x, y of points in the plane at depth one of a camera."""
    seen = points @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]
    plane = seen[:, :2] / seen[:, 2:]
    return np.stack([plane.min(axis=0), plane.max(axis=0)])


def _framed(name: str, camera_from_world: np.ndarray, points: np.ndarray, settings: StudioSettings, rng: np.random.Generator) -> Camera:
    """The longest lens with which all points stay inside the image, less a jitter; the principal point off-centre by a few pixels."""
    low, high = _bounds(camera_from_world, points)
    size = np.array([settings.cameras.width, settings.cameras.height], dtype=np.float64)
    focal = float(((1 - 2 * MARGIN) * size / (high - low)).min()) * (1 - FOCAL_JITTER * rng.uniform(0, 1))
    # The margin holds the jitter: nothing is cut.
    centre = 0.5 * size - focal * 0.5 * (low + high) + PRINCIPAL_JITTER * settings.cameras.width * rng.uniform(-1, 1, 2)
    return Camera(
        name=name,
        width=settings.cameras.width,
        height=settings.cameras.height,
        fx=focal,
        fy=focal,
        cx=float(centre[0]),
        cy=float(centre[1]),
        camera_from_world=camera_from_world,
    )
