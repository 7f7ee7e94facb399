"""Cameras: projection by hand and against a slow reference, sizes, round trip, and every file that must be refused."""

import json

import cv2
import numpy as np
import pytest

from mitsuba_avatar.captures.cameras import Camera, load_cameras, save_cameras
from mitsuba_avatar.captures.rigid import inverse_rigid, is_rigid
from tests.small_capture import make_cameras


def upright_camera(**changes) -> Camera:
    """A camera at (0, -2, 1) that looks along +y with x to the right: the image's down is the world's -z."""
    pose = np.array([[1.0, 0, 0, 0], [0, 0, -1, 1], [0, 1, 0, 2], [0, 0, 0, 1]])
    values = {"name": "a", "width": 64, "height": 48, "fx": 80.0, "fy": 90.0, "cx": 30.0, "cy": 20.0, "camera_from_world": pose}
    return Camera(**(values | changes))


def test_projection_by_hand():
    pixels, depth = upright_camera().project(np.array([[0.0, 0.0, 1.0], [1.0, 2.0, 0.5], [0.0, -3.0, 1.0]]))
    np.testing.assert_allclose(pixels[:2], [[30.0, 20.0], [30 + 80 * 1 / 4, 20 + 90 * 0.5 / 4]])
    np.testing.assert_allclose(depth, [2.0, 4.0, -1.0])


def test_center_and_inverse():
    camera = upright_camera()
    np.testing.assert_allclose(camera.center_world, [0, -2, 1])
    np.testing.assert_allclose(camera.world_from_camera, np.linalg.inv(camera.camera_from_world))


def test_distortion_follows_opencv_model():
    """Written out for one point: x = 0.25, y = 0.125 at depth 1."""
    k1, k2, p1, p2, k3 = -0.1, 0.05, 0.01, -0.02, 0.3
    camera = upright_camera(distortion=(k1, k2, p1, p2, k3))
    x, y = 0.25, 0.125
    r2 = x**2 + y**2
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    expected = [x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2), y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y]
    pixels, _ = camera.project(np.array([[2 * x, 0.0, 1 - 2 * y]]))
    np.testing.assert_allclose(pixels[0], [30 + 80 * expected[0], 20 + 90 * expected[1]])
    assert camera.is_distorted and not upright_camera().is_distorted and not upright_camera(distortion=(0.0,) * 4).is_distorted


@pytest.mark.parametrize("count", [4, 5, 8])
def test_distortion_is_opencv_s_projection(count):
    coefficients = (0.3, -0.1, 0.01, -0.02, 0.05, 0.4, -0.05, 0.02)[:count]
    camera = upright_camera(distortion=coefficients)
    points = np.random.default_rng(3).uniform(-0.4, 0.4, (20, 3)) + camera.world_from_camera[:3, 2] * 2 + camera.center_world
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    turn, shift = cv2.Rodrigues(camera.camera_from_world[:3, :3])[0], camera.camera_from_world[:3, 3]
    expected = cv2.projectPoints(points, turn, shift, matrix, np.array(coefficients))[0][:, 0]
    np.testing.assert_allclose(camera.project(points)[0], expected, atol=1e-9)


def test_resized_camera_projects_to_the_same_place():
    """Rounded sizes are followed exactly: 64x48 by 0.4 is 26x19, not 25.6x19.2."""
    camera = upright_camera()
    small = camera.resized(0.4)
    assert (small.width, small.height) == (26, 19)
    points = np.array([[0.3, 0.4, 0.8], [-0.2, 1.0, 1.3]])
    np.testing.assert_allclose(small.project(points)[0], camera.project(points)[0] * [26 / 64, 19 / 48])


def test_round_trip_keeps_order_and_every_digit(tmp_path):
    cameras = make_cameras()
    cameras["bent"] = upright_camera(name="bent", distortion=(0.1, 0.2, 0.3, 0.4))
    save_cameras(tmp_path / "cameras.json", cameras)
    loaded = load_cameras(tmp_path / "cameras.json")
    assert list(loaded) == list(cameras)
    for name, camera in cameras.items():
        np.testing.assert_array_equal(loaded[name].camera_from_world, camera.camera_from_world)
        for key in ("name", "width", "height", "fx", "fy", "cx", "cy", "distortion"):
            assert getattr(loaded[name], key) == getattr(camera, key)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"width": 0}, r"a must be at least 1x1 pixels; got 0x48"),
        ({"fx": -80.0}, r"positive focal lengths.*got fx=-80.0"),
        ({"cy": float("nan")}, r"finite principal point"),
        ({"name": "a/b"}, r"a name that can be a folder's; got 'a/b'"),
        ({"distortion": (0.1,) * 6}, r"distortion of a must be empty or \(k1, k2, p1, p2"),
        ({"camera_from_world": np.diag([2.0, 2, 2, 1])}, r"camera_from_world of a must be a rigid 4x4.*Divide out the scale"),
        ({"camera_from_world": np.diag([1.0, 1, -1, 1])}, r"without scale or mirror"),
        ({"camera_from_world": np.full((4, 4), np.nan)}, r"must be a rigid 4x4"),
    ],
)
def test_impossible_cameras_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        upright_camera(**changes)


def edit(path, change):
    """Apply `change` to the entries of a written camera file."""
    save_cameras(path, make_cameras())
    document = json.loads(path.read_text())
    change(document["cameras"])
    path.write_text(json.dumps(document))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda entries: entries.append(entries[0]), r"every camera once in .*cameras.json; got 'front' twice"),
        (lambda entries: entries[1].pop("cx"), r"camera 1 of .*missing \['cx'\]"),
        (lambda entries: entries[1].update(focal=3), r"camera 1 of .*unknown \['focal'\]"),
        (lambda entries: entries[2].update(fx=0), r"camera 2 \(high\) of .*cameras.json is not usable.*positive focal"),
        (lambda entries: entries[2].update(width="wide"), r"camera 2 \(high\) of .*is not usable.*'wide'"),
        (lambda entries: entries[0].update(camera_from_world=[[1, 0], [0, 1]]), r"camera 0 \(front\).*4 rows of 4 numbers; got \[2, 2\]"),
        (lambda entries: entries.clear(), r"at least one camera"),
        (lambda entries: entries[0].update(fx=1.44), r"focal lengths in pixels.*fx=1.44 for front, 64 pixels wide.*normalized"),
    ],
)
def test_unusable_files_are_refused(tmp_path, change, message):
    edit(tmp_path / "cameras.json", change)
    with pytest.raises(ValueError, match=message):
        load_cameras(tmp_path / "cameras.json")


@pytest.mark.parametrize(("factor", "unit"), [(1000, "looks like millimetres"), (100, "looks like centimetres or millimetres")])
def test_positions_in_other_units_are_refused(tmp_path, factor, unit):
    def scale(entries):
        for entry in entries:
            for row in entry["camera_from_world"][:3]:
                row[3] *= factor

    edit(tmp_path / "cameras.json", scale)
    with pytest.raises(ValueError, match=f"positions in metres in .*{unit}.*Divide the translations"):
        load_cameras(tmp_path / "cameras.json")


def test_missing_and_foreign_files_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"expected a camera file at .*cameras.json; got none"):
        load_cameras(tmp_path / "cameras.json")
    (tmp_path / "cameras.json").write_text('{"cameras": [')
    with pytest.raises(ValueError, match=r"expected JSON in .*cameras.json"):
        load_cameras(tmp_path / "cameras.json")
    (tmp_path / "cameras.json").write_text('{"KRT": []}')
    with pytest.raises(ValueError, match=r"'format_version': 1.*got \{'KRT': \[\]\}"):
        load_cameras(tmp_path / "cameras.json")


def test_rigid_transforms_in_batches():
    poses = np.stack([camera.camera_from_world for camera in make_cameras().values()])
    np.testing.assert_allclose(inverse_rigid(poses) @ poses, np.broadcast_to(np.eye(4), (3, 4, 4)), atol=1e-12)
    bad = np.stack([poses[0], poses[0].T, poses[1] * 1.01, np.diag([-1.0, 1, 1, 1]), np.full((4, 4), np.inf)])
    assert is_rigid(bad).tolist() == [True, False, False, False, False]
