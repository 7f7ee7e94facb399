"""Files are whole or absent; places that cannot be written are told before anything is made."""

import errno
import os
from pathlib import Path

import pytest

from mitsuba_avatar.files import atomic_path, cache_folder, check_writable
from tests.full_disk import full_disk


def test_a_file_appears_when_it_is_whole(tmp_path):
    path = tmp_path / "new/folder/picture.png"
    with atomic_path(path) as temporary:
        assert temporary.parent == path.parent and temporary.suffix == ".png" and temporary != path
        temporary.write_text("half")
        assert not path.exists()
    assert path.read_text() == "half" and list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize("error", [OSError(errno.ENOSPC, "No space left on device"), KeyboardInterrupt()])
def test_a_failed_write_leaves_the_old_file(tmp_path, error):
    path = tmp_path / "file.json"
    path.write_text("old")
    with pytest.raises(type(error)), atomic_path(path) as temporary:
        temporary.write_text("new, but not whol")
        raise error
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]


def test_a_disk_that_fills_up_leaves_the_old_file(tmp_path):
    path = tmp_path / "file.bin"
    path.write_bytes(b"old")
    with full_disk(1000), pytest.raises(OSError), atomic_path(path) as temporary:
        temporary.write_bytes(bytes(2000))
    assert path.read_bytes() == b"old" and list(tmp_path.iterdir()) == [path]


def test_two_writers_do_not_share_a_temporary_file(tmp_path):
    with atomic_path(tmp_path / "a.txt") as first, atomic_path(tmp_path / "a.txt") as second:
        assert first != second
        first.write_text("1")
        second.write_text("2")
    assert (tmp_path / "a.txt").read_text() == "1", "the one that ends last wins, whole"


def test_a_folder_that_can_be_made_is_writable_and_not_made(tmp_path):
    check_writable(tmp_path / "a/b/c")
    check_writable(tmp_path)
    assert not list(tmp_path.iterdir())


def test_a_file_in_the_way_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(PermissionError, match=r"expected a folder at .*/file/b; got .*/file, which is a file\. Name another place\."):
        check_writable(tmp_path / "file/b")


def test_a_folder_without_permission_is_named(tmp_path, monkeypatch):
    """By the system's word: the tests may run as root, who may write anywhere."""
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != tmp_path)
    with pytest.raises(PermissionError, match=rf"expected permission to write into {tmp_path}; got none\. Name another place\."):
        check_writable(tmp_path / "a/b")


def test_the_cache_folder_follows_the_environment(monkeypatch):
    monkeypatch.setenv("MITSUBA_AVATAR_CACHE", "~/mine")
    assert cache_folder() == Path.home() / "mine"
    monkeypatch.delenv("MITSUBA_AVATAR_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", "/elsewhere")
    assert cache_folder() == Path("/elsewhere/mitsuba_avatar")
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert cache_folder() == Path.home() / ".cache/mitsuba_avatar"
