"""Filming: from settings to a capture on disk. Interrupted filming goes on where it stopped; the same settings give the same capture.

    settings -> rig, clothes, paint -> motion -> surface of every frame -> cameras -> images frame by frame

The surface that is filmed is kept as `vertices.npy`: the registered mesh is the truth. The capture's rig has the dressed person's mean
rest shape over the training frames as its template, so that skinning the template alone already fits the clothes on average.
"""

import dataclasses
import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32

from mitsuba_avatar.body.anny_rig import build_anny_rig, facial_action_displacements
from mitsuba_avatar.body.driving import face_keypoints
from mitsuba_avatar.body.rig import Rig, save_rig
from mitsuba_avatar.body.skeleton import Skeleton
from mitsuba_avatar.body.skinning import pose_vertices
from mitsuba_avatar.captures.colour import decode_bytes, encode_bytes
from mitsuba_avatar.captures.description import CaptureDescription
from mitsuba_avatar.captures.folder import Capture
from mitsuba_avatar.captures.writer import CaptureWriter
from mitsuba_avatar.files import cache_folder
from mitsuba_avatar.filming.anatomy import Anatomy
from mitsuba_avatar.filming.appearance import Appearance, paint
from mitsuba_avatar.filming.cameras import DomeCameras, place_cameras
from mitsuba_avatar.filming.clothing import dress, hair, shirt, trousers
from mitsuba_avatar.filming.contact_sheet import save_contact_sheet
from mitsuba_avatar.filming.motion import Motion, perform
from mitsuba_avatar.filming.settings import StudioSettings
from mitsuba_avatar.filming.stage import Stage
from mitsuba_avatar.filming.wrinkles import KinematicCloth
from mitsuba_avatar.resources import find_resource

FILMING_VERSION = 4  # raised when what filming makes of the same settings changes, so that older cached captures are not taken
PERSONS: dict[str, Callable[[], Rig]] = {"anny": build_anny_rig}
CONTACT_SHEET = "contact_sheet.png"
Progress = Callable[[int, int], None]  # frames done, frames in all


@dataclass(frozen=True)
class Performance:
    """Everything that is in front of the cameras, frame by frame.

    Attributes:
        rig: with the dressed mean rest shape as template.
        appearance: textures of the person.
        motion: frames, pose angles, root, facial actions.
        rest_vertices: [N, V, 3] surface before skinning: clothes, folds and facial movement. Metres.
        vertices: [N, V, 3] posed surface, world axes.
    """

    rig: Rig
    appearance: Appearance
    motion: Motion
    rest_vertices: Float32[np.ndarray, "N V 3"]
    vertices: Float32[np.ndarray, "N V 3"]


def default_capture_path(settings: StudioSettings) -> Path:
    """Where the capture of these settings is kept: in the cache folder, under name and a hash of every setting."""
    text = f"{FILMING_VERSION} {sorted(dataclasses.asdict(settings).items())}"
    return cache_folder() / "captures" / f"{settings.name}-{hashlib.sha256(text.encode()).hexdigest()[:10]}"


def stage_performance(settings: StudioSettings) -> Performance:
    """Dress, paint and move the person; nothing is rendered."""
    bare = PERSONS[settings.person]()
    anatomy = Anatomy.of(bare)
    top = shirt(anatomy)
    body = dress(anatomy, (trousers(anatomy, top), top, hair(anatomy)))
    names, displacements = facial_action_displacements()
    motion = perform(bare, settings, names)
    folds = KinematicCloth(anatomy, body, settings.seed).displacements(motion.theta, settings.motion.fps, motion.segments())
    face = np.einsum("na,avc->nvc", motion.actions, displacements, optimize=True)
    rest = (body.vertices + folds + face).astype(np.float32)
    train = [index for index, frame in enumerate(motion.frames) if frame.split == "train"]
    rig = dataclasses.replace(bare, rest_vertices=rest[train].mean(axis=0))
    root, vertices = _on_floor(motion.root, _posed(rig, motion, rest))
    appearance = paint(anatomy, body, settings.clothing.texture_size, settings.seed)
    return Performance(rig, appearance, dataclasses.replace(motion, root=root), rest, vertices)


def film_capture(settings: StudioSettings, folder: Path | str, progress: Progress | None = None) -> Capture:
    """Film a capture into a folder, or finish one that was interrupted there.

    Args:
        settings: what to film.
        folder: new, or holding an unfinished capture of the same settings. A finished one of the same settings is returned as it is.
        progress: called after every frame with the number of frames done and in all.

    Raises:
        FileExistsError: if the folder holds something else.
        OSError: no write permission, disk full.
    """
    folder = Path(folder)
    if (folder / "capture.yaml").is_file() and _filmed_with(folder) == _signature(settings):
        return Capture.open(folder)
    find_resource("scenes", settings.light.scene, ".xml")  # a wrong name is told before the work, not after
    performance = stage_performance(settings)
    dome = place_cameras(performance.vertices, settings)
    writer = CaptureWriter(folder, _describe(performance.rig, dome, settings), dome.cameras, performance.motion.frames)
    _write_arrays(writer, performance)
    stage = Stage(performance.rig.topology, performance.appearance, list(dome.cameras.values()), settings)
    total = len(performance.motion.frames)
    backdrop = np.float32(_backdrop(settings))
    for index in range(total):
        if not all(writer.has_image(name, index) and writer.has_mask(name, index) for name in dome.cameras):
            radiance, coverage = stage.shoot(performance.vertices[index], seed=settings.seed * 1_000_003 + index)
            composed = radiance + (1 - coverage[..., None]) * backdrop
            for name, image, mask in zip(dome.cameras, encode_bytes(composed, "srgb"), coverage, strict=True):
                writer.write_mask(name, index, mask)
                writer.write_image(name, index, image)
        if progress is not None:
            progress(index + 1, total)
    capture = writer.finish()
    save_contact_sheet(capture, folder / CONTACT_SHEET)
    return capture


def _posed(rig: Rig, motion: Motion, rest_vertices: Float32[np.ndarray, "N V 3"]) -> Float32[np.ndarray, "N V 3"]:
    """The surface in the world, frame by frame: all at once would need memory for N x V blended transforms."""
    weights = torch.from_numpy(rig.skinning_weights)
    with torch.no_grad():
        transforms = Skeleton(rig)(torch.from_numpy(motion.theta), torch.from_numpy(motion.root))
        posed = [
            pose_vertices(torch.from_numpy(rest)[None], transform[None], weights)
            for rest, transform in zip(rest_vertices, transforms, strict=True)
        ]
    return torch.cat(posed).numpy()


def _on_floor(
    root: Float32[np.ndarray, "N 4 4"], vertices: Float32[np.ndarray, "N V 3"]
) -> tuple[Float32[np.ndarray, "N 4 4"], Float32[np.ndarray, "N V 3"]]:
    """Root and surface, shifted so that the lowest point of every frame lies on z = 0, whatever ankles and toes do."""
    lowest = vertices[..., 2].min(axis=1)
    up = np.array([0, 0, 1], dtype=np.float32)
    shifted = root.copy()
    shifted[:, 2, 3] -= lowest
    return shifted, vertices - lowest[:, None, None] * up


def _describe(rig: Rig, dome: DomeCameras, settings: StudioSettings) -> CaptureDescription:
    """What capture.yaml says."""
    axes = [f"{name}_{axis}" for name in rig.face_keypoint_names for axis in "xyz"]
    return CaptureDescription(
        name=settings.name,
        fps=settings.motion.fps,
        colour_curve="srgb",
        lighting={"scene": settings.light.scene},
        background=(_backdrop(settings),) * 3,
        face_signal="keypoints",
        face_names=tuple(axes),
        keypoint_names=rig.keypoint_names,
        held_out_cameras=dome.held_out,
        licence="CC0-1.0",
        source=_signature(settings),
    )


def _backdrop(settings: StudioSettings) -> float:
    """The backdrop's linear radiance, as the nearest 8-bit value: images then hold exactly what the description says."""
    return float(decode_bytes(encode_bytes(np.array([settings.light.background]), "srgb"), "srgb")[0])


def _signature(settings: StudioSettings) -> str:
    """Says in the capture what made it, so that a finished capture is recognised."""
    return f"mitsuba_avatar.studio {default_capture_path(settings).name}"


def _filmed_with(folder: Path) -> str:
    return Capture.open(folder).description.source


def _write_arrays(writer: CaptureWriter, performance: Performance) -> None:
    """Pose, face signal, keypoints, registered surface and rig."""
    rig, motion = performance.rig, performance.motion
    with torch.no_grad():
        face = face_keypoints(rig, torch.from_numpy(performance.rest_vertices)).numpy()
        skeleton = Skeleton(rig)
        joints = skeleton.posed_joints(skeleton(torch.from_numpy(motion.theta), torch.from_numpy(motion.root))).numpy()[
            :, rig.keypoint_joints
        ]
    keypoints = np.concatenate([joints, np.ones_like(joints[..., :1])], axis=-1)
    writer.write_arrays(theta=motion.theta, root=motion.root, face=face, keypoints=keypoints, vertices=performance.vertices)
    save_rig(writer.path / writer.description.rig, rig)
