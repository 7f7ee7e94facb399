"""One small performance and its dressed body for all tests of the studio: built once a session, never changed."""

import dataclasses

import pytest

from mitsuba_avatar.body.anny_rig import build_anny_rig
from mitsuba_avatar.body.rig import Rig
from mitsuba_avatar.filming.anatomy import Anatomy
from mitsuba_avatar.filming.clothing import DressedBody, dress, hair, shirt, trousers
from mitsuba_avatar.filming.performance import Performance
from mitsuba_avatar.filming.settings import StudioSettings
from mitsuba_avatar.filming.wardrobe import Outfit, choose_outfit
from mitsuba_avatar.presets import resolve
from tests.filming.acted import Acted


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
def shirt_outfit(anatomy: Anatomy) -> Outfit:
    return choose_outfit(anatomy, "shirt")


@pytest.fixture(scope="session")
def settings() -> StudioSettings:
    return resolve("studio/tiny", kind=StudioSettings)


@pytest.fixture(scope="session")
def performance(settings: StudioSettings, tmp_path_factory: pytest.TempPathFactory) -> Acted:
    """In displaced clothes, which need no simulation."""
    displaced = dataclasses.replace(settings, clothing=dataclasses.replace(settings.clothing, is_simulated=False))
    return Acted.of(Performance(displaced, tmp_path_factory.mktemp("performance")))


@pytest.fixture(scope="session")
def simulated(settings: StudioSettings, tmp_path_factory: pytest.TempPathFactory) -> Performance:
    """In a simulated shirt; segments are simulated when a frame is first asked for."""
    return Performance(settings, tmp_path_factory.mktemp("simulated"))
