"""What a run shows: panels have their parts, pictures their cameras."""

import numpy as np

from mitsuba_avatar.captures.images import read_image
from mitsuba_avatar.reporting.presentation import Presentation, Shot
from tests.drawn_capture import HEIGHT, HELD_OUT, WIDTH

SHOTS = [Shot(2, "left"), Shot(8, HELD_OUT)]


def test_a_preview_has_a_row_for_every_shot(evaluator, loaded):
    presentation = Presentation(evaluator, loaded.run.rig)
    one, two = presentation.preview(SHOTS[:1]), presentation.preview(SHOTS)
    assert one.shape[1] == two.shape[1] and 1.5 * one.shape[0] < two.shape[0] < 2.2 * one.shape[0]
    assert two.shape[1] > 7 * WIDTH, "capture, render, error, mesh, texture, occlusion, shadow"


def test_a_comparison_shows_every_method(evaluator, loaded):
    grid = Presentation(evaluator, loaded.run.rig).compare(SHOTS)
    assert grid.shape[0] > 2 * HEIGHT and grid.shape[1] > 4 * WIDTH and grid.std() > 10


def test_held_out_pictures_are_the_avatar_at_the_captures_size(evaluator, loaded, tmp_path):
    paths = Presentation(evaluator, loaded.run.rig).save_held_out_pictures(tmp_path / "out", SHOTS)
    assert [path.name for path in paths] == ["left_000022.png", f"{HELD_OUT}_000028.png"]
    drawn = evaluator.draw("avatar", evaluator.reader.read([8], [[HELD_OUT]]))
    expected = drawn.images[0].permute(1, 2, 0).numpy()
    np.testing.assert_allclose(read_image(paths[1]) / 255, expected, atol=0.5 / 255 + 1e-6)
