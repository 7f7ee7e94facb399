"""Truncated skinning and principal shapes: right where nothing is lost, measured where something is."""

import dataclasses

import numpy as np
import pytest
import torch

from mitsuba_avatar.body.skeleton import Skeleton
from mitsuba_avatar.body.split_mesh import split_at_seams
from mitsuba_avatar.exporting.influences import strongest_influences, truncation_error_mm
from mitsuba_avatar.exporting.shapes import facial_actions, one_sided, principal_motion
from tests.small_rig import make_small_rig

WEIGHTS = np.array([[0.1, 0.5, 0.0, 0.25, 0.15], [0, 0, 1, 0, 0], [0.2, 0.2, 0.2, 0.2, 0.2]], np.float32)


def test_the_strongest_joints_are_kept_and_sum_to_one():
    kept = strongest_influences(WEIGHTS, 4)
    assert kept.joints[0].tolist() == [1, 3, 4, 0] and kept.joints[1].tolist() == [2, 0, 0, 0]
    np.testing.assert_allclose(kept.weights.sum(axis=1), 1, atol=1e-6)
    np.testing.assert_allclose(kept.dense(5)[:2], WEIGHTS[:2], atol=1e-6)
    two = strongest_influences(WEIGHTS, 2)
    np.testing.assert_allclose(two.dense(5)[0], [0, 2 / 3, 0, 1 / 3, 0], atol=1e-6)


def test_more_influences_than_joints_are_padded():
    kept = strongest_influences(WEIGHTS[:, :3] / WEIGHTS[:, :3].sum(axis=1, keepdims=True), 8)
    assert kept.joints.shape == (3, 8) and not kept.joints[:, 3:].any() and not kept.weights[:, 3:].any()


def test_the_cost_is_the_distance_between_both_skinnings():
    rig = make_small_rig()
    theta = torch.tensor([[0.0, 0, 0, 0, 0], [0.3, 0.2, 1.5, 0.4, 0.1]])
    transforms = Skeleton(rig)(theta, torch.eye(4).repeat(2, 1, 1))
    rest = torch.from_numpy(rig.rest_vertices).expand(2, -1, -1)
    weights = torch.from_numpy(rig.skinning_weights)
    cost = truncation_error_mm(strongest_influences(rig.skinning_weights, 1), rest, transforms, weights)
    assert cost[0].max() < 1e-3 and 1 < cost[1].max() < 50
    sole = rig.skinning_weights.max(axis=1) > 0.9999
    assert cost[1][torch.from_numpy(sole)].max() < 1e-2
    assert truncation_error_mm(strongest_influences(rig.skinning_weights, 4), rest, transforms, weights).max() < 1e-3


def test_shapes_rebuild_the_surfaces_that_they_came_from():
    random = np.random.default_rng(5)
    true_shapes = random.normal(size=(3, 40, 3)) * np.array([0.03, 0.01, 0.002])[:, None, None]
    surfaces = (1 + np.tensordot(random.normal(size=(9, 3)), true_shapes, axes=1)).astype(np.float32)
    motion = principal_motion(surfaces, 16)
    assert motion.shapes.names == ("pose_00", "pose_01", "pose_02") and np.abs(motion.strengths).max() == pytest.approx(1)
    rebuilt = motion.mean + np.tensordot(motion.strengths, motion.shapes.displacements, axes=1)
    np.testing.assert_allclose(rebuilt, surfaces, atol=1e-5)
    fewer = principal_motion(surfaces, 1)
    left = surfaces - fewer.mean - np.tensordot(fewer.strengths, fewer.shapes.displacements, axes=1)
    np.testing.assert_allclose(fewer.error_mm, 1000 * np.linalg.norm(left, axis=2), atol=1e-3)
    assert fewer.error_mm.mean() < principal_motion(surfaces, 0).error_mm.mean()


def test_one_sided_shapes_make_the_same_surfaces_with_strengths_between_0_and_1():
    """Programs that clip strengths to that range must not lose half of the motion."""
    surfaces = np.random.default_rng(8).normal(size=(5, 40, 3)).astype(np.float32)
    signed = principal_motion(surfaces, 3)
    assert signed.strengths.min() < -0.1
    motion = one_sided(signed)
    assert motion.strengths.min() >= 0 and motion.strengths.max() == pytest.approx(1)
    assert motion.shapes.names[:2] == ("pose_00", "pose_00_minus") and len(set(motion.shapes.names)) == 6
    expected = np.tensordot(signed.strengths, signed.shapes.displacements, axes=1)
    np.testing.assert_allclose(np.tensordot(motion.strengths, motion.shapes.displacements, axes=1), expected, atol=1e-6)


def test_directions_that_a_sequence_does_not_use_are_left_out():
    signed = principal_motion(np.random.default_rng(8).normal(size=(5, 40, 3)).astype(np.float32), 2)
    forwards = dataclasses.replace(signed, strengths=np.abs(signed.strengths))
    assert one_sided(forwards).shapes.names == ("pose_00", "pose_01")


def test_a_surface_that_stands_still_has_no_shapes():
    motion = one_sided(principal_motion(np.ones((4, 7, 3), np.float32), 5))
    assert motion.shapes.displacements.shape == (0, 7, 3) and motion.strengths.shape == (4, 0) and not motion.error_mm.any()


def test_only_annys_rig_has_facial_actions():
    assert facial_actions(make_small_rig()) is None


def test_cutting_seams_keeps_every_corner():
    topology = make_small_rig().topology
    split = split_at_seams(topology)
    np.testing.assert_array_equal(split.welded[split.faces], topology.faces)
    np.testing.assert_array_equal(split.uv[split.faces], topology.uv[topology.uv_faces])
    assert len(split.welded) > topology.num_vertices
