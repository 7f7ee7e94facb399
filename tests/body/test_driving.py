"""Driving masks and face landmarks."""

import dataclasses

import numpy as np
import pytest
import torch

from mitsuba_avatar.body.driving import driving_masks, face_keypoints


def _cell(uv: tuple[float, float], size: int) -> tuple[int, int]:
    return int((1 - uv[1]) * size), int(uv[0] * size)


def test_masks_follow_the_skin(small_rig):
    masks = driving_masks(small_rig, 16)
    assert masks.theta.shape == (5, 16, 16)
    assert set(masks.theta.unique().tolist()) == {0.0, 1.0}
    by_name = dict(zip(small_rig.dofs.names, masks.theta, strict=True))
    base, elbow, wrist = (_cell((0.5, 0.44 + 0.52 * height), 16) for height in (0.1, 0.6, 0.97))  # on the tube's chart
    assert by_name["base_flexion"][base] == 1
    assert by_name["base_flexion"][wrist] == 0
    assert by_name["elbow_flexion"][elbow] == 1
    assert by_name["wrist_flexion"][wrist] == 1
    assert by_name["wrist_flexion"][base] == 0
    assert torch.equal(by_name["wrist_flexion"], by_name["wrist_deviation"])


def test_parent_skin_counts_within_reach(small_rig):
    """The wrist's own skin reaches 0.13 m, so skin of the forearm counts up to 0.26 m below it and no farther."""
    wrist = dict(zip(small_rig.dofs.names, driving_masks(small_rig, 16).theta, strict=True))["wrist_flexion"]
    column = wrist[: 16 - 7, 8]  # the tube's chart along its length, row 0 is its upper end
    heights = (1 - (torch.nonzero(column).max() + 0.5) / 16 - 0.44) / 0.52 * 0.6
    assert 0.1 < heights < 0.3, "the mask must end between the base and the elbow, one cell wider than its reach"


def test_face_mask_covers_the_face_alone(small_rig):
    face = driving_masks(small_rig, 16).face
    assert face[_cell((0.5, 0.95), 16)] == 1
    assert face[_cell((0.72, 0.2), 16)] == 1  # the upper cap
    assert face[_cell((0.5, 0.6), 16)] == 0
    assert face[_cell((0.24, 0.21), 16)] == 0  # the lower cap


def test_a_joint_without_skin_acts_where_its_descendants_do(small_rig):
    weights = small_rig.skinning_weights.copy()
    weights[:, 2] += weights[:, 1]
    weights[:, 1] = 0
    masks = driving_masks(dataclasses.replace(small_rig, skinning_weights=weights), 16)
    assert masks.theta[2].any()
    assert masks.theta[2][_cell((0.5, 0.95), 16)] == 1


def test_an_angle_that_moves_nothing_is_refused(small_rig):
    weights = np.zeros_like(small_rig.skinning_weights)
    weights[:, 0] = 1
    lonely = dataclasses.replace(
        small_rig,
        joint_positions=small_rig.joint_positions + np.array([[0, 0, 0], [0, 0, 0], [9, 0, 0]], dtype=np.float32),
        skinning_weights=weights,
    )
    with pytest.raises(ValueError, match=r"got none for \['elbow_flexion', 'wrist_flexion', 'wrist_deviation'\]"):
        driving_masks(lonely, 16)
    with pytest.raises(ValueError, match="expected a face region"):
        driving_masks(dataclasses.replace(small_rig, face_region=np.zeros(258, dtype=np.float32)), 16)


def test_face_keypoints_are_landmarks_seen_from_the_head(small_rig):
    rest = torch.from_numpy(small_rig.rest_vertices).repeat(2, 1, 1).requires_grad_()
    signal = face_keypoints(small_rig, rest)
    assert signal.shape == (2, 12)
    expected = small_rig.rest_vertices[small_rig.face_keypoint_vertices] - small_rig.joint_positions[2]
    np.testing.assert_allclose(signal[1].detach().numpy().reshape(4, 3), expected, atol=1e-7)
    signal[1].sum().backward()
    moved = torch.nonzero(rest.grad.abs().sum(-1))
    assert moved.tolist() == [[1, vertex] for vertex in sorted(small_rig.face_keypoint_vertices.tolist())]


def test_face_keypoints_refuse_another_mesh(small_rig):
    with pytest.raises(ValueError, match=r"rest_vertices must be \[B, 258, 3\] for this rig; got \[2, 100, 3\]"):
        face_keypoints(small_rig, torch.zeros(2, 100, 3))
