import numpy as np
import pytest

from mitsuba_avatar.filming.hidden_state import Error, angles_that_move, measure_hidden_state


def _constructed(seed: int, hidden: float, count: int = 60) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A garment of 7 vertices that moves 10 mm times an angle along x, and `hidden` metres up or down whatever the pose."""
    rng = np.random.default_rng(seed)
    theta = rng.normal(size=(count, 3)).astype(np.float32)
    vertices = np.zeros((count, 7, 3), np.float32) + rng.normal(size=(7, 3)).astype(np.float32)
    vertices[:, :, 0] += 0.01 * theta[:, :1]
    vertices[:, :, 2] += hidden * rng.choice([-1.0, 1.0], size=(count, 1)).astype(np.float32)
    return theta, vertices, np.arange(count) < count - 20


def test_error_is_the_distance_between_vertices():
    difference = np.zeros((2, 2, 3))
    difference[0, 0], difference[1, 1] = [0.003, 0.004, 0.0], [0.0, 0.0, -0.001]
    error = Error.of(difference)
    assert error.mean_mm == pytest.approx(6 / 4) and error.rms_mm == pytest.approx(np.sqrt(26 / 4))


def test_what_is_linear_in_pose_is_not_hidden():
    state = measure_hidden_state(*_constructed(0, hidden=0.0))
    assert state.mean.rms_mm > 5 and state.linear.rms_mm < 0.05 and state.hidden_share < 1e-4
    assert state.linear.rms_mm < state.nearest.rms_mm < state.mean.rms_mm


def test_what_pose_does_not_say_is_hidden_in_full():
    state = measure_hidden_state(*_constructed(1, hidden=0.004, count=400))
    assert state.linear.rms_mm == pytest.approx(4.0, rel=0.05)
    assert state.hidden_mm == min(state.linear.rms_mm, state.nearest.rms_mm)
    assert state.mean.rms_mm == pytest.approx(np.sqrt(4.0**2 + 10.0**2), rel=0.25)


def test_the_nearest_pose_finds_a_garment_that_is_not_linear_in_pose():
    theta = np.linspace(-1, 1, 81, dtype=np.float32)[:, None] * np.ones((1, 2), np.float32)
    vertices = np.zeros((81, 4, 3), np.float32)
    vertices[:, :, 1] = np.cos(6 * theta[:, :1]) * 0.02
    state = measure_hidden_state(theta, vertices, np.arange(81) % 3 > 0)
    assert state.nearest.rms_mm < 3.5 < state.linear.rms_mm
    assert state.hidden_mm == state.nearest.rms_mm


def test_gates_and_table_say_what_the_figures_say():
    floor = Error(rms_mm=6.0, mean_mm=4.0)
    theta, vertices, is_train = _constructed(2, hidden=0.0)
    state = measure_hidden_state(theta, vertices, is_train, floor=floor)
    passed = list(state.gates().values())
    assert passed == [True, 0.5 * state.mean.rms_mm >= 6.0]
    assert "itself (floor)" in state.table() and "6.00" in state.table()
    lengths = {len(line) for line in state.table().splitlines()}
    assert len(lengths) == 1, state.table()
    nothing = measure_hidden_state(theta[::-1].copy() * 0 + theta[:1], vertices, is_train)
    assert nothing.linear == nothing.mean and nothing.gates() == {"linear regression on pose clearly beats the mean garment": False}


def test_a_finger_that_told_of_the_pose_in_training_alone_fails_the_gate_of_the_whole_drive():
    """In training a finger moves with the elbow, in the test against it: a regression that reads both halves the weight of each."""
    theta, vertices, is_train = _constructed(3, hidden=0.0, count=120)
    finger = np.where(is_train, theta[:, 0], -3 * theta[:, 0])[:, None]
    misled = measure_hidden_state(theta, vertices, is_train, whole=np.concatenate([theta, finger], axis=1))
    np.testing.assert_allclose(misled.whole.rms_mm, 2 * misled.mean.rms_mm, rtol=0.15)
    told = measure_hidden_state(theta, vertices, is_train, whole=theta)
    assert told.whole == told.linear
    gate = "so does, in mean distance, regression on the whole driving signal"
    assert told.gates()[gate] and not misled.gates()[gate] and "all, linearly" in misled.table()


def test_a_split_without_test_frames_is_refused():
    theta, vertices, _ = _constructed(0, hidden=0.0)
    with pytest.raises(ValueError, match="at least 2 training frames and 1 other; got 60 and 0"):
        measure_hidden_state(theta, vertices, np.ones(60, dtype=bool))


def test_angles_that_move_a_shirt_are_those_of_trunk_and_arms(rig, shirt_outfit):
    names = [rig.dofs.names[row] for row in angles_that_move(rig, shirt_outfit.mesh)]
    assert {"spine03_turn", "left_shoulder_abduction", "right_clavicle_elevation"} <= set(names)
    assert not any(name.startswith(("left_index", "right_wrist", "left_knee", "head")) for name in names)
