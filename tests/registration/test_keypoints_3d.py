"""Order of the points, found from the body that they make; lenses; whole folders of keypoints."""

from dataclasses import replace

import numpy as np
import pytest

from mitsuba_avatar.captures.cameras import Camera
from mitsuba_avatar.registration.frames import capture_cameras, full_cameras
from mitsuba_avatar.registration.keypoints_2d import LANDMARKS, ORDERS
from mitsuba_avatar.registration.keypoints_3d import asymmetry, find_person
from mitsuba_avatar.registration.recording import RecordedView, Recording
from mitsuba_avatar.registration.settings import KeypointSettings
from tests.registration.people_in_cameras import make_cameras, seen, standing_person, write_people

FRAMES = 6


def written(folder, order: str, distortion: tuple[float, ...] = ()) -> Recording:
    """A recording whose videos are not there: keypoints of a walker and, in two cameras, of a bystander."""
    cameras: dict[str, Camera] = {name: replace(camera, distortion=distortion) for name, camera in make_cameras().items()}
    for frame in range(FRAMES):
        walker = seen(cameras, standing_person((0.04 * frame, -0.02 * frame)))
        bystander = seen(cameras, standing_person((1.0, 0.7)))
        for index, name in enumerate(cameras):
            people = [bystander[index], walker[index]] if index < 2 else [walker[index]]
            write_people(folder / name / f"{frame:04d}.json", people, order)
    views = {
        name: RecordedView(camera, folder / f"{name}.mp4", tuple(sorted((folder / name).glob("*.json"))), ())
        for name, camera in cameras.items()
    }
    return Recording(folder, views, FRAMES, 25.0)


def found(recording: Recording, settings: KeypointSettings = KeypointSettings()):  # noqa: B008 - frozen
    cameras = full_cameras(recording, capture_cameras(recording, 135, 240))
    return find_person(recording, cameras, settings), cameras


@pytest.mark.parametrize("order", ["body_25", "body_25b"])
def test_orders_of_equal_length_are_told_apart_by_the_body_they_make(order, tmp_path):
    person, _ = found(written(tmp_path, order))
    assert person.order == order
    wrong = {"body_25": "body_25b", "body_25b": "body_25"}[order]
    other, _ = found(written(tmp_path, order), KeypointSettings(order=wrong))
    assert asymmetry(person.positions) < 0.02 < 0.15 < asymmetry(other.positions)


def test_points_lie_where_the_person_stood_though_lenses_bend(tmp_path):
    person, cameras = found(written(tmp_path, "halpe_26", distortion=(-0.05, 0.12, 0.001, -0.002)))
    assert person.observations.shape == (FRAMES, 4, len(LANDMARKS), 3)
    known = [index for index, name in enumerate(LANDMARKS) if name in ORDERS["halpe_26"]]
    for frame in range(FRAMES):
        truth = standing_person((0.04 * frame, -0.02 * frame))
        np.testing.assert_allclose(person.positions[frame, known, :3], truth[known], atol=2e-4)
        pixels = cameras["c"].project(truth[known])[0]
        np.testing.assert_allclose(person.observations[frame, 2, known, :2], pixels, atol=0.05)
    assert (person.positions[..., 3] > 0).sum() == FRAMES * len(known)


def test_files_without_anybody_are_refused(tmp_path):
    recording = written(tmp_path, "coco")
    for view in recording.views.values():
        for path in view.keypoints:
            write_people(path, [], "coco")
    with pytest.raises(ValueError, match="got nobody in any frame of any camera"):
        found(recording)


@pytest.mark.parametrize("nobody", [[], [np.zeros((27, 3))]])
def test_a_camera_whose_files_are_empty_throughout_is_named(nobody, tmp_path):
    """Whether a detector writes no people, or one without a single point."""
    recording = written(tmp_path, "coco")
    for path in recording.views["c"].keypoints:
        write_people(path, nobody, "coco")
    with pytest.raises(ValueError, match=r"got nobody in any frame of \['c'\]. Detect keypoints in these videos again, or take them away"):
        found(recording)
    write_people(recording.views["c"].keypoints[3], [seen(make_cameras(), standing_person((0.12, -0.06)))[2]], "coco")
    assert np.isfinite(found(recording)[0].observations[3, 2]).any(), "one frame is enough: the camera has the right files"


def crossing(folder) -> tuple[Recording, np.ndarray]:
    """Two people pass each other 0.8 m apart; in camera b one hides the other, and the detector mixes their limbs.

    Returns the recording and the places [N, K, 3] of the one who is there from the beginning.
    """
    cameras, frames, truth = make_cameras(), 16, []
    hidden = {6: 0.5, 7: 1.0, 8: 0.4}  # share of the far person's points that the near one takes
    for frame in range(frames):
        far, near = standing_person((-0.8 + 0.1 * frame, -0.3)), standing_person((0.8 - 0.1 * frame, 0.5))
        views = [seen(cameras, person, noise=0.4, seed=2 * frame + index) for index, person in enumerate((far, near))]
        for index, name in enumerate(cameras):
            people = [view[index] for view in views] if frame >= 3 else [views[0][index]]
            if name == "b" and frame in hidden:
                mixed = views[0][index].copy()
                taken = np.random.default_rng(frame).permutation(len(mixed))[: int(hidden[frame] * len(mixed))]
                mixed[taken] = views[1][index][taken]
                people = [mixed, views[1][index]] if hidden[frame] < 1 else [views[1][index]]
            write_people(folder / name / f"{frame:04d}.json", people[:: -1 if (index + frame) % 2 else 1], "halpe_26")
        truth.append(far)
    views = {
        name: RecordedView(camera, folder / f"{name}.mp4", tuple(sorted((folder / name).glob("*.json"))), ())
        for name, camera in cameras.items()
    }
    return Recording(folder, views, frames, 15.0), np.stack(truth)


def test_two_people_whose_ways_cross_in_one_view_are_not_exchanged(tmp_path):
    recording, truth = crossing(tmp_path)
    in_b = [make_cameras()["b"].project(standing_person((x, y)))[0][:, 0].mean() for x, y in ((-0.1, -0.3), (0.1, 0.5))]
    assert abs(in_b[0] - in_b[1]) < 20, "they do cross in this view"
    person, _ = found(recording)
    known = [index for index, name in enumerate(LANDMARKS) if name in ORDERS["halpe_26"]]
    assert (person.positions[:, known, 3] > 0).all()
    np.testing.assert_allclose(person.positions[:, known, :3], truth[:, known], atol=0.05)


def test_files_of_two_detectors_are_refused(tmp_path):
    recording = written(tmp_path, "coco")
    write_people(recording.views["b"].keypoints[2], [seen(make_cameras(), standing_person())[1]], "body_25")
    with pytest.raises(ValueError, match=r"one keypoint order.*got \[17, 25\] points"):
        found(recording)


def test_an_order_of_another_length_is_refused(tmp_path):
    with pytest.raises(ValueError, match="expected 25 points of body_25; got 17"):
        found(written(tmp_path, "coco"), KeypointSettings(order="body_25"))
