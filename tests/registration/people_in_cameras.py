"""Synthetic cameras and people for the tests of registration: nothing symmetric, cameras at unequal heights and distances."""

import json
from pathlib import Path

import numpy as np

from mitsuba_avatar.captures.cameras import Camera, look_at
from mitsuba_avatar.registration.keypoints_2d import LANDMARKS, ORDERS


def make_cameras(width: int = 270, height: int = 480) -> dict[str, Camera]:
    """Four cameras around the origin at a person's height."""
    places = {"a": (3.1, -1.4, 1.7), "b": (0.4, 3.3, 1.2), "c": (-3.0, 0.9, 2.1), "d": (-0.8, -3.4, 1.4)}
    focal = 0.85 * height
    return {
        name: Camera(
            name,
            width,
            height,
            focal + 7 * index,
            focal + 4 * index,
            0.5 * width - 3 * index,
            0.5 * height + 5 - index,
            look_at(np.array(place), np.array([0.05, -0.05, 0.95])),
        )
        for index, (name, place) in enumerate(places.items())
    }


def standing_person(offset: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    """[K, 3] landmarks of an upright person who faces -Y, left at +X, metres."""
    heights = {"shoulder": 1.42, "elbow": 1.12, "wrist": 0.88, "hip": 0.92, "knee": 0.5, "ankle": 0.09}
    sides = {"shoulder": 0.18, "elbow": 0.25, "wrist": 0.3, "hip": 0.1, "knee": 0.11, "ankle": 0.1}
    other = {
        "nose": (0, -0.1, 1.6),
        "neck": (0, 0.02, 1.44),
        "mid_hip": (0, 0.01, 0.93),
        "upper_neck": (0, 0.03, 1.5),
        "head_top": (0, 0.01, 1.77),
    }
    surface = {
        "eye": (0.03, -0.08, 1.64),
        "ear": (0.08, 0.01, 1.62),
        "big_toe": (0.08, -0.19, 0.02),
        "small_toe": (0.15, -0.14, 0.02),
        "heel": (0.1, 0.05, 0.02),
    }
    points = []
    for name in LANDMARKS:
        side, _, part = name.partition("_")
        if name in other:
            point = other[name]
        elif part in heights:
            point = (sides[part], -0.03 if part == "wrist" else 0.01, heights[part])
        else:
            point = surface[part]
        mirror = -1.0 if side == "right" else 1.0
        points.append([mirror * point[0] + offset[0], point[1] + offset[1], point[2]])
    return np.array(points)


def seen(cameras: dict[str, Camera], points: np.ndarray, noise: float = 0.0, seed: int = 0) -> np.ndarray:
    """[C, K, 3] observations of points [K, 3] with confidence 0.9."""
    rng = np.random.default_rng(seed)
    views = []
    for camera in cameras.values():
        pixels, _ = camera.project(points)
        views.append(np.concatenate([pixels + noise * rng.normal(size=pixels.shape), np.full((len(points), 1), 0.9)], axis=1))
    return np.stack(views)


def write_people(path: Path, people: list[np.ndarray], order: str) -> None:
    """OpenPose JSON of people [K, 3] (x, y with corner origin, confidence) given in the order of `LANDMARKS`."""
    rows = [LANDMARKS.index(name) for name in ORDERS[order]]
    entries = []
    for person in people:
        chosen = person[rows].copy()
        chosen[:, :2] -= 0.5  # files count from the first pixel's centre
        entries.append({"person_id": [-1], "pose_keypoints_2d": np.nan_to_num(chosen).reshape(-1).tolist()})
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({"version": 1.3, "people": entries}))
