"""The run folder: what is written comes back, and what does not belong to the run is refused."""

import dataclasses
import json

import numpy as np
import pytest
import torch

from mitsuba_avatar.captures.folder import Capture
from mitsuba_avatar.model.avatar import Avatar, DrivingStatistics
from mitsuba_avatar.presets import resolve
from mitsuba_avatar.training.run_folder import RunFolder
from tests.small_rig import make_small_rig


@pytest.fixture
def run(tmp_path, rig, drawn_capture):
    return RunFolder.create(tmp_path / "run", resolve("tiny"), rig, drawn_capture.path, face_size=3)


def save_checkpoint(run, iteration=5):
    avatar = Avatar(run.rig, run.settings.model, DrivingStatistics.neutral(run.rig, run.face_size, run.settings.model.texture_size))
    avatar.mean_texture += 0.25
    run.checkpoints.save(avatar.state_dict(), {"optimizer": {}}, iteration, None)
    return avatar


def test_a_run_comes_back(run, rig, drawn_capture):
    avatar = save_checkpoint(run)
    again = RunFolder.open(run.path)
    assert again.settings == run.settings and again.rig.fingerprint == rig.fingerprint and again.face_size == 3
    assert again.capture_path == drawn_capture.path
    loaded = again.load_avatar("last")
    assert not loaded.training
    for name, value in avatar.state_dict().items():
        torch.testing.assert_close(loaded.state_dict()[name], value, rtol=0, atol=0)


def test_a_run_with_a_checkpoint_is_not_written_over(run, rig, drawn_capture):
    RunFolder.create(run.path, run.settings, rig, drawn_capture.path, 3)  # one that never got that far may be begun again
    save_checkpoint(run)
    with pytest.raises(FileExistsError, match=r"expected a new run at .*run; got one\. Continue it with --resume, or name another"):
        RunFolder.create(run.path, run.settings, rig, drawn_capture.path, 3)


def test_a_place_that_cannot_be_written_is_refused(tmp_path, rig, drawn_capture):
    (tmp_path / "file").write_text("not a folder")
    with pytest.raises(PermissionError, match=r"expected a folder at .*file/runs/a; got .*/file, which is a file\. Name another place"):
        RunFolder.create(tmp_path / "file/runs/a", resolve("tiny"), rig, drawn_capture.path, 3)


@pytest.mark.parametrize("name", ["settings.yaml", "rig.npz", "run.json"])
def test_a_missing_piece_is_named(run, name):
    (run.path / name).unlink()
    with pytest.raises(FileNotFoundError, match=rf"expected a run with {name} in .*run; got none"):
        RunFolder.open(run.path)


@pytest.mark.parametrize("text", ['{"capture": "/x", "face_', json.dumps({"capture": "x"})])
def test_damaged_facts_are_named(run, text):
    (run.path / "run.json").write_text(text)
    with pytest.raises(ValueError, match=r"expected capture and face_size in .*run\.json; got: .*Restore the file"):
        RunFolder.open(run.path)


def test_a_capture_of_another_rig_is_refused(run, drawn_capture):
    rig = make_small_rig()
    other = dataclasses.replace(rig, dofs=dataclasses.replace(rig.dofs, names=tuple(f"other_{name}" for name in rig.dofs.names)))
    with pytest.raises(ValueError, match=r"expected the rig of run .*run \(fingerprint .*\) in .*rig\.npz; got .*train anew"):
        run.check_capture(drawn_capture, other)
    run.check_capture(drawn_capture, rig)


def test_a_capture_with_another_face_signal_is_refused(run, drawn_capture, rig, tmp_path):
    (tmp_path / "copy").mkdir()
    for name in ("capture.yaml", "cameras.json", "frames.csv"):
        (tmp_path / "copy" / name).write_bytes((drawn_capture.path / name).read_bytes())
    with pytest.raises(ValueError, match=r"expected a face signal of 3 numbers.*; got none"):
        run.check_capture(Capture.open(tmp_path / "copy"), rig)
    np.save(tmp_path / "copy/face.npy", np.zeros((len(drawn_capture.frames), 4), np.float32))
    with pytest.raises(ValueError, match=r"expected a face signal of 3 numbers.*; got 4"):
        run.check_capture(Capture.open(tmp_path / "copy"), rig)


def test_a_continued_run_saves_its_new_settings_but_keeps_its_model(run):
    longer = resolve("tiny", ["training.iterations=99"])
    assert run.with_settings(longer).settings == longer == RunFolder.open(run.path).settings
    with pytest.raises(ValueError, match=r"expected the model of run .*; got model\.latent_size 16 -> 8\. A trained model keeps"):
        run.with_settings(resolve("tiny", ["model.latent_size=8"]))


def test_weights_of_other_sizes_are_refused(run):
    save_checkpoint(run)
    other = RunFolder(run.path, resolve("tiny", ["model.latent_size=8"]), run.rig, run.capture_path, run.face_size)
    with pytest.raises(
        ValueError, match=r"expected weights of the model of .*settings\.yaml in .*checkpoints; got others: .*size mismatch"
    ):
        other.load_avatar("last")
