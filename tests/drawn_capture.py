"""A capture for tests of learning: the small rig with what skinning cannot explain, drawn by the package's own renderer.

The arm bulges as the elbow bends, its texture darkens with the bend and reddens with the face signal, over a uniform backdrop that is
not black. Five cameras of 40x56 pixels, the last one held out; eight training and two test frames. Texture and bulge are known, so that
what was learnt can be compared with the truth.
"""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from mitsuba_avatar.body.rig import Rig, save_rig
from mitsuba_avatar.body.skeleton import Skeleton
from mitsuba_avatar.body.skinning import pose_vertices
from mitsuba_avatar.captures.cameras import Camera, look_at, save_cameras
from mitsuba_avatar.captures.colour import encode_bytes
from mitsuba_avatar.captures.description import CaptureDescription
from mitsuba_avatar.captures.folder import Capture
from mitsuba_avatar.captures.frames import Frame
from mitsuba_avatar.captures.writer import CaptureWriter
from mitsuba_avatar.rendering.cameras import CameraBatch
from mitsuba_avatar.rendering.surface import SurfaceRenderer
from tests.small_rig import LENGTH, make_small_rig

WIDTH, HEIGHT = 40, 56
TRAIN_FRAMES, TEST_FRAMES = 8, 2
BACKGROUND = (0.04, 0.08, 0.12)  # linear radiance
HELD_OUT = "above"
TEXTURE_SIZE = 64
FIRST_NUMBER = 20  # frame numbers are not indices


def make_texture() -> torch.Tensor:
    """[3, 64, 64] linear radiance: smooth, and different along every direction and channel."""
    v, u = torch.meshgrid(
        1 - (torch.arange(TEXTURE_SIZE) + 0.5) / TEXTURE_SIZE, (torch.arange(TEXTURE_SIZE) + 0.5) / TEXTURE_SIZE, indexing="ij"
    )
    # Periodic in u, as the tube's seam asks.
    return torch.stack([0.35 + 0.2 * torch.sin(2 * torch.pi * u), 0.2 + 0.4 * v, 0.3 + 0.15 * torch.cos(2 * torch.pi * u + 2 * v)])


def bulge(rig: Rig, theta: np.ndarray) -> np.ndarray:
    """[N, V, 3] rest-space offsets in metres: outwards around the elbow, growing with its flexion theta[:, 2]."""
    outwards = rig.rest_vertices * np.array([1, 1, 0], np.float32)
    outwards /= np.linalg.norm(outwards, axis=1, keepdims=True) + 1e-3
    around_elbow = np.exp(-(((rig.rest_vertices[:, 2] / LENGTH - 0.4) / 0.2) ** 2))
    return (0.03 * (theta[:, 2] - 0.4)[:, None, None] * around_elbow[None, :, None] * outwards).astype(np.float32)


def write_drawn_capture(path: Path, is_plain: bool = False) -> Capture:
    """Write the capture into a new folder and open it; `is_plain` leaves out whatever changes the texture from frame to frame."""
    rig, cameras = make_small_rig(), _cameras()
    theta, root, face = _motion(rig)
    vertices = _posed(rig, theta, root)
    count = len(theta)
    frames = tuple(
        Frame(FIRST_NUMBER + i, 0.1 * i, "train" if i < TRAIN_FRAMES else "test", "sweep" if i < TRAIN_FRAMES else "new")
        for i in range(count)
    )
    description = CaptureDescription(
        "drawn", fps=10.0, background=BACKGROUND, held_out_cameras=(HELD_OUT,), licence="CC0-1.0", source="drawn by the tests"
    )
    writer = CaptureWriter(path, description, cameras, frames)
    renderer = SurfaceRenderer(rig.topology, WIDTH, HEIGHT, samples_per_pixel=16)
    batch = CameraBatch.from_cameras(list(cameras.values()))
    background = torch.tensor(BACKGROUND)[:, None, None]
    for i in range(count):
        texture = make_texture()
        if not is_plain:
            texture = texture * (1.2 - 0.35 * float(theta[i, 2]))
            texture[0] *= 0.8 + 0.4 * float(face[i, 0])
        radiance, mask = renderer.render(torch.from_numpy(vertices[i : i + 1]), texture.expand(len(cameras), -1, -1, -1), batch, seed=i)
        images = (radiance + (1 - mask) * background).permute(0, 2, 3, 1).numpy()
        for view, name in enumerate(cameras):
            writer.write_image(name, i, encode_bytes(np.ascontiguousarray(images[view]), "srgb"))
            writer.write_mask(name, i, mask[view, 0].numpy())
    writer.write_arrays(theta=theta, root=root, face=face, vertices=vertices)
    rig_file = path.parent / f"{path.name}_rig.npz"
    save_rig(rig_file, rig)
    writer.write_rig(rig_file)
    return writer.finish()


def with_small_camera(capture: Capture, path: Path, name: str, width: int, height: int) -> Capture:
    """A copy of a capture in which one camera's images are cut to their upper left corner: other sizes, the same pixels there."""
    shutil.copytree(capture.path, path)
    save_cameras(path / "cameras.json", capture.cameras | {name: replace(capture.cameras[name], width=width, height=height)})
    for file in (*path.glob(f"images/{name}/*"), *path.glob(f"masks/{name}/*")):
        with Image.open(file) as image:
            cut = image.crop((0, 0, width, height))
        cut.save(file)
    return Capture.open(path)


def _cameras() -> dict[str, Camera]:
    """Four cameras around the body and the held-out one above; focal lengths and principal points differ."""
    target = np.array([0.0, 0.0, 0.3])
    places = {"front": (0.1, -1.5, 0.5), "right": (1.4, -0.2, 0.2), "back": (-0.2, 1.6, 0.4), "left": (-1.5, 0.1, 0.6)}
    places[HELD_OUT] = (0.8, -1.1, 0.9)
    cameras = {}
    for index, (name, place) in enumerate(places.items()):
        pose = look_at(np.array(place), target)
        cameras[name] = Camera(name, WIDTH, HEIGHT, 88.0 + index, 90.0 - index, 19.0 + 0.5 * index, 29.0 - 0.5 * index, pose)
    return cameras


def _motion(rig: Rig) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """theta [N, 5] radians, root [N, 4, 4], face [N, 3] of all frames; test poses lie between training poses."""
    phase = np.concatenate([np.linspace(0, 1, TRAIN_FRAMES), np.linspace(0.3, 0.65, TEST_FRAMES)])
    waves = np.stack([np.sin(2 * np.pi * (k + 1) * phase / 2 + k) for k in range(5)], axis=1)
    lower, upper = rig.dofs.lower, rig.dofs.upper
    theta = 0.5 * (lower + upper) + 0.25 * (upper - lower) * waves
    root = np.broadcast_to(np.eye(4), (len(phase), 4, 4)).copy()
    angle = 0.3 * np.sin(3 * phase)
    root[:, 0, 0] = root[:, 1, 1] = np.cos(angle)
    root[:, 1, 0], root[:, 0, 1] = np.sin(angle), -np.sin(angle)
    root[:, 0, 3] = 0.03 * phase
    face = np.stack([0.5 + 0.5 * np.cos(4 * phase), phase, 1 - phase * phase], axis=1)
    return theta.astype(np.float32), root.astype(np.float32), face.astype(np.float32)


def _posed(rig: Rig, theta: np.ndarray, root: np.ndarray) -> np.ndarray:
    """[N, V, 3] the bulging rest surface, posed."""
    with torch.no_grad():
        transforms = Skeleton(rig)(torch.from_numpy(theta), torch.from_numpy(root))
        rest = torch.from_numpy(rig.rest_vertices + bulge(rig, theta))
        return pose_vertices(rest, transforms, torch.from_numpy(rig.skinning_weights)).numpy()


def copy_with_a_wider_held_out_camera(capture: Capture, folder: Path) -> Path:
    """Copy a capture, without its pictures, to `folder`; there the first camera is 64 pixels wide and held out too."""
    shutil.copytree(capture.path, folder, ignore=shutil.ignore_patterns("*.png"))
    document = json.loads((folder / "cameras.json").read_text())
    document["cameras"][0]["width"] = 64
    (folder / "cameras.json").write_text(json.dumps(document))
    description = folder / "capture.yaml"
    description.write_text(description.read_text().replace(f"- {HELD_OUT}", f"- {HELD_OUT}\n- front"))
    return folder
