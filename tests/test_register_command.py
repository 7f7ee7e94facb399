"""`python -m mitsuba_avatar.register`: videos in, a capture out; and the real capture where it lies beside the project."""

import json
from pathlib import Path

import numpy as np
import pytest

from mitsuba_avatar.body.rig import load_rig
from mitsuba_avatar.captures.checks import check_values
from mitsuba_avatar.captures.folder import Capture
from mitsuba_avatar.captures.silhouettes import silhouette
from mitsuba_avatar.register import main
from mitsuba_avatar.registration.keypoints_2d import LANDMARKS
from mitsuba_avatar.registration.recording import open_recording
from tests.registration.drawn_recording import write_recording

pytestmark = pytest.mark.usefixtures("one_thread", "private_cache")
REAL = Path(__file__).parents[2] / "shared/captures/pose2sim_balance"
SHORT = (
    *("output.width=80", "output.height=136", "output.held_out_cameras=b", "pose.iterations=80", "pose.learning_rate=0.05"),
    *("refinement.passes=4", "refinement.offset_passes=2", "refinement.frames_per_step=4", "masks.margin=0.08"),
)


@pytest.fixture(scope="module")
def registered(tmp_path_factory, session_cache):
    """Folder of the recording, folder of the capture, and the truth."""
    folder, out = tmp_path_factory.mktemp("recording"), tmp_path_factory.mktemp("captures") / "drawn"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MITSUBA_AVATAR_CACHE", str(session_cache))
        truth = write_recording(folder)
        assert main([str(folder), "--out", str(out), *SHORT]) == 0
    return folder, out, truth


def test_the_capture_is_whole_and_its_body_stands_where_the_person_stood(registered):
    _, out, truth = registered
    capture = Capture.open(out)
    rig = load_rig(capture.rig_path)
    check_values(capture, rig)
    assert list(capture.cameras) == ["a", "b", "c"] and capture.camera_names(held_out=True) == ["b"]
    assert len(capture.frames) == 4 and [frame.split for frame in capture.frames] == ["train"] * 3 + ["test"]
    assert capture.keypoints.shape == (4, len(LANDMARKS), 4)
    assert np.ptp(capture.face, axis=0).max() == 0, "no face was tracked"
    error = np.linalg.norm(capture.vertices - truth.vertices, axis=-1)
    assert np.median(error) < 0.04
    for name in capture.cameras:
        drawn = silhouette(capture.cameras[name], capture.vertices[2], rig.topology.faces)
        mask = capture.mask(name, 2) > 0.5
        assert (drawn & mask).sum() / (drawn | mask).sum() > 0.75, name


def test_the_report_has_figures_of_all_cameras(registered):
    _, out, _ = registered
    report = json.loads((out / "registration.json").read_text())
    assert report["frames_kept"] == report["frames"] == 4 and report["frames_dropped"] == []
    assert 0 < report["keypoint_px_median"] < 40 and 0.7 < report["iou_after"] <= 1 and 0 < report["iou_before"] <= 1
    assert set(report["cameras"]) == {"a", "b", "c"} and report["cameras"]["b"]["is_held_out"]
    assert report["settings"]["pose"]["iterations"] == 80
    assert (out / "diagnostics.mp4").stat().st_size > 1000


def test_a_finished_capture_is_not_overwritten(registered, capsys):
    folder, out, _ = registered
    assert main([str(folder), "--out", str(out), *SHORT]) == 2
    assert "got a finished capture" in capsys.readouterr().err


def test_stages_that_are_done_are_not_repeated(registered, capsys, monkeypatch):
    """Without the capture's last file the folder is an interrupted registration: the same command ends it in no time."""
    folder, out, _ = registered
    description = (out / "capture.yaml").read_bytes()
    (out / "capture.yaml").rename(out / "capture.unfinished.yaml")
    monkeypatch.setattr("mitsuba_avatar.registration.registering.fit_keypoints", lambda *arguments: pytest.fail("fitted again"))
    monkeypatch.setattr("mitsuba_avatar.registration.registering.refine_pose", lambda *arguments: pytest.fail("refined again"))
    assert main([str(folder), "--out", str(out), *SHORT]) == 0
    assert (out / "capture.yaml").read_bytes() == description


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["/nowhere"], "expected a folder of videos at /nowhere"),
        (["/nowhere", "output.widht=3"], "Did you mean 'output.width'?"),
        (["/nowhere", "keypoints.order=smpl"], "one of auto, body_25"),
    ],
)
def test_bad_input_is_one_line(words, message, capsys, tmp_path):
    assert main([*words, "--out", str(tmp_path / "out")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("register: ") and message in line
    assert not (tmp_path / "out").exists()


def test_an_unknown_held_out_camera_is_refused(registered, capsys, tmp_path):
    folder, _, _ = registered
    assert main([str(folder), "--out", str(tmp_path / "out"), "output.held_out_cameras=z"]) == 2
    assert "output.held_out_cameras among ['a', 'b', 'c']" in capsys.readouterr().err


@pytest.mark.skipif(not REAL.is_dir(), reason="the real capture does not lie beside the project")
def test_the_real_recording_opens():
    recording = open_recording(REAL)
    assert recording.num_frames == 100 and recording.fps == 60.0
    assert {name: view.camera.width for name, view in recording.views.items()} == {
        "cam01": 1080,
        "cam02": 1080,
        "cam03": 1088,
        "cam04": 1088,
    }
