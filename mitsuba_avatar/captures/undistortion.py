"""Lens distortion: images, masks and points of a bent camera as a straight one sees them.

A `Camera` carries Brown-Conrady coefficients itself; `Lens` names any model, also the ones that cameras.json cannot hold. Pixels have
their origin at the image's corner, as everywhere in the package; OpenCV, which computes the maps, puts it at the first pixel's centre,
so half a pixel is taken off on the way in and added on the way out. The straight camera stands where the bent one stands and looks
where it looks: only intrinsics and size change.
"""

from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float, Float32, Float64

from mitsuba_avatar.captures.cameras import Camera

BROWN_CONRADY_COUNTS = (0, 4, 5, 8, 12, 14)  # OpenCV's: k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4 [tx ty]]]]
FISHEYE_COUNT = 4
BORDER_SAMPLES = 33  # points along each side of the image that bound what the lens sees
LARGEST_RESIDUAL = 0.05  # pixels by which an undistorted point, bent again, may miss its origin
REFINEMENTS = 40  # OpenCV stops after a few steps, up to a pixel off near the border of wide lenses


@dataclass(frozen=True)
class Lens:
    """How a lens bends straight lines.

    Attributes:
        coefficients: in OpenCV's order: (k1, k2, p1, p2[, k3[, k4, k5, k6[, s1, s2, s3, s4[, tx, ty]]]]), or (k1, k2, k3, k4) of a
            fisheye. Empty is a pinhole.
        kind: "brown_conrady" (radial and tangential, OpenCV's standard model) or "fisheye" (Kannala-Brandt, OpenCV's fisheye model).

    Raises:
        ValueError: for another count, or a coefficient that is not finite.
    """

    coefficients: tuple[float, ...] = ()
    kind: Literal["brown_conrady", "fisheye"] = "brown_conrady"

    def __post_init__(self) -> None:
        allowed = BROWN_CONRADY_COUNTS if self.kind == "brown_conrady" else (FISHEYE_COUNT,)
        if len(self.coefficients) not in allowed or not np.isfinite(self.coefficients).all():
            raise ValueError(
                f"Lens(): expected {' or '.join(map(str, allowed))} finite coefficients of a {self.kind} lens; got {self.coefficients}. "
                "Write them in OpenCV's order."
            )

    @property
    def is_pinhole(self) -> bool:
        """Whether it bends nothing. A fisheye with zero coefficients still bends: its pinhole limit is equidistant."""
        return self.kind == "brown_conrady" and not any(self.coefficients)


def lens_of(camera: Camera) -> Lens:
    """The lens that a camera's own `distortion` describes."""
    return Lens(tuple(float(value) for value in camera.distortion))


def distort_points(points: Float[np.ndarray, "N 2"], camera: Camera, lens: Lens) -> Float64[np.ndarray, "N 2"]:
    """Where the bent camera shows what a pinhole of the same intrinsics shows at `points` (pixels, corner origin)."""
    rays = _rays_through_pinhole(points, camera)
    if lens.is_pinhole:
        return points.astype(np.float64)
    if lens.kind == "fisheye":
        bent = cv2.fisheye.distortPoints(rays[:, None], _matrix(camera), np.array(lens.coefficients))[:, 0]
    else:
        directions = np.concatenate([rays, np.ones((len(rays), 1))], axis=1)
        bent = cv2.projectPoints(directions, np.zeros(3), np.zeros(3), _matrix(camera), np.array(lens.coefficients))[0][:, 0]
    return bent + 0.5


def undistort_points(
    points: Float[np.ndarray, "N 2"], camera: Camera, lens: Lens | None = None, target: Camera | None = None
) -> Float64[np.ndarray, "N 2"]:
    """Carry pixels of a bent image to the straight one.

    Args:
        points: [N, 2] pixels of the bent image, corner origin. Keypoint detectors that count from the first pixel's centre need + 0.5.
        camera: intrinsics of the bent image.
        lens: its lens; None takes the camera's own distortion.
        target: straight camera whose pixels are wanted; None keeps the intrinsics of `camera`.

    Returns:
        [N, 2] pixels of the straight image, corner origin; NaN where the lens model cannot be inverted (it folds over there).
    """
    lens = lens_of(camera) if lens is None else lens
    target = camera if target is None else target
    rays = _rays_through_lens(points, camera, lens)
    return rays * np.array([target.fx, target.fy]) + np.array([target.cx, target.cy])


def undistorted_camera(
    camera: Camera, lens: Lens | None = None, width: int | None = None, height: int | None = None, is_cropped: bool = True
) -> Camera:
    """The straight camera that sees as much as possible of what a bent one saw.

    Pixels keep their aspect ratio. Without distortion and at the same size this is the same camera; at another size it is the resized
    one, cut at the sides where the shapes differ.

    Args:
        camera: intrinsics of the bent image.
        lens: its lens; None takes the camera's own distortion.
        width, height: pixels of the wanted image; None keeps the camera's.
        is_cropped: true cuts until every pixel has a source; false keeps the intrinsics (scaled to the size), which leaves pixels
            without a source where the lens saw less than the pinhole would.

    Returns:
        a camera without distortion, at the same place.

    Raises:
        ValueError: if the lens model folds over inside the image, which happens to coefficients fitted far from the border.
    """
    lens = lens_of(camera) if lens is None else lens
    width, height = width or camera.width, height or camera.height
    if is_cropped:
        left, right, top, bottom = _inscribed_rectangle(camera, lens)
    else:
        left, right = -camera.cx / camera.fx, (camera.width - camera.cx) / camera.fx
        top, bottom = -camera.cy / camera.fy, (camera.height - camera.cy) / camera.fy
    scale = max(width / (camera.fx * (right - left)), height / (camera.fy * (bottom - top)))
    fx, fy = scale * camera.fx, scale * camera.fy
    return replace(
        camera,
        width=width,
        height=height,
        fx=fx,
        fy=fy,
        cx=0.5 * width - 0.5 * fx * (left + right),
        cy=0.5 * height - 0.5 * fy * (top + bottom),
        distortion=(),
    )


@dataclass(frozen=True, eq=False)
class Undistortion:
    """A remap from the images of one camera to those of a straight one. `undistortion` makes it; use it for every frame.

    Attributes:
        camera: size of the images that come in.
        target: the straight camera, size of those that go out.
        map_x, map_y: source pixel of every output sample, origin at the first pixel's centre, as cv2.remap takes them.
        samples: output samples along a pixel's side, averaged: more than 1 where the images become smaller.
    """

    camera: Camera
    target: Camera
    map_x: Float32[np.ndarray, "h w"]
    map_y: Float32[np.ndarray, "h w"]
    samples: int

    def image(self, linear: Float32[np.ndarray, "H W 3"]) -> Float32[np.ndarray, "H2 W2 3"]:
        """Remap linear radiance with bicubic interpolation; pixels without a source take the nearest one's value.

        Raises:
            ValueError: if the image's size is not the camera's.
        """
        return self._remap(linear, cv2.INTER_CUBIC if self.samples == 1 else cv2.INTER_LINEAR, cv2.BORDER_REPLICATE).clip(0.0, None)

    def mask(self, coverage: Float32[np.ndarray, "H W"]) -> Float32[np.ndarray, "H2 W2"]:
        """Remap coverage 0..1, bilinearly; pixels without a source are background. Raises as `image`."""
        return self._remap(coverage, cv2.INTER_LINEAR, cv2.BORDER_CONSTANT)

    def labels(self, labels: np.ndarray) -> np.ndarray:
        """Remap integer labels [H, W] by the nearest pixel; those without a source are 0. Raises as `image`."""
        self._check(labels)
        middle = self.samples // 2
        map_x, map_y = (m[middle :: self.samples, middle :: self.samples] for m in (self.map_x, self.map_y))
        return cv2.remap(labels, map_x, map_y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=0)

    def _remap(self, pixels: Float32[np.ndarray, "..."], interpolation: int, border: int) -> Float32[np.ndarray, "..."]:
        self._check(pixels)
        fine = cv2.remap(pixels, self.map_x, self.map_y, interpolation, borderMode=border, borderValue=0.0)
        if self.samples == 1:
            return fine
        blocks = fine.reshape(self.target.height, self.samples, self.target.width, self.samples, *fine.shape[2:])
        return blocks.mean(axis=(1, 3), dtype=np.float32)

    def _check(self, pixels: np.ndarray) -> None:
        if pixels.shape[:2] != (self.camera.height, self.camera.width):
            raise ValueError(
                f"Undistortion(): expected images of {self.camera.width}x{self.camera.height} pixels, the size of {self.camera.name}; "
                f"got {pixels.shape[1]}x{pixels.shape[0]}. Take images and intrinsics of the same resolution."
            )


def undistortion(camera: Camera, target: Camera, lens: Lens | None = None) -> Undistortion:
    """Prepare the remap of images of `camera` (bent by `lens`; None takes its own distortion) to those of `target`.

    Raises:
        ValueError: if the target is distorted or stands elsewhere.
    """
    lens = lens_of(camera) if lens is None else lens
    if target.is_distorted or not np.allclose(target.camera_from_world, camera.camera_from_world, atol=1e-6):
        raise ValueError(
            f"undistortion(): expected a straight target at the place of {camera.name}; got distortion {target.distortion} or another "
            "camera_from_world. Make the target with undistorted_camera()."
        )
    samples = max(1, round(min(camera.fx / target.fx, camera.fy / target.fy)))
    fine = replace(
        target,
        width=target.width * samples,
        height=target.height * samples,
        fx=target.fx * samples,
        fy=target.fy * samples,
        cx=target.cx * samples,
        cy=target.cy * samples,
    )
    make_map = cv2.fisheye.initUndistortRectifyMap if lens.kind == "fisheye" else cv2.initUndistortRectifyMap
    coefficients = np.array(lens.coefficients or (0.0,) * 4)
    map_x, map_y = make_map(_matrix(camera), coefficients, np.eye(3), _matrix(fine), (fine.width, fine.height), cv2.CV_32FC1)
    return Undistortion(camera, target, map_x, map_y, samples)


def _matrix(camera: Camera) -> Float64[np.ndarray, "3 3"]:
    """Intrinsics as OpenCV counts pixels: from the first one's centre."""
    return np.array([[camera.fx, 0.0, camera.cx - 0.5], [0.0, camera.fy, camera.cy - 0.5], [0.0, 0.0, 1.0]])


def _rays_through_pinhole(points: Float[np.ndarray, "N 2"], camera: Camera) -> Float64[np.ndarray, "N 2"]:
    """x / z and y / z of pixels of an unbent image."""
    return (points.astype(np.float64) - np.array([camera.cx, camera.cy])) / np.array([camera.fx, camera.fy])


def _rays_through_lens(points: Float[np.ndarray, "N 2"], camera: Camera, lens: Lens) -> Float64[np.ndarray, "N 2"]:
    """x / z and y / z of pixels of a bent image; NaN where no ray arrives there."""
    if lens.is_pinhole or not len(points):
        return _rays_through_pinhole(points, camera)
    pixels = points.astype(np.float64)[:, None] - 0.5
    coefficients = np.array(lens.coefficients)
    undistort = cv2.fisheye.undistortPoints if lens.kind == "fisheye" else cv2.undistortPoints
    rays = undistort(pixels, _matrix(camera), coefficients)[:, 0]
    focal, centre = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    with np.errstate(invalid="ignore", over="ignore"):
        for _ in range(REFINEMENTS):
            missing = points - distort_points(rays * focal + centre, camera, lens)
            if np.nanmax(np.abs(missing), initial=0.0) < 1e-9:
                break
            rays = rays + missing / focal
        residual = np.abs(distort_points(rays * focal + centre, camera, lens) - points).max(axis=1)
    # The iteration ends anywhere when the model folds over; bent again, such a point does not come back.
    return np.where((residual <= LARGEST_RESIDUAL)[:, None], rays, np.nan)


def _inscribed_rectangle(camera: Camera, lens: Lens) -> tuple[float, float, float, float]:
    """Left, right, top, bottom (x / z, y / z) of a rectangle of rays that all arrive inside the image."""
    along = np.linspace(0.0, 1.0, BORDER_SAMPLES)
    x, y = along * camera.width, along * camera.height
    sides = {
        "left": np.stack([np.zeros_like(y), y], axis=1),
        "right": np.stack([np.full_like(y, camera.width), y], axis=1),
        "top": np.stack([x, np.zeros_like(x)], axis=1),
        "bottom": np.stack([x, np.full_like(x, camera.height)], axis=1),
    }
    rays = {name: _rays_through_lens(points, camera, lens) for name, points in sides.items()}
    if not all(np.isfinite(values).all() for values in rays.values()):
        raise ValueError(
            f"undistorted_camera(): expected a lens model that can be inverted up to the image's border; got {lens.kind} coefficients "
            f"{lens.coefficients} of {camera.name}, which fold over. Calibrate again with points near the border, or crop the images."
        )
    left, right = float(rays["left"][:, 0].max()), float(rays["right"][:, 0].min())
    top, bottom = float(rays["top"][:, 1].max()), float(rays["bottom"][:, 1].min())
    return left, right, top, bottom
