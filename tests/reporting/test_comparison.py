"""The comparison: cuts hold the person, insets sit on the worst places, every method gets both error maps."""

import numpy as np
import pytest

from mitsuba_avatar.reporting.comparison import Cut, inset_cuts, inset_grid, person_cut
from mitsuba_avatar.reporting.figures import View, to_bytes


def test_the_cut_holds_the_person_with_a_margin_inside_the_picture():
    mask = np.zeros((60, 80), np.float32)
    mask[2:52, 30:41] = 0.5
    assert person_cut(mask) == Cut(0, 55, 27, 44)
    assert person_cut(np.zeros((60, 80), np.float32)) == Cut(0, 60, 0, 80), "nobody: the whole picture"


def test_insets_sit_where_the_difference_is_largest_and_do_not_overlap():
    difference = np.zeros((40, 50))
    difference[8:12, 30:34] = 1.0
    difference[30:33, 3:6] = 0.8
    first, second = inset_cuts(difference, 10)
    assert first.of(difference).sum() == 16 and second.of(difference).sum() == pytest.approx(7.2)
    assert first.bottom - first.top == first.right - first.left == 10
    for cut in (first, second):
        assert cut.top >= 0 and cut.left >= 0 and cut.bottom <= 40 and cut.right <= 50
    assert inset_cuts(np.zeros((40, 50)), 10) == [], "nothing to show"
    assert len(inset_cuts(np.ones((12, 11)), 10)) == 1, "no room for a second"
    corner = np.zeros((40, 50))
    corner[39, 49] = 1
    (only,) = inset_cuts(corner, 9, 1)
    assert (only.bottom, only.right) == (40, 50)


def view(number: int) -> View:
    random = np.random.default_rng(number)
    image = np.full((50, 40, 3), 0.25, np.float32)
    mask = np.zeros((50, 40), np.float32)
    mask[5:45, 10:30] = 1
    image[5:45, 10:30] = 0.3 + 0.5 * random.random((40, 20, 3), dtype=np.float32)
    return View(f"north {number}", image, mask)


def test_every_view_has_three_lines_and_every_method_a_column():
    views = [view(1), view(2)]
    good = [np.clip(one.image + np.float32(0.05), 0, 1) for one in views]
    bad = [one.image.copy() for one in views]
    for image in bad:
        image[10:20, 12:22] = (0, 1, 0)
    grid = inset_grid(views, {"ours": good, "theirs": bad}, height=120)
    alone = inset_grid(views[:1], {"ours": good[:1]}, height=120)
    assert grid.shape[0] == pytest.approx(2 * alone.shape[0], abs=8) and alone.shape[0] > 3 * 120
    assert grid.shape[1] > 1.3 * alone.shape[1]
    assert (grid == to_bytes(np.array([[[0, 1, 0]]], np.float32))[0, 0]).all(axis=-1).sum() > 100, "the pictures themselves are there"
    with pytest.raises(ValueError, match="expected 2 pictures of ours; got 1"):
        inset_grid(views, {"ours": good[:1]})


def test_a_view_without_a_person_is_drawn_too():
    empty = View("nobody", view(1).image, np.zeros((50, 40), np.float32))
    assert inset_grid([empty], {"ours": [empty.image]}, height=60).shape[0] > 180
