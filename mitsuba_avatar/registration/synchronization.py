"""Whether videos are synchronous, told by the followed person: shifted against the others, a late camera's keypoints meet better.

Equal lengths say nothing about the moment at which recording began. A calibration that is off by some pixels hides a shift of many
frames in the errors of triangulation, so each point's constant error (its median over time) is taken off first: what is left is the
part that moves with the person.

Symbols: N frames, C cameras, K points. Pixels with the origin at the image's corner.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64

from mitsuba_avatar.captures.cameras import Camera
from mitsuba_avatar.registration.triangulation import triangulate

FEWEST_FRAMES = 24  # below that a shift is guessed, not measured
LONGEST_SHIFT = 1.0  # seconds to either side
SAMPLED_FRAMES = 120  # compared at most
LEAST_GAIN = 0.05  # part of the misfit that a shift must take away
DEVIATIONS = 4.0  # of the median of so many residuals: a gain below is chance


@dataclass(frozen=True)
class FrameShift:
    """Frame n of one camera shows what frame n + `frames` of the others shows; `misfit` and `misfit_before` are median pixels.

    `is_at_limit` says that no longer shift was tried: the true one may be longer.
    """

    camera: int
    frames: int
    misfit: float
    misfit_before: float
    is_at_limit: bool = False


def find_shift(cameras: Sequence[Camera], observations: Float[np.ndarray, "N C K 3"], fps: float) -> FrameShift | None:
    """The camera that is most clearly out of step with the others, if any is.

    Args:
        cameras: C, without distortion.
        observations: [N, C, K, 3] of one person: x, y (pixels of those cameras), confidence; NaN where missing.
        fps: frames a second.

    Returns:
        None where all agree, the person hardly moves, or there are too few frames to tell. Of two cameras, either may be named.
    """
    num_frames = len(observations)
    longest = min(round(LONGEST_SHIFT * fps), num_frames // 4)
    if num_frames < FEWEST_FRAMES or longest < 1:
        return None
    compared = np.arange(longest, num_frames - longest)
    compared = compared[np.linspace(0, len(compared) - 1, min(SAMPLED_FRAMES, len(compared))).round().astype(int)]
    before, count = _misfit(cameras, observations[compared])
    if not np.isfinite(before):
        return None
    best = FrameShift(0, 0, before, before)
    for camera in range(len(cameras)):
        for shift in range(-longest, longest + 1):
            shifted = observations[compared].copy()
            shifted[:, camera] = observations[compared - shift, camera]
            misfit, shifted_count = _misfit(cameras, shifted)
            # A shift that makes points vanish explains nothing.
            if misfit < best.misfit and shifted_count >= 0.9 * count:
                best = FrameShift(camera, shift, misfit, before, abs(shift) == longest)
    gain = 1 - best.misfit / before if before > 0 else 0.0
    return best if gain > max(LEAST_GAIN, DEVIATIONS / np.sqrt(count)) else None


def require_synchronized(cameras: Sequence[Camera], observations: Float[np.ndarray, "N C K 3"], fps: float) -> None:
    """Refuse videos of which one shows other moments than the rest.

    Raises:
        ValueError: names the camera, the frames, and where to cut.
    """
    shift = find_shift(cameras, observations, fps)
    if shift is None:
        return
    name, frames = cameras[shift.camera].name, abs(shift.frames)
    about = f"{frames} frames or more" if shift.is_at_limit else f"about {frames} frames"
    cut = f"the other videos and their keypoints by their first {frames} frames" if shift.frames > 0 else f"{name} by its first {frames}"
    raise ValueError(
        f"require_synchronized(): expected frame n to be the same moment in all videos; got {name} "
        f"{'ahead of' if shift.frames > 0 else 'behind'} the others by {about} ({frames / fps:.2f} s): shifted so, keypoints "
        f"agree to {shift.misfit:.1f} px instead of {shift.misfit_before:.1f}. Shorten {cut}, all to one length; or set "
        "keypoints.checks_synchronization=false if you know better."
    )


def _misfit(cameras: Sequence[Camera], observations: Float[np.ndarray, "N C K 3"]) -> tuple[float, int]:
    """Median pixels by which points that are triangulated from all cameras miss them, apart from what stays constant; and of how many."""
    frames, num_cameras, points = observations.shape[:3]
    flat = observations.transpose(1, 0, 2, 3).reshape(num_cameras, frames * points, 3)
    positions = triangulate(cameras, flat, np.nan_to_num(flat[..., 2]))
    misses = np.stack([_missed(camera, positions, seen) for camera, seen in zip(cameras, flat, strict=True)])
    misses = misses.reshape(num_cameras, frames, points, 2)
    is_known = np.isfinite(misses).all(axis=-1)
    is_often = is_known.sum(axis=1) >= max(2, frames // 2)  # [C, K]
    if not is_often.any():
        return float("inf"), 0
    chosen = misses.transpose(0, 2, 1, 3)[is_often]  # [_, N, 2]
    moving = np.linalg.norm(chosen - np.nanmedian(chosen, axis=1, keepdims=True), axis=-1)
    known = moving[np.isfinite(moving)]
    return float(np.median(known)), len(known)


def _missed(camera: Camera, positions: Float64[np.ndarray, "P 3"], seen: Float[np.ndarray, "P 3"]) -> Float64[np.ndarray, "P 2"]:
    """Projected minus observed pixels; NaN where either is missing."""
    with np.errstate(invalid="ignore", over="ignore"):
        return camera.project(positions)[0] - seen[:, :2]
