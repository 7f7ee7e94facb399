"""The measures of disentanglement on avatars and data whose answer is known."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from mitsuba_avatar.body.driving import face_keypoints
from mitsuba_avatar.driving.signals import DrivingSignals
from mitsuba_avatar.model.avatar import Avatar, DrivingStatistics
from mitsuba_avatar.model.encoder import Posterior
from mitsuba_avatar.model.keypoints import DrivenKeypoints
from mitsuba_avatar.presets import resolve
from mitsuba_avatar.reporting.disentanglement import (
    drive_swap,
    fresh_mutual_information,
    latent_swap,
    latent_use,
    linear_probe,
    other_frames,
)
from tests.small_rig import make_small_rig

pytestmark = pytest.mark.usefixtures("one_thread")

FRAMES = 11  # more than are decoded at once
SHIRT = make_small_rig().rest_vertices[:, 2] < 0.2


class ConstructedAvatar(Avatar):
    """Its first entry of z moves the shirt along x, its second one the whole surface along y: 1 cm each a unit."""

    def decode_rest_vertices(self, theta, face, z):
        rest_vertices = self.template_vertices.repeat(len(theta), 1, 1)
        if z is not None:
            rest_vertices[:, torch.from_numpy(SHIRT), 0] += 0.01 * z[:, :1]
            rest_vertices[:, :, 1] += 0.01 * z[:, 1:2]
        return rest_vertices


@pytest.fixture(scope="module")
def avatar():
    settings = resolve("tiny").model
    return ConstructedAvatar(make_small_rig(), settings, DrivingStatistics.neutral(make_small_rig(), 12, settings.texture_size))


@pytest.fixture(scope="module")
def keypoints(avatar):
    return DrivenKeypoints(make_small_rig(), avatar.template_vertices, with_face=True)


@pytest.fixture(scope="module")
def drive(avatar):
    """Poses at random; the face signal lists the template's landmarks."""
    generator = torch.Generator().manual_seed(0)
    face = face_keypoints(make_small_rig(), avatar.template_vertices[None]).expand(FRAMES, -1)
    return DrivingSignals(0.5 * torch.randn((FRAMES, 5), generator=generator), torch.eye(4).repeat(FRAMES, 1, 1), face, fps=10.0)


def codes(first: float, second: float) -> torch.Tensor:
    z = torch.zeros(FRAMES, 16)
    z[:, 0], z[:, 1] = first, second
    return z


def test_a_code_that_moves_only_the_shirt_swaps_without_moving_the_hand(avatar, keypoints, drive):
    swapped = latent_swap(avatar, keypoints, drive, codes(0.5, 0.0), codes(-1.5, 0.0), {"shirt": SHIRT, "fist": ~SHIRT})
    assert swapped.vertices_mm["shirt"] == pytest.approx(20, rel=1e-4) and swapped.vertices_mm["fist"] == 0
    assert swapped.vertices_mm["all"] == pytest.approx(20 * SHIRT.mean(), rel=1e-4)
    assert swapped.face_landmarks_mm == 0 and 0 < swapped.body_keypoints_mm < 20


def test_a_code_that_moves_everything_moves_the_keypoints_by_as_much(avatar, keypoints, drive):
    swapped = latent_swap(avatar, keypoints, drive, codes(0.0, 0.0), codes(0.0, 0.7))
    assert swapped.face_landmarks_mm == pytest.approx(7, rel=1e-3) and swapped.vertices_mm == {"all": pytest.approx(7, rel=1e-3)}
    assert swapped.body_keypoints_mm == pytest.approx(7, rel=0.2), "blended joints shorten it a little"


def test_a_drive_swap_measures_the_distance_to_what_the_signal_asks_for(avatar, keypoints, drive):
    faithful = drive_swap(avatar, keypoints, drive, codes(0.0, 0.0))
    assert faithful.body_keypoints_mm < 1e-3 and faithful.face_landmarks_mm < 1e-3 and faithful.vertices_mm["all"] == 0
    dragged = drive_swap(avatar, keypoints, drive, codes(0.0, -0.3))
    assert dragged.face_landmarks_mm == pytest.approx(3, rel=1e-3) and dragged.vertices_mm["all"] == pytest.approx(3, rel=1e-3)
    moved_face = dataclasses.replace(drive, face=drive.face + torch.tensor([0.0, 0.004, 0.003]).repeat(4))
    assert drive_swap(avatar, keypoints, moved_face, codes(0.0, 0.0)).face_landmarks_mm == pytest.approx(5, rel=1e-3)


def test_without_landmarks_none_are_reported(avatar, drive):
    keypoints = DrivenKeypoints(make_small_rig(), avatar.template_vertices, with_face=False)
    assert latent_swap(avatar, keypoints, drive, codes(0.0, 0.0), codes(0.0, 1.0)).face_landmarks_mm is None


def test_other_frames_are_far_in_driving_space():
    driving = torch.linspace(0, 1, 41)[:, None]
    others = other_frames(driving, seed=3)
    distance = (driving[others] - driving).abs()[:, 0]
    assert (distance >= (driving - driving.T).abs().median(dim=1).values - 1e-6).all()
    assert len(set(others.tolist())) > 10 and torch.equal(others, other_frames(driving, seed=3))


def test_latent_use_by_hand():
    mu = torch.zeros(4, 3)
    mu[:, 1] = torch.tensor([1.0, -1.0, 1.0, -1.0])
    logvar = torch.zeros(4, 3)
    logvar[:, 2] = math.log(0.25)
    use = latent_use(Posterior(mu, logvar))
    assert use.active_entries == 1
    assert use.kl_nats == pytest.approx(0.5 + 0.5 * (0.25 - 1 + math.log(4)))
    assert use.offset_nats == 0
    mu[:, 0], mu[:, 1] = 0.6, mu[:, 1] - 0.8
    shifted = latent_use(Posterior(mu, logvar))
    assert shifted.offset_nats == pytest.approx(0.5) and shifted.kl_nats == pytest.approx(use.kl_nats + 0.5)


def test_codes_that_tell_frames_apart_with_certainty_carry_the_logarithm_of_their_number():
    sure = Posterior(10.0 * torch.eye(7), torch.full((7, 7), -2.0))
    assert latent_use(sure).frame_information_nats == pytest.approx(math.log(7), abs=1e-6)
    alike = Posterior(torch.ones(7, 3), torch.full((7, 3), -6.0))
    assert latent_use(alike).frame_information_nats == pytest.approx(0, abs=1e-9)
    assert latent_use(alike).kl_nats > 5, "narrow and shifted, it costs nats all the same"


def test_information_about_frames_is_that_of_a_gaussian_channel():
    """Means spread with deviation s, noise of deviation 1: log(1 + s^2) / 2 for each entry, for as many frames as hide each other."""
    mu = 0.8 * torch.randn((3000, 2), generator=torch.Generator().manual_seed(4))
    found = latent_use(Posterior(mu, torch.zeros(3000, 2))).frame_information_nats
    assert found == pytest.approx(math.log(1 + 0.8**2), rel=0.05)


def leaking_posterior(frames: int, entries: int, correlation: float) -> tuple[Posterior, torch.Tensor]:
    """Codes correlated entry by entry with a driving signal of as many entries, and four idle entries on both sides."""
    generator = torch.Generator().manual_seed(1)
    driving = torch.randn((frames, entries + 4), generator=generator)
    mu = torch.cat([correlation * driving[:, :entries], torch.zeros(frames, 4)], dim=1)
    logvar = torch.cat([torch.full((frames, entries), math.log(1 - correlation**2)), torch.zeros(frames, 4)], dim=1)
    return Posterior(mu, logvar), driving


def test_a_fresh_estimate_is_within_a_tenth_of_the_closed_form():
    estimate = fresh_mutual_information(*leaking_posterior(1600, 3, 0.7), steps=150)
    assert estimate == pytest.approx(-1.5 * math.log(1 - 0.7**2), rel=0.1)


def test_a_fresh_estimate_of_independent_codes_is_zero_even_where_frames_could_be_memorised():
    """120 frames of twenty entries: an estimator judged on the frames that it learnt would claim several nats."""
    generator = torch.Generator().manual_seed(2)
    posterior = Posterior(torch.randn((120, 20), generator=generator), torch.full((120, 20), -4.0))
    assert fresh_mutual_information(posterior, torch.randn((120, 20), generator=generator), steps=75) < 0.1


def test_too_few_frames_are_refused():
    posterior = Posterior(torch.zeros(31, 2), torch.zeros(31, 2))
    with pytest.raises(ValueError, match="got 8 and 31 frames"):
        fresh_mutual_information(posterior, torch.zeros(31, 3), block_frames=8)


def test_a_linear_probe_finds_what_z_holds_and_nothing_more():
    """Of a target whose halves of the variance come from z and from elsewhere, a half is read off."""
    generator = np.random.default_rng(0)
    z, held_out = generator.normal(size=(400, 10)), generator.normal(size=(300, 10))
    mix = generator.normal(size=(10, 6))

    def target(codes: np.ndarray, noise: float) -> np.ndarray:
        hidden = codes @ mix
        return 3.0 + hidden + noise * hidden.std() * generator.normal(size=hidden.shape)

    assert linear_probe(z, target(z, 0.0), held_out, target(held_out, 0.0)) > 0.999
    assert linear_probe(z, target(z, 1.0), held_out, target(held_out, 1.0)) == pytest.approx(0.5, abs=0.06)
    strangers = generator.normal(size=(300, 10))
    unrelated = linear_probe(z, target(generator.normal(size=(400, 10)), 0.0), strangers, target(held_out, 0.0))
    assert -0.02 < unrelated < 0.02, "a code that tells nothing is not read, nor does it spoil the mean"
    with pytest.raises(ValueError, match="that differ from the training mean"):
        linear_probe(z, target(z, 0.0), held_out, np.tile(target(z, 0.0).mean(0), (300, 1)))
