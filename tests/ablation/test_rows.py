"""Rows of the table: named, ordered, and told apart from what is no row."""

import pytest

from mitsuba_avatar.ablation.rows import ROWS, choose_rows
from mitsuba_avatar.presets import resolve


def test_every_row_has_a_preset():
    assert {resolve(row.preset).training.iterations for row in ROWS} == {resolve("ablation/ours").training.iterations}


def test_rows_come_in_the_order_of_the_table_however_they_are_named():
    assert [row.name for row in choose_rows("without_shadow, ours")] == ["ours", "without_shadow"]
    assert choose_rows("") == ROWS


def test_an_unknown_row_is_refused_by_name():
    with pytest.raises(ValueError, match="got without_legs. Change --rows."):
        choose_rows("ours,without_legs")
