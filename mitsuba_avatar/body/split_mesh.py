"""The mesh cut open along its texture seams: what renderers and formats need that keep texture coordinates at vertices."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Int64

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

    @property
    def image_uv(self) -> Float32[np.ndarray, "S 2"]:
        """[S, 2] with v running down the image, as Mitsuba and glTF have it."""
        return (self.uv * np.array([1, -1], np.float32) + np.array([0, 1], np.float32)).astype(np.float32)


def split_at_seams(topology: Topology, shown: Bool[np.ndarray, "T"] | None = None) -> SplitMesh:  # noqa: F821
    """Copy each vertex once for every texture coordinate that its corners have; vertices of no triangle are left out.

    Args:
        topology: of the welded mesh, T triangles.
        shown: [T] triangles to keep; None keeps all.
    """
    kept = slice(None) if shown is None else shown
    corners = np.stack([topology.faces[kept].reshape(-1), topology.uv_faces[kept].reshape(-1)], axis=1)
    pairs, corner_pair = np.unique(corners, axis=0, return_inverse=True)
    return SplitMesh(pairs[:, 0], corner_pair.reshape(-1, 3).astype(np.int64), topology.uv[pairs[:, 1]])
