"""Cameras of windows: viser's pose and field of view become ours."""

import numpy as np
import pytest

from mitsuba_avatar.captures.cameras import look_at
from mitsuba_avatar.viewing.window import FILM_STEP, camera_of_view, film_of_window, pose_of_view


def test_a_quaternion_and_a_centre_give_the_pose():
    turn = np.radians(40)
    wxyz = 2.5 * np.array([np.cos(turn / 2), 0, np.sin(turn / 2), 0])  # about y, not normalised
    pose = pose_of_view(np.array([1.0, 2.0, 3.0]), wxyz)
    np.testing.assert_allclose(pose @ [1, 2, 3, 1], [0, 0, 0, 1], atol=1e-12)
    forward = np.array([np.sin(turn), 0, np.cos(turn), 0])
    np.testing.assert_allclose(pose @ forward, [0, 0, 1, 0], atol=1e-12)


def test_the_picture_fills_the_window_whatever_its_aspect():
    """A point on the window's edge lies on the picture's edge, though the picture has another aspect."""
    field, aspect = 0.7, 1.9
    camera = camera_of_view(look_at(np.array([0.0, -3, 0]), np.zeros(3)), field, aspect, 320, 200)
    half = 3 * np.tan(field / 2)
    pixels, _ = camera.project(np.array([[half * aspect, 0, half], [-half * aspect, 0, -half], [0, 0, 0]]))
    np.testing.assert_allclose(pixels, [[320, 0], [0, 200], [160, 100]], atol=1e-9)


@pytest.mark.parametrize(("aspect", "width"), [(1.0, 480), (1.34, 640), (10.0, 1440), (0.01, 64)])
def test_films_come_in_few_widths(aspect, width):
    assert film_of_window(aspect, 480) == (width, 480) and width % FILM_STEP == 0
