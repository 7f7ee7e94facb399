"""Tensors over the ranks of a distributed run; nothing happens in a single process. All ranks must make the same calls."""

from collections.abc import Iterable

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mitsuba_avatar.training.distributed import Process


def gather_rows(rows: Float[Tensor, "P C"], process: Process) -> Float[Tensor, "N C"]:
    """Rows of all ranks, one rank's below the other's; each rank has as many."""
    if not process.is_distributed:
        return rows
    parts = [torch.empty_like(rows) for _ in range(process.num_ranks)]
    torch.distributed.all_gather(parts, rows.contiguous())
    return torch.cat(parts)


def average_gradients(parameters: Iterable[nn.Parameter], process: Process) -> None:
    """Replace each gradient by its mean over the ranks, in one message: for networks too small for a wrapper of their own."""
    if not process.is_distributed:
        return
    gradients = [parameter.grad for parameter in parameters if parameter.grad is not None]
    flat = torch.cat([gradient.flatten() for gradient in gradients])
    torch.distributed.all_reduce(flat)
    flat /= process.num_ranks
    for gradient, mean in zip(gradients, flat.split([gradient.numel() for gradient in gradients]), strict=True):
        gradient.copy_(mean.view_as(gradient))
