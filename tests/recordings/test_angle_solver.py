import numpy as np
import pytest

from mitsuba_avatar.body.rig import Rig
from mitsuba_avatar.recordings.angle_solver import AngleSolver, BoneTargets, PositionTargets

BONES = ("spine01", "upperarm02.L", "wrist.L", "foot.R")


@pytest.fixture(scope="module")
def solver(rig: Rig) -> AngleSolver:
    parts = ("spine", "left_shoulder", "left_elbow", "left_forearm", "left_wrist", "right_hip", "right_knee", "right_ankle")
    return AngleSolver(rig, np.array([index for index, name in enumerate(rig.dofs.names) if name.startswith(parts)]))


def targets_of(solver: AngleSolver, theta: np.ndarray, root: np.ndarray) -> BoneTargets:
    joints = np.array([solver.rig.joint_names.index(name) for name in BONES])
    directions = np.array([[0, 0, 1.0], [0.6, 0, -0.8], [0, -1.0, 0], [0, -0.6, -0.8]])
    return BoneTargets(joints, solver.pose(theta, root)[0][:, joints], directions, np.full((len(joints), 2), [1.0, 0.5]))


def random_pose(solver: AngleSolver, share: float) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(4)
    theta = np.zeros((3, len(solver.rig.dofs.names)))
    middle, half = 0.5 * (solver.lower + solver.upper), 0.5 * (solver.upper - solver.lower)
    theta[:, solver.free] = middle + share * half * rng.uniform(-1, 1, (3, len(solver.free)))
    root = np.tile(np.eye(4), (3, 1, 1))
    root[:, :3, 3] = rng.normal(size=(3, 3))
    return theta, root


def test_derivatives_are_those_of_finite_differences(solver: AngleSolver):
    theta, root = random_pose(solver, 0.6)
    aim, other = targets_of(solver, theta, root), random_pose(solver, 0.5)[0] * 0.7
    places = PositionTargets(np.array([solver.rig.joint_names.index(name) for name in ("wrist.L", "foot.R")]), np.zeros((3, 2, 3)))
    _, jacobian = solver._linearise(other, root, root[:, :3, 3] + 0.1, aim, places)
    step = 1e-5
    for unknown in (0, 4, len(solver.free) - 2, len(solver.free) + 1):
        residuals = []
        for sign in (-1, 1):
            moved, shifted = other.copy(), root.copy()
            if unknown < len(solver.free):
                moved[:, solver.free[unknown]] += sign * step
            else:
                shifted[:, unknown - len(solver.free), 3] += sign * step
            residuals.append(solver._linearise(moved, shifted, root[:, :3, 3] + 0.1, aim, places)[0])
        np.testing.assert_allclose(jacobian[..., unknown], (residuals[1] - residuals[0]) / (2 * step), atol=1e-5)


def test_reachable_rotations_are_reached(solver: AngleSolver):
    theta, root = random_pose(solver, 0.5)
    aim = targets_of(solver, theta, root)
    found, same_root = solver.solve(np.zeros_like(theta), root, aim)
    np.testing.assert_array_equal(same_root, root)
    reached = solver.pose(found, root)[0][:, aim.joints]
    assert np.abs(reached - aim.rotations).max() < 0.05
    assert (found[:, solver.free] >= solver.lower).all() and (found[:, solver.free] <= solver.upper).all()
    fixed = np.setdiff1d(np.arange(theta.shape[1]), solver.free)
    assert (found[:, fixed] == 0).all()


def test_out_of_reach_stops_at_the_limit(solver: AngleSolver):
    knee = solver.rig.dofs.names.index("right_knee_flexion")
    theta, root = np.zeros((2, len(solver.rig.dofs.names))), np.tile(np.eye(4), (2, 1, 1))
    beyond = theta.copy()
    beyond[:, knee] = solver.rig.dofs.upper[knee] + 0.3
    joints = np.array([solver.rig.joint_names.index(name) for name in ("upperleg02.R", "lowerleg02.R")])
    aim = BoneTargets(joints, solver.pose(beyond, root)[0][:, joints], np.array([[0, 0, -1.0], [0, 0, -1.0]]), np.full((2, 2), 1.0))
    found, _ = solver.solve(theta, root, aim)
    np.testing.assert_allclose(found[:, knee], solver.rig.dofs.upper[knee], atol=1e-6)


def test_joints_are_brought_to_places_with_the_root_following(solver: AngleSolver):
    theta, root = random_pose(solver, 0.4)
    aim = targets_of(solver, theta, root)
    foot = np.array([solver.rig.joint_names.index("foot.R")])
    wanted = solver.pose(theta, root)[1][:, foot] + np.array([0.03, -0.02, 0.01])
    _, moved = solver.solve(theta, root, aim, PositionTargets(foot, wanted))
    found, moved = solver.solve(theta, root, aim, PositionTargets(foot, wanted))
    np.testing.assert_allclose(solver.pose(found, moved)[1][:, foot], wanted, atol=2e-3)
