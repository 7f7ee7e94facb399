"""What a viewer shows of a finished run, in a copy that may be written to."""

import shutil

import pytest

from mitsuba_avatar.loaded_run import LoadedRun
from mitsuba_avatar.view import open_viewed_avatar


@pytest.fixture(scope="session")
def viewed(fitted_run, tmp_path_factory):
    folder = tmp_path_factory.mktemp("viewed") / "run"
    shutil.copytree(fitted_run, folder)
    return open_viewed_avatar(LoadedRun.open(folder))


@pytest.fixture
def session(viewed, private_cache, one_thread):
    from mitsuba_avatar.viewing.session import ViewerSession

    return ViewerSession(viewed)
