"""Shadow branch: neutral at first, positive and bounded always, right gradients."""

import math

import torch

from mitsuba_avatar.model.shadow import ShadowUNet
from mitsuba_avatar.settings import ModelSettings


def make_network(gain_weight: float) -> ShadowUNet:
    torch.manual_seed(0)
    network = ShadowUNet(ModelSettings(shadow_channels=(3, 4, 5)))
    torch.nn.init.normal_(network.last.weight, std=gain_weight)
    return network


def test_an_untrained_gain_is_exactly_one():
    assert torch.equal(make_network(0.0)(torch.rand(2, 1, 16, 16)), torch.ones(2, 1, 16, 16))


def test_gain_stays_positive_and_bounded_whatever_the_weights():
    gain = make_network(1e4)(torch.rand(2, 1, 16, 16))
    assert gain.min() < 0.2
    assert gain.max() > 5.0
    assert gain.min() > 0.99 * math.exp(-2.0)
    assert gain.max() < 1.01 * math.exp(2.0)


def test_every_level_contributes():
    network = make_network(0.3)
    network(torch.rand(2, 1, 16, 16)).square().sum().backward()
    assert all(parameter.grad.any() for parameter in network.parameters())


def test_gradient_equals_finite_differences():
    network = make_network(0.5).double()
    assert torch.autograd.gradcheck(network, torch.rand(2, 1, 8, 8, dtype=torch.float64, requires_grad=True), fast_mode=True)
