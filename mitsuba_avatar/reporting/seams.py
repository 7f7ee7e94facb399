"""How visible the cuts of the texture atlas are: the difference of a texture on the two sides of its seams.

A seam is an edge of the welded surface whose two triangles lie in the atlas apart. Both sides show the same points of the surface, so a
perfect texture agrees there; what it does not agree by is a line that the eye finds at once on an otherwise smooth body.
"""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mitsuba_avatar.body.rig import Topology
from mitsuba_avatar.captures.colour import encode

SAMPLES_PER_EDGE = 4


class SeamSampler:
    """Points along all seams of a topology, seen from both sides.

    Args:
        topology: mesh and atlas.
        samples_per_edge: points on each seam edge, evenly spaced, ends left out.

    Attributes:
        sides: [2, N, 2] texture coordinates of the same N points in either chart.
    """

    def __init__(self, topology: Topology, samples_per_edge: int = SAMPLES_PER_EDGE):
        first, second = _seam_edges(topology)  # [E, 2] rows of uv each
        share = ((np.arange(samples_per_edge) + 0.5) / samples_per_edge)[None, :, None]
        sides = []
        for ends in (first, second):
            start, end = topology.uv[ends[:, 0]][:, None], topology.uv[ends[:, 1]][:, None]  # [E, 1, 2]
            sides.append(((1 - share) * start + share * end).reshape(-1, 2))
        self.sides: Float[np.ndarray, "2 N 2"] = np.stack(sides).astype(np.float32)

    def difference(self, texture: Float[Tensor, "3 T T"]) -> float:
        """Mean absolute difference of a texture across its seams, in display-encoded 0..255 values; 0 for an atlas without seams.

        Args:
            texture: [3, T, T] linear radiance, looked up bilinearly as the renderer does.
        """
        if not self.sides.shape[1]:
            return 0.0
        grid = torch.from_numpy(np.stack([2 * self.sides[..., 0] - 1, 1 - 2 * self.sides[..., 1]], axis=-1))[None]
        values = torch.nn.functional.grid_sample(
            texture[None].cpu(), grid, mode="bilinear", padding_mode="border", align_corners=False
        )  # [1, 3, 2, N]
        encoded = 255 * encode(values.clamp(0, 1), "srgb").double()
        return float((encoded[0, :, 0] - encoded[0, :, 1]).abs().mean())


def _seam_edges(topology: Topology) -> tuple[np.ndarray, np.ndarray]:
    """Rows of `uv` at both ends of every seam edge, [E, 2] for either side, ends in the same order."""
    corners, following = np.arange(3), np.array([1, 2, 0])
    vertices = np.stack([topology.faces[:, corners], topology.faces[:, following]], axis=-1).reshape(-1, 2)
    points = np.stack([topology.uv_faces[:, corners], topology.uv_faces[:, following]], axis=-1).reshape(-1, 2)
    is_backward = vertices[:, 0] > vertices[:, 1]
    vertices[is_backward], points[is_backward] = vertices[is_backward, ::-1], points[is_backward, ::-1]
    order = np.lexsort((vertices[:, 1], vertices[:, 0]))
    vertices, points = vertices[order], points[order]
    # Where three triangles meet at one edge, neighbours in this order are compared: every side still meets another one.
    is_same_edge = (vertices[1:] == vertices[:-1]).all(axis=1)
    is_seam = is_same_edge & (points[1:] != points[:-1]).any(axis=1)
    return points[:-1][is_seam], points[1:][is_seam]
