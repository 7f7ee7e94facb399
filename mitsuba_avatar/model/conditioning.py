"""Spatially localized driving signals: e = proj(M o tile2d(signal)), for the joint angles theta and for the face signal f.

A driving signal is standardised, repeated over the map, masked to the region of the surface it governs and compressed at every
location by two 1x1 convolutions with untied biases. Because what follows is convolutional too, a joint angle cannot reach a texel
farther from its region than the decoder's receptive field: chance correlations between distant parts cannot be learnt.

Symbols: D entries of the signal, S texels along the conditioning map, C channels of the embedding.

Source: arXiv:2105.10441, section 3.3.
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mitsuba_avatar.model.layers import NEGATIVE_SLOPE, convolution


class Standardization(nn.Module):
    """Shift a signal by its training mean and scale *all* of it by one number: (signal - mean) / max std.

    Entries share a unit (radians, or metres), so one scale keeps their proportions. Dividing each by its own deviation would blow up
    an angle that hardly moved in training to many deviations at its first real movement: on a capture whose test takes recombine limb
    motions, that raised the error of driven test vertices by 40 %.

    Args:
        mean, std: [D] in the signal's own unit.
    """

    def __init__(self, mean: Float[Tensor, "D"], std: Float[Tensor, "D"]):  # noqa: F821
        super().__init__()
        self.register_buffer("mean", mean.clone())
        self.register_buffer("std", std.clone())

    def forward(self, signal: Float[Tensor, "B D"]) -> Float[Tensor, "B D"]:
        """Standardised signal, without unit; a signal that never moves (all deviations zero) is only shifted."""
        largest = self.std.max()
        return (signal - self.mean) / torch.where(largest > 0, largest, torch.ones_like(largest))


class LocalizedSignal(nn.Module):
    """Maps of one driving signal: mask, then compress at every location.

    Args:
        masks: [D, S, S] in {0, 1}, where each entry may act; all ones for a signal that reaches everywhere.
        channels: C of the embedding, or None to hand on the masked signal itself (then C = D), divided by the root of D. Adam moves each
            of the next layer's weights by the learning rate at every step, so that its output would jump by as much as there are
            entries: undivided, 250 of them ended a run within 80 steps.
    """

    def __init__(self, masks: Float[Tensor, "D S S"], channels: int | None):
        super().__init__()
        # Rebuilt from the rig, hence no part of a checkpoint. Entries last in memory, as the products of the masks are wanted.
        self.register_buffer("masks_entries_last", masks.permute(1, 2, 0).contiguous(), persistent=False)
        entries, size = masks.shape[:2]
        self.channels = entries if channels is None else channels
        self.scale = entries**-0.5 if channels is None else 1.0
        self.projection = nn.Identity()
        if channels is not None:
            first, second = convolution(entries, channels, size, kernel=1), convolution(channels, channels, size, kernel=1)
            self.projection = nn.Sequential(first, nn.LeakyReLU(NEGATIVE_SLOPE), second)

    def forward(self, signal: Float[Tensor, "B D"]) -> Float[Tensor, "B C S S"]:
        """Embedding e of a standardised signal. Outside its masks an entry has no influence whatever."""
        masked = self.masks_entries_last * (self.scale * signal)[:, None, None]  # [B, S, S, D]
        return self.projection(masked.permute(0, 3, 1, 2))

    @property
    def masks(self) -> Float[Tensor, "D S S"]:
        """Where each entry may act, 0 or 1."""
        return self.masks_entries_last.permute(2, 0, 1)
