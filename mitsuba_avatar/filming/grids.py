"""Meshes that are grids of vertices: what simple things on the stage are built from, with an atlas laid out by rows and columns."""

from collections.abc import Sequence

import numpy as np

from mitsuba_avatar.body.rig import Topology


def grid_topology(rows: int, columns: int, is_closed: bool = False) -> Topology:
    """Two triangles between every four vertices; vertex (row, column) has index `row * columns + column`.

    Args:
        rows, columns: of vertices, at least two.
        is_closed: whether the last column joins the first; the texture is cut there, not the mesh.

    Returns:
        u runs along a row from 0 to 1, v down the rows from 1 to 0: the texture's first row is the grid's.
    """
    uv_columns = columns + is_closed
    row, column = (index.reshape(-1) for index in np.meshgrid(np.arange(rows - 1), np.arange(uv_columns - 1), indexing="ij"))
    corners = [(row, column), (row + 1, column), (row + 1, column + 1), (row, column + 1)]
    vertex = np.stack([r * columns + c % columns for r, c in corners], axis=1)
    place = np.stack([r * uv_columns + c for r, c in corners], axis=1)
    across, down = np.meshgrid(np.linspace(0, 1, uv_columns), np.linspace(1, 0, rows))
    uv = np.stack([across, down], axis=-1).reshape(-1, 2).astype(np.float32)
    faces, uv_faces = (np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]) for quads in (vertex, place))
    return Topology(rows * columns, faces, uv, uv_faces)


def stacked(topologies: Sequence[Topology]) -> Topology:
    """Several meshes as one; their atlases become strips of equal height, the first on top."""
    vertices = np.cumsum([0] + [topology.num_vertices for topology in topologies])
    places = np.cumsum([0] + [len(topology.uv) for topology in topologies])
    count = len(topologies)
    uv = [
        (topology.uv + np.array([0, count - 1 - index], np.float32)) / np.array([1, count], np.float32)
        for index, topology in enumerate(topologies)
    ]
    return Topology(
        int(vertices[-1]),
        np.concatenate([topology.faces + start for topology, start in zip(topologies, vertices, strict=False)]),
        np.concatenate(uv).clip(0, 1),
        np.concatenate([topology.uv_faces + start for topology, start in zip(topologies, places, strict=False)]),
    )
