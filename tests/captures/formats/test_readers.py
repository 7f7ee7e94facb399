"""Readers of other data sets: a known point lands on the right pixel, each trap shows, bad files are named."""

import importlib.util
import json
import shutil

import cv2
import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from mitsuba_avatar.captures.colour import encode_bytes
from mitsuba_avatar.captures.formats.conversion import ConversionOptions, convert, read_report
from mitsuba_avatar.captures.formats.opencv_yaml import opencv_yaml_text, read_opencv_yaml
from mitsuba_avatar.captures.formats.opening import open_source
from mitsuba_avatar.captures.formats.source import SourceOptions
from mitsuba_avatar.captures.frames import Frame
from tests.captures.formats.data_sets import FRAMES, WRITERS, encoded, spot_errors

HAS_H5PY = importlib.util.find_spec("h5py") is not None
FORMATS = tuple(name for name in WRITERS if name != "dna" or HAS_H5PY)


@pytest.fixture(scope="module")
def data_sets(tmp_path_factory):
    """Format -> (folder, scene); not to be written to."""
    base = tmp_path_factory.mktemp("data_sets")
    found = {}
    for name in FORMATS:
        (base / name).mkdir()
        found[name] = (base / name, WRITERS[name](base / name))
    return found


@pytest.fixture
def folder(request, data_sets, tmp_path):
    """A fresh copy of the data set that the test asks for."""
    shutil.copytree(data_sets[request.param][0], tmp_path / request.param)
    return tmp_path / request.param


def largest_error(capture, scene):
    """Pixels by which the worst spot misses its point, over all cameras and frames."""
    errors = [
        spot_errors(encode_bytes(capture.image(name, index), "srgb"), camera, scene.points[frame.number])
        for index, frame in enumerate(capture.frames)
        for name, camera in capture.cameras.items()
    ]
    return float(np.max(errors))


@pytest.mark.parametrize("name", FORMATS)
def test_known_points_land_on_their_pixels_after_conversion(name, data_sets, tmp_path):
    path, scene = data_sets[name]
    capture = convert(open_source(name, path), tmp_path / "capture")
    assert largest_error(capture, scene) < 0.15
    assert set(capture.cameras) == set(scene.cameras) and not any(camera.distortion for camera in capture.cameras.values())
    assert len({(camera.width, camera.height) for camera in capture.cameras.values()}) == 1
    for index in range(len(capture.frames)):
        for camera in capture.cameras:
            bright = capture.image(camera, index).max(axis=-1) > 0.15
            assert (capture.mask(camera, index) > 0.5)[bright].mean() > 0.8, "mask and image fall together"
    # The world is ours again: Z up, metres.
    for camera_name, camera in scene.cameras.items():
        np.testing.assert_allclose(capture.cameras[camera_name].camera_from_world, camera.camera_from_world, atol=1e-6)
    assert "rig.npz" in read_report(capture.path)["lacks"][0]


TRAPS = [
    ("actorshq", "pixel centre"),
    ("actorshq", "world to camera"),
    ("actorshq", "focal in pixels"),
    ("easymocap", "pixel centre"),
    ("easymocap", "distortion"),
    ("easymocap", "camera to world"),
    ("easymocap", "transposed"),
    ("zju", "pixel centre"),
    ("zju", "distortion"),
    ("zju", "metres"),
    ("avatarrex", "pixel centre"),
    ("avatarrex", "camera to world"),
    ("thuman4", "pixel centre"),
    *([("dna", trap) for trap in ("pixel centre", "distortion", "world to camera")] if HAS_H5PY else []),
]


@pytest.mark.parametrize(("name", "trap"), TRAPS)
def test_each_trap_misses_by_half_a_pixel_or_is_refused(name, trap, tmp_path):
    """Files written with the mistake, read by the right convention: what a reader with the mistake would make of right files."""
    (tmp_path / "data").mkdir()
    scene = WRITERS[name](tmp_path / "data", trap)
    try:
        capture = convert(
            open_source(name, tmp_path / "data", SourceOptions(up="z" if name in ("easymocap", "zju") else "auto")), tmp_path / "out"
        )
        error = largest_error(capture, scene)
    except ValueError:
        error = np.inf
    assert error > 0.4


@pytest.mark.parametrize("name", FORMATS)
def test_images_that_need_no_change_are_copied_byte_for_byte(name, data_sets, tmp_path):
    path, _ = data_sets[name]
    source = open_source(name, path, SourceOptions(distortion="ignore", cameras=tuple(sorted(data_sets[name][1].cameras)[:1])))
    capture = convert(source, tmp_path / "capture")
    camera = next(iter(capture.cameras))
    assert capture.images.image_path(camera, capture.frames[1].number).read_bytes() == source.encoded_image(camera, 1)
    assert not read_report(capture.path)["remapped_cameras"]


def test_an_image_of_twice_the_size_is_brought_to_the_others(data_sets, tmp_path):
    path, scene = data_sets["easymocap"]
    capture = convert(open_source("easymocap", path), tmp_path / "half", ConversionOptions(scale=0.5, held_out_cameras=("3",)))
    assert {(camera.width, camera.height) for camera in capture.cameras.values()} == {(48, 36)}
    assert capture.cameras["cam-b"].fx == pytest.approx(capture.cameras["01"].fx, rel=0.1) and largest_error(capture, scene) < 0.15
    assert capture.camera_names(held_out=True) == ["3"]


def test_cameras_may_keep_their_own_sizes(data_sets, tmp_path):
    path, scene = data_sets["easymocap"]
    capture = convert(open_source("easymocap", path), tmp_path / "own", ConversionOptions(own_sizes=True))
    assert [(camera.width, camera.height) for camera in capture.cameras.values()] == [(96, 72), (192, 150), (96, 72)]
    assert largest_error(capture, scene) < 0.15


def test_keypoints_of_one_person_come_along(data_sets, tmp_path):
    path, scene = data_sets["easymocap"]
    source = open_source("easymocap", path)
    np.testing.assert_allclose(convert(source, tmp_path / "first").keypoints[2, :, :3], scene.points[2], atol=1e-6)
    source.person = 1
    np.testing.assert_allclose(source.keypoints(0)[:, :3], scene.points[0] + 1, atol=1e-6)
    source.person = 7
    assert source.keypoints(0) is None, "nobody of that identity"


@pytest.mark.skipif(not HAS_H5PY, reason="needs h5py")
def test_dna_rendering_files_that_cannot_be_read_are_named(data_sets, tmp_path):
    path, scene = data_sets["dna"]
    np.testing.assert_allclose(open_source("dna", path).keypoints(1)[:, :3], scene.points[1], atol=1e-6)
    assert open_source("dna", path).smplx()["betas"].shape == (FRAMES, 10)
    with pytest.raises(FileNotFoundError, match="expected one SUBJECT.smc and one SUBJECT_annots.smc"):
        open_source("dna", tmp_path)
    shutil.copytree(path, tmp_path / "copy")
    file = tmp_path / "copy/0007_01.smc"
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    with pytest.raises(ValueError, match="expected whole HDF5 files in"):
        open_source("dna", tmp_path / "copy")


def test_images_can_be_linked_to_instead_of_copied(data_sets, tmp_path):
    path, scene = data_sets["actorshq"]
    capture = convert(open_source("actorshq", path), tmp_path / "linked", ConversionOptions(links=True))
    link = capture.images.image_path("Cam002", capture.frames[3].number)
    assert link.is_symlink() and link.resolve() == (path / "rgbs/Cam002/Cam002_rgb000003.jpg").resolve()
    assert largest_error(capture, scene) < 0.05


def test_smpl_parameters_and_vertices_can_be_read_in_place(data_sets):
    zju = open_source("zju", data_sets["zju"][0])
    np.testing.assert_allclose(zju.vertices(3), data_sets["zju"][1].points[3], atol=1e-6)
    np.testing.assert_allclose(zju.smpl(2)["Rh"], 0.2)
    assert open_source("thuman4", data_sets["thuman4"][0]).smplx()["transl"].shape == (FRAMES, 3)


def test_missing_frames_are_left_out_and_reported(data_sets, tmp_path):
    """AvatarReX lists them itself; elsewhere a frame without an image or a mask in one camera is one."""
    assert [frame.number for frame in open_source("avatarrex", data_sets["avatarrex"][0]).info.frames] == [0, 1, 2]
    for name, victim, reason in (
        ("actorshq", "rgbs/Cam002/Cam002_rgb000001.jpg", "no image of Cam002"),
        ("easymocap", "mask/3/000001.png", "no mask of 3"),
        ("zju", "Camera_B3/000001.jpg", "no image of Camera_B3"),
        ("thuman4", "masks/cam01/00000001.jpg", "no mask of cam01"),
    ):
        copy = tmp_path / name
        shutil.copytree(data_sets[name][0], copy)
        (copy / victim).unlink()
        capture = convert(open_source(name, copy), tmp_path / f"{name}_capture")
        assert [frame.number for frame in capture.frames] == [0, 2, 3]
        assert read_report(capture.path)["missing_frames"] == {"1": reason}


def test_splits_and_rates_can_be_chosen(data_sets):
    source = open_source("thuman4", data_sets["thuman4"][0], SourceOptions(fps=10.0, test_frames=1))
    assert source.info.frames[-1] == Frame(3, 0.3, "test", "sequence") and source.info.frames[2].split == "train"
    with pytest.raises(ValueError, match="fewer test frames than the 4"):
        open_source("thuman4", data_sets["thuman4"][0], SourceOptions(test_frames=4))


def remove_from_calibration(path):
    text = (path / "calibration.csv").read_text(encoding="utf-8-sig").splitlines()
    (path / "calibration.csv").write_text("\n".join(line for line in text if not line.startswith("Cam002")))


def other_schema(path):
    (path / "calibration.json").write_text(json.dumps({"KRT": [1, 2]}))


def harmful_pickle(path):
    class Harm:
        def __reduce__(self):
            return print, ("harm",)

    np.save(path / "annots.npy", np.array({"cams": Harm()}, dtype=object), allow_pickle=True)


def other_size(path):
    document = json.loads((path / "calibration_full.json").read_text())
    document["22010708"]["imgSize"] = [192, 144]
    (path / "calibration_full.json").write_text(json.dumps(document))


BAD_CALIBRATION = [
    ("actorshq", remove_from_calibration, r"expected calibration of every camera with images in .*; got none for \['Cam002'\]"),
    ("actorshq", lambda path: (path / "calibration.csv").write_text("name,w,h\n"), r"expected the columns name,w,h,rx,.*got 'name,w,h'"),
    ("actorshq", lambda path: (path / "calibration.csv").unlink(), "expected a file at .*calibration.csv; got none"),
    ("actorshq", lambda path: shutil.rmtree(path / "rgbs"), "expected images of at least one calibrated camera"),
    ("easymocap", lambda path: (path / "intri.yml").write_text("%YAML:1.0\n---\nnames: [01\n"), "expected OpenCV YAML in .*intri.yml"),
    ("easymocap", lambda path: shutil.copytree(path / "images/3", path / "images/4"), r"got none for \['4'\]. Calibrate them"),
    ("zju", harmful_pickle, "expected a dictionary of plain arrays in .*annots.npy; got: it asks for builtins.print"),
    ("zju", lambda path: (path / "annots.npy").write_bytes(b"\x93NUMPY"), "expected a dictionary of plain arrays in .*annots.npy"),
    ("thuman4", other_schema, r"expected \{camera: \{'K', 'R', 'T'\}\} in .*calibration.json; got \{'KRT'"),
    ("avatarrex", other_size, "expected images of 192x144 pixels for 22010708 by .*; got 96x72"),
]


@pytest.mark.parametrize(("folder", "damage", "message"), BAD_CALIBRATION, indirect=["folder"])
def test_bad_calibrations_are_named(folder, damage, message):
    damage(folder)
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        open_source(folder.name, folder)


def sixteen_bit_colour():
    """Bytes of a PNG of 16-bit RGB, which Pillow opens as if it had 8 bits."""
    return cv2.imencode(".png", np.full((72, 96, 3), 1000, np.uint16))[1].tobytes()


BAD_IMAGES = {
    "truncated": (lambda good: good[: len(good) // 2], "expected a whole image in .*00000002.jpg; got"),
    "no image": (lambda good: b"<html>404</html>", "it is no image"),
    "CMYK": (lambda good: encoded(Image.new("CMYK", (96, 72)), "JPEG"), "expected 8 bits a channel .*00000002.jpg; got Pillow mode 'CMYK'"),
    "16-bit grey": (lambda good: encoded(np.zeros((72, 96), np.uint16), "PNG"), "got Pillow mode 'I;16', 16 bits"),
    "16-bit colour": (lambda good: sixteen_bit_colour(), "16 bits. Store deeper images"),
    "other size": (
        lambda good: encoded(np.zeros((72, 90, 3), np.uint8), "JPEG"),
        "expected 96x72 pixels, the size of cam02, in .*; got 90x72",
    ),
}


@pytest.mark.parametrize("kind", BAD_IMAGES)
@pytest.mark.parametrize("folder", ["thuman4"], indirect=True)
@pytest.mark.parametrize("which", ["images", "masks"])
def test_bad_images_stop_the_conversion_and_leave_nothing_that_looks_whole(kind, folder, which, tmp_path):
    damage, message = BAD_IMAGES[kind]
    victim = folder / f"{which}/cam02/00000002.jpg"
    good = victim.read_bytes()
    victim.write_bytes(damage(good))
    with pytest.raises(ValueError, match=message):
        convert(open_source("thuman4", folder), tmp_path / "out")
    assert (tmp_path / "out/capture.unfinished.yaml").is_file() and not (tmp_path / "out/capture.yaml").exists()
    # Once the file is repaired, the conversion goes on where it stopped.
    victim.write_bytes(good)
    early = tmp_path / "out/images/cam00/000000.jpg"
    stamp = early.stat().st_mtime_ns
    assert len(convert(open_source("thuman4", folder), tmp_path / "out").frames) == FRAMES
    assert early.stat().st_mtime_ns == stamp


def test_cameras_that_do_not_stand_upright_ask_which_way_is_up(data_sets):
    with pytest.raises(ValueError, match="expected cameras that stand upright"):
        source = open_source("actorshq", data_sets["actorshq"][0])
        from mitsuba_avatar.captures.formats.source import turned_camera, upright_world

        turn = np.eye(4)
        turn[1, 1] = turn[2, 2] = -1
        cameras = list(source.info.cameras.values())
        upright_world([*cameras, *(turned_camera(camera, turn) for camera in cameras)], "auto", data_sets["actorshq"][0])


def test_an_axis_that_the_cameras_do_not_stand_along_is_taken_but_not_silently(data_sets, tmp_path):
    """A board that leant: the data set's axis is kept, as its users expect, and the user is told how far the cameras are off."""
    path, scene = data_sets["easymocap"]
    assert not open_source("easymocap", path).info.notes
    shutil.copytree(path, tmp_path / "leaning")
    lean = Rotation.from_euler("xz", [9.0, 4.0], degrees=True).as_matrix()
    entries = read_opencv_yaml(path / "extri.yml")
    for name in entries["names"]:
        rotation = (
            entries[f"Rot_{name}"] if f"Rot_{name}" in entries else Rotation.from_rotvec(entries[f"R_{name}"].ravel()).as_matrix()
        ) @ lean
        entries |= {f"Rot_{name}": rotation, f"R_{name}": Rotation.from_matrix(rotation).as_rotvec()[:, None]}
    (tmp_path / "leaning/extri.yml").write_text(opencv_yaml_text(entries))
    (note,) = open_source("easymocap", tmp_path / "leaning").info.notes
    assert "was taken for up, though the cameras stand" in note and "--up cameras" in note
    upright = open_source("easymocap", tmp_path / "leaning", SourceOptions(up="cameras")).info
    assert not upright.notes
    first, second = list(scene.cameras)[:2]
    for info in (upright, open_source("easymocap", tmp_path / "leaning").info):
        between = [each[first].camera_from_world @ each[second].world_from_camera for each in (info.cameras, scene.cameras)]
        np.testing.assert_allclose(*between, atol=1e-6)


def test_opencv_yaml_comes_back_as_it_was_written(tmp_path):
    entries = {"names": ["01", "b"], "K_01": np.arange(9.0).reshape(3, 3) / 7, "H_01": 72, "T_b": np.array([[1e-9], [-2.5], [3.0]])}
    (tmp_path / "a.yml").write_text(opencv_yaml_text(entries))
    back = read_opencv_yaml(tmp_path / "a.yml")
    assert back["names"] == entries["names"] and back["H_01"] == 72
    np.testing.assert_array_equal(back["K_01"], entries["K_01"])
    np.testing.assert_array_equal(back["T_b"], entries["T_b"])
    (tmp_path / "a.yml").write_text(opencv_yaml_text(entries).replace("rows: 3", "rows: 4"))
    with pytest.raises(ValueError, match="expected 4x3 numbers for K_01"):
        read_opencv_yaml(tmp_path / "a.yml")
