"""Data-parallel training under `torchrun`: who this process is, and which device it owns.

    torchrun --nproc_per_node 2 -m mitsuba_avatar.fit

`claim_device` must run before torch and Dr.Jit are imported: it hides all GPUs but the rank's own from both.
"""

import os
from dataclasses import dataclass


@dataclass(frozen=True)
class Process:
    """This process among those of a run."""

    rank: int = 0
    num_ranks: int = 1

    @property
    def is_main(self) -> bool:
        """Whether this process writes files and shows progress."""
        return self.rank == 0

    @property
    def is_distributed(self) -> bool:
        """Whether there are others."""
        return self.num_ranks > 1


def claim_device() -> Process:
    """Read torchrun's environment and make this rank's GPU the only visible one."""
    process = Process(int(os.environ.get("RANK", "0")), int(os.environ.get("WORLD_SIZE", "1")))
    if process.is_distributed:
        visible = os.environ.get("CUDA_VISIBLE_DEVICES")
        local_rank = int(os.environ.get("LOCAL_RANK", "0"))
        devices = visible.split(",") if visible else None
        os.environ["CUDA_VISIBLE_DEVICES"] = devices[local_rank] if devices and local_rank < len(devices) else str(local_rank)
    return process


def join_processes(process: Process, on_gpu: bool) -> None:
    """Connect the ranks: nccl between GPUs, gloo between CPUs. Does nothing for a single process."""
    if process.is_distributed:
        import torch.distributed

        torch.distributed.init_process_group("nccl" if on_gpu else "gloo")


def leave_processes(process: Process) -> None:
    """Disconnect the ranks."""
    if process.is_distributed:
        import torch.distributed

        torch.distributed.destroy_process_group()
