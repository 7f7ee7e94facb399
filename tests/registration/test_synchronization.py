"""Videos out of step are found although the calibration is off by more than the shift costs; synchronous ones never are."""

import numpy as np
import pytest

from mitsuba_avatar.captures.cameras import Camera
from mitsuba_avatar.registration.synchronization import find_shift, require_synchronized
from tests.registration.people_in_cameras import make_cameras, seen, standing_person

FPS = 20.0
FRAMES = 48
NAMES = ("a", "b", "d")


def walk(late: str = "", shift: int = 0, speed: float = 1.0) -> tuple[list[Camera], np.ndarray]:
    """Somebody who walks and sways; frame n of `late` shows frame n + shift of the others. Detections are noisy."""
    cameras = {name: camera for name, camera in make_cameras().items() if name in NAMES}
    views = []
    for name, camera in cameras.items():
        moments = np.arange(FRAMES) + (shift if name == late else 0)
        points = [standing_person((0.02 * speed * moment, 0.3 * speed * np.sin(moment / 7))) for moment in moments]
        views.append([seen({name: camera}, place, noise=0.8, seed=100 * NAMES.index(name) + i)[0] for i, place in enumerate(points)])
    observations = np.array(views).transpose(1, 0, 2, 3)
    observations[3:9, 1, 4:7] = np.nan
    observations[:, 0, :, 0] += 3.0  # a calibration that is off
    return list(cameras.values()), observations


@pytest.mark.parametrize(("late", "shift"), [("b", 4), ("d", -7), ("a", 9)])
def test_the_camera_and_its_shift_are_found(late, shift):
    cameras, observations = walk(late, shift)
    found = find_shift(cameras, observations, FPS)
    assert (cameras[found.camera].name, found.frames) == (late, shift) and found.misfit < 0.75 * found.misfit_before


def test_the_message_says_what_to_cut():
    with pytest.raises(ValueError, match=r"got b ahead of the others by about 4 frames \(0.20 s\).*Shorten the other videos .* first 4"):
        require_synchronized(*walk("b", 4), FPS)
    with pytest.raises(ValueError, match="got d behind the others by about 7 frames.*Shorten d by its first 7"):
        require_synchronized(*walk("d", -7), FPS)


def test_a_shift_beyond_the_search_is_said_to_be_longer():
    with pytest.raises(ValueError, match="got b ahead of the others by 12 frames or more"):
        require_synchronized(*walk("b", 16), FPS)


@pytest.mark.parametrize("speed", [1.0, 0.0])
def test_synchronous_videos_pass_walking_or_standing(speed):
    for_all = walk(speed=speed)
    assert find_shift(*for_all, FPS) is None
    require_synchronized(*for_all, FPS)


def test_too_few_frames_or_nobody_say_nothing():
    cameras, observations = walk("b", 4)
    assert find_shift(cameras, observations[:20], FPS) is None
    assert find_shift(cameras, np.full_like(observations, np.nan), FPS) is None
