"""The two rigs that the body's tests share."""

import pytest

from tests.small_rig import make_small_rig


@pytest.fixture(scope="session")
def small_rig():
    return make_small_rig()


@pytest.fixture(scope="session")
def anny_rig():
    """The default person; built once into the cache folder (half a minute where Anny has never run)."""
    from mitsuba_avatar.body.anny_rig import build_anny_rig

    return build_anny_rig()
