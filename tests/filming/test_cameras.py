import dataclasses

import numpy as np
import pytest

from mitsuba_avatar.filming.cameras import look_at, place_cameras, train_positions
from mitsuba_avatar.filming.settings import CameraSettings, StudioSettings
from tests.filming.posed_body import PosedBody, posed_body


@pytest.fixture(scope="module")
def posed() -> PosedBody:
    return posed_body()


def test_nothing_is_cut_in_any_frame_and_the_body_fills_the_image(posed: PosedBody):
    settings = StudioSettings()
    for camera in place_cameras(posed.vertices, settings).cameras.values():
        pixels, depth = camera.project(posed.vertices.reshape(-1, 3))
        assert depth.min() > 1
        low, high = pixels.min(axis=0), pixels.max(axis=0)
        assert (low > 1).all() and (high < np.array([settings.cameras.width, settings.cameras.height]) - 1).all(), camera.name
        assert ((high - low) / [settings.cameras.width, settings.cameras.height]).max() > 0.85, camera.name


def test_cameras_stand_all_around_and_held_out_ones_between(posed: PosedBody):
    dome = place_cameras(posed.vertices[:, ::11], StudioSettings())
    directions = {name: camera.center_world - posed.vertices.reshape(-1, 3).mean(axis=0) for name, camera in dome.cameras.items()}
    unit = {name: direction / np.linalg.norm(direction) for name, direction in directions.items()}
    train = np.stack([unit[name] for name in unit if name not in dome.held_out])
    assert len(train) == 10 and len(dome.held_out) == 3
    assert (train[:, :2].max(axis=0) > 0.7).all() and (train[:, :2].min(axis=0) < -0.7).all()
    assert np.ptp(np.arcsin(train[:, 2])) > 0.4  # several heights
    for name in dome.held_out:
        assert np.degrees(np.arccos((train @ unit[name]).max())) > 8


def test_lenses_differ_and_principal_points_are_off_centre(posed: PosedBody):
    settings = StudioSettings()
    cameras = list(place_cameras(posed.vertices[:, ::11], settings).cameras.values())
    assert len({round(camera.fx, 3) for camera in cameras}) == len(cameras)
    offsets = np.array([[camera.cx - settings.cameras.width / 2, camera.cy - settings.cameras.height / 2] for camera in cameras])
    assert np.abs(offsets).max() < 0.12 * settings.cameras.width and np.abs(offsets).min(axis=1).max() > 0.2


def test_the_seed_decides_the_cameras(posed: PosedBody):
    settings = StudioSettings()
    first, again, other = (place_cameras(posed.vertices[:, ::11], dataclasses.replace(settings, seed=seed)) for seed in (0, 0, 1))
    assert first.cameras["train_00"].fx == again.cameras["train_00"].fx != other.cameras["train_00"].fx


def test_look_at_puts_the_target_straight_ahead_and_up_upwards():
    camera_from_world = look_at(np.array([1.0, -3.0, 2.0]), np.array([0.2, 0.1, 0.9]))
    target = camera_from_world @ [0.2, 0.1, 0.9, 1]
    np.testing.assert_allclose(target[:2], 0, atol=1e-12)
    assert target[2] > 0
    assert (camera_from_world @ [0.2, 0.1, 1.0, 1])[1] < 0  # y points down
    np.testing.assert_allclose(np.linalg.det(camera_from_world[:3, :3]), 1)


def _directions(positions: list[tuple[float, float]]) -> np.ndarray:
    azimuth, elevation = np.array(positions).T
    return np.stack([np.sin(azimuth) * np.cos(elevation), -np.cos(azimuth) * np.cos(elevation), np.sin(elevation)], axis=-1)


@pytest.mark.parametrize("count", [17, 24, 60, 140])
def test_many_cameras_cover_the_dome_evenly(count: int):
    """Each camera's nearest neighbour is about as far as the area of the dome allows, all around and up to steep views."""
    directions = _directions(train_positions(count))
    assert len(directions) == count
    angles = np.sort(np.degrees(np.arccos(np.clip(directions @ directions.T, -1, 1))), axis=1)[:, 1]
    even = np.degrees(np.sqrt(2 * np.pi * 1.17 / count))  # the side of a camera's share of the dome, if that were a square
    assert angles.min() > 0.75 * even and angles.max() < 1.35 * even
    octants = {tuple(direction > 0) for direction in directions[:, :2]}
    assert len(octants) == 4 and directions[:, 2].max() > 0.75 and directions[:, 2].min() < 0.2


@pytest.mark.parametrize(("train", "held_out"), [(1, 2), (8, 2), (16, 9), (140, 12)])
def test_held_out_cameras_stand_apart_from_all_others_at_any_count(posed: PosedBody, train: int, held_out: int):
    settings = StudioSettings(cameras=CameraSettings(train=train, held_out=held_out))
    dome = place_cameras(posed.vertices[:, ::29], settings)
    middle = posed.vertices.reshape(-1, 3).mean(axis=0)
    centres = np.stack([camera.center_world for camera in dome.cameras.values()]) - middle
    unit = centres / np.linalg.norm(centres, axis=1, keepdims=True)
    angles = np.degrees(np.arccos(np.clip(unit @ unit.T, -1, 1))) + 360 * np.eye(len(unit))
    assert len(dome.held_out) == held_out and len(dome.cameras) == train + held_out
    assert angles[train:].min() > 5.5  # 140 cameras are 12 degrees apart


def test_names_sort_in_order_and_images_may_be_of_the_papers_size(posed: PosedBody):
    settings = StudioSettings(cameras=CameraSettings(train=140, held_out=5, width=2668, height=4096))
    cameras = place_cameras(posed.vertices[:, ::29], settings).cameras
    assert list(cameras)[:2] == ["train_000", "train_001"] and list(cameras)[-1] == "held_out_04"
    names = list(cameras)[:140]
    assert names == sorted(names)
    for camera in cameras.values():
        pixels, _ = camera.project(posed.vertices[3, ::29])
        assert (pixels > 0).all() and (pixels < [2668, 4096]).all() and (camera.width, camera.height) == (2668, 4096)


def test_the_cameras_of_the_default_capture_stay_where_they_were(posed: PosedBody):
    dome = place_cameras(posed.vertices[:, ::11], StudioSettings())
    centre = 0.5 * (posed.vertices[:, ::11].min(axis=(0, 1)) + posed.vertices[:, ::11].max(axis=(0, 1)))
    seen = [camera.center_world - centre for camera in dome.cameras.values()]
    positions = [(np.arctan2(x, -y) % (2 * np.pi), np.arctan2(z, np.hypot(x, y))) for x, y, z in seen]
    expected = [(2 * np.pi * (index + 0.5) / 10, (0.22, 0.55, 0.22, -0.10)[index % 4]) for index in range(10)]
    np.testing.assert_allclose(positions, [*expected, (0.16, 0.08), (1.75, 0.30), (3.50, 0.72)], atol=1e-6)
