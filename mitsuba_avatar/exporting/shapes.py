"""Shapes that add to the rest surface: what a decoder does from frame to frame as a few principal ones, and those of the face."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor

from mitsuba_avatar.body.anny_rig import facial_action_displacements, is_anny
from mitsuba_avatar.body.rig import Rig
from mitsuba_avatar.model.avatar import Avatar


@dataclass(frozen=True, eq=False)
class Shapes:
    """Named displacements of the rest vertices.

    Attributes:
        names: M unique names.
        displacements: [M, V, 3] metres, at strength one.
    """

    names: tuple[str, ...]
    displacements: Float32[np.ndarray, "M V 3"]

    def __add__(self, other: "Shapes") -> "Shapes":
        return Shapes(self.names + other.names, np.concatenate([self.displacements, other.displacements]))


@dataclass(frozen=True, eq=False)
class PrincipalMotion:
    """A sequence of rest surfaces as a mean and a few shapes.

    Attributes:
        mean: [V, 3] metres.
        shapes: M of them, largest first, each as large as its largest strength makes it in the sequence.
        strengths: [N, M] in -1..1.
        error_mm: [N, V] what the shapes leave out, millimetres.
    """

    mean: Float32[np.ndarray, "V 3"]
    shapes: Shapes
    strengths: Float32[np.ndarray, "N M"]
    error_mm: Float32[np.ndarray, "N V"]


def principal_motion(rest_vertices: Float32[np.ndarray, "N V 3"], count: int, prefix: str = "pose") -> PrincipalMotion:
    """Principal components of rest surfaces over time.

    Args:
        rest_vertices: [N, V, 3] metres.
        count: shapes at most; N surfaces have N - 1.
        prefix: of the shapes' names.
    """
    frames, vertices = rest_vertices.shape[:2]
    mean = rest_vertices.mean(axis=0, dtype=np.float64)
    offsets = (rest_vertices - mean).reshape(frames, -1)
    # The small Gram matrix instead of an SVD of [N, 3 V]: sequences are far shorter than meshes are large.
    values, vectors = np.linalg.eigh(offsets @ offsets.T)
    order = [i for i in np.argsort(-values)[:count] if values[i] > 1e-12 * max(float(values[-1]), 1e-12)]  # rounding is no motion
    strengths = vectors[:, order]  # unit columns; the shapes carry the size
    shapes = (strengths.T @ offsets).reshape(len(order), vertices, 3)
    largest = np.abs(strengths).max(axis=0) if order else np.ones(0)
    strengths, shapes = strengths / largest, shapes * largest[:, None, None]
    left = offsets.reshape(frames, vertices, 3) - np.tensordot(strengths, shapes, axes=1)
    names = tuple(f"{prefix}_{i:02d}" for i in range(len(order)))
    error_mm = (1000 * np.linalg.norm(left, axis=2)).astype(np.float32)
    return PrincipalMotion(mean.astype(np.float32), Shapes(names, shapes.astype(np.float32)), strengths.astype(np.float32), error_mm)


def one_sided(motion: PrincipalMotion) -> PrincipalMotion:
    """The same surfaces with strengths in 0..1, which is all that some programs (Blender) let a shape have.

    A shape that is used in both directions becomes two: `pose_00`, and `pose_00_minus`, which displaces the other way. Directions that the
    sequence does not use are left out.
    """
    names, displacements, strengths = [], [], []
    for name, shape, values in zip(motion.shapes.names, motion.shapes.displacements, motion.strengths.T, strict=True):
        for suffix, sign in (("", 1), ("_minus", -1)):
            side = np.maximum(sign * values, 0)
            if side.any():
                names.append(name + suffix)
                displacements.append(sign * shape)
                strengths.append(side)
    if not names:
        return motion
    return PrincipalMotion(motion.mean, Shapes(tuple(names), np.stack(displacements)), np.stack(strengths, axis=1), motion.error_mm)


def facial_actions(rig: Rig) -> Shapes | None:
    """The rig's own facial actions; None for a rig that has none (only Anny's do)."""
    if not is_anny(rig):
        return None
    names, displacements = facial_action_displacements()
    if displacements.shape[1] != rig.topology.num_vertices:
        return None
    return Shapes(names, displacements.astype(np.float32))


@torch.no_grad()
def face_response(avatar: Avatar, theta: Float[Tensor, "D"], faces: Float[Tensor, "N F"], count: int) -> Shapes:
    """Principal directions in which an avatar's surface follows its face signal, body held still.

    Args:
        avatar: decoded with a zero latent code.
        theta: [D] pose angles of the body, radians.
        faces: [N, F] face signals of a recording.
        count: shapes at most.
    """
    surfaces = [avatar.decode_rest_vertices(theta.expand(len(part), -1), part, None).cpu().numpy() for part in faces.split(8)]
    return principal_motion(np.concatenate(surfaces), count, prefix="face").shapes
