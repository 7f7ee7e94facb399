"""Layers that every network of the avatar is made of: convolutions whose biases differ from texel to texel.

In a texture atlas a location *means* something (this texel is the left elbow), so a bias of its own for every channel and location
lets a convolutional network treat places differently while its weights stay shared. No layer normalises over the map: that would
couple all locations and undo the localized conditioning. Maps are [B, C, H, W], texels on a square grid of `size`.

Transposed convolutions upsample: on a CPU they cost two to four times less than bilinear upsampling with a convolution, and a kernel
of 4 at stride 2 covers every output texel with the same number of taps, so they leave no checkerboard.

Source: arXiv:2105.10441, section 3.3 (untied biases); the use of them throughout the decoder is our choice.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn

NEGATIVE_SLOPE = 0.2  # of every leaky ReLU


class UntiedBias(nn.Module):
    """Adds one learnt number per channel and location, zero at first.

    Args:
        channels: C of the maps it is added to.
        size: height and width of those maps, texels.
    """

    def __init__(self, channels: int, size: int):
        super().__init__()
        # Stored with channels last, as the maps themselves lie in memory (see `channels_last`), and therefore contiguous in a checkpoint.
        self.bias = nn.Parameter(torch.zeros(size, size, channels))

    def forward(self, maps: Float[Tensor, "B C S S"]) -> Float[Tensor, "B C S S"]:
        """Maps plus bias, of the maps' own type. Gradients: to both."""
        return maps + self.bias.permute(2, 0, 1).to(maps.dtype)


def channels_last(maps: Float[Tensor, "B C H W"]) -> Float[Tensor, "B C H W"]:
    """The same maps with channels last in memory; convolutions keep that order, and on a CPU it makes them 1.2 to 5 times faster."""
    return maps.contiguous(memory_format=torch.channels_last)


def in_full_precision(layer: nn.Module, features: Float[Tensor, "B *sizes"]) -> Float[Tensor, "B *sizes_out"]:
    """Apply a layer in the type of its parameters, also where mixed precision computes the rest in bfloat16.

    For layers whose output is a posterior or a gain.
    """
    device = features.device.type
    if not torch.amp.is_autocast_available(device) or not torch.is_autocast_enabled(device):
        return layer(features)
    with torch.autocast(device, enabled=False):
        return layer(features.to(next(layer.parameters()).dtype))


def biased_in_full_precision(layer: nn.Sequential, features: Float[Tensor, "B C S S"]) -> Float[Tensor, "B D _ _"]:
    """A last layer, whose untied biases are added in their own type also where mixed precision computes the rest in bfloat16.

    Nearly all of a displacement or a texture that does not change from frame to frame is in these biases. Of what the convolution adds
    eight bits are enough: 0.06 mm of a fold of three centimetres.
    """
    weighted, bias = layer
    return bias(weighted(features).to(weighted.weight.dtype))


def convolution(in_channels: int, out_channels: int, size: int, kernel: int = 3) -> nn.Sequential:
    """Convolution that keeps the size of its map, with untied biases.

    Args:
        in_channels, out_channels: C before and after.
        size: height and width of the map, texels.
        kernel: odd width of the kernel.
    """
    layer = nn.Conv2d(in_channels, out_channels, kernel, padding=kernel // 2, bias=False)
    _initialize(layer.weight, fan_in=in_channels * kernel**2)
    return nn.Sequential(layer, UntiedBias(out_channels, size))


def doubling(in_channels: int, out_channels: int, size: int) -> nn.Sequential:
    """Transposed convolution to twice the size, with untied biases.

    Args:
        in_channels, out_channels: C before and after.
        size: height and width *after* doubling, texels.
    """
    layer = nn.ConvTranspose2d(in_channels, out_channels, kernel_size=4, stride=2, padding=1, bias=False)
    _initialize(layer.weight, fan_in=in_channels * 4)  # of the 4x4 taps, 2x2 meet any one output texel
    return nn.Sequential(layer, UntiedBias(out_channels, size))


def start_at_zero(layer: nn.Sequential) -> nn.Sequential:
    """Zero the weights of a last layer (its biases are zero already), so that an untrained branch adds nothing; returns the layer."""
    nn.init.zeros_(layer[0].weight)
    return layer


def _initialize(weight: Tensor, fan_in: int) -> None:
    """He's normal initialisation for leaky ReLU; written out because torch takes the wrong fan for transposed convolutions."""
    nn.init.normal_(weight, std=math.sqrt(2 / ((1 + NEGATIVE_SLOPE**2) * fan_in)))
