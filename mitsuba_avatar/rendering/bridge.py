"""The one bridge between torch and Dr.Jit: `dr.wrap` where gradients cross, plain conversions where none do.

Both sides use float32 and uint32 only. On a CPU the memory is shared, not copied. A wrapped function must be pure: what it computes
depends on its arguments alone, and one backward pass is made per call (a second one would silently return the first's gradient).
"""

from collections.abc import Callable

import torch
from torch import Tensor

from mitsuba_avatar.rendering.backend import loaded_mitsuba


def differentiable(function: Callable) -> Callable:
    """A function of Dr.Jit tensors (TensorXf) as a function of torch tensors; torch's autograd runs through it."""
    import drjit as dr

    return dr.wrap(source="torch", target="drjit")(function)


def flat_array(tensor: Tensor):
    """The elements of a float32 torch tensor as a flat mi.Float, row-major. No gradient crosses.

    Raises:
        TypeError: another element type; Dr.Jit's llvm and cuda variants compute in single precision.
    """
    if tensor.dtype != torch.float32:
        raise TypeError(f"flat_array(): expected a float32 tensor; got {tensor.dtype}. Convert with .float().")
    return loaded_mitsuba().TensorXf(tensor.detach().contiguous()).array


def torch_tensor(array, shape: tuple[int, ...]) -> Tensor:
    """A flat mi.Float as a torch tensor of the given shape; a copy, so that it outlives Dr.Jit's buffer."""
    return loaded_mitsuba().TensorXf(array, shape).torch().clone()
