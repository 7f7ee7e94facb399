"""Statistics: means over training frames and training cameras alone, and what a textured mesh's images say about its texture."""

import shutil

import numpy as np
import pytest
import torch

from mitsuba_avatar.captures.folder import Capture
from mitsuba_avatar.rendering.texture_projection import TextureProjection
from mitsuba_avatar.training.statistics import evenly_spaced, training_statistics
from tests.drawn_capture import HELD_OUT, TEXTURE_SIZE, TRAIN_FRAMES, bulge, make_texture, write_drawn_capture


def test_driving_signals_are_averaged_over_training_frames(drawn_capture, statistics):
    train = slice(0, TRAIN_FRAMES)
    np.testing.assert_allclose(statistics.theta_mean, np.asarray(drawn_capture.theta[train], np.float64).mean(0), atol=1e-6)
    np.testing.assert_allclose(statistics.theta_std, np.asarray(drawn_capture.theta[train], np.float64).std(0), atol=1e-6)
    np.testing.assert_allclose(statistics.face_mean, drawn_capture.face[train].mean(0), atol=1e-6)
    np.testing.assert_allclose(statistics.face_std, drawn_capture.face[train].std(0), atol=1e-6)


def test_mean_displacement_is_the_mean_bulge(drawn_capture, rig, statistics):
    """The registered meshes are the posed rest surface plus a known bulge; unposing must give it back."""
    expected = bulge(rig, np.asarray(drawn_capture.theta[:TRAIN_FRAMES])).mean(0)
    assert np.abs(expected).max() > 0.01
    np.testing.assert_allclose(statistics.mean_displacement, expected, atol=2e-6)


def test_mean_texture_is_the_texture_that_was_drawn(tmp_path, rig):
    """Where a camera saw the surface, within what 40x56 pixels of 8 bits can tell: 3 % on average, 12 % anywhere."""
    capture = write_drawn_capture(tmp_path / "plain", is_plain=True)
    texture = training_statistics(capture, rig, TEXTURE_SIZE).mean_texture
    is_covered = TextureProjection(rig.topology, TEXTURE_SIZE).atlas.covered
    error = (texture - make_texture()).abs().max(dim=0).values[is_covered & tube_texels()]
    assert error.mean() < 0.03 * 0.4 and error.max() < 0.12, f"mean error {error.mean():.4f}, largest {error.max():.4f}"


def tube_texels() -> torch.Tensor:
    """[S, S] texels of the tube, less its ends: the caps face away from most cameras."""
    v = 1 - (torch.arange(TEXTURE_SIZE) + 0.5) / TEXTURE_SIZE
    return ((v > 0.5) & (v < 0.9))[:, None].expand(-1, TEXTURE_SIZE)


def test_held_out_cameras_and_test_frames_are_never_read(drawn_capture, rig, statistics, tmp_path):
    """With their images and masks gone, nothing fails and nothing changes."""
    shutil.copytree(drawn_capture.path, tmp_path / "copy")
    for kind in ("images", "masks"):
        shutil.rmtree(tmp_path / "copy" / kind / HELD_OUT)
    for frame in drawn_capture.frames[TRAIN_FRAMES:]:
        for path in (tmp_path / "copy").glob(f"*/*/{frame.number:06d}.*"):
            path.unlink()
    again = training_statistics(Capture.open(tmp_path / "copy"), rig, statistics.mean_texture.shape[1])
    for name, value in vars(statistics).items():
        torch.testing.assert_close(getattr(again, name), value)


def test_without_a_texture_no_image_is_read_and_the_surface_is_grey(drawn_capture, rig, statistics, monkeypatch):
    monkeypatch.setattr(Capture, "mask", None)
    shape_alone = training_statistics(drawn_capture, rig, 32, with_texture=False)
    assert shape_alone.mean_texture.shape == (3, 32, 32) and bool((shape_alone.mean_texture == 0.5).all())
    torch.testing.assert_close(shape_alone.mean_displacement, statistics.mean_displacement)
    torch.testing.assert_close(shape_alone.face_std, statistics.face_std)


def test_without_registered_meshes_the_rest_shape_stands_in(drawn_capture, rig, statistics, tmp_path):
    shutil.copytree(drawn_capture.path, tmp_path / "copy")
    (tmp_path / "copy/vertices.npy").unlink()
    without = training_statistics(Capture.open(tmp_path / "copy"), rig, statistics.mean_texture.shape[1])
    assert not without.mean_displacement.any()
    assert 0 < (without.mean_texture - statistics.mean_texture).abs().mean() < 0.05


def test_progress_counts_frames(drawn_capture, rig):
    calls = []
    training_statistics(drawn_capture, rig, 16, lambda done, total: calls.append((done, total)))
    assert calls == [(i + 1, TRAIN_FRAMES) for i in range(TRAIN_FRAMES)]


@pytest.mark.parametrize(("count", "expected"), [(1, [3]), (2, [3, 9]), (3, [3, 5, 9]), (9, [3, 4, 5, 8, 9])])
def test_evenly_spaced(count, expected):
    assert evenly_spaced([3, 4, 5, 8, 9], count) == expected
