"""Keypoint files and the orders of their points."""

import json

import numpy as np
import pytest

from mitsuba_avatar.registration.keypoints_2d import LANDMARKS, ORDERS, in_landmark_order, orders_of_length, read_people
from tests.registration.people_in_cameras import make_cameras, seen, standing_person, write_people


@pytest.mark.parametrize("order", sorted(ORDERS))
def test_every_order_gives_each_landmark_its_own_point(order, tmp_path):
    person = seen(make_cameras(), standing_person())[1]
    other = seen(make_cameras(), standing_person((0.3, 0.2)))[1]
    write_people(tmp_path / "0.json", [person, other], order)
    people = in_landmark_order(read_people(tmp_path / "0.json"), order)
    known = [index for index, name in enumerate(LANDMARKS) if name in ORDERS[order]]
    missing = [index for index in range(len(LANDMARKS)) if index not in known]
    np.testing.assert_allclose(people[:, known], np.stack([person, other])[:, known], atol=1e-9)
    assert np.isnan(people[:, missing]).all()


def test_orders_are_those_of_the_detectors():
    """Spot checks against the detectors' documentation: index -> point."""
    assert ORDERS["body_25"][:3] == ("nose", "neck", "right_shoulder") and ORDERS["body_25"][8] == "mid_hip"
    assert ORDERS["body_25"][19:22] == ("left_big_toe", "left_small_toe", "left_heel") and ORDERS["body_25"][11] == "right_ankle"
    assert ORDERS["body_25b"][5] == "left_shoulder" and ORDERS["body_25b"][17:20] == ("upper_neck", "head_top", "left_big_toe")
    assert ORDERS["coco"][1:5] == ("left_eye", "right_eye", "left_ear", "right_ear") and ORDERS["coco"][16] == "right_ankle"
    assert ORDERS["halpe_26"][17:21] == ("head_top", "neck", "mid_hip", "left_big_toe") and ORDERS["halpe_26"][25] == "right_heel"
    assert ORDERS["openpose_coco"][14:] == ("right_eye", "left_eye", "right_ear", "left_ear")
    assert {name: len(order) for name, order in ORDERS.items()} == {
        "body_25": 25,
        "body_25b": 25,
        "coco": 17,
        "openpose_coco": 18,
        "halpe_26": 26,
    }
    assert orders_of_length(25) == ["body_25", "body_25b"] and orders_of_length(136) == ["halpe_26"]


def test_points_below_the_threshold_are_missing(tmp_path):
    person = seen(make_cameras(), standing_person())[0]
    person[LANDMARKS.index("left_knee"), 2] = 0.1
    person[LANDMARKS.index("nose")] = 0
    write_people(tmp_path / "0.json", [person], "coco")
    (read,) = in_landmark_order(read_people(tmp_path / "0.json", 0.2), "coco")
    assert np.isnan(read[[LANDMARKS.index("left_knee"), LANDMARKS.index("nose")]]).all()
    assert np.isfinite(read[LANDMARKS.index("right_knee")]).all()


def test_nobody_is_no_error(tmp_path):
    (tmp_path / "0.json").write_text('{"people": []}')
    assert read_people(tmp_path / "0.json").shape == (0, 0, 3)


@pytest.mark.parametrize(
    "text",
    ["{", "[1, 2]", '{"persons": []}', '{"people": [{"keypoints": []}]}', '{"people": [{"pose_keypoints_2d": ["x"]}]}', '{"people": 3}'],
)
def test_another_schema_is_refused_with_the_file(text, tmp_path):
    (tmp_path / "7.json").write_text(text)
    with pytest.raises(ValueError, match=r"expected OpenPose JSON.*7\.json"):
        read_people(tmp_path / "7.json")


def test_people_with_different_numbers_of_points_are_refused(tmp_path):
    document = {"people": [{"pose_keypoints_2d": [1.0] * 51}, {"pose_keypoints_2d": [1.0] * 75}]}
    (tmp_path / "0.json").write_text(json.dumps(document))
    with pytest.raises(ValueError, match=r"got \[51, 75\] numbers"):
        read_people(tmp_path / "0.json")


def test_an_unknown_number_of_points_is_refused():
    with pytest.raises(ValueError, match="got 21"):
        orders_of_length(21)
