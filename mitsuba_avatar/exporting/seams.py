"""The mesh cut open along its texture seams: what formats need that keep texture coordinates at vertices."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int64

from mitsuba_avatar.body.rig import Topology


@dataclass(frozen=True, eq=False)
class SplitMesh:
    """S vertices, each with one texture coordinate; the same triangles in the same order.

    Attributes:
        welded: [S] vertex of the welded mesh that each is a copy of; any values per vertex are split by `values[welded]`.
        faces: [F, 3] into the S vertices.
        uv: [S, 2] OBJ orientation (v = 1 is the image's first row).
    """

    welded: Int64[np.ndarray, "S"]
    faces: Int64[np.ndarray, "F 3"]
    uv: Float32[np.ndarray, "S 2"]


def split_at_seams(topology: Topology) -> SplitMesh:
    """Copy each vertex once for every texture coordinate that its corners have; vertices of no triangle are left out."""
    corners = np.stack([topology.faces.reshape(-1), topology.uv_faces.reshape(-1)], axis=1)
    pairs, corner_pair = np.unique(corners, axis=0, return_inverse=True)
    return SplitMesh(pairs[:, 0], corner_pair.reshape(-1, 3).astype(np.int64), topology.uv[pairs[:, 1]])
