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


def test_files_of_two_detectors_are_refused(tmp_path):
    recording = written(tmp_path, "coco")
    write_people(recording.views["b"].keypoints[2], [seen(make_cameras(), standing_person())[1]], "body_25")
    with pytest.raises(ValueError, match=r"one keypoint order.*got \[17, 25\] points"):
        found(recording)


def test_an_order_of_another_length_is_refused(tmp_path):
    with pytest.raises(ValueError, match="expected 25 points of body_25; got 17"):
        found(written(tmp_path, "coco"), KeypointSettings(order="body_25"))
