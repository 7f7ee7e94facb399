"""Shape and pose from keypoints of a known body."""

import dataclasses

import numpy as np
import pytest
import torch

from mitsuba_avatar.body.anny_rig import build_anny_rig
from mitsuba_avatar.registration.body_sequence import rotation_matrices
from mitsuba_avatar.registration.body_shape import PARAMETERS, AnnyShapes
from mitsuba_avatar.registration.keypoint_fit import KeypointEnergy, filled_in_time, fit_keypoints, trunk_roots
from mitsuba_avatar.registration.keypoints_2d import LANDMARKS
from mitsuba_avatar.registration.keypoints_3d import triangulate_person
from mitsuba_avatar.registration.settings import BodySettings, KeypointSettings, PoseSettings
from mitsuba_avatar.registration.silhouette_refinement import sequence_of
from tests.registration.drawn_recording import PHENOTYPE, acted, observed
from tests.registration.people_in_cameras import make_cameras

pytestmark = pytest.mark.usefixtures("one_thread", "private_cache")
FPS = 10.0


def test_a_body_is_found_from_noisy_keypoints_with_outliers():
    cameras = make_cameras(1080, 1920)
    truth = acted(4, cameras)
    observations = observed(truth, cameras, noise=3.0)
    rng = np.random.default_rng(5)
    outliers = rng.random(observations.shape[:3]) < 0.05
    observations[outliers, :2] += rng.choice([-150.0, 150.0], (outliers.sum(), 2))
    person = triangulate_person(list(cameras.values()), observations, "body_25b", KeypointSettings())
    pose, body = PoseSettings(iterations=90, learning_rate=0.05), BodySettings()
    fitted = fit_keypoints(list(cameras.values()), person, FPS, pose, body)

    sequence = sequence_of(fitted)
    energy = KeypointEnergy(list(cameras.values()), observations, FPS, pose, body)
    with torch.no_grad():
        vertices, joints = sequence.rest()
        errors = energy.known_errors(sequence.landmarks(vertices, joints, sequence.transforms(joints)))
    assert np.median(errors[~outliers]) < 8
    rig = build_anny_rig(fitted.phenotype)
    assert (fitted.theta >= rig.dofs.lower - 1e-6).all() and (fitted.theta <= rig.dofs.upper + 1e-6).all()
    height, true_height = (np.ptp(r.rest_vertices[:, 2]) for r in (rig, truth.rig))
    start = np.ptp(build_anny_rig(dataclasses.replace(PHENOTYPE, height=body.height, muscle=body.muscle)).rest_vertices[:, 2])
    assert abs(height - true_height) < 0.5 * abs(start - true_height), "taller than where the search began, as the person is"
    knee = rig.dofs.names.index("right_knee_flexion")
    np.testing.assert_allclose(fitted.theta[:, knee], truth.theta[:, knee], atol=0.2)
    assert fitted.phenotype.age == body.age, "fixed"


def test_trunk_roots_are_those_of_a_rest_body():
    cameras = make_cameras()
    truth = acted(3, cameras)
    truth = dataclasses.replace(truth)
    positions = np.concatenate([truth.landmarks, np.ones((*truth.landmarks.shape[:2], 1))], axis=2).astype(np.float64)
    roots = trunk_roots(truth.rig, positions)
    np.testing.assert_allclose(roots[0, :3, :3], truth.root[0, :3, :3], atol=0.15)
    positions[1, :, 3] = 0
    with pytest.raises(ValueError, match="expected hips and shoulders"):
        trunk_roots(truth.rig, positions)


def test_gaps_are_filled_from_both_sides():
    positions = np.zeros((5, len(LANDMARKS), 4))
    positions[[0, 4], 3] = [[1, 2, 3, 0.5], [5, 2, 3, 0.9]]
    filled = filled_in_time(positions)
    np.testing.assert_allclose(filled[2, 3], [3, 2, 3, 0.7])
    assert (filled[:, 5, 3] == 0).all() and (positions[2] == 0).all()


def test_tangents_predict_the_shape_nearby():
    tangent = AnnyShapes().tangent(PHENOTYPE)
    np.testing.assert_allclose(tangent.vertices, build_anny_rig(PHENOTYPE).rest_vertices, atol=1e-5)
    delta = torch.zeros(len(PARAMETERS))
    delta[PARAMETERS.index("height")], delta[PARAMETERS.index("weight")] = 0.03, -0.02
    vertices, joints = tangent.rest(delta)
    moved = build_anny_rig(tangent.moved(delta))
    assert tangent.moved(delta).height == pytest.approx(PHENOTYPE.height + 0.03)
    step = np.abs(moved.rest_vertices - tangent.vertices.numpy()).max()
    assert np.abs(vertices.numpy() - moved.rest_vertices).max() < 0.15 * step
    assert np.abs(joints.numpy() - moved.joint_positions).max() < 0.15 * step


def test_rotation_matrices_turn_and_have_gradients_at_zero():
    vectors = torch.tensor([[0.0, 0.0, 0.5], [0.0, 0.0, 0.0]], dtype=torch.float64, requires_grad=True)
    matrices = rotation_matrices(vectors)
    expected = torch.tensor([np.cos(0.5), np.sin(0.5), 0.0], dtype=torch.float64)
    torch.testing.assert_close(matrices[0, :, 0].detach(), expected)
    matrices[1, 2, 1].backward()
    torch.testing.assert_close(vectors.grad[1], torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64), atol=1e-5, rtol=0)
