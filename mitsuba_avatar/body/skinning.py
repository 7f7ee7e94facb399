"""Linear blend skinning, its inverse, and the same for directions.

Every vertex moves with the weighted mean of its joints' transforms, A_v = sum_j w_vj M_j. Metres, world axes. Weights of another rig
are a user's mistake: their sizes carry names of their own in the types and are compared by hand, with the remedy.

Source: arXiv:2105.10441, section 3.4.1 (posing) and 3.2 (unposing the registered mesh for the encoder).
"""

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor

from mitsuba_avatar.body.rig import Rig
from mitsuba_avatar.body.skeleton import Skeleton

SMALLEST_DETERMINANT = 1e-3  # of a blended matrix: below it a vertex is folded flat (a joint twisted by about 180 degrees)


@torch.no_grad()
def posed_rest_surface(rig: Rig, theta: Float[np.ndarray, "D"], root: Float[np.ndarray, "4 4"]) -> Float32[np.ndarray, "V 3"]:  # noqa: F821
    """The rig's rest surface in one pose.

    Args:
        rig: skeleton and skin.
        theta: [D] joint angles, radians.
        root: [4, 4] rigid world_from_root.

    Returns:
        [V, 3] metres, world axes.
    """
    transforms = Skeleton(rig)(*(torch.from_numpy(np.array(values, np.float32))[None] for values in (theta, root)))
    return pose_vertices(torch.from_numpy(rig.rest_vertices)[None], transforms, torch.from_numpy(rig.skinning_weights))[0].numpy()


def blend_transforms(
    posed_from_rest: Float[Tensor, "B J 4 4"], skinning_weights: Float[Tensor, "vertices joints"]
) -> Float[Tensor, "B vertices 3 4"]:
    """Upper rows of A_v = sum_j w_vj M_j for every vertex.

    Gradients: flow to posed_from_rest; weights are constants.

    Raises:
        ValueError: if the joint counts differ.
    """
    return _blended(posed_from_rest, skinning_weights).permute(0, 3, 1, 2)


def pose_vertices(
    rest_vertices: Float[Tensor, "B V 3"], posed_from_rest: Float[Tensor, "B J 4 4"], skinning_weights: Float[Tensor, "vertices joints"]
) -> Float[Tensor, "B V 3"]:
    """Linear blend skinning: carry rest vertices to a pose, v' = A_v v.

    Args:
        rest_vertices: [B, V, 3] metres, world axes.
        posed_from_rest: [B, J, 4, 4] rigid, no scale.
        skinning_weights: [V, J] >= 0, rows sum to 1.

    Returns:
        [B, V, 3] metres, world axes.

    Gradients: flow to rest_vertices and posed_from_rest; weights are constants.

    Raises:
        ValueError: if the vertex counts differ.

    Source: arXiv:2105.10441, section 3.4.1.
    """
    _check_vertex_count("pose_vertices", rest_vertices.shape[1], skinning_weights)
    blended = _blended(posed_from_rest, skinning_weights)
    rest = rest_vertices.transpose(1, 2).contiguous()  # [B, 3, V]
    posed = (blended[:, :, :3] * rest[:, None]).sum(2) + blended[:, :, 3]
    return posed.transpose(1, 2).contiguous()


def unpose_vertices(
    posed_vertices: Float[Tensor, "B V 3"], posed_from_rest: Float[Tensor, "B J 4 4"], skinning_weights: Float[Tensor, "vertices joints"]
) -> Float[Tensor, "B V 3"]:
    """Inverse of `pose_vertices`: v = A_v^-1 v', exact wherever the blended matrix can be inverted.

    Where a joint is twisted by nearly half a turn the blend folds the surface flat and has no inverse: there the determinant is
    kept at `SMALLEST_DETERMINANT`, which bounds the result instead of letting it run to infinity.

    Args:
        posed_vertices: [B, V, 3] metres, world axes.
        posed_from_rest: [B, J, 4, 4] rigid, no scale.
        skinning_weights: [V, J] >= 0, rows sum to 1.

    Returns:
        [B, V, 3] metres, rest space.

    Gradients: flow to posed_vertices and posed_from_rest.

    Raises:
        ValueError: if the vertex counts differ.

    Source: arXiv:2105.10441, section 3.2.
    """
    _check_vertex_count("unpose_vertices", posed_vertices.shape[1], skinning_weights)
    blended = _blended(posed_from_rest, skinning_weights)
    offset = posed_vertices.transpose(1, 2) - blended[:, :, 3]  # [B, 3, V]
    # Cramer's rule on columns a, b, c: far faster than a batched LAPACK inverse of thousands of 3x3 matrices.
    first, second, third = blended[:, :, 0], blended[:, :, 1], blended[:, :, 2]
    across, aside = _cross(second, third), _cross(first, offset)
    determinant = (first * across).sum(1)  # [B, V]
    safe = torch.where(determinant.abs() < SMALLEST_DETERMINANT, torch.full_like(determinant, SMALLEST_DETERMINANT), determinant)
    rest = torch.stack([(offset * across).sum(1), (third * aside).sum(1), -(second * aside).sum(1)], dim=-1)
    return rest / safe[..., None]


def rest_directions_from_posed(
    directions: Float[Tensor, "B *views V 3"], posed_from_rest: Float[Tensor, "B J 4 4"], skinning_weights: Float[Tensor, "vertices joints"]
) -> Float[Tensor, "B *views V 3"]:
    """Turn directions at posed vertices (view vectors) back to rest space: sum_j w_vj R_j^T d, renormalised.

    Args:
        directions: [B, ..., V, 3] in the posed world; any number of views between batch and vertices.
        posed_from_rest: [B, J, 4, 4] rigid.
        skinning_weights: [V, J] >= 0, rows sum to 1.

    Returns:
        [B, ..., V, 3] unit vectors in rest space.

    Gradients: flow to directions and posed_from_rest.

    Raises:
        ValueError: if the vertex counts differ.
    """
    _check_vertex_count("rest_directions_from_posed", directions.shape[-2], skinning_weights)
    blended = blend_transforms(posed_from_rest, skinning_weights)[..., :3].contiguous()  # [B, V, 3, 3]
    batch, count = blended.shape[:2]
    flat = directions.reshape(batch, -1, count, 3)
    turned = (flat[..., :, None] * blended[:, None]).sum(-2).reshape(directions.shape)
    return torch.nn.functional.normalize(turned, dim=-1)


def _blended(
    posed_from_rest: Float[Tensor, "B J 4 4"], skinning_weights: Float[Tensor, "vertices joints"]
) -> Float[Tensor, "B 3 4 vertices"]:
    """What `blend_transforms` gives, with vertices last: one matrix product, and what follows runs along memory instead of in threes,
    which takes a third of the time."""
    batch, joints = posed_from_rest.shape[:2]
    if skinning_weights.shape[1] != joints:
        raise ValueError(
            f"blend_transforms(): skinning_weights must be [V, {joints}] for these joints; got {list(skinning_weights.shape)}. "
            "Take weights and skeleton from the same rig."
        )
    entries = posed_from_rest[:, :, :3].permute(0, 2, 3, 1).reshape(batch * 12, joints)
    return (entries @ skinning_weights.T).reshape(batch, 3, 4, -1)


def _cross(first: Float[Tensor, "B 3 V"], second: Float[Tensor, "B 3 V"]) -> Float[Tensor, "B 3 V"]:
    """Cross product over the middle; several times faster than torch's, which takes it vector by vector."""
    return first.roll(-1, 1) * second.roll(1, 1) - first.roll(1, 1) * second.roll(-1, 1)


def _check_vertex_count(function: str, count: int, skinning_weights: Float[Tensor, "vertices joints"]) -> None:
    if count != len(skinning_weights):
        raise ValueError(
            f"{function}(): vertices must be [B, {len(skinning_weights)}, 3] for this rig; got {count} vertices. "
            "Load mesh and rig from the same capture."
        )
