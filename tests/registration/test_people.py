"""Following one person through several cameras and frames, among others."""

import numpy as np
import pytest

from mitsuba_avatar.registration.people import FollowingLimits, follow_person, group_detections
from tests.registration.people_in_cameras import make_cameras, seen, standing_person

LIMITS = FollowingLimits(person_pixels=12.0, fastest=6.0, ambiguous_distance=0.12)
FPS = 30.0


def views_of(people: list[np.ndarray], swap: int = 0) -> list[np.ndarray]:
    """C views of [P, K, 3]; in every second camera (shifted by `swap`) people are listed the other way round."""
    cameras = make_cameras()
    observations = [seen(cameras, person, noise=0.7, seed=index) for index, person in enumerate(people)]
    views = []
    for camera in range(len(cameras)):
        stacked = np.stack([entry[camera] for entry in observations])
        views.append(stacked[::-1].copy() if (camera + swap) % 2 else stacked)
    return views


def test_detections_of_two_people_are_told_apart_whatever_their_order():
    people = [standing_person((-0.5, 0.1)), standing_person((0.6, -0.3))]
    groups = group_detections(list(make_cameras().values()), views_of(people), 12.0)
    assert [group.support for group in groups] == [4, 4]
    for group in groups:
        assert min(np.abs(group.positions - person).max() for person in people) < 0.05
    assert {group.members for group in groups} == {(0, 1, 0, 1), (1, 0, 1, 0)}


def test_the_walker_is_followed_past_a_bystander_whom_two_cameras_see():
    cameras = list(make_cameras().values())
    walk = [(-0.8 + 0.05 * frame, 0.02 * frame) for frame in range(20)]
    frames, truth = [], []
    for index, place in enumerate(walk):
        walker, bystander = standing_person(place), standing_person((0.9, 1.2))
        views = views_of([walker, bystander], swap=index)
        for camera in (2, 3):  # they do not see the bystander
            member = 1 if (camera + index) % 2 else 0
            views[camera] = views[camera][member : member + 1]
        frames.append(views)
        truth.append(np.stack([camera.project(walker)[0] for camera in cameras]))
    followed = follow_person(cameras, frames, FPS, LIMITS)
    assert followed.shape == (20, 4, 27, 3)
    assert np.nanmax(np.abs(followed[..., :2] - np.stack(truth))) < 5


def test_somebody_lost_for_some_frames_is_found_again():
    cameras = list(make_cameras().values())
    frames = [views_of([standing_person((0.03 * frame, 0.0)), standing_person((1.1, 1.0))]) for frame in range(12)]
    for frame in (5, 6):
        frames[frame] = [view[:0] for view in frames[frame]]
    followed = follow_person(cameras, frames, FPS, LIMITS)
    assert np.isnan(followed[5:7]).all()
    first, last = (np.nanmean(followed[frame, 0, :, 0]) for frame in (0, 11))
    expected = [cameras[0].project(standing_person((0.03 * frame, 0.0)))[0][:, 0].mean() for frame in (0, 11)]
    other = cameras[0].project(standing_person((1.1, 1.0)))[0][:, 0].mean()
    follows_walker = np.allclose([first, last], expected, atol=2)
    assert follows_walker or np.allclose([first, last], other, atol=2), "whoever it is, it is one person throughout"


def test_people_who_cross_in_space_are_refused_with_the_frames():
    cameras = list(make_cameras().values())
    frames = []
    for frame in range(11):
        left, right = standing_person((-0.5 + 0.1 * frame, 0.0)), standing_person((0.5 - 0.1 * frame, 0.02))
        frames.append(views_of([left, right]))
    with pytest.raises(ValueError, match=r"two nearer than that in frames 5 to 5 \(1 in all\).*before they cross"):
        follow_person(cameras, frames, FPS, LIMITS)


def test_keypoints_of_nobody_are_refused():
    cameras = list(make_cameras().values())
    with pytest.raises(ValueError, match="got nobody in any frame.*'a': 0"):
        follow_person(cameras, [[np.zeros((0, 27, 3)) for _ in cameras]] * 3, FPS, LIMITS)


def test_views_of_different_people_agree_on_nobody():
    cameras = list(make_cameras().values())
    people = [standing_person(place) for place in ((-1.5, 0.2), (0.1, 1.4), (1.6, -0.8), (0.2, -1.7))]
    views = [seen(make_cameras(), person)[index][None] for index, person in enumerate(people)]
    for index, view in enumerate(views):  # two views alone often meet somewhere; points that mean something else do not
        view[:] = view[:, np.random.default_rng(index).permutation(view.shape[1])]
    with pytest.raises(ValueError, match="got nobody"):
        follow_person(cameras, [views, views], FPS, FollowingLimits(person_pixels=4.0, fastest=6.0, ambiguous_distance=0.12))
