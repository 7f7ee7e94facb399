import dataclasses

import numpy as np
import pytest
import torch

from mitsuba_avatar.body.rig import Rig
from mitsuba_avatar.body.skeleton import Skeleton
from mitsuba_avatar.filming.cloth_simulation import BodyMotion, ClothSimulator, _Skeleton
from mitsuba_avatar.filming.settings import ClothingSettings
from tests.filming.sphere_outfit import CENTRE, COTTON, RADIUS, ball_rig, square_outfit

QUICK = ClothingSettings(settle_time=1.0)


@pytest.fixture(scope="module")
def ball() -> Rig:
    return ball_rig()


def _motion(rig: Rig, turn: np.ndarray, fps: float = 10.0) -> BodyMotion:
    theta = np.zeros((len(turn), 2), np.float32)
    theta[:, 0] = turn
    return BodyMotion(theta, np.tile(np.eye(4, dtype=np.float32), (len(turn), 1, 1)), fps, rig.rest_vertices)


def _simulate(rig: Rig, outfit, motion: BodyMotion, settings: ClothingSettings = QUICK, seed: int = 0) -> np.ndarray:
    return np.stack([state.vertices for state in ClothSimulator(rig, outfit, settings).states(motion, "take", seed)])


def _lengths(outfit, vertices: np.ndarray) -> np.ndarray:
    ends = vertices[..., outfit.mesh.edges, :]
    return np.linalg.norm(ends[..., 0, :] - ends[..., 1, :], axis=-1) / outfit.mesh.edge_lengths


def test_cloth_comes_to_rest_on_a_ball_at_its_gap_and_keeps_its_lengths(ball: Rig):
    outfit = square_outfit(ball, size=0.3, height=RADIUS + 0.01)
    settled = _simulate(ball, outfit, _motion(ball, np.zeros(12)))
    distance = np.linalg.norm(settled[-1] - CENTRE, axis=1)
    assert distance.min() > RADIUS + 0.5 * COTTON.gap - 0.001  # planes of a polyhedron lie inside the sphere
    middle = np.linalg.norm(settled[-1, :, :2], axis=1) < 0.03
    np.testing.assert_allclose(distance[middle], RADIUS + COTTON.gap, atol=0.0015)
    assert np.abs(settled[-1] - settled[-2]).max() < 5e-4
    lengths = _lengths(outfit, settled[-1])
    assert lengths.min() > 0.95 and lengths.max() < 1.09


def test_free_cloth_falls_by_gravity(ball: Rig):
    free = dataclasses.replace(COTTON, damping=0.0)
    outfit = square_outfit(ball, size=0.1, height=RADIUS + 0.28, fabric=free)
    settings = ClothingSettings(settle_time=0.1)
    start = outfit.mesh.rest_vertices[:, 2]
    fallen = start - _simulate(ball, outfit, _motion(ball, np.zeros(2)), settings)[..., 2]
    np.testing.assert_allclose(fallen, np.array([0.1, 0.2])[:, None] ** 2 * 0.5 * 9.81 * np.ones_like(start), rtol=0.06)


def test_energy_of_free_flat_cloth_is_kept(ball: Rig):
    free = dataclasses.replace(COTTON, damping=0.0)
    outfit = square_outfit(ball, size=0.1, height=RADIUS + 0.29, fabric=free)
    motion = _motion(ball, np.zeros(4), fps=20.0)
    height = _simulate(ball, outfit, motion, ClothingSettings(settle_time=0.05))[..., 2].mean(axis=1)
    speed = (height[2:] - height[:-2]) / 0.1
    energy = 9.81 * height[1:-1] + 0.5 * speed**2  # per mass
    start = 9.81 * outfit.mesh.rest_vertices[0, 2]
    np.testing.assert_allclose(energy, start, atol=0.06 * 9.81 * (outfit.mesh.rest_vertices[0, 2] - height[-1]))


def test_hanging_cloth_does_not_stretch_beyond_its_tethers(ball: Rig):
    outfit = square_outfit(ball, size=0.25, height=0.2, pinned_edge=True)
    hanging = _simulate(ball, outfit, _motion(ball, np.zeros(15)))[-1]
    pinned = outfit.mesh.pinned
    np.testing.assert_allclose(hanging[pinned], outfit.mesh.rest_vertices[pinned], atol=1e-6)
    reach = np.linalg.norm(hanging[outfit.mesh.tethers[:, 0]] - hanging[outfit.mesh.tethers[:, 1]], axis=1)
    assert (reach <= outfit.mesh.tether_lengths * 1.01 + 1e-4).all()
    assert np.percentile(_lengths(outfit, hanging), 99) < 1.06


@pytest.mark.parametrize(("friction", "smallest", "largest"), [(0.8, 0.5, 0.65), (0.0, -0.1, 0.15)])
def test_friction_carries_cloth_along_with_turning_skin(ball: Rig, friction: float, smallest: float, largest: float):
    outfit = square_outfit(ball, size=0.2, height=RADIUS + 0.006, fabric=dataclasses.replace(COTTON, friction=friction, damping=0.0))
    brief = ClothingSettings(settle_time=0.1)  # without friction nothing stays on a ball for long
    frames = _simulate(ball, outfit, _motion(ball, np.concatenate([np.zeros(2), np.linspace(0, 0.6, 5)]), fps=20.0), brief)
    before, after = (frame[:, 0] + 1j * frame[:, 1] for frame in (frames[0], frames[-1]))
    turned = float(np.angle((after * before.conj()).sum()))
    assert smallest < turned < largest, f"{turned=}"


def test_a_simulator_leaves_no_traces_of_one_segment_in_the_next(ball: Rig):
    outfit = square_outfit(ball, size=0.3, height=RADIUS + 0.01)
    simulator = ClothSimulator(ball, outfit, QUICK)
    first, again = (
        np.stack([state.vertices for state in simulator.states(_motion(ball, np.linspace(1, -1, 3)), "take")]) for _ in range(2)
    )
    np.testing.assert_array_equal(first, again)


@pytest.mark.parametrize(("fps", "self_distance"), [(10.0, 0.0), (30.0, 0.008)])
def test_a_simulation_that_goes_on_from_a_state_gives_the_same_bits(ball: Rig, fps: float, self_distance: float):
    """Also where a frame ends between two searches for the closest triangles: at 30 frames a second there are 7 steps, 4 a search."""
    outfit = square_outfit(ball, size=0.3, height=RADIUS + 0.01)
    grown = ball.rest_vertices + np.linspace(0, 0.02, 6, dtype=np.float32)[:, None, None]
    motion = dataclasses.replace(_motion(ball, np.linspace(0, 1.2, 6), fps), rest_vertices=grown)
    settings = dataclasses.replace(QUICK, settle_time=0.2, self_distance=self_distance)
    through = list(ClothSimulator(ball, outfit, settings).states(motion, "take"))
    resumed = list(ClothSimulator(ball, outfit, settings).states(motion, "take", after=through[2]))
    assert [state.frame for state in resumed] == [3, 4, 5]
    assert np.abs(through[2].vertices - through[3].vertices).max() > 1e-4
    for one, other in zip(through[3:], resumed, strict=True):
        np.testing.assert_array_equal(one.vertices, other.vertices)
        np.testing.assert_array_equal(one.velocities, other.velocities)


def test_start_noise_changes_the_result_by_seed(ball: Rig):
    outfit = square_outfit(ball, size=0.3, height=RADIUS + 0.01)
    noisy = dataclasses.replace(QUICK, settle_time=0.05, start_noise=0.001)
    first, again, other = (_simulate(ball, outfit, _motion(ball, np.zeros(1)), noisy, seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert 1e-5 < np.abs(first - other).max() < 0.02


def test_the_body_beneath_may_change_its_rest_shape(ball: Rig):
    outfit = square_outfit(ball, size=0.3, height=RADIUS + 0.01)
    grown = ball.rest_vertices + np.array([0, 0, 0.02], np.float32)
    rest = np.stack([ball.rest_vertices, ball.rest_vertices, grown, grown, grown, grown])
    frames = _simulate(ball, outfit, dataclasses.replace(_motion(ball, np.zeros(6)), rest_vertices=rest))
    middle = np.linalg.norm(frames[0, :, :2], axis=1) < 0.05
    np.testing.assert_allclose((frames[-1] - frames[0])[middle, 2].mean(), 0.02, atol=0.002)


def test_self_collision_keeps_a_folded_cloth_apart(ball: Rig):
    outfit = square_outfit(ball, size=0.3, height=0.35)
    folded = outfit.mesh.rest_vertices.copy()
    folded[:, 0] = np.abs(folded[:, 0])  # one half on top of the other
    folded[outfit.mesh.rest_vertices[:, 0] < 0, 2] += 0.001
    flat = outfit.mesh.rest_vertices

    def closest(self_distance: float) -> float:
        simulator = ClothSimulator(ball, outfit, ClothingSettings(settle_time=0.1, self_distance=self_distance))
        simulator.mesh = dataclasses.replace(outfit.mesh, rest_vertices=folded)
        vertices = next(simulator.states(_motion(ball, np.zeros(1)), "take")).vertices
        apart = np.linalg.norm(vertices[:, None] - vertices[None], axis=-1)
        return float(apart[np.linalg.norm(flat[:, None] - flat[None], axis=-1) > 0.1].min())

    assert closest(0.015) > 0.011
    assert closest(0.0) < 0.009


def test_exploding_cloth_is_refused_with_frame_segment_and_setting(ball: Rig):
    outfit = square_outfit(ball, size=0.3, height=0.1, pinned_edge=True)  # starts inside the ball, held fast
    motion = _motion(ball, np.zeros(3))
    motion.root[1:, 0, 3] = [400.0, -900.0]
    with pytest.raises(ValueError, match=r"frame 1 of segment 'take'.*clothing\.substeps_per_second \(now 200\)"):
        _simulate(ball, outfit, motion)


def test_cloth_that_has_left_the_body_is_refused(ball: Rig):
    outfit = square_outfit(ball, size=0.1, height=RADIUS + 0.9)
    with pytest.raises(ValueError, match=r"within 0\.3 m of the body; 100 % are farther at frame 0"):
        _simulate(ball, outfit, _motion(ball, np.zeros(1)), ClothingSettings(settle_time=0.05))


def test_kinematics_are_those_of_the_skeleton(rig: Rig):
    rng = np.random.default_rng(3)
    theta = rng.uniform(rig.dofs.lower, rig.dofs.upper, size=(2, len(rig.dofs.names))).astype(np.float32)
    root = np.tile(np.eye(4, dtype=np.float32), (2, 1, 1))
    root[:, :3, :3] = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    root[:, :3, 3] = rng.normal(size=(2, 3))
    with torch.no_grad():
        expected = Skeleton(rig)(torch.from_numpy(theta), torch.from_numpy(root)).numpy()
    skeleton = _Skeleton(rig)
    skeleton.upload(theta, root)
    transforms = skeleton.pose(1)
    np.testing.assert_allclose(transforms.turns.numpy(), expected[1, :, :3, :3], atol=3e-6)
    np.testing.assert_allclose(transforms.places.numpy(), expected[1, :, :3, 3], atol=6e-6)


def test_poses_between_frames_follow_arcs_and_meet_the_frames(ball: Rig):
    motion = _motion(ball, np.array([0.0, 0.1, 0.4, 0.9, 1.6]))
    angle = 0.5 * np.pi * np.arange(5) / 4
    motion.root[:, 0, 0], motion.root[:, 0, 1] = np.cos(angle), -np.sin(angle)
    motion.root[:, 1, 0], motion.root[:, 1, 1] = np.sin(angle), np.cos(angle)
    theta_at, root_at = motion.curves()
    np.testing.assert_allclose(theta_at(np.array([1.0, 2.5, 3.0]))[:, 0], [0.1, 0.625, 0.9], atol=1e-6)  # a parabola
    halfway = root_at(np.array([1.5]))[0]
    np.testing.assert_allclose(halfway[:2, 0], [np.cos(0.59049), np.sin(0.59049)], atol=2e-3)
    np.testing.assert_allclose(halfway[:3, :3] @ halfway[:3, :3].T, np.eye(3), atol=1e-6)
