"""Drivable full-body avatars, learnt from multi-view images by differentiable rendering with Mitsuba 3."""

import os

# Torch and Dr.Jit each bring a thread pool. OpenMP's idle threads spin by default and would take the cores from Dr.Jit's; the
# policy is read when torch loads, so it is set here, before any module of the package imports torch.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

__version__ = "0.1.0"
