"""Driving signals: where on the surface each of them may act, and the face landmarks.

`driving_masks` gives the binary masks M_theta and M_f that confine each pose angle, and the face signal, to its part of the texture
atlas (32 x 32 cells in the paper). `face_keypoints` reads the face signal f off rest-space vertices. Metres, radians.

Source: arXiv:2105.10441, section 3.3.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32
from torch import Tensor

from mitsuba_avatar.body.rig import Rig
from mitsuba_avatar.body.uv import UvAtlas

TEXELS_PER_CELL = 8  # a cell looks at this many texels a side: single samples would miss fingers
WEIGHT_THRESHOLD = 0.1  # of a skinning weight (or of the face region) somewhere in a cell
REACH = 2.0  # how far from a joint its parent's skin counts, in units of how far the joint's own skin reaches


@dataclass(frozen=True, eq=False)  # tensors have no truth value to compare by
class DrivingMasks:
    """Binary masks in atlas orientation (row 0 is v = 1): theta [D, S, S] one per pose angle, face [S, S]."""

    theta: Float32[Tensor, "D S S"]
    face: Float32[Tensor, "S S"]


@dataclass(frozen=True, eq=False)
class DrivingRegions:
    """The same on the surface itself: theta [D, V], one row per pose angle, face [V]; True where the signal governs a vertex."""

    theta: Bool[np.ndarray, "D V"]
    face: Bool[np.ndarray, "V"]


def driving_regions(rig: Rig) -> DrivingRegions:
    """Vertices that each pose angle, and the face signal, govern: what `driving_masks` looks for in its cells, without widening."""
    joints, row_of_dof = np.unique(rig.dofs.joints, return_inverse=True)
    influence = np.stack([_influence(rig, int(joint)) for joint in joints])
    return DrivingRegions(theta=influence[row_of_dof] > WEIGHT_THRESHOLD, face=rig.face_region > WEIGHT_THRESHOLD)


def driving_masks(rig: Rig, size: int = 32) -> DrivingMasks:
    """Cells of the atlas on which each pose angle, and the face signal, may act.

    A pose angle acts where the skin follows its joint, and where skin follows the joint's parent not farther away than `REACH` times
    the joint's own skin reaches: an elbow acts on the forearm's and on the upper arm's skin, an eye on its lids and not on the whole
    head. A parent without skin is replaced by its other children (the lowest spine joint faces both halves of the pelvis), a joint
    without skin by its descendants. "Follows" means that the skinning weight exceeds `WEIGHT_THRESHOLD` somewhere in the cell; every
    mask is widened by one cell.

    Args:
        rig: its skinning weights, pose angles and face region.
        size: cells a side.

    Returns:
        Masks of zeros and ones.

    Raises:
        ValueError: if a pose angle or the face has no cell at all.

    Source: arXiv:2105.10441, section 3.3.
    """
    joints, row_of_dof = np.unique(rig.dofs.joints, return_inverse=True)
    signals = [_influence(rig, int(joint)) for joint in joints] + [rig.face_region]
    masks = _widen(_cell_maxima(rig, np.stack(signals, axis=1), size) > WEIGHT_THRESHOLD)
    theta, face = masks[torch.from_numpy(row_of_dof)], masks[-1]
    empty = [name for name, mask in zip(rig.dofs.names, theta, strict=True) if not mask.any()]
    if empty:
        raise ValueError(
            f"driving_masks(): expected every pose angle to move some surface; got none for {empty}. "
            "Remove them from the rig or give the masks more cells."
        )
    if not face.any():
        raise ValueError("driving_masks(): expected a face region; got none above the threshold. Mark face vertices in the rig.")
    return DrivingMasks(theta=theta, face=face)


def face_keypoints(rig: Rig, rest_vertices: Float[Tensor, "B V 3"]) -> Float[Tensor, "B K3"]:
    """The face signal f: landmarks of unposed vertices seen from the head.

    Args:
        rig: names the landmarks and the head, the joint that they follow most.
        rest_vertices: [B, V, 3] metres, rest space (unposed, facial movement included).

    Returns:
        [B, K * 3] metres: x, y, z of each landmark along rest world axes, from the head joint.

    Gradients: flow to rest_vertices.

    Raises:
        ValueError: if the vertex count is not the rig's.

    Source: arXiv:2105.10441, section 3.2 (3D facial keypoints).
    """
    if rest_vertices.shape[1] != rig.topology.num_vertices:
        raise ValueError(
            f"face_keypoints(): rest_vertices must be [B, {rig.topology.num_vertices}, 3] for this rig; got {list(rest_vertices.shape)}. "
            "Load mesh and rig from the same capture."
        )
    head = int(rig.skinning_weights[rig.face_keypoint_vertices].sum(axis=0).argmax())
    origin = torch.from_numpy(rig.joint_positions[head]).to(rest_vertices)
    landmarks = torch.from_numpy(rig.face_keypoint_vertices).to(rest_vertices.device)
    return (rest_vertices[:, landmarks] - origin).flatten(1)


def _influence(rig: Rig, joint: int) -> Float32[np.ndarray, "V"]:
    """Largest skinning weight through which each vertex feels the joint's turning: see `driving_masks`."""
    weights, parents = rig.skinning_weights, rig.joint_parents
    has_skin = weights.max(axis=0) > WEIGHT_THRESHOLD
    below = {joint}
    for child in range(joint + 1, len(parents)):  # parents come first
        if int(parents[child]) in below:
            below.add(child)
    carried = [joint] if has_skin[joint] else sorted(below)
    own = weights[:, carried].max(axis=1)
    parent = int(parents[joint])
    if parent < 0 or not (own > WEIGHT_THRESHOLD).any():
        return own
    opposite = [parent] if has_skin[parent] else sorted(set(np.flatnonzero(parents == parent)) - {joint})
    if not opposite:
        return own
    distance = np.linalg.norm(rig.rest_vertices - rig.joint_positions[joint], axis=1)
    near = distance < REACH * distance[own > WEIGHT_THRESHOLD].max()
    return np.maximum(own, weights[:, opposite].max(axis=1) * near)


def _cell_maxima(rig: Rig, signals: Float32[np.ndarray, "V N"], size: int) -> Float32[Tensor, "N S S"]:
    """Largest value of each vertex signal among the covered texels of each cell; 0 in empty cells."""
    atlas = UvAtlas(rig.topology, size * TEXELS_PER_CELL)
    texels = atlas.texels_from_vertices(torch.from_numpy(signals)[None])
    return torch.nn.functional.max_pool2d(texels * atlas.covered, TEXELS_PER_CELL)[0]


def _widen(masks: Tensor) -> Float32[Tensor, "N S S"]:
    """Boolean masks [N, S, S] dilated by one cell in all eight directions, as zeros and ones."""
    return torch.nn.functional.max_pool2d(masks.float()[None], kernel_size=3, stride=1, padding=1)[0]
