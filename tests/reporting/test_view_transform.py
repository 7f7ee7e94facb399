"""View transforms: what they do to radiance, and that files say which it was."""

import numpy as np
import pytest
from PIL import Image

from mitsuba_avatar.reporting.view_transform import ViewTransform, write_png

RADIANCE = np.array([[[0.18, 0.5, 1.0], [0.0, 2.0, 0.2]]], np.float32)  # [1, 2, 3], covered fully and half
COVERAGE = np.array([[1.0, 0.5]], np.float32)


def test_srgb_over_a_backdrop():
    shown = ViewTransform(backdrop=0.18).apply(RADIANCE, COVERAGE)
    assert shown.tolist() == [[[118, 188, 255], [85, 255, 147]]]  # 0.09, beyond white, 0.29


def test_exposure_is_in_stops_and_leaves_the_backdrop():
    shown = ViewTransform(exposure=-1.0, backdrop=0.18).apply(RADIANCE * 2, COVERAGE)
    np.testing.assert_array_equal(shown, ViewTransform(backdrop=0.18).apply(RADIANCE, COVERAGE))


def test_without_a_backdrop_colour_is_straight_and_alpha_is_coverage():
    shown = ViewTransform(backdrop=None).apply(np.array([[[0.09, 0.1, 0.5]]], np.float32), np.array([[0.5]], np.float32))
    assert shown.tolist() == [[[118, 124, 255, 128]]]


def test_soft_keeps_highlights_apart_and_order():
    ramp = np.linspace(0, 4, 30, dtype=np.float32)[None, :, None].repeat(3, axis=2)
    shown = ViewTransform("soft", backdrop=0.0).apply(ramp, np.ones((1, 30), np.float32))[0, :, 0].astype(int)
    assert (np.diff(shown) > 0).all() and shown[-1] == 255 and shown[0] == 0


def test_files_say_how_they_were_shown(tmp_path):
    transform = ViewTransform("soft", exposure=0.5, backdrop=None)
    write_png(tmp_path / "a.png", transform.apply(RADIANCE, COVERAGE), transform)
    with Image.open(tmp_path / "a.png") as picture:
        assert picture.mode == "RGBA" and picture.size == (2, 1)
        assert picture.info["srgb"] == 0 and picture.info["view_transform"] == "soft, exposure 0.5 stops, backdrop none"


def test_impossible_settings_are_refused():
    with pytest.raises(ValueError, match="backdrop >= 0"):
        ViewTransform(backdrop=-0.1)
    with pytest.raises(ValueError, match="finite exposure"):
        ViewTransform(exposure=float("inf"))
