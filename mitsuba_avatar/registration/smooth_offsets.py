"""Smooth displacements of a mesh from few pulls: offsets are solutions of (I + smoothness L) x = u for the unknowns u.

Gradients of silhouettes touch only the vertices at the outline. Optimising u instead of x spreads every pull over the surface around it,
which keeps the mesh smooth without a stiff penalty. Pieces that hang together with no edge (eyes in their sockets, the mouth's inside)
are tied to the nearest vertex of the largest piece, so that they move along.

Source: Nicolet, Jacobson, Jakob, "Large Steps in Inverse Rendering of Geometry", ACM TOG 2021.
"""

import numpy as np
import scipy.sparse
import scipy.sparse.linalg
import torch
from jaxtyping import Float
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from torch import Tensor

from mitsuba_avatar.body.mesh import unique_edges


class SmoothOffsets:
    """The map u -> x, factorised once.

    Args:
        vertices: [V, 3] rest mesh, which says what is near.
        faces: [F, 3].
        smoothness: weight of the graph Laplacian; a pull spreads over about its square root of rings.
    """

    def __init__(self, vertices: Float[np.ndarray, "V 3"], faces: np.ndarray, smoothness: float):
        edges = np.concatenate([unique_edges(faces), _ties(vertices, faces)])
        ones = np.ones(len(edges))
        count = len(vertices)
        adjacency = scipy.sparse.coo_matrix((ones, edges.T), shape=(count, count))
        adjacency = adjacency + adjacency.T
        laplacian = scipy.sparse.diags(np.asarray(adjacency.sum(axis=1)).ravel()) - adjacency
        matrix = (scipy.sparse.identity(count) + smoothness * laplacian).tocsc()
        # Symmetric positive definite: no pivoting, and an ordering that keeps the factors thin.
        self._factors = scipy.sparse.linalg.splu(matrix, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}, diag_pivot_thresh=0.0)

    def __call__(self, unknowns: Float[Tensor, "M V 3"]) -> Float[Tensor, "M V 3"]:
        """Offsets x of M meshes. Gradients: to the unknowns, by the same (symmetric) solve."""
        return _Solve.apply(unknowns, self)

    def solve(self, right: Float[Tensor, "M V 3"]) -> Float[Tensor, "M V 3"]:
        """(I + smoothness L)^-1 of every column."""
        count = right.shape[1]
        columns = right.detach().permute(1, 0, 2).reshape(count, -1).double().numpy()
        solved = torch.from_numpy(self._factors.solve(columns)).to(right.dtype)
        return solved.reshape(count, len(right), 3).permute(1, 0, 2).contiguous()


class _Solve(torch.autograd.Function):
    @staticmethod
    def forward(context, unknowns: Tensor, offsets: SmoothOffsets) -> Tensor:
        context.offsets = offsets
        return offsets.solve(unknowns)

    @staticmethod
    def backward(context, gradient: Tensor) -> tuple[Tensor, None]:
        return context.offsets.solve(gradient), None


def _ties(vertices: Float[np.ndarray, "V 3"], faces: np.ndarray) -> np.ndarray:
    """[E, 2] from every vertex of a smaller piece to the nearest of the largest."""
    edges = unique_edges(faces)
    graph = scipy.sparse.coo_matrix((np.ones(len(edges)), edges.T), shape=(len(vertices),) * 2)
    _, piece = connected_components(graph, directed=False)
    is_main = piece == np.bincount(piece).argmax()
    loose, main = np.flatnonzero(~is_main), np.flatnonzero(is_main)
    if not len(loose):
        return np.zeros((0, 2), np.int64)
    return np.stack([loose, main[cKDTree(vertices[main]).query(vertices[loose])[1]]], axis=1)


class UniformAdam:
    """Adam with one step length for a whole mesh, as smooth unknowns need it.

    Plain Adam divides every entry by its own gradient's size; after a smooth solve all entries have some gradient, and tiny ones would
    move as far as large ones. Here the largest entry of a mesh sets the scale for all of it. Meshes without gradient rest.

    Args:
        parameter: [M, V, 3] unknowns of M meshes.
        learning_rate: metres that the fastest entry moves in a step.
    """

    MOMENTUM, MEMORY = 0.9, 0.99

    def __init__(self, parameter: Float[Tensor, "M V 3"], learning_rate: float):
        self.parameter, self.learning_rate = parameter, learning_rate
        self._first = torch.zeros_like(parameter)
        self._second = parameter.new_zeros(len(parameter), 1, 1)
        self._steps = parameter.new_zeros(len(parameter), 1, 1)

    def step(self, factor: float) -> None:
        """Move along the parameter's gradient, `factor` times as far as usual, and forget the gradient."""
        gradient = self.parameter.grad
        if gradient is None:
            return
        size = gradient.flatten(1).abs().amax(dim=1)
        active = torch.nonzero(size > 0)[:, 0]
        self._steps[active] += 1
        self._first[active] = self.MOMENTUM * self._first[active] + (1 - self.MOMENTUM) * gradient[active]
        self._second[active] = self.MEMORY * self._second[active] + (1 - self.MEMORY) * size[active, None, None] ** 2
        first = self._first[active] / (1 - self.MOMENTUM ** self._steps[active])
        second = self._second[active] / (1 - self.MEMORY ** self._steps[active])
        with torch.no_grad():
            self.parameter[active] -= factor * self.learning_rate * first / (second.sqrt() + 1e-12)
        self.parameter.grad = None
