"""The sparse product against its dense twin."""

import numpy as np
import pytest
import torch

from mitsuba_avatar.body.sparse import SparseLinear


def example() -> tuple[SparseLinear, torch.Tensor]:
    """A 4 x 3 matrix with an empty row, an empty column, and one entry given in two parts."""
    rows, columns = np.array([3, 0, 0, 3, 0]), np.array([2, 0, 2, 2, 0])
    weights = np.array([0.5, 2.0, -1.0, 0.25, 1.0])
    dense = torch.zeros(4, 3, dtype=torch.float64)
    dense.index_put_((torch.from_numpy(rows), torch.from_numpy(columns)), torch.from_numpy(weights), accumulate=True)
    return SparseLinear(rows, columns, weights, (4, 3)), dense


def test_product_and_adjoint_equal_the_dense_matrix():
    matrix, dense = example()
    values = torch.randn(3, 5, dtype=torch.float64, generator=torch.Generator().manual_seed(1)).requires_grad_()
    torch.testing.assert_close(matrix(values), dense @ values)
    assert torch.autograd.gradcheck(matrix, values)


def test_wrong_number_of_rows_is_refused():
    with pytest.raises(ValueError, match="expected 3 rows; got 4"):
        example()[0](torch.zeros(4, 2))
