"""Colour curves against colour-science, their inverses, their gradients, and the byte table."""

import warnings

import numpy as np
import pytest
import torch

from mitsuba_avatar.captures.colour import decode, decode_bytes, encode, encode_bytes

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # colour-science warns about optional packages that this test does not need
    import colour


def ramp() -> np.ndarray:
    """Values on both sides of the knee, beyond white, and in an order without pattern; 7x11."""
    return np.random.default_rng(3).permutation(np.concatenate([np.linspace(0, 0.05, 30), np.linspace(0.05, 3.0, 47)])).reshape(7, 11)


def test_srgb_equals_colour_science():
    """The library prefers its own knee constants; formulas and constants agree to 1e-6."""
    np.testing.assert_allclose(encode(ramp(), "srgb"), colour.cctf_encoding(ramp(), function="sRGB"), atol=1e-6)
    np.testing.assert_allclose(decode(ramp(), "srgb"), colour.cctf_decoding(ramp(), function="sRGB"), atol=1e-6)


def test_known_values():
    np.testing.assert_allclose(encode(np.array([0.0, 0.18, 1.0]), "srgb"), [0.0, 0.461356, 1.0], atol=1e-6)


@pytest.mark.parametrize("curve", ["srgb", "linear"])
def test_round_trip_in_both_libraries(curve):
    values = ramp().astype(np.float32)
    np.testing.assert_allclose(decode(encode(values, curve), curve), values, rtol=2e-5, atol=1e-7)
    tensor = torch.from_numpy(values)
    np.testing.assert_allclose(encode(tensor, curve).numpy(), encode(values, curve), rtol=1e-6)
    np.testing.assert_allclose(decode(tensor, curve).numpy(), decode(values, curve), rtol=2e-6, atol=1e-9)
    assert encode(values, curve).dtype == np.float32 and decode(tensor, curve).dtype == torch.float32


@pytest.mark.parametrize("function", [encode, decode])
def test_gradients_match_finite_differences_and_stay_finite(function):
    """Including a negative value, zero, and both sides of the knee."""
    values = torch.tensor([[-0.1, 0.0, 0.001], [0.01, 0.3, 1.7]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: function(x, "srgb"), values)


@pytest.mark.parametrize("curve", ["srgb", "linear"])
def test_bytes_round_trip(curve):
    levels = np.arange(256, dtype=np.uint8).reshape(8, 32)
    np.testing.assert_array_equal(encode_bytes(decode_bytes(levels, curve), curve), levels)
    np.testing.assert_allclose(decode_bytes(levels, curve), decode(levels / 255.0, curve), rtol=1e-6)


def test_bytes_clip_and_refuse_nan():
    assert encode_bytes(np.array([-1.0, 0.5, 7.0]), "linear").tolist() == [0, 128, 255]
    with pytest.raises(ValueError, match="expected numbers; got 1 NaN"):
        encode_bytes(np.array([0.1, np.nan]), "srgb")


@pytest.mark.parametrize(("function", "name"), [(encode, "encode"), (decode, "decode"), (encode_bytes, "encode")])
def test_unknown_curve_is_refused(function, name):
    with pytest.raises(ValueError, match=rf"{name}\(\): expected the curve 'srgb' or 'linear'; got 'rec709'"):
        function(ramp(), "rec709")
