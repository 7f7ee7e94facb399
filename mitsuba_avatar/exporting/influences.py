"""Skinning with few joints per vertex, as game engines and file formats have it, and what it costs."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32, Int64
from torch import Tensor

from mitsuba_avatar.body.skinning import pose_vertices


@dataclass(frozen=True, eq=False)
class Influences:
    """The strongest joints of every vertex, strongest first.

    Attributes:
        joints: [V, K] joint indices, 0 where the weight is 0.
        weights: [V, K] >= 0, rows sum to 1.
    """

    joints: Int64[np.ndarray, "V K"]
    weights: Float32[np.ndarray, "V K"]

    def dense(self, num_joints: int) -> Float32[np.ndarray, "V J"]:
        """The same as a full matrix of weights."""
        full = np.zeros((len(self.joints), num_joints), np.float32)
        np.add.at(full, (np.arange(len(full))[:, None], self.joints), self.weights)
        return full


def strongest_influences(skinning_weights: Float32[np.ndarray, "V J"], count: int) -> Influences:
    """Keep the `count` largest weights of every vertex and make them sum to one again."""
    padded = np.pad(skinning_weights, ((0, 0), (0, max(0, count - skinning_weights.shape[1]))))
    joints = np.argsort(-padded, axis=1, kind="stable")[:, :count]
    weights = np.take_along_axis(padded, joints, axis=1).astype(np.float64)
    weights = (weights / weights.sum(axis=1, keepdims=True)).astype(np.float32)
    return Influences(np.where(weights > 0, joints, 0), weights)


@torch.no_grad()
def truncation_error_mm(
    influences: Influences, rest_vertices: Float[Tensor, "N V 3"], posed_from_rest: Float[Tensor, "N J 4 4"], weights: Float[Tensor, "V J"]
) -> Float[Tensor, "N V"]:
    """How far vertices move from where full skinning puts them, [N, V] millimetres, in N poses.

    Args:
        influences: truncated ones.
        rest_vertices: [N, V, 3] metres.
        posed_from_rest: [N, J, 4, 4] rigid.
        weights: [V, J] the full ones.
    """
    truncated = torch.from_numpy(influences.dense(weights.shape[1]))
    full = pose_vertices(rest_vertices, posed_from_rest, weights)
    return 1000 * (pose_vertices(rest_vertices, posed_from_rest, truncated) - full).norm(dim=2)
