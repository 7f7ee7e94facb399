"""Triangulation against truth, with wrong views."""

import numpy as np
import pytest

from mitsuba_avatar.registration.triangulation import triangulate_robustly
from tests.registration.people_in_cameras import make_cameras, seen


@pytest.fixture
def points() -> np.ndarray:
    return np.random.default_rng(3).uniform([-0.6, -0.4, 0.1], [0.5, 0.6, 1.8], (40, 3))


def test_exact_observations_give_the_points_back(points):
    cameras = make_cameras()
    found = triangulate_robustly(list(cameras.values()), seen(cameras, points), inlier_pixels=5.0)
    np.testing.assert_allclose(found.positions, points, atol=1e-6)
    assert found.is_inlier.all() and found.errors.max() < 1e-3


def test_one_wrong_view_of_four_is_outvoted(points):
    cameras = make_cameras()
    observations = seen(cameras, points, noise=0.5)
    wrong = np.arange(len(points)) % 4
    observations[wrong, np.arange(len(points)), :2] += [60, -45]
    found = triangulate_robustly(list(cameras.values()), observations, inlier_pixels=5.0)
    assert np.linalg.norm(found.positions - points, axis=1).max() < 0.02
    assert not found.is_inlier[wrong, np.arange(len(points))].any()
    assert found.is_inlier.sum(axis=0).min() == 3


def test_the_mean_over_all_views_would_have_been_far_off(points):
    """The test above can fail: plain least squares over all four views is wrong by centimetres."""
    cameras = make_cameras()
    observations = seen(cameras, points)
    observations[0, :, :2] += [60, -45]
    everything = triangulate_robustly(list(cameras.values()), observations, inlier_pixels=1e6)
    assert np.median(np.linalg.norm(everything.positions - points, axis=1)) > 0.03


def test_a_point_that_one_camera_sees_stays_unknown(points):
    cameras = make_cameras()
    observations = seen(cameras, points)
    observations[1:, 5] = np.nan
    observations[:, 6] = np.nan
    found = triangulate_robustly(list(cameras.values()), observations, inlier_pixels=5.0)
    assert np.isnan(found.positions[[5, 6]]).all() and np.isfinite(np.delete(found.positions, [5, 6], axis=0)).all()


def test_confidence_weighs(points):
    cameras = make_cameras()
    observations = seen(cameras, points)
    observations[0, :, 0] += 3
    sure, doubtful = observations.copy(), observations.copy()
    doubtful[0, :, 2] = 0.05
    errors = [
        np.linalg.norm(triangulate_robustly(list(cameras.values()), given, inlier_pixels=20.0).positions - points, axis=1).mean()
        for given in (sure, doubtful)
    ]
    assert errors[1] < 0.3 * errors[0]
