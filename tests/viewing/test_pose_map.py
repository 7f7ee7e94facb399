"""The map of poses: alike poses stand together, a click finds its point, empty places hold none."""

import numpy as np
import pytest

from mitsuba_avatar.viewing.pose_map import COLOURS, PoseMap


def groups() -> dict[str, np.ndarray]:
    """Two heaps of training poses far apart along the first angle, and one test pose between them."""
    random = np.random.default_rng(3)
    heap = 0.05 * random.standard_normal((20, 4))
    return {"training": np.concatenate([heap, heap + [2, 0.3, 0, 0]]), "test": np.array([[1.0, 0.15, 0.0, 0.0]])}


def test_points_of_alike_poses_are_neighbours_and_all_lie_inside():
    pose_map = PoseMap(groups())
    points = pose_map.points["training"]
    assert np.ptp(points[:20], axis=0).max() < 0.15 < 0.6 < abs(points[:20, 0].mean() - points[20:, 0].mean())
    everything = np.concatenate(list(pose_map.points.values()))
    assert everything.min() >= 0 and everything.max() <= 1
    np.testing.assert_allclose(pose_map.place(groups()["test"][0]), pose_map.points["test"][0])


def test_a_click_finds_its_point_and_none_where_there_is_none():
    pose_map = PoseMap(groups())
    for name, row in (("training", 0), ("training", 31), ("test", 0)):
        x, y = pose_map.points[name][row]
        assert pose_map.nearest(float(x), float(y)) == (name, row)
    assert pose_map.nearest(0.3, 0.05) is None


def test_the_picture_shows_every_group_and_a_ring_around_the_pose():
    pose_map, theta = PoseMap(groups()), groups()["training"][0]
    picture = pose_map.draw(200, theta)
    assert picture.shape == (200, 200, 3)
    x, y = 200 * pose_map.points["test"][0]
    assert tuple(picture[int(y), int(x)]) == COLOURS[1]
    ring = (picture == 255).all(axis=-1)
    rows, columns = np.nonzero(ring)
    np.testing.assert_allclose([columns.mean(), rows.mean()], 200 * pose_map.place(theta), atol=1.5)
    other = pose_map.draw(200, groups()["training"][30])
    assert not np.array_equal(other, picture)


def test_too_few_poses_span_no_plane():
    with pytest.raises(ValueError, match="expected at least three training poses to span a plane; got 2"):
        PoseMap({"training": np.zeros((2, 4))})
