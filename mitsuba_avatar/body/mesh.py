"""Differential quantities of a welded triangle mesh: vertex normals and the uniform Laplacian. Metres, world axes."""

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from mitsuba_avatar.body.rig import Topology
from mitsuba_avatar.body.sparse import SparseLinear


class Laplacian(nn.Module):
    """Uniform Laplacian of a topology: mean of a vertex's neighbours minus the vertex. A vertex without neighbours gets zero.

    Source: arXiv:2105.10441, section 3.6 (L_lap).
    """

    def __init__(self, topology: Topology):
        super().__init__()
        count = topology.num_vertices
        starts, ends = unique_edges(topology.faces).T
        rows, columns = np.concatenate([starts, ends]), np.concatenate([ends, starts])
        degree = np.bincount(rows, minlength=count)
        joined = np.flatnonzero(degree)
        self.matrix = SparseLinear(
            np.concatenate([rows, joined]),
            np.concatenate([columns, joined]),
            np.concatenate([1.0 / degree[rows], -np.ones(len(joined))]),
            (count, count),
        )

    def forward(self, vertices: Float[Tensor, "B V 3"]) -> Float[Tensor, "B V 3"]:
        """[B, V, 3] metres: how far each vertex is from its neighbours' mean. Gradients flow to vertices."""
        batch, count = vertices.shape[:2]
        rows = self.matrix(vertices.transpose(0, 1).reshape(count, batch * 3))
        return rows.reshape(count, batch, 3).transpose(0, 1)


def unique_edges(faces: Int[np.ndarray, "F 3"]) -> Int[np.ndarray, "E 2"]:
    """[E, 2] vertex pairs of a mesh's edges, each once, smaller index first."""
    pairs = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    return np.unique(pairs, axis=0)


def vertex_normals(vertices: Float[Tensor, "B V 3"], faces: Int[Tensor, "F 3"]) -> Float[Tensor, "B V 3"]:
    """Unit normals, mean of the adjoining faces' weighted by their area. A vertex of no face, or of flat faces only, gets zero.

    Gradients: flow to vertices.
    """
    corners = vertices[:, faces]  # [B, F, 3, 3]
    face_normals = torch.linalg.cross(corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0])  # length: twice the area
    normals = torch.zeros_like(vertices)
    for corner in range(3):
        normals = normals.index_add(1, faces[:, corner], face_normals)
    return torch.nn.functional.normalize(normals, dim=-1, eps=1e-20)  # areas of 1e-6 square metres are usual
