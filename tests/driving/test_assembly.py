"""Body and face put together for one avatar, and what is drawn of it."""

import dataclasses
import shutil

import numpy as np
import pytest
import torch

from mitsuba_avatar.body.rig import load_rig, save_rig
from mitsuba_avatar.driving.animation import FrameClock, animate, outline
from mitsuba_avatar.driving.assembly import assemble, trained_face
from mitsuba_avatar.driving.signals import DrivingSignals
from mitsuba_avatar.driving.sources import load_body, load_face, neutral_landmarks
from mitsuba_avatar.reporting.camera_paths import orbit
from mitsuba_avatar.training.run_folder import RunFolder
from tests.driving.conftest import make_signals

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def run(fitted_run):
    return RunFolder.open(fitted_run)


@pytest.fixture(scope="module")
def fitted_avatar(run):
    return run.load_avatar("last")


def no_training() -> DrivingSignals:
    raise AssertionError("nobody asked for the training frames")


def test_the_runs_own_capture_is_the_matched_setting(run, fitted_avatar, drawn_capture):
    body = load_body(drawn_capture.path, run.rig)
    face = load_face(drawn_capture.path, trained_face(run), 10.0)
    drive = assemble(run, fitted_avatar, body, face, no_training)
    assert drive.setting == "matched" and drive.notes == ()
    np.testing.assert_array_equal(drive.signals.face.numpy(), drawn_capture.face[8:])
    np.testing.assert_array_equal(drive.signals.root.numpy(), drawn_capture.root[8:])


def test_without_a_face_the_training_mean_stands_in(run, fitted_avatar, drawn_capture):
    drive = assemble(run, fitted_avatar, load_body(drawn_capture.path, run.rig), None, no_training)
    np.testing.assert_allclose(drive.signals.face[1].numpy(), drawn_capture.face[:8].mean(0), atol=1e-6)
    assert "keeps the mean of the training frames" in drive.notes[0]


def test_a_face_of_one_frame_is_held_and_a_short_one_played_back_and_forth(run, fitted_avatar, tmp_path):
    np.save(tmp_path / "theta.npy", np.zeros((5, 5), np.float32))
    body = load_body(tmp_path / "theta.npy", run.rig)
    np.save(tmp_path / "face.npy", np.array([[0.1, 0.2, 0.3]], np.float32))
    held = assemble(run, fitted_avatar, body, load_face(tmp_path / "face.npy", trained_face(run), 10.0), no_training)
    np.testing.assert_allclose(held.signals.face.numpy(), np.tile([0.1, 0.2, 0.3], (5, 1)), atol=1e-6)
    np.save(tmp_path / "face.npy", np.arange(9, dtype=np.float32).reshape(3, 3))
    swung = assemble(run, fitted_avatar, body, load_face(tmp_path / "face.npy", trained_face(run), 10.0), no_training)
    np.testing.assert_allclose(swung.signals.face[:, 0].numpy(), [0, 3, 6, 3, 0], atol=1e-4)
    assert "played back and forth" in swung.notes[-1] and swung.setting == "unmatched"


def test_landmarks_of_another_body_are_carried_over_to_this_one(run, fitted_avatar, drawn_capture, tmp_path):
    """The other head is longer by a tenth: its face at rest must become this one's face at rest."""
    shutil.copytree(drawn_capture.path, tmp_path / "other", ignore=shutil.ignore_patterns("*.png"))
    rig = load_rig(drawn_capture.rig_path)
    longer = dataclasses.replace(rig, rest_vertices=(rig.rest_vertices * np.array([1, 1, 1.1])).astype(np.float32))
    (tmp_path / "other/rig.npz").unlink()
    save_rig(tmp_path / "other/rig.npz", longer)
    moved = neutral_landmarks(longer) + np.linspace(0, 0.01, 12)
    np.save(tmp_path / "other/face.npy", np.tile(moved, (10, 1)).astype(np.float32))
    description = tmp_path / "other/capture.yaml"
    body = load_body(tmp_path / "other", run.rig)
    wide = RunFolder(run.path, run.settings, run.rig, tmp_path / "gone", 12)
    assert trained_face(wide).names == tuple(f"{name}_{axis}" for name in run.rig.face_keypoint_names for axis in "xyz")
    assert description.is_file()
    drive = assemble(wide, fitted_avatar, body, load_face(tmp_path / "other", trained_face(wide), 10.0), no_training)
    np.testing.assert_allclose(drive.signals.face[0].numpy(), neutral_landmarks(run.rig) + np.linspace(0, 0.01, 12), atol=1e-6)


def test_pictures_follow_the_signals_and_every_part_is_timed(run, fitted_avatar, private_cache):
    from mitsuba_avatar.loaded_run import avatar_occlusion
    from mitsuba_avatar.rendering.surface import SurfaceRenderer

    signals = make_signals(3, seed=1)
    points = outline(fitted_avatar, signals)
    camera = orbit(points, 1, 30, 44)[0]
    renderer, clock = SurfaceRenderer(run.rig.topology, 30, 44, 4), FrameClock()
    z = torch.zeros(3, fitted_avatar.settings.latent_size)
    frames = list(animate(fitted_avatar, signals, z, [(2, camera), (0, camera)], renderer, avatar_occlusion(run), clock))
    assert [frame.row for frame in frames] == [2, 0] and frames[0].radiance.shape == (44, 30, 3)
    with torch.no_grad():
        rest = fitted_avatar.pose_template(signals.theta[2:], signals.root[2:])[0]
    assert (frames[0].vertices - rest).norm(dim=1).mean() < 0.03, "in the pose that was asked for"
    assert 0.02 < frames[0].coverage.mean() < 0.6 and frames[0].coverage[:, [0, -1]].max() == 0
    assert set(clock.frames_per_second()) == {"occlusion", "decoding", "rendering"} and "decoding" in clock.summary()


def test_the_outline_holds_every_vertex_of_every_frame(fitted_avatar):
    signals = make_signals(4, seed=5)
    points = outline(fitted_avatar, signals)
    with torch.no_grad():
        everything = fitted_avatar.pose_template(signals.theta, signals.root).flatten(0, 1).numpy()
    assert len(points) < 0.5 * len(everything)
    for direction in np.random.default_rng(0).normal(size=(50, 3)):
        np.testing.assert_allclose((points @ direction).max(), (everything @ direction).max(), rtol=1e-5)


def test_in_place_leaves_out_the_way_and_keeps_the_height():
    signals = make_signals(5)
    root = signals.root.clone()
    root[:, 2, 3] = torch.arange(5.0)
    still = dataclasses.replace(signals, root=root).in_place()
    assert still.root[:, 0, 3].std() == 0 and torch.equal(still.root[:, 2, 3], torch.arange(5.0))
