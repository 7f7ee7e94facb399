"""From files of 2D keypoints to the followed person's points in space: order found, lens distortion taken out, outliers left out.

Symbols: N frames, C cameras, K landmarks. Pixels are those of `full` cameras: undistorted, as many rows as the video has.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64

from mitsuba_avatar.captures.cameras import Camera
from mitsuba_avatar.captures.undistortion import undistort_points
from mitsuba_avatar.registration.keypoints_2d import LANDMARKS, in_landmark_order, orders_of_length, read_people
from mitsuba_avatar.registration.people import FollowingLimits, follow_person
from mitsuba_avatar.registration.recording import RecordedView, Recording
from mitsuba_avatar.registration.settings import KeypointSettings
from mitsuba_avatar.registration.synchronization import require_synchronized
from mitsuba_avatar.registration.triangulation import triangulate_robustly

REFERENCE_HEIGHT = 1920.0  # rows at which settings count pixels
ORDER_FRAMES = 12  # frames that decide about the order
LIMBS = (("shoulder", "elbow"), ("elbow", "wrist"), ("hip", "knee"), ("knee", "ankle"))


@dataclass(frozen=True, eq=False)
class PersonKeypoints:
    """The followed person.

    Attributes:
        order: of the detector.
        observations: [N, C, K, 3] x, y (pixels of the full cameras), confidence; NaN where missing.
        positions: [N, K, 4] metres and confidence, which is 0 where too few views agree (the place is then 0 too).
    """

    order: str
    observations: Float64[np.ndarray, "N C K 3"]
    positions: Float64[np.ndarray, "N K 4"]


def find_person(
    recording: Recording,
    cameras: Mapping[str, Camera],
    settings: KeypointSettings,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> PersonKeypoints:
    """Read all keypoints, follow the person on whom the cameras agree, and triangulate.

    Args:
        recording: names the files.
        cameras: full cameras by name, in the recording's order.
        settings: of this step.
        progress: called as progress(done, total).

    Raises:
        FileNotFoundError, ValueError: files, as `read_people`; nobody is seen, or not by some camera; people cross, as
            `follow_person`; a video is out of step, as `require_synchronized`; no order makes a body.
    """
    views = list(recording.views.values())
    targets = list(cameras.values())
    detections = []
    for frame in range(recording.num_frames):
        detections.append([_straight(view, target, frame, settings) for view, target in zip(views, targets, strict=True)])
        progress(frame + 1, recording.num_frames)
    scale = targets[0].height / REFERENCE_HEIGHT
    limits = FollowingLimits(settings.person_pixels * scale, settings.fastest, settings.ambiguous_distance)
    lengths = {people.shape[1] for frame in detections for people in frame if len(people)}
    if not lengths:
        raise ValueError(
            f"find_person(): expected people in the keypoint files of {recording.path}; got nobody in any frame of any camera. "
            "Detect keypoints with a lower threshold, or check that the files are those of these videos."
        )
    blind = [name for index, name in enumerate(cameras) if not any(len(frame[index]) for frame in detections)]
    if blind:
        raise ValueError(
            f"find_person(): expected people in the keypoint files of every camera of {recording.path}; got nobody in any frame of "
            f"{blind}. Detect keypoints in these videos again, or take them away: a camera that never sees the person is of no use."
        )
    if len(lengths) > 1:
        raise ValueError(
            f"find_person(): expected one keypoint order in all files of {recording.path}; got {sorted(lengths)} points. "
            "Run one detector on all videos."
        )
    nobody = np.zeros((0, lengths.pop(), 3))
    detections = [[people if len(people) else nobody for people in frame] for frame in detections]
    # Points are grouped and followed before their names are known: the numbers alone say which belong together.
    followed = follow_person(targets, detections, recording.fps, limits)
    if settings.checks_synchronization:
        require_synchronized(targets, followed, recording.fps)
    names = orders_of_length(followed.shape[2]) if settings.order == "auto" else [settings.order]
    few = np.unique(np.linspace(0, len(followed) - 1, min(ORDER_FRAMES, len(followed))).round().astype(int))
    candidates = [triangulate_person(targets, _ordered(followed[few], name), name, settings) for name in names]
    order = min(candidates, key=lambda person: asymmetry(person.positions)).order
    return triangulate_person(targets, _ordered(followed, order), order, settings)


def triangulate_person(
    cameras: Sequence[Camera], observations: Float64[np.ndarray, "N C K 3"], order: str, settings: KeypointSettings
) -> PersonKeypoints:
    """Points in space from a person's observations by full cameras."""
    frames, num_cameras, landmarks = observations.shape[:3]
    flat = observations.transpose(1, 0, 2, 3).reshape(num_cameras, frames * landmarks, 3)
    points = triangulate_robustly(cameras, flat, settings.inlier_pixels * cameras[0].height / REFERENCE_HEIGHT)
    confidence = np.where(points.is_inlier, np.nan_to_num(flat[..., 2]), 0).sum(axis=0) / num_cameras
    is_known = np.isfinite(points.positions).all(axis=-1)
    positions = np.concatenate([np.nan_to_num(points.positions), np.where(is_known, confidence, 0)[:, None]], axis=1)
    return PersonKeypoints(order, observations, positions.reshape(frames, landmarks, 4))


def asymmetry(positions: Float[np.ndarray, "N K 4"]) -> float:
    """How unlike a body's the limbs are: mean relative difference of left and right lengths, and of the lengths over time.

    Infinite where no limb is seen. The right order of points has a few per cent; a wrong one takes a nose for a shoulder.
    """
    lengths = []
    for start, end in LIMBS:
        for side in ("left", "right"):
            ends = positions[:, [LANDMARKS.index(f"{side}_{start}"), LANDMARKS.index(f"{side}_{end}")]]
            is_known = (ends[..., 3] > 0).all(axis=1)
            lengths.append(np.where(is_known, np.linalg.norm(ends[:, 0, :3] - ends[:, 1, :3], axis=-1), np.nan))
    limbs = np.stack(lengths)  # [limbs * 2, N]
    known = np.isfinite(limbs).sum(axis=1) >= 1
    if not known.all():
        return float("inf")
    medians = np.nanmedian(limbs, axis=1)
    unsteady = np.nanmedian(np.abs(limbs - medians[:, None]), axis=1) / medians
    sides = np.abs(medians[0::2] - medians[1::2]) / (medians[0::2] + medians[1::2])
    return float(unsteady.mean() + sides.mean())


def _straight(view: RecordedView, target: Camera, frame: int, settings: KeypointSettings) -> Float64[np.ndarray, "P points 3"]:
    """Detections of one image in pixels of the undistorted camera."""
    people = read_people(view.keypoints[frame], settings.least_confidence)
    people = people[np.isfinite(people).any(axis=(1, 2))]  # some detectors write somebody without a single point
    if people.size:
        known = np.isfinite(people[..., 0])
        people[known, :2] = undistort_points(people[known][:, :2], view.camera, target=target)
    return people


def _ordered(followed: Float64[np.ndarray, "N C points 3"], order: str) -> Float64[np.ndarray, "N C K 3"]:
    frames, cameras = followed.shape[:2]
    return in_landmark_order(followed.reshape(frames * cameras, -1, 3), order).reshape(frames, cameras, len(LANDMARKS), 3)
