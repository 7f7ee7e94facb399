"""Settings refuse values out of range, wherever they come from; the defaults are in range."""

import pytest

from mitsuba_avatar.filming.settings import StudioSettings
from mitsuba_avatar.settings import DisentanglementSettings, LossSettings, ModelSettings


def test_values_given_in_python_are_checked_too():
    with pytest.raises(ValueError, match=r"LossSettings\(\): expected image to be zero or more; got nan"):
        LossSettings(image=float("nan"))
    with pytest.raises(ValueError, match=r"expected latent_size to be positive; got 0"):
        ModelSettings(latent_size=0)
    with pytest.raises(ValueError, match=r"expected pairs of at least 2, to be mismatched; got 1"):
        DisentanglementSettings(pairs=1)
    with pytest.raises(ValueError, match="it names a folder; got '../x'"):
        StudioSettings(name="../x")
