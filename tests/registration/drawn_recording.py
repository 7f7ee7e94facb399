"""A recording of a drawn Anny person for tests of the whole chain: videos, calibration and keypoints, with the truth kept."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from mitsuba_avatar.body.anny_rig import AnnyPhenotype, build_anny_rig
from mitsuba_avatar.body.rig import Rig
from mitsuba_avatar.captures.cameras import Camera, save_cameras
from mitsuba_avatar.captures.silhouettes import silhouette
from mitsuba_avatar.registration.body_sequence import BodySequence
from mitsuba_avatar.registration.body_shape import frozen_shape
from mitsuba_avatar.reporting.video import write_video
from tests.registration.people_in_cameras import make_cameras, seen, standing_person, write_people

PHENOTYPE = AnnyPhenotype(gender=0.3, height=0.55, muscle=0.6)


@dataclass(frozen=True, eq=False)
class Truth:
    """What the recording shows: N frames."""

    rig: Rig
    theta: np.ndarray
    root: np.ndarray
    vertices: np.ndarray
    landmarks: np.ndarray
    cameras: dict[str, Camera]


def acted(num_frames: int, cameras: dict[str, Camera]) -> Truth:
    """A person who shifts sideways, bends the right knee and raises the left arm."""
    rig = build_anny_rig(PHENOTYPE)
    names = rig.dofs.names
    theta = np.zeros((num_frames, len(names)), np.float32)
    along = np.linspace(0, 1, num_frames)
    for name, start, end in (
        ("left_shoulder_abduction", 0.1, 0.5),
        ("left_elbow_flexion", 0.0, 0.5),
        ("right_knee_flexion", 0.2, 0.6),
        ("right_hip_flexion", 0.2, 0.5),
        ("spine03_bend", -0.05, 0.1),
    ):
        theta[:, names.index(name)] = start + (end - start) * along
    root = np.tile(np.eye(4, dtype=np.float32), (num_frames, 1, 1))
    turn = 0.5
    root[:, :2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    root[:, 0, 3], root[:, 1, 3] = 0.08 * along, 0.05
    sequence = BodySequence(rig, frozen_shape(rig, PHENOTYPE), theta, root)
    with torch.no_grad():
        vertices, joints = sequence.rest()
        transforms = sequence.transforms(joints)
        landmarks = sequence.landmarks(vertices, joints, transforms).numpy()
        posed = sequence.posed(vertices.expand(num_frames, -1, -1), transforms).numpy()
    return Truth(rig, theta, root, posed, landmarks, cameras)


def observed(truth: Truth, cameras: dict[str, Camera], noise: float, seed: int = 0) -> np.ndarray:
    """[N, C, K, 3] keypoints of the truth in pixels of some cameras."""
    return np.stack([seen(cameras, points, noise, seed + frame) for frame, points in enumerate(truth.landmarks)])


def write_recording(folder: Path, num_frames: int = 4, width: int = 80, height: int = 136) -> Truth:
    """Videos in which the person walks before a striped wall, and a bystander whom one camera's detector finds too."""
    cameras = {name: camera for name, camera in make_cameras(width, height).items() if name != "d"}
    truth = acted(num_frames, cameras)
    save_cameras(folder / "cameras.json", cameras)
    keypoints = observed(truth, cameras, noise=0.3)
    bystander = seen(cameras, standing_person((1.0, 0.9)))
    for index, (name, camera) in enumerate(cameras.items()):
        y, x = np.mgrid[0:height, 0:width]
        wall = np.stack([90 + 30 * np.sin(x / 3), 110 + 0 * x, 140 + 25 * np.cos(y / 4)], axis=-1)
        pictures = []
        for frame in range(num_frames):
            body = silhouette(camera, truth.vertices[frame], truth.rig.topology.faces)
            picture = wall.copy()
            picture[body] = np.stack([225 - 0 * x, 150 + 20 * np.sin(y / 3), 90 + 0 * x], axis=-1)[body]
            pictures.append(picture.astype(np.uint8))
            people = [bystander[index], keypoints[frame, index]] if index == 1 else [keypoints[frame, index]]
            write_people(folder / "keypoints_2d" / name / f"{frame:04d}.json", people, "body_25b")
        write_video(folder / f"{name}.mp4", pictures, 25.0, quality=8)
    return truth
