"""A finished run as a character, made once."""

import pytest

from mitsuba_avatar.exporting.character import Character, CharacterSettings, make_character
from mitsuba_avatar.loaded_run import LoadedRun


@pytest.fixture(scope="session")
def loaded(fitted_run) -> LoadedRun:
    return LoadedRun.open(fitted_run)


@pytest.fixture(scope="session")
def character(loaded) -> Character:
    """Eight frames, three shapes of the face and four of the pose."""
    settings = CharacterSettings(pose_shapes=4, face_principals=3)
    return make_character(loaded.avatar, loaded.run.rig, loaded.capture, list(range(8)), settings)
