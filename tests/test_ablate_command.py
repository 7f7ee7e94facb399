"""The ablation command from end to end, on a small capture with a small avatar."""

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import yaml

from mitsuba_avatar.ablate import main
from mitsuba_avatar.presets import resolve

SMALL = [
    f"model.{key}={','.join(map(str, value)) if isinstance(value, list | tuple) else value}"
    for key, value in vars(resolve("tiny").model).items()
    if not key.startswith("use_")
]
SHORT = [
    "training.iterations=4",
    "training.checkpoint_every=2",
    "training.validate_every=4",
    "training.preview_every=4",
    "training.views_per_pose=2",
    "evaluation.frames_per_split=2",
    "evaluation.samples_per_pixel=4",
    "rendering.ambient_occlusion_rays=16",
]


def test_rows_are_trained_measured_and_tabled_once(drawn_capture, tmp_path: Path, private_cache, capsys: pytest.CaptureFixture):
    words = [
        "--capture",
        str(drawn_capture.path),
        "--out",
        str(tmp_path / "out"),
        "--rows",
        "pose_face,ours",
        "--jobs",
        "2",
        *SMALL,
        *SHORT,
    ]
    assert main(words) == 0
    rows = json.loads((tmp_path / "out" / "table.json").read_text())
    assert [(row["name"], row["seed"]) for row in rows] == [("ours", 0), ("pose_face", 0)]
    assert all(0 < row["train"] < 5000 and 0 < row["test"] < 5000 for row in rows)
    assert "kl_nats" in rows[0]["measures"]["disentanglement"] and "kl_nats" not in rows[1]["measures"]["disentanglement"]
    assert "| pose+face |" in capsys.readouterr().out
    settings = yaml.safe_load((tmp_path / "out" / "ours" / "seed_0" / "settings.yaml").read_text())
    assert settings["training"]["iterations"] == 4 and settings["model"]["use_localization"]

    made = (tmp_path / "out" / "ours" / "seed_0" / "measures.json").stat().st_mtime_ns
    assert main(words) == 0
    assert (tmp_path / "out" / "ours" / "seed_0" / "measures.json").stat().st_mtime_ns == made


@pytest.mark.slow
def test_a_rehearsal_learns_from_meshes_alone(drawn_capture, tmp_path: Path, private_cache):
    words = ["--capture", str(drawn_capture.path), "--out", str(tmp_path), "--rows", "pose_face", "--rehearsal", *SMALL, *SHORT]
    assert main([word for word in words if "views_per_pose" not in word]) == 0
    row = json.loads((tmp_path / "table.json").read_text())[0]
    assert "images" not in row["measures"] and row["test"] == row["measures"]["geometry"]["test"]["driven_mm"] > 0


@pytest.mark.slow
def test_a_worker_that_fails_is_told_with_its_log(drawn_capture, tmp_path: Path, private_cache, capsys: pytest.CaptureFixture):
    words = [
        "--capture",
        str(drawn_capture.path),
        "--out",
        str(tmp_path / "out"),
        "--rows",
        "ours",
        *SMALL,
        *SHORT,
        "training.views_per_pose=9",
    ]
    assert main(words) == 2
    told = capsys.readouterr().err
    assert "seed_0 ended with status" in told and "views_per_pose" in told


@pytest.mark.slow
def test_workers_save_and_end_when_the_command_is_ended(drawn_capture, tmp_path: Path, private_cache):
    words = [
        "--capture",
        str(drawn_capture.path),
        "--out",
        str(tmp_path),
        "--rows",
        "pose_face",
        *SMALL,
        *SHORT,
        "training.iterations=4000",
    ]
    command = subprocess.Popen([sys.executable, "-m", "mitsuba_avatar.ablate", *words], stderr=subprocess.PIPE, text=True)
    checkpoints = tmp_path / "pose_face" / "seed_0" / "checkpoints" / "checkpoints.json"
    while not checkpoints.is_file():
        assert command.poll() is None
        time.sleep(0.2)
    command.send_signal(signal.SIGTERM)
    assert "interrupted; every run is saved" in command.communicate(timeout=60)[1] and command.returncode == 130
    stopped_at = json.loads(checkpoints.read_text())["last"]
    assert 0 < stopped_at < 4000
    stamp = checkpoints.stat().st_mtime_ns
    time.sleep(1.5)
    assert checkpoints.stat().st_mtime_ns == stamp  # nobody goes on unseen


@pytest.mark.parametrize(
    ("words", "message"),
    [(["--rows", "theirs"], "expected rows among"), (["--jobs", "-1"], "expected --jobs"), (["--budgett", "1"], "Did you mean '--budget'")],
)
def test_bad_words_are_refused(words: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture):
    assert main(["--out", str(tmp_path), *words]) == 2
    assert message in capsys.readouterr().err
