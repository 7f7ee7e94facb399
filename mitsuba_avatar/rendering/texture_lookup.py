"""Bilinear texture lookup and its adjoint inside a Dr.Jit kernel.

Textures of a batch lie one after the other as [B, h, w] packets of four floats (r, g, b, unused), row 0 at v = 1 (see `body.uv`).
Texel centres are at half-integers; beyond the outermost centres the border texel continues.
"""

from dataclasses import dataclass

from mitsuba_avatar.rendering.backend import loaded_mitsuba


@dataclass
class Footprint:
    """The four texels under a lookup and where between them it falls: one per lane."""

    index: tuple  # UInt32 packet indices: (x0, y0), (x1, y0), (x0, y1), (x1, y1)
    fraction_x: object
    fraction_y: object

    @staticmethod
    def at(uv, texture_index, height: int, width: int) -> "Footprint":
        """Footprint of texture coordinates `uv` (Point2f) in texture `texture_index` of a batch of height x width textures."""
        import drjit as dr

        mi = loaded_mitsuba()
        x = uv.x * width - 0.5
        y = (1.0 - uv.y) * height - 0.5
        x_floor, y_floor = dr.floor(x), dr.floor(y)
        x0 = dr.clip(mi.Int32(x_floor), 0, width - 1)
        y0 = dr.clip(mi.Int32(y_floor), 0, height - 1)
        x1 = dr.clip(mi.Int32(x_floor) + 1, 0, width - 1)
        y1 = dr.clip(mi.Int32(y_floor) + 1, 0, height - 1)
        base = texture_index * (height * width)
        row0, row1 = base + mi.UInt32(y0) * width, base + mi.UInt32(y1) * width
        index = (row0 + mi.UInt32(x0), row0 + mi.UInt32(x1), row1 + mi.UInt32(x0), row1 + mi.UInt32(x1))
        return Footprint(index, x - x_floor, y - y_floor)

    def texels(self, textures, active=True) -> tuple:
        """The four texels as Color3f."""
        import drjit as dr

        mi = loaded_mitsuba()
        packets = [dr.gather(mi.Vector4f, textures, index, active) for index in self.index]
        return tuple(mi.Color3f(packet.x, packet.y, packet.z) for packet in packets)

    def value(self, textures, active=True):
        """Bilinear value, Color3f."""
        import drjit as dr

        t00, t10, t01, t11 = self.texels(textures, active)
        return dr.lerp(dr.lerp(t00, t10, self.fraction_x), dr.lerp(t01, t11, self.fraction_x), self.fraction_y)

    def derivative(self, textures, height: int, width: int, active=True) -> tuple:
        """Derivatives of the value with respect to u and v, two Color3f."""
        import drjit as dr

        t00, t10, t01, t11 = self.texels(textures, active)
        along_x = dr.lerp(t10 - t00, t11 - t01, self.fraction_y)
        along_y = dr.lerp(t01 - t00, t11 - t10, self.fraction_x)
        return along_x * width, along_y * (-height)

    def scatter_adjoint(self, gradient, adjoint, active=True) -> None:
        """Add `adjoint` (Color3f) to the gradient of the four texels by their bilinear weights."""
        import drjit as dr

        mi = loaded_mitsuba()
        fx, fy = self.fraction_x, self.fraction_y
        weights = ((1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy)
        for index, weight in zip(self.index, weights, strict=True):
            packet = mi.Vector4f(adjoint.x * weight, adjoint.y * weight, adjoint.z * weight, 0.0)
            dr.scatter_add(gradient, packet, index, active)


def texel_packets(textures):
    """Textures [B, 3, h, w] as packets [B * h * w, 4] of red, green, blue, 0: a texel is one 16-byte read, and one atomic add."""
    import drjit as dr

    mi = loaded_mitsuba()
    count, _, height, width = textures.shape
    size = height * width
    lane = dr.arange(mi.UInt32, count * size)
    first = lane + lane // size * (2 * size)
    red, green, blue = (dr.gather(mi.Float, textures.array, first + channel * size) for channel in range(3))
    packets = dr.empty(mi.Float, count * size * 4)
    dr.scatter(packets, mi.Vector4f(red, green, blue, 0.0), lane)
    return packets


def planar_texels(packets, shape: tuple[int, int, int, int]):
    """The inverse of `texel_packets`, flat."""
    import drjit as dr

    mi = loaded_mitsuba()
    count, _, height, width = shape
    size = height * width
    lane = dr.arange(mi.UInt32, count * size)
    first = lane + lane // size * (2 * size)
    packet = dr.gather(mi.Vector4f, packets, lane)
    flat = dr.empty(mi.Float, count * size * 3)
    for channel in range(3):
        dr.scatter(flat, packet[channel], first + channel * size, mode=dr.ReduceMode.NoConflicts)  # one kernel
    return flat
