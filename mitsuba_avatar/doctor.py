"""Check the machine: `python -m mitsuba_avatar.doctor [--variant NAME]`. Ends with "ready", or with the exact fix.

Prints what was found (variant, LLVM, CUDA and OptiX, versions, cores, memory), then renders a 16x12 image of a triangle and carries a
gradient back through it.
"""

import math
import os
import platform
import sys
import time
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version

import tyro

from mitsuba_avatar.rendering import backend

# The distributions that pyproject.toml asks for.
PACKAGES = (
    "mitsuba",
    "drjit",
    "torch",
    "numpy",
    "scipy",
    "anny",
    "trimesh",
    "OpenEXR",
    "colour-science",
    "pygltflib",
    "opencv-python-headless",
    "flip-evaluator",
    "av",
    "pillow",
    "matplotlib",
    "safetensors",
    "jaxtyping",
    "tyro",
    "pyyaml",
    "rich",
)


@dataclass(frozen=True)
class DoctorCommand:
    """Say whether this machine can fit avatars, and what to do if it cannot."""

    variant: str = "auto"  # Mitsuba variant to check


def main(arguments: list[str] | None = None) -> int:
    """Run the command; returns 0 when ready."""
    command = tyro.cli(DoctorCommand, args=arguments)
    _print("python", f"{platform.python_version()} on {platform.platform()}")
    _print("cores", str(os.cpu_count()))
    _print("memory", f"{_memory_gib():.1f} GiB")
    for name in PACKAGES:
        try:
            _print(name, version(name))
        except PackageNotFoundError:
            return _unwell(f"{name} is not installed. Run: pip install -e . (or: make set-up)")
    llvm = backend.find_llvm()
    _print("LLVM", f"{llvm.major} ({llvm.path})" if llvm else "none found")
    _print("CUDA", "driver found" if backend.cuda_driver_found() else "no driver")
    _print("OptiX", "found" if backend.optix_found() else "not found")
    try:
        _print("variant", backend.select_variant(command.variant))
        value, gradient, seconds = render_once()
    except (backend.BackendError, ValueError) as error:
        return _unwell(str(error))
    _print("render", f"16x12 image, coverage {value:.3f} pixels, gradient {gradient:.3f}, {seconds:.2f} s with compilation")
    if not (value > 0 and math.isfinite(gradient) and gradient != 0):
        return _unwell("the renderer gave no image or no gradient. Please report this with the lines above.")
    sys.stdout.write("ready\n")
    return 0


def render_once() -> tuple[float, float, float]:
    """Render a triangle on a 16x12 film and push its right half's coverage back to a vertex.

    Returns:
        Coverage in pixels, its derivative by the first vertex's x (pixels per metre), and the seconds it took.
    """
    import numpy as np
    import torch

    from mitsuba_avatar.body.rig import Topology
    from mitsuba_avatar.rendering.cameras import CameraBatch
    from mitsuba_avatar.rendering.surface import SurfaceRenderer

    started = time.perf_counter()
    corners = np.array([[0, 1, 2]], np.int64)
    topology = Topology(num_vertices=3, faces=corners, uv=np.array([[0, 0], [1, 0], [0, 1]], np.float32), uv_faces=corners)
    pose = torch.eye(4)[None]
    pose[0, 2, 3] = 2.0
    cameras = CameraBatch(torch.tensor([[16.0, 16.0, 8.0, 6.0]]), pose)
    vertices = torch.tensor([[[-0.6, -0.4, 0.0], [0.6, -0.3, 0.0], [0.1, 0.5, 0.0]]], requires_grad=True)
    _, mask = SurfaceRenderer(topology, 16, 12).render(vertices, torch.full((1, 3, 2, 2), 0.5), cameras)
    mask.sum().backward()
    return float(mask.detach().sum()), float(vertices.grad[0, 0, 0]), time.perf_counter() - started


def _memory_gib() -> float:
    """Physical memory; 0 where the system does not say."""
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    except (ValueError, OSError, AttributeError):
        return 0.0


def _print(name: str, value: str) -> None:
    sys.stdout.write(f"{name:>15}  {value}\n")


def _unwell(advice: str) -> int:
    sys.stdout.write(f"not ready: {advice}\n")
    return 1


if __name__ == "__main__":
    sys.exit(main())
