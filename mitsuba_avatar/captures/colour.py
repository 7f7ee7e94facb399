"""Colour curves: between linear radiance, which the project computes with, and the encoded values that image files hold.

`linear` stores radiance itself, `srgb` the piecewise curve of IEC 61966-2-1. Curves act on each channel alone; primaries are not
touched. Encoded and linear values both call the file's white 1. Values outside 0..1 pass through the same formulas unclipped
(negative ones along the straight piece), so that decode(encode(x)) = x for x >= 0 and highlights survive in float formats.
"""

from functools import cache
from typing import Literal, TypeVar

import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from torch import Tensor

ColourCurve = Literal["srgb", "linear"]
Array = TypeVar("Array", np.ndarray, Tensor)

SRGB_LINEAR_KNEE = 0.0031308  # linear value where the straight piece ends
SRGB_ENCODED_KNEE = 0.04045  # the same point, encoded


def encode(linear: Array, curve: str) -> Array:
    """Encoded values of linear ones, numpy or torch, any shape, dtype kept.

    Gradients: flow through every element and are finite everywhere.

    Raises:
        ValueError: for an unknown curve.
    """
    if not _is_srgb(curve, "encode"):
        return linear
    if isinstance(linear, Tensor):
        return _SrgbEncoding.apply(linear)
    # Clipping the unused branch keeps its power, and the gradient of its power, from becoming NaN below the knee.
    curved = 1.055 * linear.clip(SRGB_LINEAR_KNEE, None) ** (1 / 2.4) - 0.055
    return _where(linear <= SRGB_LINEAR_KNEE, 12.92 * linear, curved)


class _SrgbEncoding(torch.autograd.Function):
    """The curve with its own derivative, for which the power need not be taken again: every training step encodes its pictures."""

    @staticmethod
    def forward(context, linear):
        is_straight = linear <= SRGB_LINEAR_KNEE
        clipped = linear.clip(SRGB_LINEAR_KNEE, None)  # keeps the power of the unused branch from becoming NaN
        power = clipped.pow(1 / 2.4).mul_(1.055)
        context.save_for_backward(is_straight, clipped, power)
        return torch.where(is_straight, 12.92 * linear, power - 0.055)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(context, gradient):
        is_straight, clipped, power = context.saved_tensors
        return gradient * torch.where(is_straight, 12.92, (power / clipped).mul_(1 / 2.4))


def decode(encoded: Array, curve: str) -> Array:
    """Linear values of encoded ones: the inverse of `encode`.

    Gradients: flow through every element and are finite everywhere.

    Raises:
        ValueError: for an unknown curve.
    """
    if not _is_srgb(curve, "decode"):
        return encoded
    curved = ((encoded.clip(SRGB_ENCODED_KNEE, None) + 0.055) / 1.055) ** 2.4
    return _where(encoded <= SRGB_ENCODED_KNEE, encoded / 12.92, curved)


def encode_bytes(linear: Float[np.ndarray, "*shape"], curve: str) -> UInt8[np.ndarray, "*shape"]:
    """Encode for an 8-bit file: clipped to 0..1 and rounded to the nearest of 256 levels. NaN is refused.

    Raises:
        ValueError: if a value is NaN, or for an unknown curve.
    """
    if np.isnan(linear).any():
        raise ValueError(
            f"encode_bytes(): expected numbers; got {int(np.isnan(linear).sum())} NaN. Find the renderer's or reader's fault first."
        )
    return np.rint(encode(linear, curve).clip(0.0, 1.0) * 255.0).astype(np.uint8)


def decode_bytes(encoded: UInt8[np.ndarray, "*shape"], curve: str) -> Float32[np.ndarray, "*shape"]:
    """Decode an 8-bit image by table: exact, and several times faster than the power function."""
    return _byte_table(curve)[encoded]


@cache
def _byte_table(curve: str) -> Float32[np.ndarray, "256"]:
    """Linear value of each byte, computed in float64 and rounded once."""
    return decode(np.arange(256, dtype=np.float64) / 255.0, curve).astype(np.float32)


def _is_srgb(curve: str, caller: str) -> bool:
    """Which of the two curves; refuses others."""
    if curve not in ("srgb", "linear"):
        raise ValueError(f"{caller}(): expected the curve 'srgb' or 'linear'; got {curve!r}. Correct colour_curve in capture.yaml.")
    return curve == "srgb"


def _where(condition: Array, if_true: Array, if_false: Array) -> Array:
    """`where` of the library that the arrays come from."""
    return torch.where(condition, if_true, if_false) if isinstance(condition, Tensor) else np.where(condition, if_true, if_false)
