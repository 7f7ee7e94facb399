"""Silhouettes drawn by the renderer are brought onto masks."""

import numpy as np
import pytest

from mitsuba_avatar.captures.silhouettes import silhouette
from mitsuba_avatar.registration.keypoint_fit import FittedBody, KeypointEnergy
from mitsuba_avatar.registration.keypoints_2d import LANDMARKS
from mitsuba_avatar.registration.settings import BodySettings, PoseSettings, RefinementSettings
from mitsuba_avatar.registration.silhouette_refinement import (
    RegisteredBody,
    SilhouetteProblem,
    posed_vertices,
    refine_offsets,
    refine_pose,
    sequence_of,
)
from tests.registration.drawn_recording import PHENOTYPE, acted, observed
from tests.registration.people_in_cameras import make_cameras

pytestmark = pytest.mark.usefixtures("one_thread", "private_cache")
FRAMES = 2
SETTINGS = RefinementSettings(passes=18, offset_passes=16, frames_per_step=2, learning_rate=0.012, offset_learning_rate=0.008)


@pytest.fixture(scope="module")
def scene():
    """Cameras, truth, and an energy whose keypoints are off by 12 reference pixels to the right in every view."""
    cameras = {name: camera for name, camera in make_cameras(72, 120).items() if name != "b"}
    truth = acted(FRAMES, cameras)
    full = {name: camera.resized(4.0) for name, camera in cameras.items()}
    observations = observed(truth, full, noise=0.0)
    observations[..., 0] += 12 * 480 / 1920
    energy = KeypointEnergy(list(full.values()), observations, 10.0, PoseSettings(), BodySettings())
    return cameras, truth, energy


def problem_of(cameras, truth, vertices: np.ndarray) -> SilhouetteProblem:
    masks = [
        np.stack([silhouette(camera, shape, truth.rig.topology.faces) for camera in cameras.values()]).astype(np.float32)
        for shape in vertices
    ]
    return SilhouetteProblem(truth.rig.topology, cameras, lambda frame: masks[frame])


def body_of(theta: np.ndarray, root: np.ndarray) -> RegisteredBody:
    vertices = 13718
    fitted = FittedBody(PHENOTYPE, theta, root, np.zeros((len(LANDMARKS), 3), np.float32))
    return RegisteredBody(fitted, np.zeros((vertices, 3), np.float32), np.zeros((len(theta), vertices, 3), np.float32))


def overlap(problem: SilhouetteProblem, body: RegisteredBody) -> float:
    frames = list(range(FRAMES))
    return float(problem.overlaps(posed_vertices(body, sequence_of(body.fitted), frames), frames).mean())


def test_overlap_is_one_at_the_truth_and_falls_beside_it(scene):
    cameras, truth, _ = scene
    problem = problem_of(cameras, truth, truth.vertices)
    assert overlap(problem, body_of(truth.theta, truth.root)) > 0.95
    shifted = truth.root.copy()
    shifted[:, 0, 3] += 0.1
    assert overlap(problem, body_of(truth.theta, shifted)) < 0.7


def test_root_and_pose_are_brought_onto_the_masks(scene):
    cameras, truth, energy = scene
    problem = problem_of(cameras, truth, truth.vertices)
    root, theta = truth.root.copy(), truth.theta.copy()
    root[:, :3, 3] += [0.03, -0.03, 0.02]
    theta[:, truth.rig.dofs.names.index("right_knee_flexion")] += 0.25
    start = body_of(theta, root)
    refined = refine_pose(start.fitted, problem, energy, SETTINGS, BodySettings(), lambda done, total: None)
    before, after = overlap(problem, start), overlap(problem, body_of(refined.theta, refined.root))
    assert after > 0.88 and after > before + 0.1, f"{before:.3f} -> {after:.3f}"


def test_offsets_add_what_the_phenotype_lacks(scene):
    """The person wears something four centimetres thick about the belly."""
    cameras, truth, energy = scene
    names = truth.rig.joint_names
    belly = truth.rig.skinning_weights[:, [names.index(name) for name in ("spine05", "spine04", "spine03")]].sum(axis=1) > 0.5
    middle = truth.vertices[:, belly].mean(axis=1, keepdims=True)
    dressed = truth.vertices.copy()
    outwards = (dressed[:, belly] - middle) * [1, 1, 0]
    dressed[:, belly] += (0.04 * outwards / np.linalg.norm(outwards, axis=-1, keepdims=True)).astype(np.float32)
    problem = problem_of(cameras, truth, dressed)
    start = body_of(truth.theta, truth.root)
    refined = refine_offsets(start, problem, energy, SETTINGS, lambda done, total: None)
    before, after = overlap(problem, start), overlap(problem, refined)
    assert after > before + 0.01, f"{before:.3f} -> {after:.3f}"
    moved = np.linalg.norm(refined.shared_offset, axis=1)
    assert moved[belly].mean() > 1.5 * moved[~belly].mean() and moved.max() < 0.08
    assert refined.frame_offsets.shape == (FRAMES, len(belly), 3)
    assert np.allclose(refined.rig().rest_vertices, truth.rig.rest_vertices + refined.shared_offset)
