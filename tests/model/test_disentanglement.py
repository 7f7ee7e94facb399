"""The statistics network and its bound: values by hand, invariance to scale, shuffles without self-pairs, the corrected gradient."""

import math

import pytest
import torch

from mitsuba_avatar.model.disentanglement import (
    LARGEST_SCORE,
    StatisticsNetwork,
    corrected_objective,
    log_mean_exp,
    mismatched,
    mutual_information_bound,
    without_common_shift,
)


def make_network(latent_size: int = 3, driving_size: int = 5) -> StatisticsNetwork:
    """Weights at random, where a fresh network has zeros too."""
    torch.manual_seed(0)
    network = StatisticsNetwork(latent_size, driving_size, 16)
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, std=0.4)
    return network


def pairs(rows: int = 40) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(1)
    return torch.randn((rows, 3), generator=generator), torch.randn((rows, 5), generator=generator)


def test_an_untrained_network_tells_nothing():
    z, driving = pairs()
    assert not StatisticsNetwork(3, 5, 16)(z, driving).any()


def test_scores_are_bounded_whatever_the_weights():
    network = make_network()
    with torch.no_grad():
        for parameter in network.parameters():
            parameter *= 100
    scores = network(*pairs())
    assert scores.abs().max() <= LARGEST_SCORE and scores.min() < -0.9 * LARGEST_SCORE < 0.9 * LARGEST_SCORE < scores.max()


def test_leading_sizes_are_broadcast():
    network, (z, driving) = make_network(), pairs()
    table = network(z[:, None], driving[None, :7])
    assert table.shape == (40, 7)
    torch.testing.assert_close(table[11, 4], network(z[11:12], driving[4:5])[0])


def test_scores_do_not_change_with_the_scale_of_codes_and_signals():
    """A leak that is made small is still seen; an entry that hardly moves is not blown up."""
    network, (z, driving) = make_network(), pairs()
    network.standardize_by(z, driving)
    scores = network(z, driving)
    network.standardize_by(1e-3 * z + 2, 40 * driving - 7)
    torch.testing.assert_close(network(1e-3 * z + 2, 40 * driving - 7), scores, rtol=1e-3, atol=1e-3)
    driving[:, 2] *= 1e-6
    network.standardize_by(z, driving)
    assert network.driving_std[2] == pytest.approx(0.05 * float(network.driving_std.max()))
    network.standardize_by(z, torch.ones_like(driving))
    assert torch.isfinite(network(z, torch.ones_like(driving))).all(), "a signal that never moves"


def test_mismatched_rows_are_shifted_and_never_their_own():
    rows = torch.arange(6.0)[:, None]
    others = mismatched(rows, 50, torch.Generator().manual_seed(0))
    assert others.shape == (50, 6, 1) and not (others == rows).any()
    assert len({tuple(shuffle.flatten().tolist()) for shuffle in others}) == 5, "every other shift occurs"
    assert all(sorted(shuffle.flatten().tolist()) == list(range(6)) for shuffle in others)


def test_bound_by_hand():
    joint, product = torch.tensor([1.0, 2.0]), torch.tensor([[0.0, math.log(3)], [math.log(2), math.log(6)]])
    assert float(mutual_information_bound(joint, product)) == pytest.approx(1.5 - math.log(3))
    assert float(log_mean_exp(torch.tensor([1000.0, 1000.0]))) == 1000.0


def test_the_corrected_gradient_is_the_bounds_own_where_the_average_is_the_batchs():
    """And the plain one is biased: averaged over small batches it differs from that of all pairs at once; the corrected one does not."""
    generator = torch.Generator().manual_seed(2)
    values = 1.5 * torch.randn(60_000, generator=generator)
    weight = torch.tensor(1.0, requires_grad=True)
    (true,) = torch.autograd.grad(mutual_information_bound(torch.zeros(1), weight * values), weight)
    mean_exp = float(values.exp().mean())
    (whole,) = torch.autograd.grad(corrected_objective(torch.zeros(1), weight * values, mean_exp), weight)
    assert float(whole) == pytest.approx(float(true), rel=1e-4)
    batches = values.view(-1, 3)
    plain = -(batches.softmax(1) * batches).sum(1).mean()
    corrected = -(batches.exp() * batches).mean() / mean_exp
    assert float(corrected) == pytest.approx(float(true), rel=1e-3) and abs(float(plain - true)) > 0.3 * abs(float(true))


def test_only_the_gradient_that_shifts_all_rows_is_taken_out():
    z, wanted = pairs(4)[0].requires_grad_(), pairs(4)[1][:, :3]
    passed = without_common_shift(z)
    assert torch.equal(passed, z)
    (passed * wanted).sum().backward()
    torch.testing.assert_close(z.grad, wanted - wanted.mean(0))
    alone = torch.zeros(1, 3, requires_grad=True)
    (without_common_shift(alone) * wanted[:1]).sum().backward()
    assert torch.equal(alone.grad, wanted[:1])
