"""`python -m mitsuba_avatar.capture`: what it prints, what it draws, and that it fails with the trap's name."""

import json
import shutil

import numpy as np
import pytest
from PIL import Image

from mitsuba_avatar.capture import main
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
