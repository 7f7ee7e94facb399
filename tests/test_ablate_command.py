"""The ablation command from end to end, on a small capture with a small avatar."""

import json
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import contextmanager
from pathlib import Path

import pytest
import yaml

from mitsuba_avatar.ablate import main
from mitsuba_avatar.ablation import worker
from mitsuba_avatar.ablation.plan import PlannedRun
from mitsuba_avatar.presets import resolve
from mitsuba_avatar.training.run_folder import RunFolder

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
    assert all(row["measures"]["training_seconds"] > 0 and row["measures"]["num_skipped"] == 0 for row in rows)
    assert len(rows[0]["measures"]["capture_digest"]) == 64
    settings = yaml.safe_load((tmp_path / "out" / "ours" / "seed_0" / "settings.yaml").read_text())
    assert settings["training"]["iterations"] == 4 and settings["model"]["use_localization"]

    made = (tmp_path / "out" / "ours" / "seed_0" / "measures.json").stat().st_mtime_ns
    assert main(words) == 0
    assert (tmp_path / "out" / "ours" / "seed_0" / "measures.json").stat().st_mtime_ns == made


@pytest.mark.usefixtures("one_thread")
def test_a_run_that_was_stopped_goes_on_from_its_checkpoint(drawn_capture, tmp_path: Path, private_cache, monkeypatch):
    """The first worker is stopped after iteration 3 of 10, in this process; the second one is real. A rehearsal, because it is fast."""
    words = ["--capture", str(drawn_capture.path), "--out", str(tmp_path), "--rows", "pose_face", "--rehearsal", *SMALL]
    words += ["training.iterations=10", "training.checkpoint_every=100", "evaluation.frames_per_split=2"]
    run = tmp_path / "pose_face" / "seed_0"
    answers = iter([False, False, True])

    @contextmanager
    def interrupts():
        yield lambda: next(answers)

    def stop_in_mid_row(planned: list[PlannedRun], jobs: int, progress: Callable[[int, int], None]) -> None:
        assert worker._work(planned[0]) == 130
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("mitsuba_avatar.fitting.interrupts", interrupts)
        patch.setattr("mitsuba_avatar.fitting.LOG_EVERY", 3)
        patch.setattr("mitsuba_avatar.training.loop.Trainer.seconds", 1000.0)
        patch.setattr("mitsuba_avatar.ablate.run_workers", stop_in_mid_row)
        assert main(words) == 130
    assert not (run / "measures.json").exists() and (tmp_path / "table.json").read_text() == "[]\n"
    log = (run / "metrics.jsonl").read_text()
    stopped_at, state = RunFolder.open(run).checkpoints.load_training()
    assert stopped_at == 3 and state["seconds"] == 1000.0 and json.loads(log)["iteration"] == 3

    assert main(words) == 0
    lines = (run / "metrics.jsonl").read_text()
    assert lines.startswith(log), "a run that began anew would have written this line anew, with other times"
    assert [json.loads(line)["iteration"] for line in lines.splitlines()] == [3, 10]
    finished_at, finished = RunFolder.open(run).checkpoints.load_training()
    assert finished_at == 10 and finished["guard"]["accepted"] == 10
    (row,) = json.loads((tmp_path / "table.json").read_text())
    assert row["name"] == "pose_face" and row["test"] > 0 and row["measures"]["iterations"] == 10
    assert 1000.0 < row["measures"]["training_seconds"] < 1500.0, "both sessions count"
    assert "| pose+face |" in (tmp_path / "table.md").read_text()


def test_a_capture_that_was_filmed_again_is_refused(drawn_capture, tmp_path: Path, monkeypatch, capsys: pytest.CaptureFixture):
    """Nothing is trained here: a run counts as begun by its checkpoint."""
    monkeypatch.setattr("mitsuba_avatar.ablate.run_workers", lambda *arguments: None)
    capture, run = tmp_path / "capture", tmp_path / "out" / "ours" / "seed_0"
    shutil.copytree(drawn_capture.path, capture)
    words = ["--capture", str(capture), "--out", str(tmp_path / "out"), "--rows", "ours"]
    assert main(words) == 0
    (run / "checkpoints").mkdir()
    (run / "checkpoints" / "checkpoints.json").write_text("{}")
    assert main(words) == 0
    (capture / "frames.csv").write_text((capture / "frames.csv").read_text().replace("train", "test", 1))
    capsys.readouterr()
    assert main(words) == 2
    told = capsys.readouterr().err
    assert f"expected {run} to be new or of the capture that is in {capture} now" in told and "Name another folder with --out" in told


def test_a_data_set_that_is_read_in_place_has_no_digest(drawn_capture, tmp_path: Path, monkeypatch):
    """Its folder in the cache is named after the state of the data set, and path and settings are compared."""
    monkeypatch.setattr("mitsuba_avatar.ablate.run_workers", lambda *arguments: None)
    monkeypatch.setattr("mitsuba_avatar.ablate.capture_folder", lambda name, track: drawn_capture.path)
    assert main(["--capture", "goliath:somewhere", "--out", str(tmp_path / "out"), "--rows", "ours"]) == 0
    assert not (tmp_path / "out" / "ours").exists()
    assert main(["--capture", str(drawn_capture.path), "--out", str(tmp_path / "out"), "--rows", "ours"]) == 0
    assert (tmp_path / "out" / "ours" / "seed_0" / "capture.json").is_file()


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
