"""The small capture, written once; tests that damage it work on a copy."""

import shutil

import pytest

from tests.small_capture import write_small_capture


@pytest.fixture(scope="session")
def small_capture(tmp_path_factory):
    """The whole capture; not to be written to."""
    return write_small_capture(tmp_path_factory.mktemp("capture") / "small")


@pytest.fixture
def capture_copy(small_capture, tmp_path):
    """Folder of a fresh copy."""
    shutil.copytree(small_capture.path, tmp_path / "copy")
    return tmp_path / "copy"
