"""Encoder and posterior: the variance convention, shapes, outliers."""

import math

import pytest
import torch

from mitsuba_avatar.model.encoder import Encoder, Posterior
from mitsuba_avatar.settings import ModelSettings


def test_std_is_the_exponential_of_half_the_logarithm_of_the_variance():
    posterior = Posterior(mu=torch.tensor([[1.0, -2.0]]), logvar=torch.tensor([[2 * math.log(3.0), 0.0]]))
    assert posterior.sample(torch.tensor([[1.0, -0.5]])).tolist() == [[pytest.approx(4.0), pytest.approx(-2.5)]]


def test_samples_have_the_mean_and_variance_that_the_posterior_states():
    torch.manual_seed(0)
    posterior = Posterior(mu=torch.full((20000, 1), 0.7), logvar=torch.full((20000, 1), -2.0))
    z = posterior.sample(torch.randn(20000, 1))
    assert z.mean() == pytest.approx(0.7, abs=0.01)
    assert z.var() == pytest.approx(math.exp(-2.0), rel=0.03)


def test_both_halves_of_the_posterior_are_as_long_as_z(settings):
    posterior = Encoder(settings)(torch.randn(3, 3, settings.encoder_size, settings.encoder_size))
    assert posterior.mu.shape == posterior.logvar.shape == (3, settings.latent_size)


def test_the_gradient_reaches_the_map_and_every_parameter(settings):
    torch.manual_seed(0)
    encoder = Encoder(settings)
    offsets = torch.randn(2, 3, settings.encoder_size, settings.encoder_size, requires_grad=True)
    posterior = encoder(offsets)
    posterior.sample(torch.ones_like(posterior.mu)).square().sum().backward()
    assert all(tensor.grad is not None and tensor.grad.any() for tensor in (offsets, *encoder.parameters()))


def test_a_vertex_flung_away_does_not_drown_the_others(settings):
    torch.manual_seed(0)
    encoder = Encoder(settings)
    offsets = torch.zeros(2, 3, settings.encoder_size, settings.encoder_size)
    offsets[0, :, 5, 7], offsets[1, :, 5, 7] = 10.0, 1e6
    posterior = encoder(offsets)
    assert torch.equal(posterior.mu[0], posterior.mu[1])


def test_a_surface_far_from_all_others_sends_its_code_no_farther_than_an_ordinary_one(settings):
    """Ten times the offsets: a code in the same direction, not ten times as far, which the KL term would square."""
    torch.manual_seed(0)
    encoder = Encoder(settings)
    with torch.no_grad():
        for layer in encoder.convolutions[::2]:
            layer.weight *= 4.0  # as training grows them
    offsets = torch.randn(2, 3, settings.encoder_size, settings.encoder_size).clamp(-1, 1)
    ordinary, far = encoder(offsets).mu, encoder(10.0 * offsets).mu
    assert torch.nn.functional.cosine_similarity(ordinary, far).min() > 0.9
    assert (far.norm(dim=1) < 1.5 * ordinary.norm(dim=1)).all()


def test_gradient_equals_finite_differences():
    torch.manual_seed(0)
    encoder = Encoder(ModelSettings(latent_size=3, encoder_size=8, encoder_channels=(3, 4))).double()
    offsets = torch.randn(2, 3, 8, 8, dtype=torch.float64, requires_grad=True)
    noise = torch.randn(2, 3, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda maps: encoder(maps).sample(noise), offsets, fast_mode=True)
