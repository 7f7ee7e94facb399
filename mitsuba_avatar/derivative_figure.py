"""The renderer's teaching figure: what a small motion of the body does to every pixel, by gradient and by finite differences.

The renderer computes adjoints, a row of the Jacobian for every *loss*; the figure needs the derivative of every *pixel* along one motion.
A tangent is read off adjoints by probing: with random signs s per pixel, the product s * (sum over pixels of s * tangent) has the tangent
as its mean. Noise falls with the number of pixels that share a probe, so probes are sparse: each pass lights every n-th pixel of both
axes, and the vertices near a pixel tell its share apart from that of the others.
"""

from pathlib import Path

import matplotlib
import numpy as np
import torch
from torch import Tensor

from mitsuba_avatar.body.rig import Rig
from mitsuba_avatar.files import atomic_path
from mitsuba_avatar.rendering.cameras import CameraBatch
from mitsuba_avatar.rendering.surface import SurfaceRenderer
