"""Localized conditioning: the equation by hand, no influence outside a mask, and signals that hardly move."""

import torch
from torch.autograd import gradcheck

from mitsuba_avatar.model.conditioning import LocalizedSignal, Standardization


def make_masks() -> torch.Tensor:
    """Three entries on a 6 x 6 map: a corner, a stripe, everywhere."""
    masks = torch.zeros(3, 6, 6)
    masks[0, :2, :3] = 1
    masks[1, :, 4] = 1
    masks[2] = 1
    return masks


def filled(layer: LocalizedSignal) -> LocalizedSignal:
    for parameter in layer.parameters():
        torch.nn.init.normal_(parameter)
    return layer


def test_embedding_equals_the_equation_evaluated_location_by_location():
    torch.manual_seed(0)
    masks, signal = make_masks(), torch.randn(2, 3)
    layer = filled(LocalizedSignal(masks, channels=4))
    (first, first_bias), _, (second, second_bias) = layer.projection
    expected = torch.zeros(2, 4, 6, 6)
    for row in range(6):
        for column in range(6):
            masked = signal * masks[:, row, column]
            hidden = masked @ first.weight[:, :, 0, 0].T + first_bias.bias[row, column]
            hidden = torch.where(hidden > 0, hidden, 0.2 * hidden)
            expected[:, :, row, column] = hidden @ second.weight[:, :, 0, 0].T + second_bias.bias[row, column]
    torch.testing.assert_close(layer(signal), expected)


def test_an_entry_has_no_influence_outside_its_mask():
    torch.manual_seed(0)
    masks, signal = make_masks(), torch.randn(2, 3)
    layer = filled(LocalizedSignal(masks, channels=4))
    for entry in range(3):
        moved = signal.clone()
        moved[:, entry] += 1.0
        changed = (layer(moved) != layer(signal)).any(dim=0).any(dim=0)
        assert torch.equal(changed, masks[entry] > 0)


def test_without_compression_the_masked_signal_itself_comes_out_in_units_of_the_root_of_its_entries():
    masks, signal = make_masks(), torch.randn(2, 3)
    layer = LocalizedSignal(masks, channels=None)
    assert layer.channels == 3
    torch.testing.assert_close(layer(signal), masks * signal[:, :, None, None] / 3**0.5)
    assert not list(layer.parameters())


def test_gradient_equals_finite_differences():
    torch.manual_seed(0)
    layer = filled(LocalizedSignal(make_masks(), channels=2)).double()
    assert gradcheck(layer, torch.randn(2, 3, dtype=torch.float64, requires_grad=True), fast_mode=True)


def test_standardization_keeps_the_proportions_of_a_signal():
    layer = Standardization(torch.tensor([1.0, 2.0, 3.0]), torch.tensor([0.5, 2.0, 1e-9]))
    result = layer(torch.tensor([[2.0, 0.0, 3.2], [1.0, 2.0, 3.0]]))
    torch.testing.assert_close(result, torch.tensor([[0.5, -1.0, 0.1], [0.0, 0.0, 0.0]]))


def test_a_signal_that_never_moves_is_only_shifted():
    layer = Standardization(torch.tensor([1.0, 2.0]), torch.zeros(2))
    assert torch.equal(layer(torch.tensor([[1.5, 2.0], [1.0, 1.0]])), torch.tensor([[0.5, 0.0], [0.0, -1.0]]))
