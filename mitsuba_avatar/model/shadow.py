"""The shadow branch: from ambient occlusion of the posed template to a gain map that multiplies the texture.

Self-shadowing reaches across the body and would break the locality of the decoder; ambient occlusion carries it instead. There is no
direct supervision: the image loss alone teaches the network what occlusion does to radiance under the capture's light.

Source: arXiv:2105.10441, section 3.4.2.
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from mitsuba_avatar.model.layers import NEGATIVE_SLOPE, channels_last, in_full_precision
from mitsuba_avatar.settings import ModelSettings

# Bound on |log gain|: a gain stays within 1/7.4 .. 7.4, so no early step can black out a texture or let it explode.
LARGEST_LOG_GAIN = 2.0


class ShadowUNet(nn.Module):
    """U-Net over the ambient-occlusion map, one level per entry of `shadow_channels`, each at half the size of the one before.

    The gain is exp of the last layer's output, which starts at zero: an untrained gain is exactly 1, always positive, and darkening by
    a factor is as easy to learn as brightening by it.
    """

    def __init__(self, settings: ModelSettings):
        super().__init__()
        widths = settings.shadow_channels
        self.down = nn.ModuleList(_level(before, after) for before, after in zip((1, *widths), widths, strict=False))
        coarse_to_fine = widths[::-1]
        self.up = nn.ModuleList(_level(below + skip, skip) for below, skip in zip(coarse_to_fine, coarse_to_fine[1:], strict=False))
        self.last = nn.Conv2d(widths[0], 1, kernel_size=1)
        nn.init.zeros_(self.last.weight)
        nn.init.zeros_(self.last.bias)

    def forward(self, ambient_occlusion: Float[Tensor, "P 1 S S"]) -> Float[Tensor, "P 1 S S"]:
        """Gain map, positive and without unit.

        Args:
            ambient_occlusion: [P, 1, S, S] in 0..1, 1 where open, defined at every texel (inpainted between charts).
        """
        features = channels_last(2 * ambient_occlusion - 1)  # centred, so that the first layer sees both signs
        skips = []
        for depth, level in enumerate(self.down):
            features = level(features if depth == 0 else functional.avg_pool2d(features, 2))
            skips.append(features)
        skips.pop()
        for level in self.up:
            wider = functional.interpolate(features, scale_factor=2, mode="bilinear", align_corners=False)
            features = level(torch.cat([wider, skips.pop()], dim=1))
        bounded = torch.tanh(in_full_precision(self.last, features) / LARGEST_LOG_GAIN)
        return torch.exp(LARGEST_LOG_GAIN * bounded)


def _level(in_channels: int, out_channels: int) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(in_channels, out_channels, kernel_size=3, padding=1), nn.LeakyReLU(NEGATIVE_SLOPE))
