"""Robust triangulation: 3D points from several calibrated, undistorted views, some of which may be wrong.

Every pair of views proposes a point, the proposal that most views agree with wins, and the point is solved again from those views,
weighted by confidence. All points are treated at once. Linear (DLT) in coordinates of the image plane at depth one.

Symbols: C cameras, N points. Pixels have their origin at the image's corner; metres.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float, Float64

from mitsuba_avatar.captures.cameras import Camera


@dataclass(frozen=True, eq=False)
class TriangulatedPoints:
    """Points and what spoke for them.

    Attributes:
        positions: [N, 3] metres; NaN where fewer than two views agree.
        is_inlier: [C, N] views that agree.
        errors: [C, N] pixels by which each observation is missed, NaN where there is none.
    """

    positions: Float64[np.ndarray, "N 3"]
    is_inlier: Bool[np.ndarray, "C N"]
    errors: Float64[np.ndarray, "C N"]


def triangulate_robustly(cameras: Sequence[Camera], observations: Float[np.ndarray, "C N 3"], inlier_pixels: float) -> TriangulatedPoints:
    """Triangulate points of which some observations are outliers.

    Args:
        cameras: C, without distortion.
        observations: [C, N, 3] x, y (pixels of those cameras), confidence; NaN where a camera has none.
        inlier_pixels: a view that a point misses by more disagrees.
    """
    best = np.full((observations.shape[1], 3), np.nan)
    best_score = np.zeros(observations.shape[1])
    best_inliers = np.zeros(observations.shape[:2], dtype=bool)
    for pair in combinations(range(len(cameras)), 2):
        weights = np.zeros(observations.shape[:2])
        weights[list(pair)] = 1
        positions = triangulate(cameras, observations, weights)
        errors = reprojection_errors(cameras, observations, positions)
        inliers = errors < inlier_pixels
        # Among proposals that as many views agree with, the smaller error wins.
        score = (inliers * (2 - np.where(inliers, errors, 0) / inlier_pixels)).sum(axis=0)
        is_better = (inliers.sum(axis=0) >= 2) & (score > best_score)
        best[is_better], best_score[is_better] = positions[is_better], score[is_better]
        best_inliers[:, is_better] = inliers[:, is_better]
    confidences = np.nan_to_num(observations[..., 2])
    positions = triangulate(cameras, observations, best_inliers * confidences)
    errors = reprojection_errors(cameras, observations, positions)
    return TriangulatedPoints(positions, best_inliers, errors)


def triangulate(
    cameras: Sequence[Camera], observations: Float[np.ndarray, "C N 3"], weights: Float[np.ndarray, "C N"]
) -> Float64[np.ndarray, "N 3"]:
    """Weighted linear triangulation of N points; NaN where fewer than two observations have weight."""
    count = observations.shape[1]
    rows = np.zeros((count, 2 * len(cameras), 4))
    usable = np.isfinite(observations).all(axis=-1) & (weights > 0)
    for index, camera in enumerate(cameras):
        plane = (observations[index, :, :2] - [camera.cx, camera.cy]) / [camera.fx, camera.fy]  # [N, 2]
        matrix = camera.camera_from_world[:3]
        equations = plane[..., None] * matrix[2] - matrix[:2]  # [N, 2, 4]
        rows[:, 2 * index : 2 * index + 2] = np.where(usable[index, :, None, None], weights[index, :, None, None] * equations, 0)
    is_solvable = usable.sum(axis=0) >= 2
    positions = np.full((count, 3), np.nan)
    if is_solvable.any():
        homogeneous = np.linalg.svd(rows[is_solvable])[2][:, -1]
        with np.errstate(divide="ignore", invalid="ignore"):  # parallel rays meet nowhere: infinite, and no view agrees
            positions[is_solvable] = homogeneous[:, :3] / homogeneous[:, 3:]
    return positions


def reprojection_errors(
    cameras: Sequence[Camera], observations: Float[np.ndarray, "C N 3"], positions: Float[np.ndarray, "N 3"]
) -> Float64[np.ndarray, "C N"]:
    """Pixels between observations and projected points; NaN where either is missing, infinite behind the camera."""
    errors = np.empty(observations.shape[:2])
    for index, camera in enumerate(cameras):
        with np.errstate(invalid="ignore", over="ignore"):
            pixels, depth = camera.project(positions)
            distance = np.linalg.norm(pixels - observations[index, :, :2], axis=-1)
        errors[index] = np.where(depth <= 0, np.inf, distance)
    return errors
