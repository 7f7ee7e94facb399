"""`python -m mitsuba_avatar.capture`: what it prints, what it draws, and that it fails with the trap's name."""

import json
import shutil

import numpy as np
import pytest
from PIL import Image

from mitsuba_avatar.body.rig import load_rig
from mitsuba_avatar.capture import main
from mitsuba_avatar.captures.folder import Capture
from mitsuba_avatar.captures.formats.goliath import GoliathSource
from tests.captures.formats.data_sets import write_thuman4
from tests.small_capture import write_small_capture


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Folder of a whole capture; not to be written to."""
    return write_small_capture(tmp_path_factory.mktemp("command") / "small").path


@pytest.fixture
def folder(whole, tmp_path):
    """Folder of a fresh copy."""
    shutil.copytree(whole, tmp_path / "copy")
    return tmp_path / "copy"


def check(folder, tmp_path, *options):
    """Run the check with its output kept out of the working folder."""
    return main(["check", str(folder), "--out", str(tmp_path / "out"), *options])


def test_info_names_what_is_there_and_what_is_missing(folder, capsys):
    (folder / "keypoints.npy").unlink()
    shutil.rmtree(folder / "masks")
    assert main(["info", str(folder)]) == 0
    text = capsys.readouterr().out
    for part in ("small: 3 cameras, 4 frames at 10 fps", "64x48", "held out", "CC0-1.0", "105 to 105", "12 of 12", "4x258x3"):
        assert part in text
    lines = text.splitlines()
    assert any("keypoints" in line and "missing" in line for line in lines) and any("masks" in line and "missing" in line for line in lines)


def test_check_passes_and_draws(whole, tmp_path, capsys):
    assert check(whole, tmp_path, "--frames", "2") == 0
    assert "The capture is fine" in capsys.readouterr().out
    sheet = np.array(Image.open(tmp_path / "out/small.png"))
    assert sheet.shape[1] > 3 * 512 and sheet.shape[0] > 2 * 384
    assert ((sheet == (255, 255, 255)).all(axis=2)).sum() > 500, "mesh and mask outlines fall together"


def test_check_poses_the_rig_where_there_is_no_registered_mesh(folder, tmp_path, capsys):
    (folder / "vertices.npy").unlink()
    assert check(folder, tmp_path) == 0
    assert "The capture is fine" in capsys.readouterr().out


def test_check_without_masks_says_what_to_do(folder, tmp_path, capsys):
    shutil.rmtree(folder / "masks")
    assert check(folder, tmp_path) == 0
    assert "There are no masks to compare with: look at the contact sheet" in capsys.readouterr().out
    assert (tmp_path / "out/copy.png").is_file()


def edit_cameras(folder, change):
    """Apply `change` to every entry of cameras.json."""
    document = json.loads((folder / "cameras.json").read_text())
    for entry in document["cameras"]:
        change(entry)
    (folder / "cameras.json").write_text(json.dumps(document))


def transpose_rotation(entry):
    pose = np.array(entry["camera_from_world"])
    pose[:3, :3] = pose[:3, :3].T
    entry["camera_from_world"] = pose.tolist()


def shift_half_a_pixel(entry):
    entry["cx"] -= 0.5
    entry["cy"] -= 0.5


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (transpose_rotation, "The likely trap: transposed rotation (undoing it gives 1.000). Transpose the upper left"),
        (
            shift_half_a_pixel,
            "The likely trap: half a pixel: the principal point counts from the first pixel's centre (undoing it gives 1.000)",
        ),
    ],
)
def test_check_fails_with_the_trap(folder, tmp_path, capsys, change, message):
    edit_cameras(folder, change)
    assert check(folder, tmp_path) == 1
    captured = capsys.readouterr()
    assert message in captured.err and "what if: " in captured.out and (tmp_path / "out/copy.png").is_file()


def test_check_names_one_wrong_camera(folder, tmp_path, capsys):
    """A camera that was knocked: nothing systematic, the others are right."""

    def knock(entry):
        if entry["name"] == "left":
            entry["camera_from_world"][0][3] += 0.35

    edit_cameras(folder, knock)
    assert check(folder, tmp_path) == 1
    assert "1 of 3 cameras below 0.7. Other cameras agree: calibration or images of left belong elsewhere" in capsys.readouterr().err


def invert_root(folder):
    np.save(folder / "root.npy", np.linalg.inv(np.load(folder / "root.npy")).astype(np.float32))


def test_check_names_an_inverted_root(folder, tmp_path, capsys):
    """Against the registered mesh, and, where there is none, against the masks."""
    invert_root(folder)
    assert check(folder, tmp_path) == 1
    error = capsys.readouterr().err
    assert "within 0.25 m of vertices.npy" in error and "The likely trap: inverted root pose" in error
    (folder / "vertices.npy").unlink()
    assert check(folder, tmp_path) == 1
    assert "The likely trap: inverted root pose (undoing it gives 1.000)" in capsys.readouterr().err


def test_check_names_poses_of_another_tracking(folder, tmp_path, capsys):
    root = np.load(folder / "root.npy")
    root[:, 2, 3] += 1.0
    np.save(folder / "root.npy", root)
    assert check(folder, tmp_path) == 1
    assert "got 1.00 m on average in frame index 0. Take pose.npy, root.npy and vertices.npy from the same" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("removed", "message"),
    [
        (["rig.npz"], "expected a rig at"),
        (["vertices.npy", "pose.npy"], "expected vertices.npy, or pose.npy and root.npy, in"),
        (["images/left/000105.png"], "images/left/000105.png; got none"),
        (["capture.yaml"], "got no capture.yaml"),
    ],
)
def test_check_names_what_is_missing(folder, tmp_path, capsys, removed, message):
    for name in removed:
        (folder / name).unlink()
    assert check(folder, tmp_path) == 1
    assert message in capsys.readouterr().err


def test_options_out_of_range_are_refused(whole, tmp_path, capsys):
    assert check(whole, tmp_path, "--frames", "0") == 1
    assert "expected at least 1 frame and 16 pixels; got 0 and 640" in capsys.readouterr().err


BODY_FOLDER = "s--20260101--0000--TST001--pilot--ProjectGoliath--ClothedBody--3cams"


def test_a_capture_goes_to_goliath_and_back_and_passes_the_check(whole, tmp_path, capsys):
    """Rig, poses, face signal and registered mesh come back; the posed rig lies on the mesh, the mesh on the masks."""
    exported = tmp_path / BODY_FOLDER
    assert main(["convert", "--to", "goliath", "--occlusion-size", "32", str(whole), str(exported)]) == 0
    assert "Wrote 3 cameras and 4 frames" in capsys.readouterr().out
    options = ["--held-out-cameras", "high", "--fps", "10", "--last-frame", "105"]
    assert main(["convert", "--from", "goliath", str(exported), str(tmp_path / "back"), *options]) == 0
    text = capsys.readouterr().out
    assert f"Wrote 3 cameras and 3 frames to {tmp_path / 'back'}" in text and "Missing for a fit" not in text
    assert check(tmp_path / "back", tmp_path, "--minimum-iou", "0.95") == 0
    assert "The capture is fine" in capsys.readouterr().out
    occlusion = GoliathSource(exported).ambient_occlusion(1)
    assert occlusion.shape == (32, 32) and 0.3 < occlusion.mean() < 1.0
    back, original = Capture.open(tmp_path / "back"), Capture.open(whole)
    np.testing.assert_allclose(back.theta, original.theta[:3], atol=1e-6)
    np.testing.assert_allclose(back.vertices, original.vertices[:3], atol=1e-6)
    assert back.description.held_out_cameras == ("high",) and back.face is not None
    assert load_rig(back.rig_path).dofs.names == load_rig(original.rig_path).dofs.names


def test_a_goliath_capture_is_described_checked_and_converted_in_place(whole, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("MITSUBA_AVATAR_CACHE", str(tmp_path / "cache"))
    exported = tmp_path / BODY_FOLDER
    assert main(["convert", "--to", "goliath", str(whole), str(exported)]) == 0
    zips = sorted(exported.rglob("*"))
    assert main(["info", f"goliath:{exported}"]) == 0
    text = capsys.readouterr().out
    assert f"read in place from goliath:{exported}" in text and "12 of 12" in text and "theta (pose.npy)" in text
    assert main(["check", f"goliath:{exported}", "--minimum-iou", "0.95", "--out", str(tmp_path / "sheets")]) == 0
    assert "The capture is fine" in capsys.readouterr().out
    assert main(["convert", "--from", "goliath", "--in-place", "--every", "2", str(exported), str(tmp_path / "own")]) == 0
    assert f"Images stay in {exported}" in capsys.readouterr().out
    capture = Capture.open(tmp_path / "own", image_scale=0.5)
    assert len(capture.frames) == 2 and capture.theta is not None and capture.image("left", 1).shape == (24, 32, 3)
    assert not list((tmp_path / "own").rglob("*.avif")) and sorted(exported.rglob("*")) == zips
    (exported / "shared").rename(tmp_path / "elsewhere")
    assert main(["check", f"goliath:{exported}"]) == 1 and "expected a rig at" in capsys.readouterr().err
    (tmp_path / "elsewhere").rename(tmp_path / "shared")  # beside the capture, and found when it comes later
    assert main(["check", f"goliath:{exported}", "--frames", "1", "--out", str(tmp_path / "sheets")]) == 0
    assert main(["info", f"golliath:{exported}"]) == 1
    assert "FORMAT one of goliath, actorshq" in capsys.readouterr().err


def test_converting_without_a_body_says_what_is_missing(tmp_path, capsys):
    (tmp_path / "data").mkdir()
    write_thuman4(tmp_path / "data")
    assert main(["convert", "--from", "thuman4", str(tmp_path / "data"), str(tmp_path / "out"), "--every", "2", "--scale", "0.5"]) == 0
    text = capsys.readouterr().out
    assert "Wrote 3 cameras and 2 frames" in text and "Undistorted or resized: images of 3 cameras" in text
    assert "Missing for a fit: the body: rig.npz, pose.npy" in text and "mitsuba_avatar.register" in text


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "expected --from FORMAT or --to goliath; got None and None"),
        (["--from", "zju", "--to", "goliath"], "expected --from FORMAT or --to goliath; got zju and goliath"),
        (["--from", "zju"], "expected a file at"),
        (["--from", "actorshq", "--up", "x"], "calibration.csv; got none"),
        (["--to", "goliath"], "expected a folder name with 'Body'"),
        (["--to", "goliath", "--in-place"], "expected --in-place with --from FORMAT"),
    ],
)
def test_conversions_that_cannot_be_are_named(whole, tmp_path, capsys, words, message):
    assert main(["convert", *words, str(whole), str(tmp_path / "out")]) == 1
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out/capture.yaml").exists()
