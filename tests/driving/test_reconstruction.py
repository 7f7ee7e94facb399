"""Descent through the renderer: a disturbed pose is found again, a latent code explains what the drive does not."""

import dataclasses

import numpy as np
import pytest
import torch

from mitsuba_avatar.driving.reconstruction import BodyState, ReconstructionSettings, Reconstructor, moved_root
from mitsuba_avatar.driving.reconstruction_folder import ReconstructedFrame, ReconstructionFolder
from mitsuba_avatar.rendering.surface import SurfaceRenderer
from mitsuba_avatar.settings import LossSettings
from mitsuba_avatar.training.batches import FrameReader
from tests.driving.conftest import make_signals

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture
def scene(fitted_run, drawn_capture, private_cache):
    """Avatar, occlusion, renderer, one test frame with all its training views, its tracked state."""
    from mitsuba_avatar.loaded_run import LoadedRun
    from mitsuba_avatar.rendering.ambient_occlusion import FrameOcclusion

    loaded = LoadedRun.open(fitted_run)
    occlusion = loaded.occlusion()
    frames = FrameOcclusion(occlusion, loaded.run.rig, loaded.avatar.template_vertices, drawn_capture.theta)
    reader = FrameReader(drawn_capture, frames)
    batch = reader.read([8], [drawn_capture.camera_names(held_out=False)])
    renderer = SurfaceRenderer(loaded.run.rig.topology, reader.width, reader.height, 4)
    tracked = BodyState(batch.theta, batch.root, batch.face, torch.zeros(1, loaded.avatar.settings.latent_size))
    return loaded, occlusion, renderer, batch, tracked


def reconstructor(scene, **changes) -> Reconstructor:
    loaded, occlusion, renderer, _, _ = scene
    settings = ReconstructionSettings(**({"steps": 40, "angle_rate": 0.02, "root_rate": 5e-3, "pull": 0.0} | changes))
    return Reconstructor(loaded.avatar, loaded.run.rig, renderer, occlusion, LossSettings(), settings)


def test_a_disturbed_pose_and_root_are_found_again_from_images(scene):
    *_, batch, tracked = scene
    motion = torch.tensor([[0.0, 0.05, 0.1, 0.02, -0.02, 0.015]])
    disturbed = dataclasses.replace(
        tracked,
        theta=tracked.theta + torch.tensor([[0.0, 0.0, 0.25, -0.2, 0.0]]),
        root=moved_root(tracked.root, motion, torch.tensor([0.0, 0.0, 0.3])),
    )
    fitter = reconstructor(scene)
    found, losses = fitter.fit(disturbed, batch)
    away = [(fitter.draw(state, batch).vertices - batch.vertices).norm(dim=-1).mean() for state in (disturbed, found)]
    assert away[0] > 0.02 and away[1] < 0.3 * away[0], f"{away[0]:.4f} m before, {away[1]:.4f} m after"
    assert np.mean(losses[-5:]) < 0.6 * losses[0]
    rotation = found.root[0, :3, :3]
    torch.testing.assert_close(rotation @ rotation.T, torch.eye(3), atol=1e-5, rtol=0)


def test_from_the_tracked_pose_it_does_not_get_worse(scene):
    *_, batch, tracked = scene
    fitter = reconstructor(scene, steps=25, angle_rate=5e-3, root_rate=1e-3)
    found, _ = fitter.fit(tracked, batch)
    errors = [float((fitter.draw(state, batch).images - batch.images).abs().mean()) for state in (tracked, found)]
    assert errors[1] < errors[0], f"{errors[0]:.5f} before, {errors[1]:.5f} after"


def test_angles_stay_within_the_rigs_limits(scene, rig):
    *_, batch, tracked = scene
    outside = dataclasses.replace(tracked, theta=torch.from_numpy(rig.dofs.upper)[None] + 0.3)
    found, _ = reconstructor(scene, steps=6, angle_rate=0.1).fit(outside, batch)
    assert bool((found.theta <= torch.from_numpy(rig.dofs.upper) + 1e-6).all())
    assert bool((found.theta >= torch.from_numpy(rig.dofs.lower) - 1e-6).all())


def test_a_mesh_pins_the_surface_where_images_alone_may_drift(scene):
    *_, batch, tracked = scene
    shifted = dataclasses.replace(tracked, root=moved_root(tracked.root, torch.tensor([[0.0, 0, 0, 0.05, 0, 0.03]]), torch.zeros(3)))
    fitter = reconstructor(scene, steps=15, use_mesh=True)
    found, _ = fitter.fit(shifted, batch)
    away = [(fitter.draw(state, batch).vertices - batch.vertices).norm(dim=-1).mean() for state in (shifted, found)]
    assert away[1] < 0.6 * away[0]
    with pytest.raises(ValueError, match="expected a registered mesh"):
        fitter.fit(shifted, dataclasses.replace(batch, vertices=None))


def test_the_pull_keeps_the_pose_near_its_start(scene):
    *_, batch, tracked = scene
    disturbed = dataclasses.replace(tracked, theta=tracked.theta + torch.tensor([[0.0, 0.0, 0.2, 0.0, 0.0]]))
    loose, tight = (reconstructor(scene, steps=10, pull=pull).fit(disturbed, batch)[0] for pull in (0.0, 10.0))
    assert (tight.theta - disturbed.theta).norm() < 0.5 * (loose.theta - disturbed.theta).norm()


def test_a_root_turns_about_its_pivot_and_shifts():
    root = make_signals(1, seed=2).root
    pivot = torch.tensor([0.3, -0.2, 1.0])
    turned = moved_root(root, torch.tensor([[0.0, 0.0, np.pi / 2, 0.0, 0.0, 0.0]]), pivot)
    point = torch.linalg.inv(root[0]) @ torch.cat([pivot, torch.ones(1)])
    torch.testing.assert_close((turned[0] @ point)[:3], pivot, atol=1e-6, rtol=0)
    torch.testing.assert_close(turned[0, :2, :2], torch.tensor([[0.0, -1.0], [1.0, 0.0]]), atol=1e-6, rtol=0)
    shifted = moved_root(root, torch.tensor([[0.0, 0.0, 0.0, 0.1, 0.2, 0.3]]), pivot)
    torch.testing.assert_close(shifted[0, :3, 3] - root[0, :3, 3], torch.tensor([0.1, 0.2, 0.3]))


def test_a_folder_gives_frames_back_and_takes_no_others(tmp_path):
    state = BodyState(torch.ones(1, 5), torch.eye(4)[None], torch.zeros(1, 3), torch.full((1, 6), 0.5))
    folder = ReconstructionFolder(tmp_path / "out", {"steps": 4, "start": "tracked"})
    assert folder.load(7) is None
    folder.save(7, ReconstructedFrame(dataclasses.replace(state, theta=torch.zeros(1, 5)), state, np.array([2.0, 1.0], np.float32), 0.25))
    back = ReconstructionFolder(tmp_path / "out", {"steps": 4, "start": "tracked"}).load(7)
    assert torch.equal(back.state.theta, state.theta) and not back.start.theta.any() and back.losses.tolist() == [2.0, 1.0]
    with pytest.raises(ValueError, match="expected steps = 4, with which .* was begun; got 5"):
        ReconstructionFolder(tmp_path / "out", {"steps": 5, "start": "tracked"})
    folder.save_signals([7, 9], [state, state])
    assert np.load(tmp_path / "out/z.npy").shape == (2, 6) and np.load(tmp_path / "out/frames.npy").tolist() == [7, 9]
    (tmp_path / "out/frames/000007.npz").write_bytes(b"cut")
    with pytest.raises(ValueError, match="expected a whole frame"):
        folder.load(7)


@pytest.mark.parametrize("change", [{"steps": 0}, {"views_per_step": 0}, {"latent_rate": -1.0}])
def test_settings_that_make_no_sense_are_refused(change):
    with pytest.raises(ValueError, match=next(iter(change))):
        ReconstructionSettings(**change)
