"""Principal directions: they find the axes of a known cloud, in units of its deviations."""

import numpy as np
import pytest

from mitsuba_avatar.driving.principal_directions import PrincipalDirections, num_explaining


def cloud() -> np.ndarray:
    """1000 points that vary by 3 along (0.6, 0.8, 0) and by 0.5 along z, around (1, 2, 3)."""
    random = np.random.default_rng(2)
    along, up = 3 * random.standard_normal((1000, 1)), 0.5 * random.standard_normal((1000, 1))
    return np.array([1, 2, 3]) + along * np.array([0.6, 0.8, 0]) + up * np.array([0, 0, 1])


def test_directions_are_the_axes_of_the_cloud_as_long_as_its_deviations():
    directions = PrincipalDirections.of(cloud(), 5)
    assert directions.steps.shape == (2, 3), "the third direction has no extent"
    np.testing.assert_allclose(directions.steps[0], 3 * np.array([0.6, 0.8, 0]), atol=0.2)
    np.testing.assert_allclose(directions.steps[1], [0, 0, 0.5], atol=0.05)
    np.testing.assert_allclose(directions.mean, cloud().mean(axis=0))


def test_coordinates_and_offsets_are_inverse_to_each_other():
    directions = PrincipalDirections.of(cloud(), 2)
    coordinates = np.array([[1.5, -2.0], [0.0, 0.25]])
    points = directions.mean + np.stack([directions.offset(row) for row in coordinates])
    np.testing.assert_allclose(directions.coordinates(points), coordinates, atol=1e-12)
    assert directions.coordinates(cloud()).std(axis=0) == pytest.approx([1, 1])


def test_samples_that_do_not_vary_have_no_directions():
    assert PrincipalDirections.of(np.ones((4, 3)), 2).steps.shape == (0, 3)


@pytest.mark.parametrize(("share", "count"), [(0.5, 1), (0.79, 1), (0.81, 2), (0.99, 3), (1.0, 3)])
def test_as_many_directions_are_kept_as_carry_the_share_of_the_variance(share, count):
    assert num_explaining(np.sqrt([80.0, 15.0, 5.0]), share) == count
    assert num_explaining(np.zeros(3), share) == 3, "nothing is left out where nothing varies"
