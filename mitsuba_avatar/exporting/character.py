"""A character that other programs can play: the avatar's mean surface, skeleton, skin, shapes, one texture and one animation.

All in the project's own conventions (metres, Z up, texture row 0 at v = 1); writers convert. What a file cannot hold is measured when
the character is made: influences beyond the strongest, what the shapes leave of the decoder's surfaces. Textures do not move.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor

from mitsuba_avatar.body.rig import Rig
from mitsuba_avatar.body.skinning import pose_vertices
from mitsuba_avatar.captures.folder import Capture
from mitsuba_avatar.exporting.influences import Influences, strongest_influences, truncation_error_mm
from mitsuba_avatar.exporting.shapes import Shapes, face_response, facial_actions, one_sided, principal_motion
from mitsuba_avatar.model.avatar import Avatar

FRAMES_AT_ONCE = 8
FaceShapes = Literal["auto", "actions", "principal", "none"]


@dataclass(frozen=True)
class CharacterSettings:
    """What a character is made of.

    Attributes:
        influences: joints per vertex, 4 or 8.
        pose_shapes: principal shapes of the decoder's surfaces over the sequence, each stored once for either direction; 0 animates the
            skeleton alone.
        face_shapes: the rig's facial actions, principal shapes of the decoder's face, neither, or the first that there is.
        face_principals: how many of the second kind.
    """

    influences: Literal[4, 8] = 4
    pose_shapes: int = 16
    face_shapes: FaceShapes = "auto"
    face_principals: int = 16

    def __post_init__(self) -> None:
        if self.influences not in (4, 8) or self.pose_shapes < 0 or self.face_principals < 1:
            raise ValueError(
                f"CharacterSettings(): expected 4 or 8 influences, pose_shapes >= 0 and face_principals >= 1; got {self.influences}, "
                f"{self.pose_shapes} and {self.face_principals}."
            )


@dataclass(frozen=True, eq=False)
class Motion:
    """A driving sequence as joints and surfaces.

    Attributes:
        fps: frames per second.
        joint_rotations: [N, J, 3, 3] local, in rest world axes; root: [N, 4, 4] world_from_root.
        rest_vertices, vertices: [N, V, 3] of the avatar, rest space and world, metres.
    """

    fps: float
    joint_rotations: Float32[np.ndarray, "N J 3 3"]
    root: Float32[np.ndarray, "N 4 4"]
    rest_vertices: Float32[np.ndarray, "N V 3"]
    vertices: Float32[np.ndarray, "N V 3"]


@dataclass(frozen=True, eq=False)
class Character:
    """What a file holds.

    Attributes:
        rig: topology, joints and their rest positions.
        base_vertices: [V, 3] rest surface that shapes add to.
        influences: of every vertex.
        shapes: of the face first (at rest in the animation), then of the pose.
        strengths: [N, M] of the shapes over the animation, 0..1.
        motion: that is animated.
        costs_mm: what was lost: name -> (root mean square, largest), millimetres, over all frames and vertices.
    """

    rig: Rig
    base_vertices: Float32[np.ndarray, "V 3"]
    influences: Influences
    shapes: Shapes
    strengths: Float32[np.ndarray, "N M"]
    motion: Motion
    costs_mm: dict[str, tuple[float, float]]


@torch.no_grad()
def play(avatar: Avatar, capture: Capture, frames: Sequence[int]) -> Motion:
    """Decode the surfaces of frames of a capture, latent code zero.

    Raises:
        ValueError: no frames.
    """
    if not frames:
        raise ValueError(f"play(): expected at least one frame of {capture.path}; got none. Choose another split.")
    parts: list[list[Tensor]] = []
    for start in range(0, len(frames), FRAMES_AT_ONCE):
        some = list(frames[start : start + FRAMES_AT_ONCE])
        theta, root, face = (
            torch.from_numpy(np.array(values[some], np.float32)).to(avatar.mean_texture.device)
            for values in (capture.theta, capture.root, capture.face)
        )
        rest = avatar.decode_rest_vertices(theta, face, None)
        posed = pose_vertices(rest, avatar.skeleton(theta, root), avatar.skinning_weights)
        parts.append([avatar.skeleton.joint_rotations(theta), root, rest, posed])
    rotations, root, rest, posed = (torch.cat(column).cpu().numpy() for column in zip(*parts, strict=True))
    return Motion(capture.description.fps, rotations, root, rest, posed)


def make_character(avatar: Avatar, rig: Rig, capture: Capture, frames: Sequence[int], settings: CharacterSettings) -> Character:
    """Turn an avatar and a driving sequence into a character.

    Args:
        avatar: of the rig.
        rig: skeleton and skin.
        capture: that drives it.
        frames: of the animation.
        settings: sizes.

    Raises:
        ValueError: no frames, or facial actions of a rig that has none.
    """
    motion = play(avatar, capture, frames)
    signed = principal_motion(motion.rest_vertices, settings.pose_shapes)
    pose = one_sided(signed)
    face = _face_shapes(avatar, rig, capture, settings)
    influences = strongest_influences(rig.skinning_weights, settings.influences)
    device = avatar.mean_texture.device
    with torch.no_grad():
        theta, root = (torch.from_numpy(np.array(values[list(frames)], np.float32)).to(device) for values in (capture.theta, capture.root))
        skinned = truncation_error_mm(
            influences, torch.from_numpy(motion.rest_vertices), avatar.skeleton(theta, root).cpu(), torch.from_numpy(rig.skinning_weights)
        )
    strengths = np.concatenate([np.zeros((len(frames), len(face.names)), np.float32), pose.strengths], axis=1)
    costs = {f"skinning with {settings.influences} joints a vertex": _rms_and_largest(skinned.numpy())}
    costs[f"surface as {len(signed.shapes.names)} principal shapes"] = _rms_and_largest(signed.error_mm)
    return Character(rig, pose.mean, influences, face + pose.shapes, strengths, motion, costs)


def _face_shapes(avatar: Avatar, rig: Rig, capture: Capture, settings: CharacterSettings) -> Shapes:
    """Shapes of the face by the settings' choice."""
    if settings.face_shapes in ("auto", "actions"):
        actions = facial_actions(rig)
        if actions is not None:
            return actions
        if settings.face_shapes == "actions":
            raise ValueError(f"make_character(): expected a rig with facial actions; {rig.name!r} has none. Use principal face shapes.")
    if settings.face_shapes == "none":
        return Shapes((), np.zeros((0, rig.topology.num_vertices, 3), np.float32))
    theta = avatar.standardize_theta.mean
    faces = torch.from_numpy(np.array(capture.face[:: max(1, len(capture.frames) // 64)], np.float32)).to(theta.device)
    return face_response(avatar, theta, faces, settings.face_principals)


def _rms_and_largest(errors: np.ndarray) -> tuple[float, float]:
    return float(np.sqrt(np.mean(np.square(errors, dtype=np.float64)))), float(errors.max())
