"""The running estimate on toy problems whose mutual information is known, and a planted leak that is detected and driven out."""

import math

import pytest
import torch

from mitsuba_avatar.model.disentanglement import LARGEST_SCORE, StatisticsNetwork, mismatched, mutual_information_bound
from mitsuba_avatar.model.encoder import Posterior
from mitsuba_avatar.settings import DisentanglementSettings
from mitsuba_avatar.training.mutual_information import FEWEST_PAIRS, MutualInformation

pytestmark = pytest.mark.usefixtures("one_thread")


def correlated(rows: int, entries: int, correlation: float, generator: torch.Generator) -> tuple[Posterior, torch.Tensor]:
    """q(z) and c, entry by entry correlated; their mutual information is -entries / 2 * log(1 - correlation^2)."""
    driving = torch.randn((rows, entries), generator=generator)
    return Posterior(correlation * driving, torch.full_like(driving, math.log(max(1 - correlation**2, 1e-12)))), driving


def drawn(posterior: Posterior, generator: torch.Generator) -> torch.Tensor:
    """z of a posterior."""
    return posterior.sample(torch.randn(posterior.mu.shape, generator=generator))


def exact(z: torch.Tensor) -> Posterior:
    """The posterior of an encoder that is sure of its code."""
    return Posterior(z.detach(), torch.full_like(z, -30.0))


def observed(entries: int, correlation: float, steps: int, poses: int = 8, memory: int = 512, updates: int = 1) -> MutualInformation:
    """An estimator that saw batches of a few pairs."""
    information = MutualInformation(entries, entries, DisentanglementSettings(memory=memory, updates=updates))
    generator = torch.Generator().manual_seed(3)
    for _ in range(steps):
        information.observe(*correlated(poses, entries, correlation, generator))
    return information


@pytest.mark.parametrize(("entries", "correlation"), [(2, 0.7), (4, 0.6)])
def test_correlated_gaussians_within_a_tenth(entries, correlation):
    """From batches of sixteen, by way of the memory."""
    estimate = observed(entries, correlation, 440, poses=16, memory=2048).estimate
    assert estimate == pytest.approx(-entries / 2 * math.log(1 - correlation**2), rel=0.1)


def test_independent_variables_have_none():
    assert observed(3, 0.0, 250, poses=16, memory=2048).estimate < 0.1


def test_small_batches_alone_teach_far_less_than_the_memory():
    """Why there is a memory: the same batches of two pairs, learnt from as they come, by as many updates."""
    information = MutualInformation(4, 4, DisentanglementSettings(updates=1))
    alone = StatisticsNetwork(4, 4, information.settings.statistics_channels)
    optimizer = torch.optim.Adam(alone.parameters(), lr=information.settings.statistics_learning_rate)
    generator, shuffles = torch.Generator().manual_seed(3), torch.Generator().manual_seed(4)
    for _ in range(250):
        posterior, driving = correlated(2, 4, 0.8, generator)
        information.observe(posterior, driving)
        z = drawn(posterior, shuffles)
        optimizer.zero_grad()
        (-mutual_information_bound(alone(z, driving), alone(z[None], mismatched(driving, 1, shuffles)))).backward()
        optimizer.step()
    true = -2 * math.log(1 - 0.8**2)
    assert judged(information.network, 4, 0.8) > 0.7 * true
    assert judged(alone, 4, 0.8) < 0.5 * true


def judged(network: StatisticsNetwork, entries: int, correlation: float) -> float:
    """The bound on pairs that the network never saw."""
    generator = torch.Generator().manual_seed(9)
    posterior, driving = correlated(1000, entries, correlation, generator)
    z = drawn(posterior, generator)
    with torch.no_grad():
        return float(mutual_information_bound(network(z, driving), network(z[:, None], driving[None, :300])))


def test_a_copy_of_the_pose_is_detected_and_cannot_diverge():
    information = observed(4, 1.0, 200, poses=16)
    assert 2.5 < information.estimate <= LARGEST_SCORE
    assert all(torch.isfinite(parameter).all() for parameter in information.network.parameters())


def test_absurd_inputs_leave_a_finite_estimate():
    information = MutualInformation(2, 2, DisentanglementSettings(memory=128, pairs=32))
    generator = torch.Generator().manual_seed(0)
    for step in range(60):
        posterior, driving = correlated(8, 2, 0.9, generator)
        information.observe(exact(drawn(posterior, generator) * 10.0 ** (step % 7)), driving)
    assert 0 <= information.estimate <= LARGEST_SCORE and math.isfinite(information.mean_exp)


def train_toy_encoder(weight: float, steps: int) -> tuple[float, float, MutualInformation]:
    """A linear autoencoder of x = (pose, state) whose decoder is given the pose, and whose code begins as a copy of both.

    Returns:
        True mutual information of code and pose, how much of the state reaches the code, the estimator.
    """
    generator = torch.Generator().manual_seed(0)
    encoder, decoder = torch.nn.Linear(4, 4, bias=False), torch.nn.Linear(6, 4, bias=False)
    with torch.no_grad():
        encoder.weight.copy_(torch.eye(4))
        decoder.weight.copy_(torch.cat([torch.eye(4), torch.zeros(4, 2)], dim=1))
    optimizer = torch.optim.Adam([*encoder.parameters(), *decoder.parameters()], lr=3e-3)
    information = MutualInformation(4, 2, DisentanglementSettings())
    for _ in range(steps):
        x = torch.randn((8, 4), generator=generator)
        mu, pose = encoder(x), x[:, :2]
        posterior = Posterior(mu, torch.full_like(mu, 2 * math.log(0.3)))
        z = drawn(posterior, generator)
        loss = (decoder(torch.cat([z, pose], dim=1)) - x).square().sum(1).mean() + 0.02 * z.square().sum(1).mean()
        loss = loss + weight * information.penalty(z, pose)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        information.observe(posterior, pose)
    columns = encoder.weight.detach()
    without_pose = columns[:, 2:] @ columns[:, 2:].T + 0.09 * torch.eye(4)
    true = 0.5 * float(torch.logdet(without_pose + columns[:, :2] @ columns[:, :2].T) - torch.logdet(without_pose))
    return true, float(columns[:, 2:].norm(dim=0).mean()), information


def test_a_planted_leak_is_detected_and_driven_out_and_the_state_stays():
    leak, state, watched = train_toy_encoder(0.0, 80)
    assert leak > 2.0 and watched.estimate > 1.0, "without the penalty it stays, and is seen"
    remaining, kept, information = train_toy_encoder(0.3, 350)
    assert remaining < 0.15 * leak and information.estimate < 0.5
    assert kept > 0.9 * state


def test_codes_of_pure_noise_are_left_alone():
    """A wide code and few frames, which the network learns by heart: what it has memorised is no reason to push the encoder."""
    generator = torch.Generator().manual_seed(0)
    frames = torch.randn((40, 30), generator=generator)
    information = MutualInformation(60, 30, DisentanglementSettings())
    values, pushes = [], []
    for step in range(200):
        z = torch.randn((2, 60), generator=generator).requires_grad_()
        driving = frames[[2 * step % 40, (2 * step + 1) % 40]]
        penalty = information.penalty(z, driving)
        penalty.backward()
        values.append(float(penalty.detach()))
        pushes.append(float(z.grad.abs().max()))
        information.observe(exact(z), driving)
    assert sum(push > 0 for push in pushes) < 20 and max(values) < 0.1


def test_a_frame_met_again_is_judged_by_its_posterior_not_by_the_draw_that_was_seen():
    """A narrow leak through a wide, noisy code: a network that learns from the draws of each meeting knows them and misses half of it."""
    generator = torch.Generator().manual_seed(0)
    frames = torch.randn((80, 4), generator=generator)
    posteriors = Posterior(torch.cat([1.5 * frames, torch.zeros(80, 60)], dim=1), torch.zeros(80, 64))
    again, once = (MutualInformation(64, 4, DisentanglementSettings()) for _ in range(2))
    for step in range(150):
        rows = torch.arange(4 * step, 4 * step + 4) % 80
        posterior = Posterior(posteriors.mu[rows], posteriors.logvar[rows])
        again.observe(posterior, frames[rows])
        once.observe(exact(drawn(posterior, generator)), frames[rows])
    true = 2 * math.log(1 + 1.5**2)
    z = drawn(posteriors, generator)
    with torch.no_grad():
        found, missed = (mutual_information_bound(one.network(z, frames), one.network(z[:, None], frames[None])) for one in (again, once))
    assert float(found) > 0.7 * true and float(missed) < 0.6 * true


def test_the_gradient_reaches_the_codes_and_nothing_else():
    information = observed(3, 0.8, 60)
    posterior, driving = correlated(5, 3, 0.8, torch.Generator().manual_seed(1))
    z, driving = posterior.mu.clone().requires_grad_(), driving.requires_grad_()
    penalty = information.penalty(z, driving)
    assert float(penalty.detach()) == pytest.approx(information.estimate)
    penalty.backward()
    assert (z.grad.abs().sum(1) > 0).all() and driving.grad is None
    assert float(z.grad.sum(0).abs().max()) < 1e-5 * float(z.grad.abs().max()), "codes are not to be shifted away from the network"
    information.optimizer.zero_grad(set_to_none=True)
    information.penalty(z, driving).backward()
    assert all(parameter.grad is None for parameter in information.network.parameters())


def test_before_the_memory_has_pairs_there_is_no_penalty():
    information = MutualInformation(3, 3, DisentanglementSettings())
    posterior, driving = correlated(FEWEST_PAIRS - 1, 3, 0.9, torch.Generator().manual_seed(1))
    information.observe(posterior, driving)
    penalty = information.penalty(posterior.mu.clone().requires_grad_(), driving)
    assert float(penalty.detach()) == 0 and penalty.requires_grad
    assert not any(parameter.any() for parameter in (information.network.score.weight, information.network.driving_embedding.weight))
    information.observe(Posterior(posterior.mu[:1], posterior.logvar[:1]), driving[:1])
    assert any(parameter.any() for parameter in (information.network.score.weight, information.network.driving_embedding.weight))


def test_a_restored_estimator_continues_the_same_curve():
    whole, first = observed(3, 0.8, 40, memory=100), observed(3, 0.8, 40, memory=100)
    second = MutualInformation(3, 3, DisentanglementSettings(memory=100, updates=1))
    state = {"information": first.state_dict()}
    second.load_state_dict(state["information"])
    generator = torch.Generator().manual_seed(8)
    for _ in range(10):
        posterior, driving = correlated(8, 3, 0.8, generator)
        whole.observe(posterior, driving)
        second.observe(posterior, driving)
        assert second.running == pytest.approx(whole.running, abs=1e-7)
    torch.testing.assert_close(second.network.state_dict(), whole.network.state_dict())
    with pytest.raises(ValueError, match=r"expected disentanglement\.memory and .* of \[100, 128\], as the run began; got \[50, 128\]"):
        MutualInformation(3, 3, DisentanglementSettings(memory=50)).load_state_dict(state["information"])


def test_the_avatars_random_numbers_do_not_depend_on_the_switch():
    torch.manual_seed(0)
    expected = torch.rand(3)
    torch.manual_seed(0)
    MutualInformation(2, 2, DisentanglementSettings())
    assert torch.equal(torch.rand(3), expected)
