"""Calibrations of other tools: the same cameras written as each tool writes them project points to the same pixels."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mitsuba_avatar.captures.cameras import Camera, save_cameras
from mitsuba_avatar.captures.formats.opencv_yaml import opencv_yaml_text
from mitsuba_avatar.registration.calibration import find_calibration
from mitsuba_avatar.registration.settings import CalibrationSettings
from tests.registration.people_in_cameras import make_cameras, standing_person

WIDTH, HEIGHT = 270, 480
LENS = {"SIMPLE_PINHOLE": (), "PINHOLE": (), "SIMPLE_RADIAL": (-0.08,), "RADIAL": (-0.08, 0.02), "OPENCV": (-0.08, 0.02, 1e-3, -2e-3)}
LENS["FULL_OPENCV"] = (0.3, -0.1, 1e-3, -2e-3, 0.02, 0.4, -0.05, 0.01)
Y_DOWN = Rotation.from_euler("x", 90, degrees=True).as_matrix()  # native_from_ours: our Z is the reconstruction's -Y
UNIT = 0.37  # metres in a unit of the reconstruction


def native_pose(camera: Camera, unit: float = 1.0, tilt: float = 0.0) -> np.ndarray:
    """camera_from_native [4, 4] in a world whose Y points down, but for `tilt` degrees, and whose unit is `unit` metres long."""
    pose = camera.camera_from_world.copy()
    pose[:3, :3] = pose[:3, :3] @ Y_DOWN.T @ Rotation.from_euler("zx", [tilt, 0.3 * tilt], degrees=True).as_matrix()
    pose[:3, 3] /= unit
    return pose


def write_colmap(folder: Path, model: str, name: str = "{}.jpg", tilt: float = 0.0) -> dict[str, Camera]:
    """cameras.txt and images.txt of three cameras; returns what they stand for."""
    cameras = {key: camera for key, camera in make_cameras(WIDTH, HEIGHT).items() if key != "d"}
    lens_lines, image_lines, expected = ["# Camera list"], ["# Image list with two lines of data per image:"], {}
    for index, (key, camera) in enumerate(cameras.items()):
        has_one_focal = model in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
        focal = (camera.fx,) if has_one_focal else (camera.fx, camera.fy)
        values = " ".join(repr(float(value)) for value in (*focal, camera.cx, camera.cy, *LENS[model]))
        lens_lines.append(f"{index + 1} {model} {WIDTH} {HEIGHT} {values}")
        pose = native_pose(camera, UNIT, tilt)
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
        numbers = " ".join(repr(float(value)) for value in (w, x, y, z, *pose[:3, 3]))
        image_lines += [f"{7 - index} {numbers} {index + 1} {name.format(key)}", "12.5 40.0 -1 13.0 41.5 3" if index else ""]
        coefficients = tuple((*LENS[model], 0.0, 0.0, 0.0, 0.0)[: max(4, len(LENS[model]))]) if any(LENS[model]) else ()
        expected[key] = Camera(
            key, WIDTH, HEIGHT, camera.fx, focal[-1], camera.cx, camera.cy, camera.camera_from_world, distortion=coefficients
        )
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "cameras.txt").write_text("\n".join(lens_lines) + "\n")
    (folder / "images.txt").write_text("\n".join(image_lines) + "\n")
    return expected


def write_opencv(folder: Path, has_sizes: bool = True, lens: tuple = (*LENS["OPENCV"], 0.003), tilt: float = 0.0) -> dict[str, Camera]:
    """intri.yml and extri.yml: bent cameras, pixel centres at integers, a world whose Y points down."""
    expected, intrinsics, extrinsics = {}, {"names": ["a", "b"]}, {"names": ["a", "b"]}
    for name in ("a", "b"):
        camera = make_cameras(WIDTH, HEIGHT)[name]
        coefficients = lens
        matrix = np.array([[camera.fx, 0, camera.cx - 0.5], [0, camera.fy, camera.cy - 0.5], [0, 0, 1]])
        intrinsics |= {f"K_{name}": matrix, f"dist_{name}": np.array([coefficients])}
        intrinsics |= {f"H_{name}": HEIGHT, f"W_{name}": WIDTH} if has_sizes else {}
        pose = native_pose(camera, tilt=tilt)
        extrinsics |= {f"R_{name}": Rotation.from_matrix(pose[:3, :3]).as_rotvec()[:, None], f"T_{name}": pose[:3, 3:]}
        expected[name] = Camera(
            name, WIDTH, HEIGHT, camera.fx, camera.fy, camera.cx, camera.cy, camera.camera_from_world, distortion=coefficients
        )
    (folder / "intri.yml").write_text(opencv_yaml_text(intrinsics))
    (folder / "extri.yml").write_text(opencv_yaml_text(extrinsics))
    return expected


def assert_same_views(cameras: dict[str, Camera], expected: dict[str, Camera]) -> None:
    """Points of a person land on the same pixels, at the same depth in metres."""
    assert list(cameras) == list(expected)
    for name, camera in cameras.items():
        assert (camera.width, camera.height) == (WIDTH, HEIGHT)
        (pixels, depth), (wanted, wanted_depth) = camera.project(standing_person()), expected[name].project(standing_person())
        np.testing.assert_allclose(pixels, wanted, atol=1e-6)
        np.testing.assert_allclose(depth, wanted_depth, atol=1e-6)


@pytest.mark.parametrize("model", LENS)
@pytest.mark.parametrize("place", ["", "sparse/0"])
def test_colmap_cameras_project_as_they_were_written(model, place, tmp_path):
    """Which way is up the cameras tell; how long a unit is the user does."""
    expected = write_colmap(tmp_path / place, model)
    assert_same_views(find_calibration(tmp_path).cameras({}, CalibrationSettings(metres=UNIT)), expected)
    assert_same_views(find_calibration(tmp_path).cameras({}, CalibrationSettings(up="-y", metres=UNIT)), expected)


def test_colmap_images_in_folders_are_named_by_their_folder(tmp_path):
    write_colmap(tmp_path, "OPENCV", "{}/000017.jpg")
    assert list(find_calibration(tmp_path).cameras({}, CalibrationSettings(metres=UNIT))) == ["a", "b", "c"]


def test_a_unit_that_nobody_named_is_asked_for(tmp_path):
    """The message gives the distance that a tape measure can turn into metres."""
    expected = write_colmap(tmp_path, "PINHOLE")
    units = np.linalg.norm(expected["a"].center_world - expected["b"].center_world) / UNIT
    with pytest.raises(ValueError, match=rf"expected calibration.metres.*a and b are {units:.4f} units apart"):
        find_calibration(tmp_path).cameras({}, CalibrationSettings())


def test_opencv_cameras_project_as_they_were_written(tmp_path):
    expected = write_opencv(tmp_path)
    assert_same_views(find_calibration(tmp_path).cameras({}, CalibrationSettings()), expected)


def test_opencv_s_rational_lenses_are_read_and_its_thin_prisms_refused(tmp_path):
    expected = write_opencv(tmp_path, lens=LENS["FULL_OPENCV"])
    assert_same_views(find_calibration(tmp_path).cameras({}, CalibrationSettings()), expected)
    text = (tmp_path / "intri.yml").read_text()
    longer = (*LENS["FULL_OPENCV"], 0.1, 0.0, 0.0, 0.0)
    (tmp_path / "intri.yml").write_text(
        text.replace("cols: 8", "cols: 12").replace("0.01 ]", ", ".join(map(str, (0.01, *longer[8:]))) + " ]")
    )
    with pytest.raises(ValueError, match="at most k1, k2, p1, p2, k3, k4, k5, k6 of a .*got 12 coefficients. Calibrate without the thin"):
        find_calibration(tmp_path).cameras({}, CalibrationSettings())


def assert_upright_and_rigid(cameras: dict[str, Camera], expected: dict[str, Camera]) -> None:
    """The world stands upright at the right height, turned about Z at most: nothing between cameras has changed."""
    heights = [[camera.center_world[2] for camera in each.values()] for each in (cameras, expected)]
    np.testing.assert_allclose(np.diff(heights[0]), np.diff(heights[1]), atol=1e-6)
    names = list(expected)
    for first, second in zip(names, names[1:], strict=False):
        between = [each[first].camera_from_world @ each[second].world_from_camera for each in (cameras, expected)]
        np.testing.assert_allclose(*between, atol=1e-6)


@pytest.mark.parametrize("tilt", [10.0, 25.0])
def test_a_world_without_axes_is_turned_as_its_cameras_stand_and_never_snapped(tilt, tmp_path):
    """All cameras look down, and none is opposite another: their mean up would be off, their horizontal axes are not."""
    expected = write_colmap(tmp_path, "PINHOLE", tilt=tilt)
    assert_upright_and_rigid(find_calibration(tmp_path).cameras({}, CalibrationSettings(metres=UNIT)), expected)


def test_a_board_that_lay_ten_degrees_off_is_asked_about(tmp_path):
    expected = write_opencv(tmp_path, tilt=10.0)
    with pytest.raises(ValueError, match="to tell which way is up; got 10 degrees off the nearest. Say calibration.up=z"):
        find_calibration(tmp_path).cameras({}, CalibrationSettings())
    assert_upright_and_rigid(find_calibration(tmp_path).cameras({}, CalibrationSettings(up="cameras")), expected)
    leaning = find_calibration(tmp_path).cameras({}, CalibrationSettings(up="-y"))
    between = [each["a"].camera_from_world @ each["b"].world_from_camera for each in (leaning, expected)]
    np.testing.assert_allclose(*between, atol=1e-6, err_msg="the axis that the user names is taken, and nothing between cameras changes")


def test_opencv_cameras_without_a_size_take_the_videos(tmp_path):
    expected = write_opencv(tmp_path, has_sizes=False)
    sizes = {"b": (WIDTH, HEIGHT)}
    assert_same_views(find_calibration(tmp_path).cameras(sizes, CalibrationSettings()), {"b": expected["b"]})


def damage(name: str, old: str, new: str):
    """What replaces a text in one of the files."""

    def change(folder: Path) -> None:
        text = (folder / name).read_text()
        assert old in text
        (folder / name).write_text(text.replace(old, new))

    return change


@pytest.mark.parametrize(
    ("harm", "message"),
    [
        (damage("cameras.txt", "RADIAL", "OPENCV_FISHEYE"), "expected a lens model of SIMPLE_PINHOLE.*got 'OPENCV_FISHEYE'. Reconstruct"),
        (damage("cameras.txt", " 480 ", " 480 1 1 "), "expected 'CAMERA_ID MODEL WIDTH HEIGHT PARAMS"),
        (damage("images.txt", " 2 b.jpg", " 9 b.jpg"), "expected 'IMAGE_ID QW QX.*got '6 "),
        (damage("images.txt", " c.jpg", " b.jpg"), "expected one image of every camera in .*got several of 'b'"),
        (lambda folder: (folder / "images.txt").write_text("# nothing\n"), "expected images in .*got none"),
    ],
)
def test_colmap_files_that_cannot_be_used_are_named(harm, message, tmp_path):
    write_colmap(tmp_path, "RADIAL")
    harm(tmp_path)
    with pytest.raises(ValueError, match=message):
        find_calibration(tmp_path).cameras({}, CalibrationSettings(metres=UNIT))


def test_none_and_several_calibrations_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"cameras.json, \*.qca.txt \(Qualisys\), intri.yml.*got none"):
        find_calibration(tmp_path)
    write_colmap(tmp_path, "PINHOLE")
    write_opencv(tmp_path)
    with pytest.raises(ValueError, match=r"expected one calibration in .*\['intri.yml', 'images.txt'\]"):
        find_calibration(tmp_path)
    save_cameras(tmp_path / "cameras.json", make_cameras(WIDTH, HEIGHT))
    assert list(find_calibration(tmp_path).cameras({}, CalibrationSettings())) == ["a", "b", "c", "d"], "our own goes first"


def test_an_opencv_calibration_of_nobody_is_refused(tmp_path):
    (tmp_path / "intri.yml").write_text(opencv_yaml_text({"K": np.eye(3)}))
    (tmp_path / "extri.yml").write_text(opencv_yaml_text({"T": np.ones((3, 1))}))
    with pytest.raises(ValueError, match="expected names, K_<name> and T_<name>"):
        find_calibration(tmp_path).cameras({}, CalibrationSettings())
