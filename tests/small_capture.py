"""A capture of the small rig for tests: three cameras of 64x48 pixels and four frames, drawn by a slow rasteriser of its own.

Nothing is symmetric: the cameras roll, fx differs from fy, the principal points are off centre, the body is bent and turned, frame
numbers start late and skip. So every mistake in a convention shows.
"""

from pathlib import Path

import numpy as np
import torch

from mitsuba_avatar.body.rig import Rig, save_rig
from mitsuba_avatar.body.skeleton import Skeleton
from mitsuba_avatar.body.skinning import pose_vertices
from mitsuba_avatar.captures.cameras import Camera
from mitsuba_avatar.captures.description import CaptureDescription
from mitsuba_avatar.captures.folder import Capture
from mitsuba_avatar.captures.frames import Frame
from mitsuba_avatar.captures.writer import CaptureWriter
from tests.small_rig import make_small_rig

FRAMES = (
    Frame(100, 0.0, "train", "bend"),
    Frame(101, 0.1, "train", "bend"),
    Frame(105, 0.5, "train", "turn"),
    Frame(106, 0.6, "test", "turn"),
)
TARGET = np.array([0.35, -0.2, 0.75])  # metres; the body's middle


def make_cameras(width: int = 64, height: int = 48) -> dict[str, Camera]:
    """Three cameras around the body: "front", "left" and the held-out "high"."""
    scale = width / 64
    views = (("front", [0.5, -1.7, 0.9], 4.0), ("left", [1.6, 0.3, 0.5], -7.0), ("high", [-0.5, 0.6, 1.7], 11.0))
    cameras = {}
    for index, (name, position, roll_deg) in enumerate(views):
        pose = _look_at(np.array(position), np.deg2rad(roll_deg))
        fx, fy = (92.0 + 5 * index) * scale, (95.0 + 3 * index) * scale
        cameras[name] = Camera(name, width, height, fx, fy, (29.5 + 2 * index) * scale, (25.3 - index) * scale, pose)
    return cameras


def make_poses() -> tuple[np.ndarray, np.ndarray]:
    """theta [4, 5] radians and root [4, 4, 4]."""
    theta = np.array([[0.1, 0.2, 0.9, 0.3, 0.1], [0.2, 0.3, 1.1, 0.2, 0.2], [0.1, 0.8, 1.3, 0.1, 0.3], [0.0, 1.0, 1.5, 0.5, 0.0]])
    root = np.broadcast_to(np.eye(4), (4, 4, 4)).copy()
    root[:, :3, :3] = _rotation(np.array([0.3, 0.2, 1.0]), 0.6)
    root[:, :3, 3] = [0.33, -0.25, 0.5]
    root[:, 0, 3] += 0.02 * np.arange(4)
    return theta.astype(np.float32), root.astype(np.float32)


def posed_vertices(rig: Rig, theta: np.ndarray, root: np.ndarray) -> np.ndarray:
    """[N, V, 3] of theta [N, D] and root [N, 4, 4]."""
    with torch.no_grad():
        transforms = Skeleton(rig)(torch.from_numpy(theta), torch.from_numpy(root))
        rest = torch.from_numpy(rig.rest_vertices).expand(len(theta), -1, -1)
        return pose_vertices(rest, transforms, torch.from_numpy(rig.skinning_weights)).numpy()


def write_small_capture(path: Path, with_masks: bool = True, size: tuple[int, int] = (64, 48)) -> Capture:
    """Write the capture into a new folder and open it."""
    rig, cameras = make_small_rig(), make_cameras(*size)
    theta, root = make_poses()
    vertices = posed_vertices(rig, theta, root)
    description = CaptureDescription(
        "small", fps=10.0, face_names=("a", "b"), held_out_cameras=("high",), licence="CC0-1.0", source="drawn by the tests"
    )
    writer = CaptureWriter(path, description, cameras, FRAMES)
    for index in range(len(FRAMES)):
        for name, camera in cameras.items():
            image, mask = draw(camera, vertices[index], rig.topology.faces)
            writer.write_image(name, index, image)
            if with_masks:
                writer.write_mask(name, index, mask)
    keypoints = np.concatenate([vertices[:, ::60], np.ones((4, len(vertices[0, ::60]), 1), np.float32)], axis=2)
    face = np.linspace(0, 1, 8, dtype=np.float32).reshape(4, 2)
    writer.write_arrays(theta=theta, root=root, face=face, keypoints=keypoints, vertices=vertices)
    rig_file = path.parent / f"{path.name}_rig.npz"
    save_rig(rig_file, rig)
    writer.write_rig(rig_file)
    return writer.finish()


def draw(camera: Camera, vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Image [H, W, 3] uint8 and mask [H, W] bool, one triangle after the other over all pixels, with a depth buffer."""
    homogeneous = np.concatenate([vertices.astype(np.float64), np.ones((len(vertices), 1))], axis=1)
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]) @ camera.camera_from_world[:3]
    projected = homogeneous @ matrix.T
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    centers = np.stack([x, y, np.ones_like(x)])  # [3, H, W]
    image = np.full((camera.height, camera.width, 3), (60, 70, 80), np.uint8)
    nearest = np.full((camera.height, camera.width), np.inf)
    for number, face in enumerate(faces):
        corners = projected[face, :2] / projected[face, 2:]
        system = np.concatenate([corners.T, np.ones((1, 3))])
        if abs(np.linalg.det(system)) < 1e-12:
            continue
        barycentric = np.tensordot(np.linalg.inv(system), centers, axes=1)
        depth = np.tensordot(projected[face, 2], barycentric, axes=1)
        is_nearer = (barycentric >= 0).all(axis=0) & (depth < nearest)
        nearest[is_nearer] = depth[is_nearer]
        image[is_nearer] = (200, 90 + number % 97, 40 + 3 * (number % 61))
    return image, np.isfinite(nearest)


def _look_at(position: np.ndarray, roll: float) -> np.ndarray:
    """camera_from_world of a camera that looks at TARGET, rolled about its axis by `roll` radians."""
    forward = (TARGET - position) / np.linalg.norm(TARGET - position)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = _rotation(np.array([0.0, 0.0, 1.0]), roll) @ np.stack([right, np.cross(forward, right), forward])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ position
    return pose


def _rotation(axis: np.ndarray, angle: float) -> np.ndarray:
    """Rotation about an axis, Rodrigues' formula."""
    x, y, z = axis / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
