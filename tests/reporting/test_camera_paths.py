"""Camera paths keep in view what they are asked to, from every side, with one lens."""

import numpy as np
import pytest

from mitsuba_avatar.reporting.camera_paths import key_framed, orbit, spiral, turntable

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


def test_a_spiral_winds_upwards_and_keeps_all_in_view():
    cameras = spiral(POINTS.astype(np.float32), 9, 36, 54, elevations=(-0.3, 0.6), turns=1.5)
    target = 0.5 * (POINTS.min(0) + POINTS.max(0))
    offsets = np.stack([camera.center_world for camera in cameras]) - target
    elevation = np.arcsin(offsets[:, 2] / np.linalg.norm(offsets, axis=1))
    np.testing.assert_allclose(elevation, np.linspace(-0.3, 0.6, 9), atol=1e-6)
    azimuth = np.unwrap(np.arctan2(offsets[:, 1], offsets[:, 0]))
    np.testing.assert_allclose(np.diff(azimuth), 1.5 * 2 * np.pi / 9, atol=1e-6)
    for camera in cameras:
        pixels, depth = camera.project(POINTS)
        assert (depth > 0).all() and (pixels > 0).all() and (pixels < (36, 54)).all() and camera.fx == cameras[0].fx


def test_a_person_on_a_turntable_looks_as_from_an_orbit():
    points = POINTS.astype(np.float32)
    still, turns = turntable(points, 7, 36, 54, elevation=0.3)
    for walking, camera, turn in zip(orbit(points, 7, 36, 54, elevation=0.3), still, turns, strict=True):
        np.testing.assert_array_equal(camera.camera_from_world, still[0].camera_from_world)
        turned = POINTS @ turn[:3, :3].T + turn[:3, 3]
        np.testing.assert_allclose(camera.project(turned)[0], walking.project(POINTS)[0], atol=1e-6)
    assert len({camera.name for camera in still}) == 7


KEYS = """keyframes:
  - {time: 0.0, position: [0.0, -4.0, 1.2], target: [0.0, 0.0, 0.9], field_of_view: 30}
  - {time: 1.0, position: [2.0, -3.5, 1.5], target: [0.1, 0.0, 1.0], field_of_view: 24}
  - {time: 3.0, position: [4.0, 0.5, 1.0], target: [0.0, 0.2, 1.1], field_of_view: 40}
"""


def test_a_key_framed_path_passes_through_its_keys_smoothly(tmp_path):
    (tmp_path / "keys.yaml").write_text(KEYS)
    cameras = key_framed(tmp_path / "keys.yaml", 61, 40, 60)
    for index, position, target, degrees in ((0, (0, -4, 1.2), (0, 0, 0.9), 30), (20, (2, -3.5, 1.5), (0.1, 0, 1), 24)):
        np.testing.assert_allclose(cameras[index].center_world, position, atol=1e-9)
        np.testing.assert_allclose(cameras[index].project(np.array([target], float))[0][0], [20, 30], atol=1e-9)
        assert 2 * np.degrees(np.arctan(30 / cameras[index].fy)) == pytest.approx(degrees)
    centers = np.stack([camera.center_world for camera in cameras])
    assert np.abs(np.diff(centers, 2, axis=0)).max() < 0.1 * np.abs(np.diff(centers, axis=0)).max(), "no corner at the middle key"
    np.testing.assert_allclose(centers[-1], (4, 0.5, 1))


def test_one_key_is_a_camera_that_stands_still(tmp_path):
    (tmp_path / "keys.yaml").write_text("\n".join(KEYS.splitlines()[:2]))
    cameras = key_framed(tmp_path / "keys.yaml", 3, 40, 60)
    np.testing.assert_array_equal(cameras[0].camera_from_world, cameras[2].camera_from_world)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("keyframes: []", "at least one entry"),
        ("[", "expected YAML"),
        ("frames: 3", "expected a list 'keyframes'"),
        (KEYS.replace("target: [0.1, 0.0, 1.0], ", ""), "in key frame 1 of"),
        (KEYS.replace("[0.0, -4.0, 1.2]", "[0.0, -4.0]"), "three coordinates each"),
        (KEYS.replace("30}", "thirty}"), "expected numbers in key frame 0"),
        (KEYS.replace("30}", "180}"), "field of view of 0..180"),
        (KEYS.replace("time: 3.0", "time: 0.5"), "expected rising times"),
        (KEYS.replace("[0.0, -4.0, 1.2]", "[0.0, 0.0, 3.2]"), "neither straight up nor down"),
    ],
)
def test_bad_key_frames_are_named(tmp_path, text, message):
    (tmp_path / "keys.yaml").write_text(text)
    with pytest.raises(ValueError, match=message):
        key_framed(tmp_path / "keys.yaml", 5, 40, 60)
    with pytest.raises(FileNotFoundError, match="none.yaml; there is none"):
        key_framed(tmp_path / "none.yaml", 5, 40, 60)
