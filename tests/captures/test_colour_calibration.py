from pathlib import Path

import numpy as np
import pytest

from mitsuba_avatar.captures.colour import encode_bytes
from mitsuba_avatar.captures.colour_calibration import (
    ColourChart,
    calibrate_cameras,
    correct_colours,
    fit_colour_matrix,
    load_chart,
    patch_means,
    save_chart,
)
from mitsuba_avatar.captures.images import write_image

ROWS, COLUMNS = 3, 4
CORNERS = np.array([[20.0, 10.0], [74.0, 16.0], [70.0, 52.0], [14.0, 44.0]])  # turned and foreshortened
RESPONSE = np.array([[1.08, 0.03, -0.02], [0.01, 0.95, 0.02], [0.03, -0.04, 1.05]])


@pytest.fixture
def patches() -> np.ndarray:
    return np.random.default_rng(0).uniform(0.03, 0.8, (ROWS * COLUMNS, 3))


def _picture(patches: np.ndarray) -> np.ndarray:
    """[64, 96, 3] a chart under a bilinear map of its corners, each patch a flat colour."""
    image = np.full((64, 96, 3), 0.5, dtype=np.float32)
    steps = (np.arange(700) + 0.5) / 700
    u, v = np.meshgrid(steps, steps)
    weights = np.stack([(1 - u) * (1 - v), u * (1 - v), u * v, (1 - u) * v], axis=-1)
    x, y = np.moveaxis(weights @ CORNERS, -1, 0)
    image[y.astype(int), x.astype(int)] = patches[(v * ROWS).astype(int) * COLUMNS + (u * COLUMNS).astype(int)]
    return image


def _chart(patches: np.ndarray) -> ColourChart:
    return ColourChart(ROWS, COLUMNS, {"left": CORNERS, "right": CORNERS}, {"left": patches, "right": patches})


def test_patches_are_read_in_reading_order_from_a_slanted_chart(patches: np.ndarray):
    np.testing.assert_allclose(patch_means(_picture(patches), CORNERS, ROWS, COLUMNS), patches, atol=1e-6)
    with pytest.raises(ValueError, match=r"patch_means\(\): expected pixels in the middle of 3 x 4 patches"):
        patch_means(_picture(patches), CORNERS * 0.05, ROWS, COLUMNS)


def test_an_affine_response_is_inverted(patches: np.ndarray):
    offset = np.array([0.01, -0.005, 0.02])
    matrix = fit_colour_matrix(patches @ RESPONSE.T + offset, patches)
    np.testing.assert_allclose(matrix[:, :3] @ RESPONSE, np.eye(3), atol=1e-9)
    image = (np.random.default_rng(1).uniform(0, 1, (2, 5, 7, 3))).astype(np.float32)
    corrected = correct_colours((image @ RESPONSE.T + offset).astype(np.float32), matrix)
    assert corrected.dtype == np.float32
    np.testing.assert_allclose(corrected, image, atol=1e-5)


def test_cameras_are_calibrated_from_eight_bit_pictures_and_clipped_patches_do_no_harm(patches: np.ndarray, tmp_path: Path):
    patches[5] = 2.5  # a lamp in the place of a patch
    for name, response in (("left", np.eye(3)), ("right", RESPONSE)):
        write_image(tmp_path / f"{name}.png", encode_bytes(_picture(patches @ response.T), "srgb"))
    save_chart(tmp_path, _chart(patches))
    matrices = calibrate_cameras(tmp_path, "srgb")
    np.testing.assert_allclose(matrices["left"], np.eye(3, 4), atol=0.01)
    np.testing.assert_allclose(matrices["right"][:, :3] @ RESPONSE, np.eye(3), atol=0.015)


def test_a_picture_that_is_too_bright_is_refused(patches: np.ndarray, tmp_path: Path):
    for name in ("left", "right"):
        write_image(tmp_path / f"{name}.png", encode_bytes(_picture(patches + 0.7), "srgb"))
    save_chart(tmp_path, _chart(patches))
    with pytest.raises(ValueError, match=r"calibrate_cameras\(\): expected 8 patches between black and level 250 in left.png"):
        calibrate_cameras(tmp_path, "srgb")


def test_a_chart_survives_its_file_and_broken_ones_are_named(patches: np.ndarray, tmp_path: Path):
    save_chart(tmp_path, _chart(patches))
    (tmp_path / "chart.json").write_bytes(b"\xef\xbb\xbf" + (tmp_path / "chart.json").read_bytes())  # as some editors save it
    chart = load_chart(tmp_path)
    assert (chart.rows, chart.columns) == (ROWS, COLUMNS)
    np.testing.assert_allclose(chart.reference["right"], patches, atol=1e-6)
    np.testing.assert_array_equal(chart.corners["left"], CORNERS)
    with pytest.raises(FileNotFoundError, match=r"load_chart\(\): expected a chart's description"):
        load_chart(tmp_path / "elsewhere")
    (tmp_path / "chart.json").write_text('{"format_version": 1, "rows": 3}')
    with pytest.raises(ValueError, match=r"load_chart\(\): expected rows, columns and cameras"):
        load_chart(tmp_path)
    with pytest.raises(ValueError, match=r"ColourChart\(\): expected corners and 3 x 4 reference values"):
        ColourChart(ROWS, COLUMNS, {"left": CORNERS}, {"left": patches[:5]})
