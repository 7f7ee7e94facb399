"""Who is who: detections of several people in several cameras become one person, followed through time.

In each frame, detections of different cameras belong to one person if their keypoints meet in space; they are grouped greedily, best
agreement first. Groups are linked from frame to frame by where the last ones were going, and the person seen by most cameras for the
longest time is the one that the capture is of. A bystander whom two cameras see stays a short, poorly supported track.

Symbols: C cameras, P people in a view, K landmarks, N frames. Pixels with the origin at the image's corner; metres, seconds.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np
from jaxtyping import Float, Float64
from scipy.optimize import linear_sum_assignment

from mitsuba_avatar.captures.cameras import Camera
from mitsuba_avatar.registration.triangulation import reprojection_errors, triangulate

FEWEST_LANDMARKS = 5  # that two views must share to be compared
PATIENCE = 0.5  # seconds that somebody may be lost
SLACK = 0.25  # metres by which noise alone may move somebody between frames
SMALLEST_BODY = 0.15  # metres, root mean square from the middle: points that all meet in one place are chance

View = Float64[np.ndarray, "_ K 3"]  # as many people as a camera sees


@dataclass(frozen=True, eq=False)
class Sighting:
    """One person in one frame: which detection of each camera (-1 none), and [K, 3] places, NaN where unknown."""

    members: tuple[int, ...]
    positions: Float64[np.ndarray, "K 3"]

    @property
    def support(self) -> int:
        """Number of cameras that see the person."""
        return sum(member >= 0 for member in self.members)


@dataclass
class _Track:
    """Sightings of one person: frame -> sighting."""

    sightings: dict[int, Sighting] = field(default_factory=dict)

    def predicted(self, frame: int) -> Float64[np.ndarray, "K 3"]:
        """Where the landmarks should be: on as the body's middle moved lately."""
        frames = sorted(self.sightings)
        last = self.sightings[frames[-1]].positions
        before = [earlier for earlier in frames[-6:-1] if frames[-1] - earlier <= 10]
        if not before:
            return last
        moved = np.nanmedian(last - self.sightings[before[0]].positions, axis=0)
        velocity = np.nan_to_num(moved) / (frames[-1] - before[0])
        return last + velocity * min(frame - frames[-1], 5)

    @property
    def support(self) -> int:
        return sum(sighting.support for sighting in self.sightings.values())


@dataclass(frozen=True)
class FollowingLimits:
    """How well detections must agree; see `registration.settings.KeypointSettings`."""

    person_pixels: float
    fastest: float
    ambiguous_distance: float


def follow_person(
    cameras: Sequence[Camera], frames: Sequence[Sequence[View]], fps: float, limits: FollowingLimits
) -> Float64[np.ndarray, "N C K 3"]:
    """The keypoints of the one person that the cameras agree on.

    Args:
        cameras: C, without distortion.
        frames: N frames of C views of [P, K, 3]: x, y (pixels of those cameras), confidence; NaN where not found.
        fps: frames a second.
        limits: of agreement.

    Returns:
        [N, C, K, 3]; NaN where a camera, or a frame, does not have the person.

    Raises:
        ValueError: if nobody is seen by two cameras at once, or two people come so near to each other in space that they cannot be
            told apart; names the frames.
    """
    sightings = [group_detections(cameras, views, limits.person_pixels) for views in frames]
    if not any(sightings):
        counts = {camera.name: max((len(views[index]) for views in frames), default=0) for index, camera in enumerate(cameras)}
        raise ValueError(
            "follow_person(): expected one person whose keypoints agree between cameras; got nobody in any frame (most people in a frame, "
            f"by camera: {counts}). Check the calibration, that the videos are synchronized, and that keypoints belong to these videos."
        )
    tracks = _link(sightings, fps, limits.fastest)
    followed = max(tracks, key=lambda track: track.support)
    _check_unambiguous(followed, sightings, limits.ambiguous_distance)
    landmarks = next(iter(followed.sightings.values())).positions.shape[0]
    result = np.full((len(frames), len(cameras), landmarks, 3), np.nan)
    for frame, sighting in followed.sightings.items():
        for index, member in enumerate(sighting.members):
            if member >= 0:
                result[frame, index] = frames[frame][index][member]
    return result


def group_detections(cameras: Sequence[Camera], views: Sequence[View], person_pixels: float) -> list[Sighting]:
    """People of one frame that at least two cameras agree on, the best supported first; no detection serves two."""
    proposals = []
    for first, second in combinations(range(len(cameras)), 2):
        for i in range(len(views[first])):
            for j in range(len(views[second])):
                proposal = _proposal(cameras, views, {first: i, second: j}, person_pixels)
                if proposal is not None:
                    proposals.append(proposal)
    proposals.sort(key=lambda entry: (-entry[0].support, entry[1]))
    chosen: list[Sighting] = []
    taken: set[tuple[int, int]] = set()
    for sighting, _ in proposals:
        members = {(camera, member) for camera, member in enumerate(sighting.members) if member >= 0}
        if not members & taken:
            chosen.append(sighting)
            taken |= members
    return chosen


def _proposal(
    cameras: Sequence[Camera], views: Sequence[View], pair: dict[int, int], person_pixels: float
) -> tuple[Sighting, float] | None:
    """The person that a pair of detections makes, with whoever agrees in other cameras, and its median error in pixels."""
    landmarks = views[next(iter(pair))].shape[1]
    observations = np.full((len(cameras), landmarks, 3), np.nan)
    for camera, member in pair.items():
        observations[camera] = views[camera][member]
    positions = triangulate(cameras, observations, np.nan_to_num(observations[..., 2]))
    error = _median(reprojection_errors(cameras, observations, positions))
    spread = positions - np.nanmean(positions, axis=0) if np.isfinite(positions).any() else positions
    if not error < person_pixels or np.sqrt(np.nanmean((spread**2).sum(axis=-1))) < SMALLEST_BODY:
        return None
    members = [pair.get(camera, -1) for camera in range(len(cameras))]
    for camera in range(len(cameras)):
        if camera not in pair and len(views[camera]):
            errors = [_median(reprojection_errors([cameras[camera]], person[None], positions)) for person in views[camera]]
            nearest = int(np.argmin(errors))
            if errors[nearest] < person_pixels:
                members[camera] = nearest
                observations[camera] = views[camera][nearest]
    positions = triangulate(cameras, observations, np.nan_to_num(observations[..., 2]))
    error = _median(reprojection_errors(cameras, observations, positions))
    return (Sighting(tuple(members), positions), error) if error < person_pixels else None


def _median(errors: Float[np.ndarray, "C K"]) -> float:
    """Median of what is finite; infinite where too few landmarks are shared."""
    known = errors[np.isfinite(errors)]
    return float(np.median(known)) if len(known) >= FEWEST_LANDMARKS * len(errors) else float("inf")


def _distance(first: Float[np.ndarray, "K 3"], second: Float[np.ndarray, "K 3"]) -> float:
    """Metres, median over the landmarks that both have; infinite if there is none."""
    distances = np.linalg.norm(first - second, axis=-1)
    known = distances[np.isfinite(distances)]
    return float(np.median(known)) if len(known) else float("inf")


def _link(sightings: Sequence[Sequence[Sighting]], fps: float, fastest: float) -> list[_Track]:
    """Tracks of everybody: sightings of consecutive frames matched by the smallest sum of distances."""
    tracks: list[_Track] = []
    for frame, present in enumerate(sightings):
        active = [track for track in tracks if frame - max(track.sightings) <= max(2.0, PATIENCE * fps)]
        costs = np.full((len(active), len(present)), 1e6)
        for row, track in enumerate(active):
            reach = SLACK + fastest * (frame - max(track.sightings)) / fps
            for column, sighting in enumerate(present):
                distance = _distance(track.predicted(frame), sighting.positions)
                if distance < reach:
                    costs[row, column] = distance
        matched = set()
        for row, column in zip(*linear_sum_assignment(costs), strict=True):
            if costs[row, column] < 1e6:
                active[row].sightings[frame] = present[column]
                matched.add(column)
        tracks += [_Track({frame: sighting}) for column, sighting in enumerate(present) if column not in matched]
    return tracks


def _check_unambiguous(followed: _Track, sightings: Sequence[Sequence[Sighting]], ambiguous_distance: float) -> None:
    """Refuse frames in which somebody else stands as near to where the followed person should be as noise is large."""
    confused = [
        frame
        for frame, sighting in followed.sightings.items()
        if any(other is not sighting and _distance(other.positions, sighting.positions) < ambiguous_distance for other in sightings[frame])
    ]
    if confused:
        raise ValueError(
            f"follow_person(): expected people to stay {ambiguous_distance} m apart in space; got two nearer than that in frames "
            f"{confused[0]} to {confused[-1]} ({len(confused)} in all). Cut the videos before they cross, or keep only the person's own "
            "keypoints in the files."
        )
