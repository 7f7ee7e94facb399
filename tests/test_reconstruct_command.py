"""`python -m mitsuba_avatar.reconstruct`: errors before and after, files that `drive` reads, and going on where it stopped."""

import json
import shutil

import numpy as np
import pytest

from mitsuba_avatar import drive
from mitsuba_avatar.captures.images import read_image
from mitsuba_avatar.reconstruct import METHODS, main

pytestmark = pytest.mark.usefixtures("one_thread")

SHORT = ("--frames", "2", "--steps", "12", "--views-per-step", "3")


def test_reconstruction_reports_errors_and_writes_what_drive_reads(fitted_run, private_cache, tmp_path, capsys):
    out = tmp_path / "out"
    assert main([str(fitted_run), *SHORT, "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    assert all(f"{method} " in printed for method in METHODS) and printed.strip().endswith(str(out))
    report = json.loads((out / "reconstruction.json").read_text())
    errors = {method: report["means"][method]["test"] for method in METHODS}
    assert errors["reconstructed"]["seen"]["mse"] < errors["driven"]["seen"]["mse"]
    assert {"psnr", "ssim", "iou", "vertex_mm"} <= errors["driven"]["held_out"].keys() and errors["driven"]["held_out"]["images"] == 2
    assert [row["frame"] for row in report["frames"]] == [28, 29] and report["cameras_held_out"] == ["above"]
    assert read_image(out / "reconstruction.png").ndim == 3
    codes = np.load(out / "z.npy")
    assert np.load(out / "theta.npy").shape == (2, 5) and codes.any() and np.load(out / "frames.npy").tolist() == [28, 29]
    words = ("--pose", str(out), "--latents", str(out / "z.npy"), "--width", "30", "--height", "44")
    assert drive.main([str(fitted_run), *words, "--out", str(tmp_path / "again")]) == 0
    assert json.loads((tmp_path / "again/drive.json").read_text())["frames"] == 2


def test_a_second_call_keeps_what_is_done_and_does_the_rest(fitted_run, private_cache, tmp_path, capsys):
    out = tmp_path / "out"
    words = (str(fitted_run), "--steps", "4", "--start", "previous", "--out", str(out))
    assert main([*words, "--frames", "1"]) == 0
    stamp = (out / "frames/000028.npz").stat().st_mtime_ns
    assert main([*words, "--frames", "2"]) == 0
    assert (out / "frames/000028.npz").stat().st_mtime_ns == stamp
    first, second = (np.load(out / f"frames/{number:06d}.npz") for number in (28, 29))
    np.testing.assert_array_equal(second["start_theta"], first["theta"])
    np.testing.assert_array_equal(second["start_z"], first["z"])
    capsys.readouterr()
    assert main([*words, "--frames", "2", "--pull", "0.5"]) == 2
    assert "expected pull = 0.001, with which" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--frames", "-1"], "expected --frames of 0 or more"),
        (["--first", "3"], "expected --first among frames 28..29 of split test; got 3"),
        (["--steps", "0"], "expected steps of at least 1"),
        (["--capture", "/nowhere"], "/nowhere; got none"),
        (["--out", "/dev/null/out"], "got /dev/null, which is a file"),
    ],
)
def test_bad_input_is_one_line(fitted_run, private_cache, tmp_path, capsys, words, message):
    assert main([str(fitted_run), "--out", str(tmp_path / "out"), *words]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("reconstruct: ") and message in line


def test_a_mesh_that_is_not_there_is_named(fitted_run, drawn_capture, private_cache, tmp_path, capsys):
    shutil.copytree(drawn_capture.path, tmp_path / "copy")
    (tmp_path / "copy/vertices.npy").unlink()
    words = (str(fitted_run), "--capture", str(tmp_path / "copy"), *SHORT)
    assert main([*words, "--mesh", "--out", str(tmp_path / "out")]) == 2
    assert "expected a registered mesh" in capsys.readouterr().err
    assert main([*words, "--out", str(tmp_path / "other")]) == 0, "images alone are enough"
