"""Ridge regression against its closed form, and the penalty that blocks of rows choose."""

import numpy as np
import pytest

from mitsuba_avatar import ridge
from mitsuba_avatar.ridge import ridge_prediction


def constructed(noise: float, count: int = 90) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    mix = rng.normal(size=(5, 3))
    features, asked = rng.normal(size=(count, 5)), rng.normal(size=(40, 5))
    return features, features @ mix + noise * rng.normal(size=(count, 3)), asked, asked @ mix


def test_what_is_linear_is_predicted():
    features, targets, asked, wanted = constructed(noise=0.0)
    np.testing.assert_allclose(ridge_prediction(features, targets, asked), wanted, atol=1e-3)


def test_one_penalty_gives_the_closed_form(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(ridge, "PENALTIES", (7.0,))
    features, targets, asked, _ = constructed(noise=1.0)
    weights = np.linalg.solve(features.T @ features + 7.0 * np.eye(5), features.T @ targets)
    np.testing.assert_allclose(ridge_prediction(features, targets, asked), asked @ weights, atol=1e-9)


def test_features_that_tell_nothing_are_not_believed():
    """As many features as rows: without a penalty every target is fitted, and nothing else predicted."""
    rng = np.random.default_rng(1)
    features, asked, targets = rng.normal(size=(60, 80)), rng.normal(size=(40, 80)), rng.normal(size=(60, 3))
    assert np.square(ridge_prediction(features, targets, asked)).mean() < 0.05


def test_neighbours_in_time_do_not_choose_the_penalty():
    """Ten spells of six frames: within a spell, features and target hardly change, and have nothing to do with other spells'."""
    rng = np.random.default_rng(2)
    features = np.repeat(rng.normal(size=(10, 40)), 6, axis=0) + 0.01 * rng.normal(size=(60, 40))
    targets = np.repeat(rng.normal(size=(10, 2)), 6, axis=0)
    assert np.square(ridge_prediction(features, targets, rng.normal(size=(50, 40)))).mean() < 0.1
