import dataclasses

import numpy as np

from mitsuba_avatar.filming.cameras import look_at, place_cameras
from mitsuba_avatar.filming.film import Performance
from mitsuba_avatar.filming.settings import StudioSettings


def test_nothing_is_cut_in_any_frame_and_the_body_fills_the_image(performance: Performance):
    settings = StudioSettings()
    for camera in place_cameras(performance.vertices, settings).cameras.values():
        pixels, depth = camera.project(performance.vertices.reshape(-1, 3))
        assert depth.min() > 1
        low, high = pixels.min(axis=0), pixels.max(axis=0)
        assert (low > 1).all() and (high < np.array([settings.cameras.width, settings.cameras.height]) - 1).all(), camera.name
        assert ((high - low) / [settings.cameras.width, settings.cameras.height]).max() > 0.85, camera.name


def test_cameras_stand_all_around_and_held_out_ones_between(performance: Performance):
    dome = place_cameras(performance.vertices[:, ::11], StudioSettings())
    directions = {name: camera.center_world - performance.vertices.reshape(-1, 3).mean(axis=0) for name, camera in dome.cameras.items()}
    unit = {name: direction / np.linalg.norm(direction) for name, direction in directions.items()}
    train = np.stack([unit[name] for name in unit if name not in dome.held_out])
    assert len(train) == 10 and len(dome.held_out) == 3
    assert (train[:, :2].max(axis=0) > 0.7).all() and (train[:, :2].min(axis=0) < -0.7).all()
    assert np.ptp(np.arcsin(train[:, 2])) > 0.4  # several heights
    for name in dome.held_out:
        assert np.degrees(np.arccos((train @ unit[name]).max())) > 8


def test_lenses_differ_and_principal_points_are_off_centre(performance: Performance):
    settings = StudioSettings()
    cameras = list(place_cameras(performance.vertices[:, ::11], settings).cameras.values())
    assert len({round(camera.fx, 3) for camera in cameras}) == len(cameras)
    offsets = np.array([[camera.cx - settings.cameras.width / 2, camera.cy - settings.cameras.height / 2] for camera in cameras])
    assert np.abs(offsets).max() < 0.12 * settings.cameras.width and np.abs(offsets).min(axis=1).max() > 0.2


def test_the_seed_decides_the_cameras(performance: Performance):
    settings = StudioSettings()
    first, again, other = (place_cameras(performance.vertices[:, ::11], dataclasses.replace(settings, seed=seed)) for seed in (0, 0, 1))
    assert first.cameras["train_00"].fx == again.cameras["train_00"].fx != other.cameras["train_00"].fx


def test_look_at_puts_the_target_straight_ahead_and_up_upwards():
    camera_from_world = look_at(np.array([1.0, -3.0, 2.0]), np.array([0.2, 0.1, 0.9]))
    target = camera_from_world @ [0.2, 0.1, 0.9, 1]
    np.testing.assert_allclose(target[:2], 0, atol=1e-12)
    assert target[2] > 0
    assert (camera_from_world @ [0.2, 0.1, 1.0, 1])[1] < 0  # y points down
    np.testing.assert_allclose(np.linalg.det(camera_from_world[:3, :3]), 1)
