"""Where the dome's cameras stand: rings of calibrated cameras around the person, framed so that nothing is ever cut.

The paper says of its dome that 140 cameras surround the person and no more; here many cameras are spread evenly over the part of the
sphere that a dome on a floor can have, on rings from just above the floor to steeply above the head. A few cameras stand in even steps
around the person instead, at alternating heights.

Cameras differ a little in focal length and principal point, as real ones do, and images are portrait. Held-out cameras stand between
training cameras: in front, at the side, behind and above. Metres, radians, pixels; the person faces -Y, world Z is up.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64

from mitsuba_avatar.captures.cameras import Camera, look_at
from mitsuba_avatar.filming.settings import StudioSettings

DISTANCE = 3.6  # metres from the dome's axis
FEW = 16  # cameras at most that alternate between three rings
RINGS = (-0.10, 0.22, 0.55)  # elevation of those, radians, seen from the person's middle; the middle ring holds every other camera
LOWEST, HIGHEST = -0.22, 1.25  # elevations of a full dome: lower the floor would be in the way
HELD_OUT = (
    (0.16, 0.08),
    (1.75, 0.30),
    (3.50, 0.72),
    (5.30, -0.02),
    (0.95, 0.45),
    (2.60, 0.10),
)  # azimuth, elevation; azimuth 0 is in front; taken where no training camera is near
CLEARANCE = math.radians(8)  # between a held-out camera of the list and training cameras
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
    train = train_positions(settings.cameras.train)
    positions = train + _held_out_positions(settings.cameras.held_out, train)
    counts = {"train": settings.cameras.train, "held_out": settings.cameras.held_out}
    names = [f"{kind}_{index:0{max(2, len(str(count - 1)))}d}" for kind, count in counts.items() for index in range(count)]
    cameras = {}
    for name, (azimuth, elevation) in zip(names, positions, strict=True):
        distance = DISTANCE * rng.uniform(0.97, 1.03)
        centre = target + distance * _direction(azimuth, elevation)
        # Look at the middle of what is seen from here, not of the box.
        towards_middle = np.append(_bounds(look_at(centre, target), points).mean(axis=0), 1.0) @ look_at(centre, target)[:3, :3]
        cameras[name] = _framed(name, look_at(centre, centre + towards_middle), points, settings, rng)
    return DomeCameras(cameras, tuple(names[settings.cameras.train :]))


def train_positions(count: int) -> list[tuple[float, float]]:
    """Azimuth and elevation of each training camera, radians, ring by ring from below where there are many."""
    if count <= FEW:
        order = (1, 2, 1, 0)
        return [(2 * np.pi * (index + 0.5) / count, RINGS[order[index % len(order)]]) for index in range(count)]
    # Rings as far apart as cameras are within a ring: each camera has a square of the dome's area.
    area = 2 * np.pi * (np.sin(HIGHEST) - np.sin(LOWEST))
    num_rings = max(2, round((HIGHEST - LOWEST) / np.sqrt(area / count)))
    elevations = LOWEST + (HIGHEST - LOWEST) * (np.arange(num_rings) + 0.5) / num_rings
    # A ring's share is its circumference's; shares are rounded so that they add up.
    ends = np.rint(count * np.concatenate([[0], np.cumsum(np.cos(elevations))]) / np.cos(elevations).sum()).astype(int)
    return [
        (2 * np.pi * (index + (0.5 if ring % 2 else 0.0)) / size, float(elevation))
        for ring, (size, elevation) in enumerate(zip(np.diff(ends).tolist(), elevations, strict=True))
        for index in range(size)
    ]


def _held_out_positions(count: int, train: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """Azimuth and elevation of each held-out camera: of the list, then wherever on the dome all other cameras are farthest."""
    directions = [_direction(*position) for position in train]
    elevations = [elevation for _, elevation in train]
    # Not beyond the training cameras: that would ask for extrapolation.
    heights = np.linspace(min(elevations), max(elevations), 25) if np.ptp(elevations) > 0 else np.array([elevations[0]])
    candidates = [(azimuth, elevation) for elevation in heights for azimuth in np.linspace(0, 2 * np.pi, 181)[:-1]]
    grid = np.stack([_direction(*candidate) for candidate in candidates])
    chosen = [place for place in HELD_OUT if _gap(_direction(*place)[None], directions)[0] > CLEARANCE][:count]
    directions += [_direction(*place) for place in chosen]
    while len(chosen) < count:
        farthest = int(_gap(grid, directions).argmax())
        chosen.append((float(candidates[farthest][0]), float(candidates[farthest][1])))
        directions.append(grid[farthest])
    return chosen


def _direction(azimuth: float, elevation: float) -> Float64[np.ndarray, "3"]:
    return np.array([np.sin(azimuth) * np.cos(elevation), -np.cos(azimuth) * np.cos(elevation), np.sin(elevation)])


def _gap(candidates: Float64[np.ndarray, "N 3"], directions: list[np.ndarray]) -> Float64[np.ndarray, "N"]:
    """Angle from each candidate to the nearest of the directions."""
    return np.arccos(np.clip((candidates @ np.stack(directions).T).max(axis=1), -1, 1))


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
