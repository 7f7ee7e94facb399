"""One small performance and its dressed body for all tests of the studio: built once a session, never changed."""

import pytest

from mitsuba_avatar.body.anny_rig import build_anny_rig
from mitsuba_avatar.body.rig import Rig
from mitsuba_avatar.filming.anatomy import Anatomy
from mitsuba_avatar.filming.clothing import DressedBody, dress, hair, shirt, trousers
from mitsuba_avatar.filming.film import Performance, stage_performance
from mitsuba_avatar.filming.settings import StudioSettings
from mitsuba_avatar.presets import resolve


@pytest.fixture(scope="session")
def rig() -> Rig:
    return build_anny_rig()


@pytest.fixture(scope="session")
def anatomy(rig: Rig) -> Anatomy:
    return Anatomy.of(rig)


@pytest.fixture(scope="session")
def body(anatomy: Anatomy) -> DressedBody:
    top = shirt(anatomy)
    return dress(anatomy, (trousers(anatomy, top), top, hair(anatomy)))


@pytest.fixture(scope="session")
def settings() -> StudioSettings:
    return resolve("studio/tiny", kind=StudioSettings)


@pytest.fixture(scope="session")
def performance(settings: StudioSettings) -> Performance:
    return stage_performance(settings)
