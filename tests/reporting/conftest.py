"""A finished run, opened: avatar, capture and what draws them."""

import pytest

from mitsuba_avatar.loaded_run import LoadedRun


@pytest.fixture(scope="session")
def loaded(fitted_run):
    return LoadedRun.open(fitted_run)


@pytest.fixture
def evaluator(loaded, private_cache, one_thread):
    return loaded.evaluator()
