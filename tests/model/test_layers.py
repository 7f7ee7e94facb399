"""Layers: shapes of untied biases, memory order, and the variance that initialisation promises."""

import pytest
import torch

from mitsuba_avatar.model.layers import UntiedBias, channels_last, convolution, doubling, start_at_zero


def test_untied_bias_has_one_number_per_channel_and_location():
    layer = UntiedBias(5, 8)
    assert layer.bias.numel() == 5 * 8 * 8
    with torch.no_grad():
        layer.bias[6, 2, 4] = 1.5  # row 6, column 2, channel 4
    maps = layer(torch.zeros(2, 5, 8, 8))
    assert maps[:, 4, 6, 2].tolist() == [1.5, 1.5]
    assert maps.count_nonzero() == 2


def test_doubling_doubles_and_convolution_keeps():
    maps = torch.randn(2, 3, 8, 8)
    assert doubling(3, 4, 16)(maps).shape == (2, 4, 16, 16)
    assert convolution(3, 4, 8)(maps).shape == (2, 4, 8, 8)
    assert convolution(3, 4, 8, kernel=1)(maps).shape == (2, 4, 8, 8)


@pytest.mark.parametrize("make", [lambda: convolution(32, 512, 16), lambda: doubling(32, 512, 32)])
def test_initialisation_keeps_the_mean_square(make):
    torch.manual_seed(0)
    maps = torch.nn.functional.leaky_relu(torch.randn(4, 32, 16, 16), 0.2)
    scale = maps.square().mean()
    result = torch.nn.functional.leaky_relu(make()(maps), 0.2).square().mean().detach()
    assert float(result) == pytest.approx(float(scale), rel=0.15)


def test_order_in_memory_changes_nothing_but_the_order():
    torch.manual_seed(0)
    layer, maps = doubling(6, 5, 16), torch.randn(2, 6, 8, 8)
    result = layer(channels_last(maps))
    assert result.is_contiguous(memory_format=torch.channels_last)
    assert not result.is_contiguous()
    torch.testing.assert_close(result, layer(maps))
    assert all(value.is_contiguous() for value in layer.state_dict().values())


def test_a_layer_that_starts_at_zero_gives_zero():
    assert not start_at_zero(doubling(3, 4, 16))(torch.randn(2, 3, 8, 8)).any()
