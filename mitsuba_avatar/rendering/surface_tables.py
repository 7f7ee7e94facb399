"""What a topology contributes to every launch: faces, corner texture coordinates and edges, packed as Dr.Jit reads them best.

Texture coordinates belong to face *corners*: the mesh stays welded, so UV seams are no boundary edges and raise no false silhouettes.
"""

import numpy as np
from jaxtyping import Float, Int

from mitsuba_avatar.rendering.backend import loaded_mitsuba

NO_FACE = 0xFFFFFFFF


class SurfaceTables:
    """Index and coordinate tables of one topology in Dr.Jit memory.

    Attributes:
        faces: [F, 4] vertices of a face, last entry unused.
        face_uv: [F, 8] u0 v0 u1 v1 u2 v2, last two unused.
        edges: [E, 4] vertices a, b in the order of the first face's winding | first face | second face (NO_FACE where the mesh is open).
            Seams, where the two faces give their edge different texture coordinates, come first.
        num_seams: how many they are.
        is_closed: whether every edge has two faces.
        edge_opposite: [E] vertex of the second face that is not on the edge (of the first face where the mesh is open).
        edge_uv: [E, 8] coordinates of a and b as corners of the first face, then of the second.
    """

    def __init__(self, faces: Int[np.ndarray, "F 3"], uv: Float[np.ndarray, "T 2"], uv_faces: Int[np.ndarray, "F 3"]):
        mi = loaded_mitsuba()
        self.num_faces = len(faces)
        face_uv = uv[uv_faces].reshape(-1, 6).astype(np.float32)
        edges, opposite, edge_uv = edge_tables(faces, uv[uv_faces])
        is_seam = (edge_uv[:, :4] != edge_uv[:, 4:]).any(axis=1)
        order = np.argsort(~is_seam, kind="stable")
        edges, opposite, edge_uv = edges[order], opposite[order], edge_uv[order]
        self.num_edges, self.num_seams = len(edges), int(is_seam.sum())
        self.is_closed = bool((edges[:, 3] != NO_FACE).all())
        self.faces = mi.UInt32(np.pad(faces, ((0, 0), (0, 1))).astype(np.uint32).ravel())
        self.face_uv = mi.Float(np.pad(face_uv, ((0, 0), (0, 2))).ravel())
        self.edges = mi.UInt32(edges.astype(np.uint32).ravel())
        self.edge_opposite = mi.UInt32(opposite.astype(np.uint32))
        self.edge_uv = mi.Float(edge_uv.astype(np.float32).ravel())


def edge_tables(
    faces: Int[np.ndarray, "F 3"], corner_uv: Float[np.ndarray, "F 3 2"]
) -> tuple[Int[np.ndarray, "E 4"], Int[np.ndarray, " E"], Float[np.ndarray, "E 8"]]:
    """Unique edges of a triangle mesh with their one or two faces; see `SurfaceTables` for the columns.

    Raises:
        ValueError: an edge has more than two faces, or two faces wind it the same way; neither has a front and a back.
    """
    num_faces = len(faces)
    corner = np.tile(np.arange(3), num_faces)
    face = np.repeat(np.arange(num_faces), 3)
    start, end = faces[face, corner], faces[face, (corner + 1) % 3]
    key = np.sort(np.stack([start, end], 1), axis=1)
    order = np.lexsort((face, key[:, 1], key[:, 0]))
    key, start, end, face, corner = key[order], start[order], end[order], face[order], corner[order]
    is_first = np.ones(len(key), bool)
    is_first[1:] = (key[1:] != key[:-1]).any(axis=1)
    first = np.flatnonzero(is_first)
    count = np.diff(np.append(first, len(key)))
    if count.max() > 2:
        a, b = key[first[count.argmax()]]
        raise ValueError(
            f"edge_tables(): expected at most two faces at an edge; edge ({a}, {b}) has {count.max()}. Split the non-manifold edge."
        )
    second = np.where(count == 2, first + 1, first)
    is_open = count == 1
    if np.any(~is_open & (start[first] == start[second])):
        row = np.flatnonzero(~is_open & (start[first] == start[second]))[0]
        raise ValueError(
            f"edge_tables(): faces {face[first[row]]} and {face[second[row]]} wind their common edge the same way. "
            "Make the faces' orientation consistent (trimesh.repair.fix_winding)."
        )
    edges = np.stack([start[first], end[first], face[first], np.where(is_open, NO_FACE, face[second])], 1)
    opposite = faces[face[second], (corner[second] + 2) % 3]
    uv_first = np.concatenate([corner_uv[face[first], corner[first]], corner_uv[face[first], (corner[first] + 1) % 3]], 1)
    # In the second face the edge runs from b to a, so a is the corner after its start.
    uv_second = np.concatenate([corner_uv[face[second], (corner[second] + 1) % 3], corner_uv[face[second], corner[second]]], 1)
    return edges, opposite, np.concatenate([uv_first, np.where(is_open[:, None], uv_first, uv_second)], 1)
