"""A fixed sparse matrix as a differentiable layer: texels from vertices, averages over seam copies, mesh Laplacians.

Rows of weighted gathers through `embedding_bag`, which is fast in both directions and exists on every platform that torch supports
(torch's own sparse CSR products need MKL on a CPU).
"""

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn


class SparseLinear(nn.Module):
    """y = A x for a constant sparse A [R, N]; x [N, C] gives y [R, C]. Gradients flow to x by the stored transpose.

    Args:
        rows, columns, weights: the entries of A; entries at one place add up.
        shape: (R, N).
    """

    def __init__(self, rows: Int[np.ndarray, "E"], columns: Int[np.ndarray, "E"], weights: Float[np.ndarray, "E"], shape: tuple[int, int]):
        super().__init__()
        self.shape = shape
        for name, (to, origin, count) in {"forward": (rows, columns, shape[0]), "transposed": (columns, rows, shape[1])}.items():
            order = np.argsort(to, kind="stable")
            offsets = np.concatenate([[0], np.cumsum(np.bincount(to, minlength=count))])
            self.register_buffer(f"{name}_index", torch.from_numpy(origin[order].astype(np.int64)), persistent=False)
            self.register_buffer(f"{name}_weight", torch.from_numpy(weights[order].astype(np.float32)), persistent=False)
            self.register_buffer(f"{name}_offset", torch.from_numpy(offsets.astype(np.int64)), persistent=False)

    def forward(self, values: Float[Tensor, "N C"]) -> Float[Tensor, "R C"]:
        """A values. The weights take the type of the values, so that double-precision references work.

        Raises:
            ValueError: if there is not one row of values per column of A.
        """
        if len(values) != self.shape[1]:
            raise ValueError(f"SparseLinear(): expected {self.shape[1]} rows; got {len(values)}. Use values of the same rig.")
        product: Tensor = _SparseProduct.apply(
            values,
            (self.forward_index, self.forward_weight, self.forward_offset),
            (self.transposed_index, self.transposed_weight, self.transposed_offset),
        )
        return product


class _SparseProduct(torch.autograd.Function):
    """`embedding_bag` with its own adjoint: torch's would scatter-add into a dense gradient entry by entry, ten times slower."""

    @staticmethod
    def forward(context, values, table, transposed):
        context.transposed = transposed
        return _gather_sum(values, *table)

    @staticmethod
    def backward(context, gradient):
        return _gather_sum(gradient, *context.transposed), None, None


def _gather_sum(values: Tensor, index: Tensor, weight: Tensor, offset: Tensor) -> Tensor:
    return torch.nn.functional.embedding_bag(
        index, values.contiguous(), offset, mode="sum", per_sample_weights=weight.to(values.dtype), include_last_offset=True
    )
