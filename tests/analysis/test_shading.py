"""Brightness errors against the change of occlusion: on constructed pixels, and on an avatar whose gain is known."""

from pathlib import Path

import numpy as np
import pytest
import torch

from mitsuba_avatar.analysis.shading import CHANGED, ShadingError, shading_errors
from mitsuba_avatar.loaded_run import LoadedRun

pytestmark = pytest.mark.usefixtures("one_thread", "private_cache")


def test_pictures_that_ignore_occlusion_have_the_slope_of_the_light_and_right_ones_zero():
    rng = np.random.default_rng(0)
    change, albedo = rng.uniform(-0.3, 0.2, 5000), rng.uniform(0.1, 0.8, 5000)
    truth = albedo * (1 + 0.4 * change)
    ignorant = ShadingError.of(change, truth, albedo, np.where(np.abs(change) >= CHANGED, 9.0, 4.0))
    assert ignorant.slope == pytest.approx(0.4, rel=1e-6)
    assert ignorant.darker == pytest.approx(np.log(1 - 0.4 * 0.2), abs=0.01)  # mean change of those below -0.1
    assert ignorant.lighter == pytest.approx(np.log(1 + 0.4 * 0.15), abs=0.01)
    assert ignorant.changed_share == pytest.approx(0.6, abs=0.03)
    assert (ignorant.changed_mse, ignorant.unchanged_mse) == (9.0, 4.0)
    right = ShadingError.of(change, truth * rng.uniform(0.9, 1.1, 5000), truth, np.zeros(5000))
    assert abs(right.slope) < 0.02 and abs(right.darker) < 0.02 and abs(right.lighter) < 0.02


def test_pixels_without_a_change_of_occlusion_tell_nothing():
    values = np.full(7, 0.5)
    error = ShadingError.of(np.zeros(7), values, values, values)
    assert (error.slope, error.darker, error.lighter, error.changed_share, error.changed_mse) == (0, 0, 0, 0, 0)
    assert error.unchanged_mse == 0.5


def test_an_avatar_that_darkens_too_little_shows_in_the_slope(fitted_run: Path, monkeypatch: pytest.MonkeyPatch):
    loaded = LoadedRun.open(fitted_run)
    evaluator, avatar = loaded.evaluator(), loaded.avatar
    mean = evaluator.reader.occlusion.maps(evaluator.train_frames).mean(dim=0, keepdim=True)

    def slope(power: float) -> float:
        """With the true gain, and a known power of the change of occlusion taken out of it."""
        decode = type(avatar).decode

        def decoded(self: object, *arguments: object) -> object:
            output, occlusion = decode(self, *arguments), arguments[-1]
            gain = (occlusion.clamp(min=0.05) / mean.clamp(min=0.05)) ** power
            gain = torch.nn.functional.interpolate(gain, size=output.textures.shape[-2:], mode="bilinear", align_corners=False)
            output.textures.mul_(gain[:, None])
            return output

        with monkeypatch.context() as patched:
            patched.setattr(type(avatar), "decode", decoded)
            errors = shading_errors(evaluator, {"validation": [], "test": [8, 9]} if power > 0 else {"test": [8, 9]})
        assert set(errors) == {"test"}
        return errors["test"]["slope"]

    brighter_where_open, darker_where_open = slope(0.5), slope(-0.5)
    assert 0.7 < darker_where_open - brighter_where_open < 1.5  # the two differ by one power of the occlusion
