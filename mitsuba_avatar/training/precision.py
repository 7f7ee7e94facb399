"""In which precision the networks train: float32, or bfloat16 where the device multiplies it in hardware.

Hidden layers alone; weights, gradients, the optimizer, skinning, rendering and losses stay in float32 (`Avatar.mixed_precision`). bfloat16
has the range of float32, so that gradients need no scaling. Without instructions for it a CPU emulates it, ten times slower.
"""

import torch

from mitsuba_avatar.settings import TrainingSettings


def is_mixed(training: TrainingSettings, device: torch.device) -> bool:
    """Whether `training.precision` means bfloat16 on this device.

    Raises:
        ValueError: it is asked for where it would be emulated.
    """
    if training.precision == "float32":
        return False
    has_bfloat16 = multiplies_bfloat16(device)
    if training.precision == "mixed" and not has_bfloat16:
        raise ValueError(
            f'training.precision: expected a device that multiplies bfloat16 in hardware for "mixed"; {device.type} does not, and would '
            'be ten times slower than in float32. Use "auto" or "float32".'
        )
    return has_bfloat16


def multiplies_bfloat16(device: torch.device) -> bool:
    """Whether products of bfloat16 are faster than those of float32: GPUs since Ampere, CPUs with AMX."""
    if device.type == "cuda":
        return torch.cuda.get_device_capability(device) >= (8, 0)
    capabilities = getattr(torch.cpu, "get_capabilities", dict)()  # torch 2.6 does not know; then float32 is safe
    return bool(capabilities.get("amx_bf16", False))
