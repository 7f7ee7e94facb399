"""Goliath body captures: our writer's files read by an independent reading of the format, and by our reader; traps and damage named."""

import dataclasses
import io
import json
import shutil
import zipfile

import numpy as np
import pytest
from PIL import Image

from mitsuba_avatar.body.momentum_rig import momentum_from_rig, momentum_poses
from mitsuba_avatar.body.rig import load_rig
from mitsuba_avatar.captures.formats.conversion import convert, read_report
from mitsuba_avatar.captures.formats.goliath import GoliathSource
from mitsuba_avatar.captures.formats.goliath_writer import GoliathBody, write_goliath
from mitsuba_avatar.captures.formats.momentum import save_momentum
from mitsuba_avatar.captures.formats.source import SourceOptions
from mitsuba_avatar.captures.silhouettes import silhouette
from tests.captures.formats.momentum_model import make_momentum_model, random_poses

NAME = "s--20260101--0000--TST001--pilot--ProjectGoliath--ClothedBody--3cams"


def write(capture, path):
    """Export a capture with its body, and an occlusion that tells frames apart."""
    rig = load_rig(capture.rig_path)
    poses = momentum_poses(np.array(capture.theta), np.array(capture.root))

    def occlusion(index):
        return np.linspace(0, 1, 64, dtype=np.float32).reshape(8, 8) * (0.5 + 0.1 * index)

    return write_goliath(capture, path, GoliathBody(momentum_from_rig(rig), poses, occlusion))


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """A small capture and its export; neither is to be written to."""
    from tests.small_capture import write_small_capture

    capture = write_small_capture(tmp_path_factory.mktemp("small") / "small", size=(96, 72))
    return capture, write(capture, tmp_path_factory.mktemp("goliath") / NAME)


@pytest.fixture
def folder(exported, tmp_path):
    """A fresh copy of the export."""
    shutil.copytree(exported[1], tmp_path / NAME)
    return tmp_path / NAME


def edit_calibration(folder, change):
    """Apply `change` to every entry of the calibration."""
    path = folder / "camera_calibration.json"
    document = json.loads(path.read_text())
    for entry in document["KRT"]:
        change(entry)
    path.write_text(json.dumps(document))


def edit_zip(path, change):
    """Write a zip anew with changed members; `change` gives bytes, or None to leave the member out."""
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in members.items():
            changed = change(name, data)
            if changed is not None:
                archive.writestr(name, changed)


def described_projection(entry, points_mm):
    """Pixels of the half-size image, pixel centres at integers, as the data set's own loader has them."""
    intrinsics, pose = np.array(entry["K"]).T, np.array(entry["T"]).T[:3, :4]
    intrinsics[:2, :2] /= 2
    intrinsics[:2, 2] = (intrinsics[:2, 2] + 0.5) / 2 - 0.5
    seen = points_mm @ pose[:, :3].T + pose[:, 3]
    return (seen @ intrinsics.T)[:, :2] / seen[:, 2:]


def test_what_we_write_reads_as_the_format_is_described(exported):
    """Transposed matrices, millimetres, twice the sensor, AVIF and PNG members at their places, labels, tables, 6 + D pose values."""
    capture, path = exported
    document = json.loads((path / "camera_calibration.json").read_text())["KRT"]
    for entry in document:
        camera = capture.cameras[entry["cameraId"]]
        points = 1000.0 * np.array(capture.vertices[1], dtype=np.float64)
        np.testing.assert_allclose(described_projection(entry, points), camera.project(capture.vertices[1])[0] - 0.5, atol=1e-6)
        assert len(entry["distortion"]) == 4 and entry["T"][0][3] == 0.0 and abs(entry["T"][3][2]) > 500
        with zipfile.ZipFile(path / f"image/cam{camera.name}.zip") as archive:
            assert archive.namelist() == [f"cam{camera.name}/{number:06d}.avif" for number in (100, 101, 105, 106)]
            assert archive.infolist()[0].compress_type == zipfile.ZIP_STORED
            image = np.array(Image.open(io.BytesIO(archive.read(archive.namelist()[2]))))
        np.testing.assert_allclose(image / 255.0, capture.image(camera.name, 2), atol=0.06)
        with zipfile.ZipFile(path / f"segmentation_parts/cam{camera.name}.zip") as archive:
            labels = np.array(Image.open(io.BytesIO(archive.read(f"cam{camera.name}/000106.png"))))
        np.testing.assert_array_equal(labels, capture.mask(camera.name, 3) > 0.5)
    assert (path / "frame_splits_list.csv").read_text().splitlines() == ["frame,split", "100,train", "101,train", "105,train", "106,test"]
    assert "105,turn" in (path / "frame_segments_list.csv").read_text()
    with zipfile.ZipFile(path / "kinematic_tracking/pose.zip") as archive:
        assert len(archive.read("pose/000100.txt").split()) == 6 + 5


def test_the_reader_gives_back_the_capture(exported, tmp_path):
    """Cameras, splits, images, masks, meshes, keypoints, rig and poses; zips are not unpacked, and nothing is written beside them."""
    capture, path = exported
    before = sorted(entry.name for entry in path.rglob("*"))
    source = GoliathSource(path)
    assert source.info.name == NAME and source.info.colour_curve == "linear" and not source.info.missing and not source.info.lacks
    assert [(frame.number, frame.split, frame.segment) for frame in source.info.frames] == [
        (frame.number, frame.split, frame.segment) for frame in capture.frames
    ]
    for name, camera in capture.cameras.items():
        read = source.info.cameras[name]
        np.testing.assert_allclose(read.camera_from_world, camera.camera_from_world, atol=1e-9)
        np.testing.assert_allclose([read.fx, read.fy, read.cx, read.cy], [camera.fx, camera.fy, camera.cx, camera.cy], atol=1e-9)
        np.testing.assert_array_equal(source.mask(name, 1) == 255, capture.mask(name, 1) > 0.5)
        np.testing.assert_allclose(source.image(name, 1) / 255.0, capture.image(name, 1), atol=0.06)
    np.testing.assert_allclose(source.vertices(2), capture.vertices[2], atol=1e-6)
    np.testing.assert_allclose(source.keypoints(2), capture.keypoints[2], atol=1e-6)
    scan, faces = source.scan(3)
    np.testing.assert_allclose(scan, capture.vertices[3], atol=1e-6)
    assert faces.shape == (512, 3)
    np.testing.assert_allclose(source.ambient_occlusion(2)[-1, -1], 0.7, atol=3e-3)
    np.testing.assert_allclose(source.mean_ambient_occlusion()[-1, -1], 0.65, atol=3e-3)
    assert source.mean_texture() is None and source.pose(0).shape == (11,)
    assert sorted(entry.name for entry in path.rglob("*")) == before


def test_the_mesh_projects_onto_the_masks(exported):
    capture, path = exported
    source = GoliathSource(path)
    faces = load_rig(capture.rig_path).topology.faces
    for name, camera in source.info.cameras.items():
        drawn, mask = silhouette(camera, source.vertices(3), faces), source.mask(name, 3) > 0
        assert (drawn & mask).sum() / (drawn | mask).sum() > 0.98


def scaled_without_shift(entry):
    """What readers do that divide the principal point by two and forget the half pixel."""
    matrix = np.array(entry["K"])
    matrix[2, :2] = 2 * (matrix[2, :2] / 2 + 0.5) - 0.5
    entry["K"] = matrix.tolist()


def test_forgetting_the_half_pixel_shift_moves_everything_by_a_quarter(exported, folder):
    points = np.array(exported[0].vertices[0])
    right = GoliathSource(exported[1]).info.cameras["left"].project(points)[0]
    edit_calibration(folder, scaled_without_shift)
    wrong = GoliathSource(folder).info.cameras["left"].project(points)[0]
    np.testing.assert_allclose(wrong - right, 0.25, atol=1e-6)


def transpose(key):
    def change(entry):
        entry[key] = np.array(entry[key]).T.tolist()

    return change


def halve(entry):
    entry["K"] = (np.array(entry["K"]) * np.array([[0.5], [0.5], [1.0]]) * np.array([1, 1, 1.0])).tolist()
    entry["K"][2] = [entry["K"][2][0] / 2, entry["K"][2][1] / 2, 1.0]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (transpose("K"), "expected K and T of front .* stored transposed"),
        (transpose("T"), "expected K and T of front .* stored transposed"),
        (halve, "expected K of front .* for 192x144 pixels, twice the images' size"),
        (lambda entry: entry.update(K=[[1, 2], [3, 4]]), "expected K of 3x3 and T of 4x4 numbers for front"),
        (lambda entry: entry.pop("T"), "expected {'KRT': .*camera_calibration.json"),
    ],
)
def test_calibrations_that_are_not_as_described_are_refused(folder, change, message):
    edit_calibration(folder, change)
    with pytest.raises(ValueError, match=message):
        GoliathSource(folder)


def test_lens_coefficients_are_ignored_as_the_data_set_does_unless_asked(folder, tmp_path):
    edit_calibration(folder, lambda entry: entry.update(distortion=[-0.2, 0.03, 0.001, -0.001]))
    source = GoliathSource(folder)
    assert not source.info.lenses and "lens distortion of 3 cameras ignored" in source.info.notes[0]
    applied = GoliathSource(folder, SourceOptions(distortion="apply"))
    assert applied.info.lenses["left"].coefficients == (-0.2, 0.03, 0.001, -0.001)
    assert read_report(convert(applied, tmp_path / "out").path)["remapped_cameras"] == ["front", "left", "high"]


def test_frames_with_missing_files_are_left_out_with_the_reason(folder, tmp_path):
    edit_zip(folder / "image/camleft.zip", lambda name, data: None if "000101" in name else data)
    edit_zip(folder / "kinematic_tracking/pose.zip", lambda name, data: None if "000105" in name else data)
    capture = convert(GoliathSource(folder), tmp_path / "out")
    assert [frame.number for frame in capture.frames] == [100, 106]
    assert read_report(capture.path)["missing_frames"] == {"101": "no image of left", "105": "no pose"}


def test_tables_with_a_byte_order_mark_and_windows_line_ends_are_read(folder):
    path = folder / "frame_splits_list.csv"
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes().replace(b"\n", b"\r\n").replace(b",", b", "))
    assert [frame.split for frame in GoliathSource(folder).info.frames] == ["train", "train", "train", "test"]
    path.write_text("number;split\n1;train\n")
    with pytest.raises(ValueError, match="expected the columns frame,split in .*frame_splits_list.csv; got 'number;split'"):
        GoliathSource(folder)


def test_unpacked_folders_read_like_their_zips(folder):
    for path in (folder / "image/camleft.zip", folder / "kinematic_tracking/pose.zip"):
        with zipfile.ZipFile(path) as archive:
            archive.extractall(path.parent if "cam" in path.name else path.with_suffix(""))
        path.unlink()
    source = GoliathSource(folder)
    assert source.image("left", 3).shape == (72, 96, 3) and source.pose(3, 11) is not None


def flip_middle(path):
    """Damage the bytes in the middle of a zip, where its members lie."""
    data = bytearray(path.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 40] = bytes(255 - value for value in data[middle : middle + 40])
    path.write_bytes(bytes(data))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda folder: flip_middle(folder / "image/camleft.zip"), "expected a whole member .*camleft.zip:camleft/.*got a damaged one"),
        (
            lambda folder: edit_zip(folder / "image/camhigh.zip", lambda name, data: data[:200] if "000105" in name else data),
            "expected a whole image in .*camhigh.zip:camhigh/000105.avif; got 200 bytes",
        ),
        (
            lambda folder: edit_zip(
                folder / "kinematic_tracking/registration_vertices.zip", lambda name, data: data[:900] if "000105" in name else data
            ),
            "expected a whole PLY mesh in .*registration_vertices/000105.ply",
        ),
    ],
)
def test_damaged_members_stop_the_conversion_unfinished(folder, damage, message, tmp_path):
    from mitsuba_avatar.captures.formats.conversion import ConversionOptions

    damage(folder)
    with pytest.raises(ValueError, match=message):
        convert(GoliathSource(folder), tmp_path / "out", ConversionOptions(writes_vertices=True))
    assert (tmp_path / "out/capture.unfinished.yaml").is_file() and not (tmp_path / "out/capture.yaml").exists()


def test_a_truncated_zip_is_named(folder):
    path = folder / "image/camleft.zip"
    path.write_bytes(path.read_bytes()[:-30])
    with pytest.raises(ValueError, match="expected a whole zip at .*camleft.zip; got .* bytes"):
        GoliathSource(folder)


def test_cameras_without_images_are_left_out_and_those_asked_for_must_be_there(folder):
    (folder / "image/camleft.zip").unlink()
    source = GoliathSource(folder)
    assert list(source.info.cameras) == ["front", "high"] and source.info.notes[0] == "cameras without images: left"
    with pytest.raises(ValueError, match=r"expected images of \['left'\] .*got none for \['left'\]"):
        GoliathSource(folder, SourceOptions(cameras=("left",)))
    shutil.copy(folder / "image/camhigh.zip", folder / "image/camother.zip")
    with pytest.raises(ValueError, match=r"expected calibration of every camera with images .*got none for \['other'\]"):
        GoliathSource(folder)
    assert list(GoliathSource(folder, SourceOptions(cameras=("high",))).info.cameras) == ["high"]


def test_keypoints_of_an_unknown_schema_are_left_out_with_a_note(folder):
    edit_zip(folder / "keypoints_3d/keypoints_3d.zip", lambda name, data: b'{"bodies": [{"joints": 3}]}')
    source = GoliathSource(folder)
    assert source.keypoints(0) is None and "unknown schema of 000100.json" in source.info.notes[-1]
    edit_zip(
        folder / "keypoints_3d/keypoints_3d.zip", lambda name, data: b'{"nose": [100, 200, 300, 0.5], "ear": {"x": 1, "y": 2, "z": 3}}'
    )
    source = GoliathSource(folder)
    assert source.info.keypoint_names == ("nose", "ear")
    np.testing.assert_allclose(source.keypoints(1), [[0.1, 0.2, 0.3, 0.5], [0.001, 0.002, 0.003, 1.0]], atol=1e-6)


def test_another_world_and_another_model_of_104_values(exported, folder):
    """A floor transform and a world with Y up: the mesh lies where the cameras see it; poses of another model are refused by name."""
    turn = np.array([[1.0, 0, 0, 30.0], [0, 0, 1, -20.0], [0, -1, 0, 40.0], [0, 0, 0, 1]])  # native_from_ours, millimetres

    def moved(entry):
        pose = np.array(entry["T"]).T @ np.linalg.inv(turn)
        entry["T"] = pose.T.tolist()

    edit_calibration(folder, moved)
    (folder / "floor_transformation.txt").write_text("\n".join(" ".join(map(str, row)) for row in np.eye(4)[:3]))
    source = GoliathSource(folder)
    np.testing.assert_allclose(
        source.info.cameras["left"].camera_from_world[:3, :3], exported[0].cameras["left"].camera_from_world[:3, :3], atol=1e-9
    )
    (folder / "floor_transformation.txt").write_text("\n".join(" ".join(map(str, row)) for row in np.linalg.inv(turn)[:3]))
    floor = GoliathSource(folder)
    np.testing.assert_allclose(floor.info.cameras["left"].camera_from_world, exported[0].cameras["left"].camera_from_world, atol=1e-9)
    model = make_momentum_model(with_scales=False)
    save_momentum(folder / "shared/static_assets_body.npz", model)
    with pytest.raises(ValueError, match=r"expected 104 finite numbers in .*pose.zip:pose/000100.txt; got 11"):
        GoliathSource(folder).tracking()
    poses = iter(random_poses(4))
    edit_zip(folder / "kinematic_tracking/pose.zip", lambda name, data: "\n".join(map(repr, map(float, next(poses)))).encode())
    assert GoliathSource(folder).tracking().poses.shape == (4, 104)


def test_exports_resume_and_never_look_whole_before_they_are(exported, tmp_path, monkeypatch):
    capture, _ = exported
    path = tmp_path / NAME
    broken = dataclasses.replace(capture.cameras["high"], distortion=(0.1, 0.0, 0.0, 0.0))
    with monkeypatch.context() as patch:
        patch.setitem(capture.cameras, "high", broken)
        with pytest.raises(ValueError, match=r"distortion of \['high'\]"):
            write(capture, path)
    with monkeypatch.context() as patch:
        patch.setattr(
            "mitsuba_avatar.captures.formats.goliath_writer._write_tables", lambda *_: (_ for _ in ()).throw(OSError("disk full"))
        )
        with pytest.raises(OSError, match="disk full"):
            write(capture, path)
    with pytest.raises(FileNotFoundError, match="camera_calibration.json"):
        GoliathSource(path)
    stamp = (path / "image/camleft.zip").stat().st_mtime_ns
    write(capture, path)
    assert (path / "image/camleft.zip").stat().st_mtime_ns == stamp and len(GoliathSource(path).info.frames) == 4
    with pytest.raises(FileExistsError, match="got a finished capture"):
        write(capture, path)
    with pytest.raises(ValueError, match="expected a folder name with 'Body'"):
        write_goliath(capture, tmp_path / "plain", None)
