"""What a viewer shows of a finished run, in a copy that may be written to."""

import shutil

import pytest

from mitsuba_avatar.loaded_run import LoadedRun
from mitsuba_avatar.view import open_material


@pytest.fixture(scope="session")
def material(fitted_run, tmp_path_factory):
    folder = tmp_path_factory.mktemp("viewed") / "run"
    shutil.copytree(fitted_run, folder)
    return open_material(LoadedRun.open(folder))


@pytest.fixture
def session(material, private_cache, one_thread):
    from mitsuba_avatar.viewing.session import ViewerSession

    return ViewerSession(material)
