import numpy as np
import pytest

from mitsuba_avatar.filming.anatomy import HAND, Anatomy
from mitsuba_avatar.filming.tracking_noise import tracking_noise


@pytest.fixture(scope="module")
def noise(anatomy: Anatomy) -> np.ndarray:
    still = np.repeat(anatomy.rig.rest_vertices[None], 24, axis=0)
    return tracking_noise(anatomy, still, [slice(0, 12), slice(12, 24)], fps=10.0, size=0.003, seed=5)


def test_noise_has_the_size_asked_for(noise: np.ndarray):
    assert np.sqrt((noise.astype(np.float64) ** 2).sum(-1).mean()) == pytest.approx(0.003, rel=1e-4)


def test_noise_is_the_same_for_the_same_seed_only(anatomy: Anatomy):
    still = np.repeat(anatomy.rig.rest_vertices[None], 3, axis=0)
    first, again, other = (tracking_noise(anatomy, still, [slice(0, 3)], 10.0, 0.002, seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 0.001


def test_neighbours_err_together_in_space_and_time(anatomy: Anatomy, noise: np.ndarray):
    on_trunk = anatomy.weight(("spine",)) > 0.9
    error = noise[:, on_trunk]
    size = np.sqrt((error**2).mean())
    from_neighbours = np.sqrt(((noise - np.stack([anatomy.smoothing @ frame for frame in noise]))[:, on_trunk] ** 2).mean())
    assert from_neighbours < 0.15 * size
    steps = np.sqrt((np.diff(error[:12], axis=0) ** 2).mean())
    across = np.sqrt(((error[12] - error[11]) ** 2).mean())
    assert steps < 0.6 * size and across > 1.6 * steps


def test_distant_places_err_apart(anatomy: Anatomy, noise: np.ndarray):
    feet = [int(np.argmax(anatomy.weight(("foot",), side))) for side in "LR"]
    left, right = noise[:, feet[0]], noise[:, feet[1]]
    assert np.sqrt(((left - right) ** 2).mean()) > 0.5 * np.sqrt((left**2).mean())


def test_errors_are_larger_at_fingers_and_where_cloth_folds(anatomy: Anatomy, noise: np.ndarray):
    hand = anatomy.weight(HAND) > 0.9
    trunk = anatomy.weight(("spine",)) > 0.9
    size = np.sqrt((noise**2).sum(-1).mean(0))
    assert size[hand].mean() > 1.7 * size[trunk].mean()
    folded = anatomy.rig.rest_vertices + 0.01 * np.sin(anatomy.rig.rest_vertices[:, 2:] * 150) * np.array([0, 1, 0], np.float32)
    frames = np.stack([anatomy.rig.rest_vertices, folded.astype(np.float32)] * 6)
    by_frame = np.sqrt((tracking_noise(anatomy, frames, [slice(0, 12)], 10.0, 0.003, 0)[:, trunk] ** 2).sum(-1).mean(1))
    assert by_frame[1::2].mean() > 1.3 * by_frame[::2].mean()
