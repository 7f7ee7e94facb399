"""A folder of pictures belongs to one set of settings, whoever draws into it."""

import json

import pytest

from mitsuba_avatar.reporting.picture_folder import SETTINGS_FILE, PictureFolder

SETTINGS = {"path": "orbit", "samples": 16, "backdrop": None}


def test_what_exists_is_not_needed_again(tmp_path):
    folder = PictureFolder(tmp_path / "out", SETTINGS)
    folder.settle(dict)
    (tmp_path / "out/a.png").write_bytes(b"drawn")
    again = PictureFolder(tmp_path / "out", SETTINGS)
    assert not again.needs("a.png") and again.needs("b.png")
    assert PictureFolder(tmp_path / "out", SETTINGS, is_overwritten=True).needs("a.png")


def test_the_first_process_settles_for_all(tmp_path):
    first, second = (PictureFolder(tmp_path / "out", SETTINGS) for _ in range(2))  # both before anything is written
    assert first.settle(lambda: {"samples": 48}) == {"samples": 48}
    assert second.settle(lambda: {"samples": 96}) == {"samples": 48}
    third = PictureFolder(tmp_path / "out", SETTINGS)
    assert third.settle(lambda: pytest.fail("it is settled")) == {"samples": 48}
    assert [path.name for path in (tmp_path / "out").iterdir()] == [SETTINGS_FILE]


def test_pictures_of_other_settings_do_not_mix(tmp_path):
    PictureFolder(tmp_path / "out", SETTINGS).settle(dict)
    changed = SETTINGS | {"samples": 32}
    with pytest.raises(ValueError, match="expected pictures with samples = 16, .* got 32. Draw into another --out"):
        PictureFolder(tmp_path / "out", changed)
    PictureFolder(tmp_path / "out", changed, is_overwritten=True).settle(dict)
    assert json.loads((tmp_path / "out" / SETTINGS_FILE).read_text())["settings"]["samples"] == 32


def test_a_damaged_file_is_named(tmp_path):
    (tmp_path / SETTINGS_FILE).write_text("{")
    with pytest.raises(ValueError, match="expected settings in .*render.json"):
        PictureFolder(tmp_path, SETTINGS)
