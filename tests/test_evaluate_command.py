"""`python -m mitsuba_avatar.evaluate`: the table and metrics.json of a finished run, and what it says about bad input."""

import json
import shutil

import numpy as np
import pytest
from safetensors.torch import save_file

from mitsuba_avatar.evaluate import main
from mitsuba_avatar.reporting.evaluation import METHODS
from mitsuba_avatar.reporting.metrics import load_metrics, load_pictures
from tests.reporting.test_lpips import random_weights

pytestmark = pytest.mark.usefixtures("one_thread")


def test_evaluation_repeats_what_the_fit_measured(fitted_run, private_cache, tmp_path, capsys):
    assert main([str(fitted_run), "--out", str(tmp_path / "metrics.json")]) == 0
    again, first = load_metrics(tmp_path / "metrics.json"), load_metrics(fitted_run / "metrics.json")
    for method in METHODS:
        for split in ("train", "test"):
            for cameras in ("seen", "held_out"):
                for name, value in first[method][split][cameras].items():
                    assert again[method][split][cameras][name] == pytest.approx(value, rel=1e-3, abs=1e-3), (method, split, cameras, name)
    table = capsys.readouterr().out
    assert [line for line in table.splitlines() if line.startswith("protocol")] == ["protocol mask", "protocol image", "protocol box"]
    assert {"flip", "box_flip", "image_ssim", "seam", "flicker"} <= set(again["avatar"]["test"]["seen"])
    assert len([row for row in load_pictures(tmp_path / "metrics.csv") if "psnr" in row]) == 3 * 5 * 4
    assert all(f"{method} " in table for method in METHODS) and "held_out" in table and "PSNR (dB)" in table


def test_frames_and_checkpoint_can_be_chosen(fitted_run, private_cache, tmp_path):
    shutil.copytree(fitted_run, tmp_path / "run")
    assert main([str(tmp_path / "run"), "--frames", "1", "--checkpoint", "last", "--no-flip", "--protocols", "box"]) == 0
    values = load_metrics(tmp_path / "run/metrics.json")["avatar"]["train"]["seen"]
    assert values["images"] == 4 and "box_psnr" in values and "psnr" not in values and "box_flip" not in values


def test_held_out_cameras_are_those_of_the_run(fitted_run, private_cache, tmp_path):
    """A run that held another camera out is not judged by the capture's own list."""
    shutil.copytree(fitted_run, tmp_path / "run")
    settings = tmp_path / "run/settings.yaml"
    settings.write_text(settings.read_text().replace("held_out_cameras: []", "held_out_cameras: [left, back]"))
    assert main([str(tmp_path / "run"), "--frames", "1"]) == 0
    images = {cameras: values["images"] for cameras, values in load_metrics(tmp_path / "run/metrics.json")["avatar"]["test"].items()}
    assert images == {"seen": 3, "held_out": 2}


def forget_checkpoints(run):
    shutil.rmtree(run / "checkpoints")


def lose_capture(run):
    facts = json.loads((run / "run.json").read_text())
    (run / "run.json").write_text(json.dumps(facts | {"capture": str(run / "gone")}))


@pytest.mark.parametrize(
    ("damage", "words", "message"),
    [
        (lambda run: (run / "rig.npz").unlink(), [], "expected a run with rig.npz in"),
        (forget_checkpoints, [], "no checkpoint in"),
        (lose_capture, [], "/gone; got none"),
        (lambda run: None, ["--frames", "-1"], "expected --frames of at least 1"),
        (lambda run: None, ["--flicker-frames", "-2"], "expected --flicker-frames of 0 or more"),
        (lambda run: None, ["--checkpoint", "newest"], "expected checkpoint 'best' or 'last'; got 'newest'"),
        (lambda run: None, ["--out", "/dev/null/metrics.json"], "got /dev/null, which is a file"),
        (lambda run: None, ["--variant", "scalar_rgb"], "scalar_rgb"),
    ],
)
def test_bad_input_is_one_line(fitted_run, private_cache, tmp_path, capsys, damage, words, message):
    shutil.copytree(fitted_run, tmp_path / "run")
    damage(tmp_path / "run")
    assert main([str(tmp_path / "run"), *words]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("evaluate: ") and message in line


def test_another_face_signal_is_refused(fitted_run, drawn_capture, private_cache, tmp_path, capsys):
    shutil.copytree(drawn_capture.path, tmp_path / "copy")
    np.save(tmp_path / "copy/face.npy", np.zeros((len(drawn_capture.frames), 5), np.float32))
    assert main([str(fitted_run), "--capture", str(tmp_path / "copy"), "--out", str(tmp_path / "metrics.json")]) == 2
    assert "expected a face signal of 3 numbers" in capsys.readouterr().err and not (tmp_path / "metrics.json").exists()


def test_lpips_is_measured_with_the_weights_of_a_file(fitted_run, private_cache, tmp_path, capsys):
    weights, out = tmp_path / "alex.safetensors", tmp_path / "metrics.json"
    words = [str(fitted_run), "--frames", "1", "--flicker-frames", "0", "--no-flip", "--out", str(out), "--lpips", str(weights)]
    assert main(words) == 2
    assert f"expected a file of weights at {weights}; got none" in capsys.readouterr().err
    save_file(random_weights(), weights)
    assert main(words) == 0 and "LPIPS ↓" in capsys.readouterr().out
    means = load_metrics(out)
    for name in ("lpips", "image_lpips", "box_lpips"):
        assert 0 < means["avatar"]["train"]["seen"][name] < 1
