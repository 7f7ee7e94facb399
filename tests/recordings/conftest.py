"""The rig that recordings are followed by: built once a session, never changed."""

import pytest

from mitsuba_avatar.body.anny_rig import build_anny_rig
from mitsuba_avatar.body.rig import Rig


@pytest.fixture(scope="session")
def rig() -> Rig:
    return build_anny_rig()
