"""Driven keypoints: both sides agree on the template in every pose, and a displacement moves them by as much as it should."""

import pytest
import torch

from mitsuba_avatar.body.driving import face_keypoints
from mitsuba_avatar.model.keypoints import DrivenKeypoints, joint_regressor, lists_face_landmarks


@pytest.fixture
def template(rig):
    generator = torch.Generator().manual_seed(5)
    return torch.from_numpy(rig.rest_vertices) + 0.004 * torch.randn((rig.topology.num_vertices, 3), generator=generator)


def test_the_template_is_where_the_driving_signal_says_in_every_pose(rig, template, drive):
    keypoints = DrivenKeypoints(rig, template, with_face=True)
    rest = template.expand(2, -1, -1)
    face = face_keypoints(rig, rest)
    shown = keypoints.from_surface(rest, drive["theta"], drive["root"])
    asked = keypoints.from_driving(drive["theta"], drive["root"], face)
    assert shown.shape == (2, 3 + 4, 3) and keypoints.num_body == 3
    torch.testing.assert_close(shown, asked)
    assert (asked[:, :3] - asked[:, :1]).norm(dim=-1).max() > 0.2, "joints are apart"


def test_joints_of_the_posed_skeleton_are_the_body_keypoints(rig, template, drive):
    keypoints = DrivenKeypoints(rig, template, with_face=False)
    joints = keypoints.skeleton.posed_joints(keypoints.skeleton(drive["theta"], drive["root"]))
    torch.testing.assert_close(keypoints.from_driving(drive["theta"], drive["root"], drive["face"]), joints)


def test_a_shift_of_all_skin_shifts_every_keypoint_by_as_much(rig, template, drive):
    keypoints = DrivenKeypoints(rig, template, with_face=True)
    shift = torch.tensor([0.01, -0.02, 0.03])
    rest = template.expand(2, -1, -1)
    before, after = (keypoints.from_surface(vertices, drive["theta"], drive["root"]) for vertices in (rest, rest + shift))
    torch.testing.assert_close((after - before)[:, 3:], shift.expand(2, 4, 3), rtol=1e-4, atol=1e-6)
    base_turn = keypoints.skeleton(drive["theta"], drive["root"])[:, 0, :3, :3]
    torch.testing.assert_close((after - before)[:, 0], base_turn @ shift, rtol=1e-4, atol=1e-6)


def test_skin_far_from_a_joint_does_not_move_its_keypoint(rig, template, drive):
    keypoints = DrivenKeypoints(rig, template, with_face=False)
    rest = template.repeat(2, 1, 1)
    raised = rest.clone()
    raised[:, template[:, 2] > 0.5] += 0.05
    moved = keypoints.from_surface(raised, drive["theta"], drive["root"]) - keypoints.from_surface(rest, drive["theta"], drive["root"])
    assert not moved[:, :2].any() and (moved[:, 2].norm(dim=-1) > 0.001).all()


def test_rows_of_the_regressor_are_means(rig):
    weights = joint_regressor(rig)(torch.eye(rig.topology.num_vertices))
    torch.testing.assert_close(weights.sum(1), torch.ones(3))
    assert (weights >= 0).all() and ((weights > 0).sum(1) >= 16).all() and ((weights > 0).sum(1) < 150).all()


def test_only_a_face_signal_of_landmarks_lists_landmarks(rig):
    assert lists_face_landmarks(rig, "keypoints", 12)
    assert not lists_face_landmarks(rig, "keypoints", 6) and not lists_face_landmarks(rig, "action_codes", 12)
