"""Pinhole cameras and cameras.json.

Axes are OpenCV's (x right, y down, z forward), `camera_from_world` carries world metres into them. Pixel coordinates have their
origin at the image's corner: the first pixel's centre is (0.5, 0.5). Formats that put pixel centres at integers get 0.5 added to
cx and cy by their reader, before they arrive here.
"""

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Float64

from mitsuba_avatar.captures.rigid import inverse_rigid, is_rigid
from mitsuba_avatar.files import atomic_path

# Which way is up in a world that is not ours yet: one of its axes, as the cameras stand, or the axis that they stand along.
UpAxis = Literal["auto", "cameras", "x", "-x", "y", "-y", "z", "-z"]

FORMAT_VERSION = 1
LARGEST_RIG_METRES = 100.0  # no capture stage is larger; 3 m domes in centimetres or millimetres are
SMALLEST_FOCAL = 0.05  # fx / width below this is a field of view above 168 degrees: a focal length in units of the width, not pixels


@dataclass(frozen=True, eq=False)
class Camera:
    """One calibrated camera.

    Attributes:
        name: also the name of its folder of images.
        width, height: pixels.
        fx, fy: focal lengths in pixels, positive.
        cx, cy: principal point in pixels, origin at the image's corner.
        camera_from_world: [4, 4] rigid, metres.
        distortion: empty, or OpenCV's radial-tangential (k1, k2, p1, p2[, k3[, k4, k5, k6]]), where k4 to k6 are the rational
            model's. `project` applies it; renderers take undistorted cameras only.

    Raises:
        ValueError: for a size or focal length that is not positive, a matrix that is not rigid, or another count of coefficients.
    """

    name: str
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    camera_from_world: Float64[np.ndarray, "4 4"]
    distortion: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if not self.name or "/" in self.name or "\\" in self.name or self.name.startswith("."):
            raise ValueError(f"Camera(): expected a name that can be a folder's; got {self.name!r}. Use letters, digits, '-' and '_'.")
        if self.width < 1 or self.height < 1:
            raise ValueError(
                f"Camera(): {self.name} must be at least 1x1 pixels; got {self.width}x{self.height}. Write width and height in pixels."
            )
        if not (np.isfinite([self.fx, self.fy, self.cx, self.cy]).all() and self.fx > 0 and self.fy > 0):
            raise ValueError(
                f"Camera(): {self.name} needs positive focal lengths and a finite principal point; got fx={self.fx}, fy={self.fy}, "
                f"cx={self.cx}, cy={self.cy}. An axis flip belongs into camera_from_world, not into the sign of a focal length."
            )
        if not is_rigid(self.camera_from_world):
            raise ValueError(
                f"Camera(): camera_from_world of {self.name} must be a rigid 4x4 matrix (rotation without scale or mirror, last row "
                f"0 0 0 1); got {self.camera_from_world.tolist()}. Divide out the scale; a matrix stored transposed has its translation "
                "in the last row."
            )
        if len(self.distortion) not in (0, 4, 5, 8) or not np.isfinite(self.distortion).all():
            raise ValueError(
                f"Camera(): distortion of {self.name} must be empty or (k1, k2, p1, p2[, k3[, k4, k5, k6]]); got {self.distortion}. "
                "Undistort the images of other lens models first."
            )

    @property
    def world_from_camera(self) -> Float64[np.ndarray, "4 4"]:
        """[4, 4] inverse of camera_from_world."""
        return inverse_rigid(self.camera_from_world)

    @property
    def center_world(self) -> Float64[np.ndarray, "3"]:
        """[3] the camera's position, metres, world axes."""
        return self.world_from_camera[:3, 3]

    @property
    def is_distorted(self) -> bool:
        """Whether straight lines appear bent, so that images must be undistorted before they are compared with renderings."""
        return any(self.distortion)

    def project(self, points_world: Float[np.ndarray, "N 3"]) -> tuple[Float64[np.ndarray, "N 2"], Float64[np.ndarray, "N"]]:
        """Project points to pixels.

        Args:
            points_world: [N, 3] metres.

        Returns:
            pixels [N, 2] (x right, y down, corner origin) and depth [N], metres along the viewing axis. Where depth is not
            positive the point lies behind the camera and its pixel means nothing; depth 0 gives NaN.
        """
        points = points_world.astype(np.float64) @ self.camera_from_world[:3, :3].T + self.camera_from_world[:3, 3]
        depth = points[:, 2]
        normalized = points[:, :2] / np.where(depth == 0, np.nan, depth)[:, None]
        if self.is_distorted:
            normalized = self._distort(normalized)
        return normalized * np.array([self.fx, self.fy]) + np.array([self.cx, self.cy]), depth

    def resized(self, scale: float) -> "Camera":
        """The camera of the same image resampled by `scale`; sizes are rounded, intrinsics follow the rounded sizes exactly."""
        width, height = max(1, round(self.width * scale)), max(1, round(self.height * scale))
        x_scale, y_scale = width / self.width, height / self.height
        # With the origin at the corner, resampling is a plain multiplication: no half-pixel terms.
        return replace(
            self, width=width, height=height, fx=self.fx * x_scale, fy=self.fy * y_scale, cx=self.cx * x_scale, cy=self.cy * y_scale
        )

    def _distort(self, normalized: Float64[np.ndarray, "N 2"]) -> Float64[np.ndarray, "N 2"]:
        """Brown-Conrady model, rational where there are k4 to k6, on coordinates [N, 2] in the plane at depth 1."""
        k1, k2, p1, p2, k3, k4, k5, k6 = (*self.distortion, 0.0, 0.0, 0.0, 0.0)[:8]
        x, y = normalized[:, 0], normalized[:, 1]
        squared_radius = x * x + y * y
        radial = 1 + squared_radius * (k1 + squared_radius * (k2 + squared_radius * k3))
        radial = radial / (1 + squared_radius * (k4 + squared_radius * (k5 + squared_radius * k6)))
        bent_x = x * radial + 2 * p1 * x * y + p2 * (squared_radius + 2 * x * x)
        bent_y = y * radial + p1 * (squared_radius + 2 * y * y) + 2 * p2 * x * y
        return np.stack([bent_x, bent_y], axis=-1)


def film_size(cameras: Iterable[Camera]) -> tuple[int, int]:
    """(width, height) of the smallest film that holds the image of every camera in its upper left corner."""
    cameras = list(cameras)
    return max(camera.width for camera in cameras), max(camera.height for camera in cameras)


def look_at(centre: Float[np.ndarray, "3"], target: Float[np.ndarray, "3"]) -> Float64[np.ndarray, "4 4"]:
    """camera_from_world of an upright camera at `centre` that looks at `target` (metres): x right, y down, z forward; world Z is up."""
    forward = (target - centre) / np.linalg.norm(target - centre)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    camera_from_world = np.eye(4)
    camera_from_world[:3, :3], camera_from_world[:3, 3] = rotation, -rotation @ centre
    return camera_from_world


def save_cameras(path: Path | str, cameras: Mapping[str, Camera]) -> None:
    """Write cameras.json, in the order of `cameras`. The file is whole or absent."""
    with atomic_path(path) as temporary:
        temporary.write_text(cameras_text(cameras), encoding="utf-8")


def cameras_text(cameras: Mapping[str, Camera]) -> str:
    """The text of cameras.json: equal cameras give equal text."""
    entries = []
    for name, camera in cameras.items():
        if name != camera.name:
            raise ValueError(
                f"cameras_text(): expected every camera under its own name; got {camera.name!r} under {name!r}. Key by Camera.name."
            )
        entry = {key: getattr(camera, key) for key in ("name", "width", "height", "fx", "fy", "cx", "cy")}
        entries.append(entry | {"camera_from_world": camera.camera_from_world.tolist(), "distortion": list(camera.distortion)})
    return json.dumps({"format_version": FORMAT_VERSION, "cameras": entries}, indent=1) + "\n"


def load_cameras(path: Path | str) -> dict[str, Camera]:
    """Read cameras.json.

    Returns:
        name -> Camera, in the file's order.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: for text that is not JSON, an unknown version, missing or unknown keys, two cameras of one name, an impossible
            camera, units that are not metres, or focal lengths that are not pixels. Names file, camera and remedy.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"load_cameras(): expected a camera file at {path}; got none. Write it with save_cameras().")
    try:
        document = json.loads(path.read_text(encoding="utf-8-sig"))
    except ValueError as error:  # JSONDecodeError and UnicodeDecodeError are both ValueErrors
        raise ValueError(
            f"load_cameras(): expected JSON in {path}; got: {error}. Repair the file or write it with save_cameras()."
        ) from error
    if not isinstance(document, dict) or document.get("format_version") != FORMAT_VERSION or not isinstance(document.get("cameras"), list):
        raise ValueError(
            f"load_cameras(): expected {{'format_version': {FORMAT_VERSION}, 'cameras': [...]}} in {path}; got "
            f"{str(document)[:80]}. Write the file with save_cameras() of this version."
        )
    cameras: dict[str, Camera] = {}
    for index, entry in enumerate(document["cameras"]):
        camera = _camera_from_entry(path, index, entry)
        if camera.name in cameras:
            raise ValueError(f"load_cameras(): expected every camera once in {path}; got {camera.name!r} twice. Rename or remove one.")
        cameras[camera.name] = camera
    if not cameras:
        raise ValueError(f"load_cameras(): expected at least one camera in {path}; got none. Add the calibrated cameras.")
    _check_units(path, list(cameras.values()))
    return cameras


def _camera_from_entry(path: Path, index: int, entry: Any) -> Camera:
    """One camera of the file; every complaint names the file and the camera."""
    required = {"name", "width", "height", "fx", "fy", "cx", "cy", "camera_from_world"}
    keys = set(entry) if isinstance(entry, dict) else set()
    if not required <= keys <= required | {"distortion"}:
        raise ValueError(
            f"load_cameras(): camera {index} of {path} must have the keys {sorted(required)} and may have 'distortion'; missing "
            f"{sorted(required - keys)}, unknown {sorted(keys - required - {'distortion'})}. Correct the entry."
        )
    try:
        pose = np.array(entry["camera_from_world"], dtype=np.float64)
        if pose.shape != (4, 4):
            raise ValueError(
                f"camera_from_world must be 4 rows of 4 numbers; got {list(pose.shape)}. Add the last row 0 0 0 1 to 3x4 matrices."
            )
        return Camera(
            name=str(entry["name"]),
            width=int(entry["width"]),
            height=int(entry["height"]),
            fx=float(entry["fx"]),
            fy=float(entry["fy"]),
            cx=float(entry["cx"]),
            cy=float(entry["cy"]),
            camera_from_world=pose,
            distortion=tuple(float(value) for value in entry.get("distortion") or ()),
        )
    except (TypeError, ValueError) as error:
        raise ValueError(f"load_cameras(): camera {index} ({entry['name']}) of {path} is not usable. {error}") from error


def _check_units(path: Path, cameras: list[Camera]) -> None:
    """Refuse positions that are not metres and focal lengths that are not pixels: both are silent and ruin everything later."""
    centers = np.stack([camera.center_world for camera in cameras])
    # A lone camera has no extent: its distance from the world's origin stands in.
    extent = float(np.ptp(centers, axis=0).max()) if len(cameras) > 1 else float(np.abs(centers).max())
    if extent > LARGEST_RIG_METRES:
        unit, divisor = ("millimetres", 1000) if extent > 10 * LARGEST_RIG_METRES else ("centimetres or millimetres", "100 or 1000")
        raise ValueError(
            f"load_cameras(): expected positions in metres in {path}; got cameras {extent:.0f} apart, which looks like {unit}. "
            f"Divide the translations of camera_from_world by {divisor}."
        )
    for camera in cameras:
        if camera.fx < SMALLEST_FOCAL * camera.width:
            raise ValueError(
                f"load_cameras(): expected focal lengths in pixels in {path}; got fx={camera.fx} for {camera.name}, {camera.width} pixels "
                "wide, which looks normalized by the image's size. Multiply fx and cx by the width, fy and cy by the height."
            )
