"""Ways to make up the latent code, on training frames whose code is known."""

import pytest
import torch

from mitsuba_avatar.driving.imputation import GivenLatents, NearestLatent, PriorSample, make_imputation
from mitsuba_avatar.driving.signals import DrivingSignals
from mitsuba_avatar.driving.temporal_model import TemporalModel
from mitsuba_avatar.driving.training_latents import TrainingLatents, latents_path, training_latents
from mitsuba_avatar.training.run_folder import RunFolder
from tests.driving.conftest import LATENT_SIZE, make_signals, make_training

NAMES = ("zero", "mean", "prior", "clip", "nearest", "temporal", "temporal_sample")


@pytest.mark.parametrize("name", NAMES)
def test_every_imputation_gives_a_code_a_frame_and_the_same_again(name):
    training, drive = make_training(), make_signals(25, seed=8, clips=(slice(0, 11), slice(11, 25)))
    imputation = make_imputation(name, LATENT_SIZE, training, seed=4)
    z = imputation.latents(drive)
    assert z.shape == (25, LATENT_SIZE) and z.dtype == torch.float32 and bool(torch.isfinite(z).all())
    assert torch.equal(z, imputation.latents(drive))


def test_zero_and_mean_are_constants():
    training, drive = make_training(), make_signals(3)
    assert not make_imputation("zero", LATENT_SIZE).latents(drive).any()
    torch.testing.assert_close(make_imputation("mean", LATENT_SIZE, training).latents(drive)[2], training.mu.mean(0))


def test_prior_samples_are_standard_normal_and_change_with_the_seed():
    drive = make_signals(4000)
    z = PriorSample(LATENT_SIZE, seed=1).latents(drive)
    assert z.mean(0).abs().max() < 0.06 and (z.std(0) - 1).abs().max() < 0.06
    assert not torch.equal(z, PriorSample(LATENT_SIZE, seed=2).latents(drive))


def test_a_clip_sample_is_held_within_a_clip_and_another_in_the_next():
    short, long = (make_signals(n, clips=(slice(0, n - 3), slice(n - 3, n))) for n in (7, 12))
    z = PriorSample(LATENT_SIZE, seed=5, is_held=True).latents(short)
    assert torch.equal(z[0], z[3]) and torch.equal(z[4], z[6]) and not torch.equal(z[3], z[4])
    again = PriorSample(LATENT_SIZE, seed=5, is_held=True).latents(long)
    assert torch.equal(z[0], again[8]) and torch.equal(z[6], again[11]), "a clip's code does not depend on its length"


def test_nearest_finds_a_training_frame_by_pose_and_face_whatever_the_root():
    training = make_training()
    rows = [5, 44, 90]
    drive = training.signals.chosen(rows)
    moved = DrivingSignals(drive.theta + 1e-4, drive.root + 3.0, drive.face, drive.fps, drive.clips)
    nearest = NearestLatent(training)
    assert nearest.nearest_frames(moved).tolist() == rows
    assert torch.equal(nearest.latents(moved), training.mu[rows])


def test_neither_signal_drowns_the_other_in_the_distance():
    """Angles of 0.4 radians and landmarks of 0.01 metres: without units of their own, the face would not count."""
    training = make_training()
    signals = training.signals
    faces_of, poses_of = signals.chosen([20]), signals.chosen([70])
    mixed = DrivingSignals(0.9 * poses_of.theta + 0.1 * faces_of.theta, poses_of.root, faces_of.face, 10.0)
    features = NearestLatent(training)._features(mixed)
    other = NearestLatent(training)._features(DrivingSignals(mixed.theta, mixed.root, poses_of.face, 10.0))
    shift = float(((features - other) ** 2).sum()) ** 0.5
    spread = float(signals.face.double().var(0, correction=0).sum().sqrt())
    assert shift == pytest.approx(float((faces_of.face - poses_of.face).double().norm()) / spread, rel=1e-5)


def make_wandering(clips: tuple[slice, ...], seed: int) -> TrainingLatents:
    """Codes that follow what moves the body with inertia, squashed, along one direction, plus noise of 0.05.

    One number wanders at random; pose and face are fixed multiples of it, so that near in driving space is near in the number itself, while
    its past is another in every clip and for every seed. Direction and multiples are those of all seeds.
    """
    count, fixed = clips[-1].stop, torch.Generator().manual_seed(5)
    of_theta, of_face, direction = (torch.randn(size, generator=fixed) for size in (5, 3, LATENT_SIZE))
    generator = torch.Generator().manual_seed(seed)
    steps = torch.randn(count, generator=generator).tolist()
    number, state = list(steps), list(steps)
    for clip in clips:
        for frame in range(clip.start + 1, clip.stop):
            number[frame] = 0.8 * number[frame - 1] + 0.6 * steps[frame]
            state[frame] = 0.6 * state[frame - 1] + 0.4 * number[frame]
    moving, inert = torch.tensor(number)[:, None], torch.tensor(state)[:, None]
    signals = DrivingSignals(0.3 * moving * of_theta, torch.eye(4).repeat(count, 1, 1), 0.01 * moving * of_face, 10.0, clips)
    mu = 0.7 + torch.tanh(inert) * direction + 0.05 * torch.randn(count, LATENT_SIZE, generator=generator)
    return TrainingLatents(mu, torch.full_like(mu, -3.0), signals)


def test_the_temporal_model_follows_the_drive_on_frames_it_never_saw():
    """z follows the drive's history, which one frame does not show: the model beats mean and nearest frame, and knows how well it does."""
    training = make_wandering((slice(0, 100), slice(100, 200), slice(200, 300)), seed=1)
    unseen = make_wandering((slice(0, 80), slice(80, 200)), seed=51)
    model = TemporalModel.fit(training)
    imputed = {
        name: make_imputation(name, LATENT_SIZE, training, model).latents(unseen.signals) for name in ("mean", "nearest", "temporal")
    }
    missed = {name: float((z - unseen.mu).square().mean()) for name, z in imputed.items()}
    assert missed["nearest"] < missed["mean"], f"the drive of the moment tells something: {missed}"
    assert missed["temporal"] < 0.3 * missed["nearest"], f"and its history much more: {missed}"
    assert model.explained == pytest.approx(1 - missed["temporal"] / missed["mean"], abs=0.1)


def test_the_temporal_model_is_steady_where_the_drive_stands_still():
    model = TemporalModel.fit(make_training())
    still = make_signals(40).chosen([12])
    held = DrivingSignals(*(values.repeat_interleave(40, 0) for values in (still.theta, still.root, still.face)), 10.0)
    z = model.run(held)
    assert (z - z[0]).abs().max() < 1e-4 * z.abs().max() + 1e-5


def test_the_temporal_model_plays_other_frame_rates_in_the_same_time():
    model = TemporalModel.fit(make_training())
    slow, fast = make_signals(21, seed=6, fps=10.0), make_signals(61, seed=6, fps=30.0)
    difference = (model.run(slow)[2:] - model.run(fast)[6::3]).abs().max()
    assert difference < 0.08 * model.run(slow).std(), "what it says at a time does not depend on how often it is asked"


def test_sampled_sequences_scatter_about_the_likely_one():
    training, drive = make_training(), make_signals(50, seed=2)
    model = TemporalModel.fit(training)
    likely = model.run(drive)
    drawn = [make_imputation("temporal_sample", LATENT_SIZE, training, model, seed=seed).latents(drive) for seed in range(20)]
    assert not torch.equal(drawn[0], drawn[1])
    mean = torch.stack(drawn).mean(0)
    assert (mean - likely).norm() < 0.5 * (drawn[0] - likely).norm()
    first, last = (torch.stack([z[frame] for z in drawn]).std(0).mean() for frame in (0, -1))
    assert 0.5 < first / last < 2, "from the first frame on"


def test_a_model_survives_its_file(tmp_path):
    model, drive = TemporalModel.fit(make_training()), make_signals(9)
    model.save(tmp_path / "model.npz")
    assert torch.equal(TemporalModel.load(tmp_path / "model.npz").run(drive), model.run(drive))
    (tmp_path / "model.npz").write_bytes(b"cut")
    with pytest.raises(ValueError, match="expected a whole model"):
        TemporalModel.load(tmp_path / "model.npz")


def test_training_latents_are_encoded_once_and_kept_with_the_run(fitted_run, drawn_capture, tmp_path):
    import shutil

    shutil.copytree(fitted_run, tmp_path / "run")
    run = RunFolder.open(tmp_path / "run")
    avatar, opened = run.load_avatar("last"), []
    first = training_latents(run, avatar, lambda: opened.append(1) or drawn_capture)
    again = training_latents(run, avatar, lambda: opened.append(1) or drawn_capture)
    assert len(opened) == 1 and latents_path(run, "training", "last").is_file()
    assert torch.equal(first.mu, again.mu) and torch.equal(first.signals.theta, again.signals.theta)
    assert first.signals.clips == again.signals.clips == (slice(0, 8),)
    with torch.no_grad():
        unposed = avatar.unpose(torch.from_numpy(drawn_capture.vertices[3:4].copy()), first.signals.theta[3:4], first.signals.root[3:4])
        torch.testing.assert_close(first.mu[3:4], avatar.encode(unposed).mu)
    latents_path(run, "training", "last").write_bytes(b"cut")
    with pytest.raises(ValueError, match="expected whole latents"):
        TrainingLatents.load(latents_path(run, "training", "last"))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("mode", 4), "expected one of zero, prior"),
        (("nearest", 4), "expected the training frames' latents for 'nearest'"),
        (("prior", 0), "expected an avatar with a latent code"),
    ],
)
def test_what_cannot_be_imputed_is_refused(arguments, message, without_shape_checks):
    with pytest.raises(ValueError, match=message):
        make_imputation(*arguments)


def test_given_codes_must_reach_to_the_last_frame():
    assert len(GivenLatents(torch.ones(5, 2)).latents(make_signals(4))) == 4
    with pytest.raises(ValueError, match="for each of 4 frames; got 3"):
        GivenLatents(torch.ones(3, 2)).latents(make_signals(4))


def test_an_avatar_without_a_code_gets_codes_of_no_entries():
    assert make_imputation("zero", 0).latents(make_signals(4)).shape == (4, 0)
