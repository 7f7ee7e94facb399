"""Figures: tiles stand where they should, at the right size and value; the curves show what the log holds."""

import numpy as np
import pytest
from PIL import Image

from mitsuba_avatar.reporting.figures import (
    Preview,
    Tile,
    View,
    comparison_grid,
    compose,
    error_map,
    loss_curves,
    preview_panel,
    save_image,
    to_bytes,
)


def flat(height: int, width: int, colour: tuple[float, float, float]) -> np.ndarray:
    return np.broadcast_to(np.array(colour, dtype=np.float32), (height, width, 3)).copy()


def view(colour: tuple[float, float, float] = (0.2, 0.4, 0.6)) -> View:
    return View("north, frame 7", flat(40, 24, colour), np.ones((40, 24), dtype=np.float32))


def columns_of(panel: np.ndarray, colour: tuple[int, int, int]) -> np.ndarray:
    """Indices of the columns in which the colour appears."""
    return np.flatnonzero((panel == colour).all(axis=-1).any(axis=0))


def test_tiles_keep_their_colour_and_shape_and_order():
    left, right = Tile("left", flat(20, 50, (1, 0, 0))), Tile("right", flat(40, 30, (0, 1, 0)))
    panel = compose([[left, right]], height=40)
    red, green = columns_of(panel, (255, 0, 0)), columns_of(panel, (0, 255, 0))
    assert (len(red), len(green)) == (100, 30)  # 50 x 20 scaled to 100 x 40
    assert red.max() < green.min()
    assert (panel == (255, 0, 0)).all(axis=-1).sum() == 100 * 40


def test_labels_are_drawn_and_fit_their_column():
    short, long = (compose([[Tile(label, flat(40, 10, (0, 0, 0)))]], height=40) for label in ("a", "a label wider than its tile"))
    assert long.shape[1] > short.shape[1]
    background = long[0, 0]
    assert (long[:, :2] == background).all()
    assert (long[:, -2:] == background).all()
    assert (long[:16].max(axis=(1, 2)) > 200).any()


def test_a_whole_multiple_keeps_texels_square():
    texels = np.array([[[1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 1, 1], [1, 0, 1], [1, 1, 0]]], dtype=np.float32)
    panel = compose([[Tile("t", texels)]], height=20)
    for colour in texels.reshape(-1, 3):
        assert (panel == to_bytes(colour[None, None])[0, 0]).all(axis=-1).sum() == 100


def test_preview_has_a_column_for_each_piece_and_a_row_for_each_view():
    first = Preview(view(), flat(40, 24, (0.3, 0.4, 0.6)), flat(40, 24, (1, 0, 0)), flat(16, 16, (0, 1, 0)), np.ones((8, 8), np.float32))
    whole = preview_panel([first], height=40)
    assert len(columns_of(whole, (255, 0, 0))) == 24
    assert len(columns_of(whole, (0, 255, 0))) == 40
    assert len(columns_of(whole, (255, 255, 255))) >= 40
    bare = preview_panel([Preview(view(), flat(40, 24, (0, 0, 1)))] * 2, height=40)
    assert bare.shape[1] < whole.shape[1]
    assert (bare == (0, 0, 255)).all(axis=-1).sum() == 2 * 40 * 24


def test_a_neutral_shadow_is_mid_grey():
    panel = preview_panel([Preview(view(), view().image, shadow=np.ones((8, 8), np.float32))], height=40)
    assert (panel == 128).all(axis=-1).sum() == 40 * 40


def test_error_map_is_black_at_zero_and_brightest_beyond_its_maximum():
    reference = flat(3, 4, (0.5, 0.5, 0.5))
    image = reference.copy()
    image[0, 1] += 0.25
    image[2, 3] += 0.5
    error = error_map(image, reference)
    assert error[1, 1].max() < 0.02
    np.testing.assert_array_equal(error[0, 1], error[2, 3])
    assert error[0, 1].min() > 0.6


def test_comparison_draws_every_method_beside_its_error():
    views = [view(), view((0.9, 0.1, 0.1))]
    grid = comparison_grid(views, {"avatar": [v.image for v in views], "nearest": [flat(40, 24, (0, 0, 1))] * 2}, height=40)
    assert (grid == to_bytes(views[0].image)[0, 0]).all(axis=-1).sum() == 2 * 40 * 24
    assert (grid == (0, 0, 255)).all(axis=-1).sum() == 2 * 40 * 24
    with pytest.raises(ValueError, match="expected 2 pictures of avatar; got 1"):
        comparison_grid(views, {"avatar": [views[0].image]})


def test_a_view_without_a_person_has_a_panel_too():
    empty = View("above", flat(40, 24, (0, 0, 0)), np.zeros((40, 24), dtype=np.float32))
    assert preview_panel([Preview(empty, empty.image)], height=40).ndim == 3


def test_what_cannot_be_drawn_is_refused(tmp_path, without_shape_checks):
    with pytest.raises(ValueError, match="expected rows of tiles"):
        compose([])
    with pytest.raises(ValueError, match="expected images of one size"):
        error_map(flat(3, 4, (0, 0, 0)), flat(4, 3, (0, 0, 0)))
    with pytest.raises(ValueError, match=r"expected records with any of \['loss/image'\]"):
        loss_curves(tmp_path / "a.png", [{"iteration": 1}], {"loss": ["loss/image"]})


def test_pictures_are_rounded_and_read_back(tmp_path):
    picture = np.array([[[0.0, 0.5, 1.0], [-1.0, 2.0, np.nan]]], dtype=np.float32)
    save_image(tmp_path / "out" / "a.png", picture)
    assert np.array(Image.open(tmp_path / "out" / "a.png")).tolist() == [[[0, 128, 255], [0, 255, 0]]]


def test_curves_are_drawn_from_records_with_gaps(tmp_path):
    records = [{"iteration": step, "loss/image": 10.0**-step, "note": "x"} for step in range(4)] + [
        {"iteration": 4, "validation/psnr": 30.0}
    ]
    loss_curves(tmp_path / "one.png", records, {"loss": ["loss/image"]})
    loss_curves(tmp_path / "two.png", records, {"loss": ["loss/image", "loss/absent"], "PSNR (dB)": ["validation/psnr"]})
    one, two = (np.array(Image.open(tmp_path / name)) for name in ("one.png", "two.png"))
    assert two.shape[0] > one.shape[0]
    assert one.std() > 5
