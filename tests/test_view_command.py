"""`python -m mitsuba_avatar.view`: what it opens, what it measures, and what it says about bad input."""

import shutil
import socket
import sys

import numpy as np
import pytest

from mitsuba_avatar.loaded_run import LoadedRun
from mitsuba_avatar.view import main, open_viewed_avatar
from tests.drawn_capture import TEST_FRAMES, TRAIN_FRAMES

pytestmark = pytest.mark.usefixtures("one_thread", "private_cache")


@pytest.fixture
def run(fitted_run, tmp_path):
    return shutil.copytree(fitted_run, tmp_path / "run")


def test_measuring_prints_the_rate_and_its_parts(run, capsys):
    assert main([str(run), "--measure", "0.2", "--height", "66"]) == 0
    line = capsys.readouterr().out.strip()
    assert "pictures a second of 88x66 pixels: " in line and all(part in line for part in ("decoding", "rendering", "encoding"))
    assert float(line.split()[0]) > 0.5


def test_what_is_viewed_has_the_capture_s_poses_and_codes(run):
    viewed = open_viewed_avatar(LoadedRun.open(run))
    assert len(viewed.training) == TRAIN_FRAMES == len(viewed.latents.mu)
    assert list(viewed.others) == ["test"] and len(viewed.timeline) == TEST_FRAMES
    assert viewed.face_names == (), "three landmark coordinates are no actions"


def test_a_recorded_motion_becomes_the_timeline(run, tmp_path):
    theta = np.linspace(0, 0.4, 15, dtype=np.float32).reshape(3, 5)
    np.save(tmp_path / "walk.npy", theta)
    viewed = open_viewed_avatar(LoadedRun.open(run), str(tmp_path / "walk.npy"))
    np.testing.assert_array_equal(viewed.timeline.theta, theta)
    assert list(viewed.others) == ["test", "motion"] and len(viewed.timeline.face) == 3


def test_a_capture_as_motion_brings_its_face(run, drawn_capture, tmp_path):
    shutil.copytree(drawn_capture.path, tmp_path / "other")
    face = np.array(drawn_capture.face) + np.float32(0.01)
    np.save(tmp_path / "other/face.npy", face)
    timeline = open_viewed_avatar(LoadedRun.open(run), str(tmp_path / "other")).timeline
    np.testing.assert_array_equal(timeline.face, face[drawn_capture.frame_indices("test")])


def test_a_capture_without_meshes_still_has_a_viewer(run, drawn_capture, tmp_path, capsys):
    copy = shutil.copytree(drawn_capture.path, tmp_path / "copy", ignore=shutil.ignore_patterns("vertices.npy"))
    facts = (run / "run.json").read_text().replace(str(drawn_capture.path), str(copy))
    (run / "run.json").write_text(facts)
    assert open_viewed_avatar(LoadedRun.open(run)).latents is None
    assert "no latent codes of training frames" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--height", "10"], "expected --height of 64 to 2160"),
        (["--port", "0"], "expected --height of 64 to 2160, --port of 1 to 65535"),
        (["--motion", "/nowhere.bvh"], "/nowhere.bvh"),
        (["--checkpoint", "first"], "'best' or 'last'"),
    ],
)
def test_bad_input_is_one_line(run, capsys, words, message):
    assert main([str(run), *words]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("view: ") and message in line


def test_a_port_in_use_is_one_line(run, capsys):
    pytest.importorskip("viser")
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        assert main([str(run), "--port", str(other.getsockname()[1])]) == 2
    assert "in use. Name another with --port" in capsys.readouterr().err


def test_without_viser_it_says_what_to_install(run, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    monkeypatch.delitem(sys.modules, "mitsuba_avatar.viewing.browser", raising=False)
    assert main([str(run), "--port", "8097"]) == 2
    assert "the viewer needs viser, which is not installed. Run `pip install 'mitsuba-avatar[view]'`" in capsys.readouterr().err
