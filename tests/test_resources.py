"""Shipped files are found by name, a user's by path; in a wheel they lie inside the package."""

from pathlib import Path

import pytest

from mitsuba_avatar import resources
from mitsuba_avatar.resources import find_resource, resource_folder


@pytest.fixture
def checkout(tmp_path, monkeypatch):
    """A checkout with two presets, as the module sees it."""
    (tmp_path / "package").mkdir()
    (tmp_path / "configs" / "ablation").mkdir(parents=True)
    for name in ("tiny", "ablation/no_latent"):
        (tmp_path / "configs" / f"{name}.yaml").write_text("")
    monkeypatch.setattr(resources, "_PACKAGE", tmp_path / "package")
    return tmp_path


@pytest.mark.parametrize("name", ["tiny", "tiny.yaml"])
def test_shipped_files_are_found_by_name(checkout, name):
    assert find_resource("configs", name, ".yaml") == checkout / "configs" / "tiny.yaml"


def test_shipped_files_may_lie_in_folders(checkout):
    assert find_resource("configs", "ablation/no_latent", ".yaml") == checkout / "configs" / "ablation" / "no_latent.yaml"


def test_a_path_of_the_users_wins_over_a_shipped_name(checkout, monkeypatch):
    (checkout / "elsewhere").mkdir()
    (checkout / "elsewhere" / "tiny").write_text("")
    monkeypatch.chdir(checkout / "elsewhere")
    assert find_resource("configs", "tiny", ".yaml") == Path("tiny")


def test_an_installed_package_carries_its_own(checkout):
    (checkout / "package" / "configs").mkdir()
    assert resource_folder("configs") == checkout / "package" / "configs"


def test_a_missing_file_is_refused_with_the_nearest_name_first(checkout):
    with pytest.raises(FileNotFoundError, match=r"got 'tinny'\. Known names: tiny, ablation/no_latent; or give"):
        find_resource("configs", "tinny", ".yaml")


def test_the_folders_of_this_project_exist():
    for kind in ("configs", "scenes"):
        assert resource_folder(kind).is_dir()
