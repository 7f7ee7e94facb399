"""Cameras that nobody built: paths around a person for videos and novel views, and cameras that a file describes.

A key-framed path is a YAML file; positions and targets are metres in world axes (Z up), a field of view is vertical, in degrees:

    keyframes:
      - {time: 0.0, position: [0.0, -4.0, 1.2], target: [0.0, 0.0, 0.9], field_of_view: 30}
      - {time: 2.5, position: [3.0, -2.0, 1.6], target: [0.0, 0.0, 1.1], field_of_view: 24}
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import yaml
from jaxtyping import Float, Float64
from scipy.interpolate import CubicSpline

from mitsuba_avatar.captures.cameras import Camera, look_at

HALF_FIELD = 0.25  # radians from the optical axis to the edge of what must be seen: a portrait lens
STEEPEST = 1.5  # radians above or below the horizon: straight up or down, nothing says which way a picture's top is
_KEYS = {"time", "position", "target", "field_of_view"}


def orbit(
    points: Float[np.ndarray, "N 3"], count: int, width: int, height: int, elevation: float = 0.12, turns: float = 1.0
) -> list[Camera]:
    """Cameras on a circle that see all points from every side.

    Args:
        points: [N, 3] metres, for instance all vertices of a sequence, thinned.
        count: cameras.
        width, height: image size in pixels.
        elevation: radians above the horizon.
        turns: times around; the last camera stops one step short of the first, so that a video loops.
    """
    _check_count("orbit", count)
    return _around("orbit", points, 2 * math.pi * turns * np.arange(count) / count, np.full(count, elevation), (width, height))


def spiral(
    points: Float[np.ndarray, "N 3"], count: int, width: int, height: int, elevations: tuple[float, float] = (-0.2, 0.8), turns: float = 2.0
) -> list[Camera]:
    """Cameras that see all points while they wind upwards.

    Args:
        points: [N, 3] metres.
        count: cameras.
        width, height: image size in pixels.
        elevations: radians above the horizon at the first and the last camera.
        turns: times around.
    """
    _check_count("spiral", count)
    return _around("spiral", points, 2 * math.pi * turns * np.arange(count) / count, np.linspace(*elevations, count), (width, height))


def turntable(
    points: Float[np.ndarray, "N 3"], count: int, width: int, height: int, elevation: float = 0.12
) -> tuple[list[Camera], Float64[np.ndarray, "count 4 4"]]:
    """A camera that stands still while the person turns once, as on a turntable: in a lit scene, light then wanders over the person.

    Args:
        points: [N, 3] metres, before the turn.
        count: pictures.
        width, height: image size in pixels.
        elevation: radians above the horizon.

    Returns:
        `count` cameras that differ in name only, and for each the rigid world transform [4, 4] that turns the person. The person looks as
        to the cameras of `orbit`.
    """
    _check_count("turntable", count)
    first = orbit(points, count, width, height, elevation)[0]  # its lens is the one that suits every side
    target = _middle(points)
    turns = np.tile(np.eye(4), (count, 1, 1))
    for i, angle in enumerate(-2 * math.pi * np.arange(count) / count):
        turns[i, :2, :2] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
        turns[i, :3, 3] = target - turns[i, :3, :3] @ target
    return [replace(first, name=f"turntable_{i:04d}") for i in range(count)], turns


def key_framed(path: Path | str, count: int, width: int, height: int) -> list[Camera]:
    """Cameras along a smooth path through key frames of a file, evenly in time from the first to the last.

    Position, target and the logarithm of the focal length follow natural cubic splines through the key frames.

    Args:
        path: YAML, see the module.
        count: cameras.
        width, height: image size in pixels.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: an empty path, a key frame that lacks something, times that do not rise, or a camera that looks straight up or down.
    """
    _check_count("key_framed", count)
    times, keys = _read_keyframes(Path(path))
    time = np.linspace(times[0], times[-1], count)
    values = CubicSpline(times, keys, bc_type="natural")(time) if len(times) > 1 else np.repeat(keys, count, axis=0)
    cameras = []
    for i, value in enumerate(values):
        position, target, half_field = value[:3], value[3:6], math.atan(math.exp(value[6]))
        axis = target - position
        distance = float(np.linalg.norm(axis))
        if distance < 1e-3 or abs(math.asin(axis[2] / distance)) > STEEPEST:
            raise ValueError(
                f"key_framed(): expected cameras in {path} that look at a target and neither straight up nor down; got position "
                f"{position.round(3).tolist()} and target {target.round(3).tolist()} at {time[i]:.3f} s. Move one of them."
            )
        focal = 0.5 * height / math.tan(half_field)
        cameras.append(Camera(f"keyed_{i:04d}", width, height, focal, focal, width / 2, height / 2, look_at(position, target)))
    return cameras


def _read_keyframes(path: Path) -> tuple[Float64[np.ndarray, "K"], Float64[np.ndarray, "K 7"]]:  # noqa: F821
    """Times, and position, target, log tangent of half the field of view."""
    if not path.is_file():
        raise FileNotFoundError(f"key_framed(): expected a file of key frames at {path}; there is none. Check the path.")
    try:
        document = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"key_framed(): expected YAML in {path}; got: {' '.join(str(error).split())}. Mend the file.") from error
    entries = document.get("keyframes") if isinstance(document, dict) else None
    if not isinstance(entries, list) or not entries:
        raise ValueError(f"key_framed(): expected a list 'keyframes' with at least one entry in {path}; got {entries!r}. Add one.")
    times, keys = [], []
    for index, entry in enumerate(entries):
        if not isinstance(entry, dict) or set(entry) != _KEYS:
            raise ValueError(f"key_framed(): expected {sorted(_KEYS)} in key frame {index} of {path}; got {entry!r}. Write these four.")
        try:
            row = np.array([*entry["position"], *entry["target"], entry["field_of_view"], entry["time"]], dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise ValueError(f"key_framed(): expected numbers in key frame {index} of {path}; got {entry!r}. Correct them.") from error
        if row.shape != (8,) or not np.isfinite(row).all() or not 0 < row[6] < 180:
            raise ValueError(
                f"key_framed(): expected three coordinates each and a field of view of 0..180 degrees in key frame {index} of {path}; "
                f"got {entry!r}. Correct it."
            )
        times.append(row[7])
        keys.append([*row[:6], math.log(math.tan(math.radians(row[6]) / 2))])
    if np.any(np.diff(times) <= 0):
        raise ValueError(f"key_framed(): expected rising times in {path}; got {times}. Sort the key frames.")
    return np.array(times), np.array(keys)


def _around(
    name: str, points: np.ndarray, azimuths: Sequence[float] | np.ndarray, elevations: Sequence[float] | np.ndarray, size: tuple[int, int]
) -> list[Camera]:
    """Cameras that look at the middle of the points, all with the longest lens that keeps the points in every picture."""
    target = _middle(points)
    distance = float(np.linalg.norm(points - target, axis=1).max()) / math.sin(HALF_FIELD)
    cameras = []
    for i, (azimuth, elevation) in enumerate(zip(azimuths, elevations, strict=True)):
        direction = np.array([math.sin(azimuth) * math.cos(elevation), -math.cos(azimuth) * math.cos(elevation), math.sin(elevation)])
        camera_from_world = look_at(target + distance * direction, target)
        focal = _focal_that_frames(points, camera_from_world, *size)
        cameras.append(Camera(f"{name}_{i:04d}", *size, focal, focal, size[0] / 2, size[1] / 2, camera_from_world))
    tightest = min(camera.fx for camera in cameras)  # one lens for the whole path: a focal length that breathes makes viewers seasick
    return [replace(camera, fx=tightest, fy=tightest) for camera in cameras]


def _middle(points: Float[np.ndarray, "N 3"]) -> Float64[np.ndarray, "3"]:
    return 0.5 * (points.min(axis=0).astype(np.float64) + points.max(axis=0).astype(np.float64))


def _check_count(function: str, count: int) -> None:
    if count < 1:
        raise ValueError(f"{function}(): expected at least one camera; got {count}.")


def _focal_that_frames(points: np.ndarray, camera_from_world: np.ndarray, width: int, height: int) -> float:
    """Longest focal length in pixels that keeps all points inside the image, less a margin of 4 %."""
    seen = points @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]
    slope = np.abs(seen[:, :2] / seen[:, 2:]).max(axis=0)
    return float(0.96 * min(0.5 * width / slope[0], 0.5 * height / slope[1]))
