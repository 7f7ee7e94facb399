"""Camera paths keep in view what they are asked to, from every side, with one lens."""

import numpy as np
import pytest

from mitsuba_avatar.reporting.camera_paths import orbit

POINTS = np.random.default_rng(3).normal(size=(200, 3)).astype(np.float32) * [0.3, 0.2, 0.8] + [2.0, -1.0, 0.9]


@pytest.mark.parametrize("size", [(36, 54), (160, 90)], ids=["portrait", "landscape"])
@pytest.mark.parametrize("elevation", [-0.4, 0.12, 0.9])
def test_all_points_stay_in_view(size, elevation):
    cameras = orbit(POINTS.astype(np.float32), 7, *size, elevation=elevation)
    assert len(cameras) == 7 and len({camera.name for camera in cameras}) == 7
    closest = np.inf
    for camera in cameras:
        assert (camera.width, camera.height) == size and camera.fx == camera.fy == cameras[0].fx
        pixels, depth = camera.project(POINTS)
        assert (depth > 0).all() and (pixels > 0).all() and (pixels < size).all()
        closest = min(closest, pixels.min(), (np.array(size) - pixels).min())
    assert closest < 0.06 * max(size), "one camera's points come near the edge: nothing is wasted"


def test_cameras_walk_around_and_stop_one_step_short():
    cameras = orbit(POINTS.astype(np.float32), 8, 30, 50)
    target = 0.5 * (POINTS.min(0) + POINTS.max(0))
    offsets = np.stack([camera.center_world for camera in cameras]) - target
    azimuth = np.unwrap(np.arctan2(offsets[:, 1], offsets[:, 0]))
    np.testing.assert_allclose(np.diff(azimuth), 2 * np.pi / 8, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(offsets, axis=1), np.linalg.norm(offsets[0]), rtol=1e-6)
    np.testing.assert_allclose(offsets[:, 2] / np.linalg.norm(offsets[0]), np.sin(0.12), atol=1e-6)
    np.testing.assert_allclose(offsets[0, :2] / np.linalg.norm(offsets[0, :2]), [0, -1], atol=1e-6)


def test_cameras_stand_upright():
    for camera in orbit(POINTS.astype(np.float32), 3, 30, 50):
        above, _ = camera.project(np.array([[2.0, -1.0, 1.4]]))
        below, _ = camera.project(np.array([[2.0, -1.0, 0.4]]))
        assert above[0, 1] < below[0, 1] and abs(above[0, 0] - below[0, 0]) < 1


def test_no_cameras_are_refused():
    with pytest.raises(ValueError, match="at least one camera; got 0"):
        orbit(POINTS.astype(np.float32), 0, 30, 50)
