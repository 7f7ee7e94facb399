"""Light from far away, as an equirectangular image around the avatar.

Row 0 is the zenith (world +z), the last row the nadir; columns run over the azimuth from +x towards +y, texel centres at half-integers:
u = azimuth / 2 pi, v = 1 - polar angle / pi.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from mitsuba_avatar.rendering.backend import loaded_mitsuba
from mitsuba_avatar.rendering.bridge import flat_array
from mitsuba_avatar.rendering.texture_lookup import Footprint


class EnvironmentMap:
    """An image of the light around the scene.

    Args:
        radiance: [3, h, w] linear.
    """

    def __init__(self, radiance: Float[Tensor, "3 h w"]):
        self.height, self.width = radiance.shape[1:]
        # One column of the other end on either side: lookups interpolate across the image's vertical border.
        wrapped = torch.cat([radiance[:, :, -1:], radiance, radiance[:, :, :1]], dim=2)
        self._packets = flat_array(torch.nn.functional.pad(wrapped.permute(1, 2, 0), (0, 1)))

    def radiance_from(self, direction):
        """Radiance (Color3f) that arrives from unit directions (Vector3f, world axes), bilinear."""
        import drjit as dr

        mi = loaded_mitsuba()
        azimuth = dr.atan2(direction.y, direction.x) * (0.5 / math.pi)
        azimuth -= dr.floor(azimuth)
        polar = dr.acos(dr.clip(direction.z, -1.0, 1.0)) * (1.0 / math.pi)
        uv = mi.Point2f((azimuth * self.width + 1.0) / (self.width + 2), 1.0 - polar)
        return Footprint.at(uv, mi.UInt32(0), self.height, self.width + 2).value(self._packets)
