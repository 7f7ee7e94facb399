"""The rest mesh of a garment that is simulated: cut from the dressed body, then refined.

The coarse mesh has the body's own vertices and triangles where a garment of `filming.clothing` covers it, so that simulated cloth can be
put back into the body's topology as its registered mesh. Midpoint subdivision makes the mesh that is simulated and filmed; its first
vertices are the coarse ones. Texture coordinates are the body atlas's, so that the same textures paint both.

Symbols: V body vertices, C coarse vertices, G fine vertices, E edges, H hinges, K tethers, J joints. Metres, rest space.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Int64
from scipy import sparse
from scipy.sparse import csgraph

from mitsuba_avatar.body.mesh import unique_edges
from mitsuba_avatar.body.rig import Topology
from mitsuba_avatar.filming.anatomy import Anatomy
from mitsuba_avatar.filming.clothing import Garment, dress


@dataclass(frozen=True, eq=False)  # arrays have no truth value to compare by
class GarmentMesh:
    """A garment at rest.

    Attributes:
        name: of the garment it was cut by.
        topology: fine triangles and texture coordinates.
        rest_vertices: [G, 3] as cut, on the resting body.
        body_vertices: [C] the body's vertex that each of the first C fine vertices replaces.
        skinning_weights: [G, J] of the body beneath; rows sum to 1.
        edges: [E, 2] and `edge_lengths`: [E] the cloth's threads.
        hinges: [H, 4] corners of two coarse or fine triangles that share an edge: both ends of it, then the outer two; `hinge_weights`:
            [H, 4] sum them to zero where they lie flat.
        pinned: [G] whether the skeleton carries a vertex.
        tethers: [K, 2] free vertex and its nearest pin; `tether_lengths`: [K] their distance along the cloth, which it cannot exceed.
    """

    name: str
    topology: Topology
    rest_vertices: Float32[np.ndarray, "G 3"]
    body_vertices: Int64[np.ndarray, "C"]
    skinning_weights: Float32[np.ndarray, "G J"]
    edges: Int64[np.ndarray, "E 2"]
    edge_lengths: Float32[np.ndarray, "E"]
    hinges: Int64[np.ndarray, "H 4"]
    hinge_weights: Float32[np.ndarray, "H 4"]
    pinned: Bool[np.ndarray, "G"]
    tethers: Int64[np.ndarray, "K 2"]
    tether_lengths: Float32[np.ndarray, "K"]


def cut_garment(anatomy: Anatomy, garment: Garment, pinned_hem: int, fit: float, rounds: int = 1) -> GarmentMesh:
    """Cut a garment from the body.

    Args:
        anatomy: of the bare rig.
        garment: which part of the body, how far from the skin.
        pinned_hem: which of its hems the skeleton carries.
        fit: rest lengths relative to the cut's; below 1 the cloth is tight.
        rounds: of subdivision; each halves the edges.
    """
    rig = anatomy.rig
    dressed = dress(anatomy, (garment,))
    chosen = garment.covered[rig.topology.faces].all(axis=1)
    body_vertices, faces = np.unique(rig.topology.faces[chosen], return_inverse=True)
    faces = faces.reshape(-1, 3)
    hem = garment.hems[pinned_hem]
    vertices = dressed.vertices[body_vertices].astype(np.float64)
    on_rim = np.zeros(len(vertices), dtype=bool)
    on_rim[boundary_edges(faces)] = True
    pinned = on_rim & hem.part[body_vertices] & (np.abs(hem.field(dressed.skin[body_vertices])) < 0.012)

    uv_used, uv_faces = np.unique(rig.topology.uv_faces[chosen], return_inverse=True)
    midpoints, fine_faces = _refine(faces, len(vertices), rounds)
    uv_midpoints, fine_uv_faces = _refine(uv_faces.reshape(-1, 3), len(uv_used), rounds)
    fine = midpoints @ vertices
    uv = uv_midpoints @ rig.topology.uv[uv_used].astype(np.float64)
    edges = unique_edges(fine_faces)
    # Hinges of the coarse triangles too: fine ones alone would let cloth be pinched into creases as narrow as a triangle.
    hinges = np.concatenate([find_hinges(faces), find_hinges(fine_faces)])
    is_pinned = midpoints @ pinned.astype(np.float64) > 0.999
    tethers, tether_lengths = hang_from(fine, np.concatenate([edges, find_hinges(fine_faces)[:, 2:]]), is_pinned)
    return GarmentMesh(
        name=garment.name,
        topology=Topology(len(fine), fine_faces, uv.clip(0, 1).astype(np.float32), fine_uv_faces),
        rest_vertices=fine.astype(np.float32),
        body_vertices=body_vertices,
        skinning_weights=(midpoints @ rig.skinning_weights[body_vertices].astype(np.float64)).astype(np.float32),
        edges=edges,
        edge_lengths=(fit * np.linalg.norm(fine[edges[:, 0]] - fine[edges[:, 1]], axis=1)).astype(np.float32),
        hinges=hinges,
        hinge_weights=flat_weights(fine[hinges]).astype(np.float32),
        pinned=is_pinned,
        tethers=tethers,
        tether_lengths=(fit * tether_lengths).astype(np.float32),
    )


def _refine(faces: Int[np.ndarray, "F 3"], count: int, rounds: int) -> tuple[sparse.csr_matrix, Int64[np.ndarray, "M 3"]]:
    """`rounds` midpoint subdivisions, as one matrix from old to new vertices and the new faces."""
    refined = sparse.identity(count, format="csr")
    for _ in range(rounds):
        midpoints, faces = subdivide(faces, refined.shape[0])
        refined = midpoints @ refined
    return refined, faces.astype(np.int64)


def subdivide(faces: Int[np.ndarray, "F 3"], count: int) -> tuple[sparse.csr_matrix, Int64[np.ndarray, "M 3"]]:
    """Midpoint subdivision: every triangle becomes four.

    Args:
        faces: triangles of a mesh.
        count: its number of vertices.

    Returns:
        matrix [G, count] that takes values at old vertices to new ones, of which the first `count` are the old; and the new faces.
    """
    edges = unique_edges(faces)
    key = edges[:, 0] * count + edges[:, 1]
    corners = []
    for first, second in ((0, 1), (1, 2), (2, 0)):
        low, high = np.sort(faces[:, [first, second]], axis=1).T
        corners.append(count + np.searchsorted(key, low * count + high))
    ab, bc, ca = corners
    a, b, c = faces.T
    fine = np.stack([np.stack(face, axis=1) for face in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))], axis=1)
    rows = np.concatenate([np.arange(count), np.repeat(count + np.arange(len(edges)), 2)])
    columns = np.concatenate([np.arange(count), edges.ravel()])
    values = np.concatenate([np.ones(count), np.full(2 * len(edges), 0.5)])
    return sparse.csr_matrix((values, (rows, columns)), shape=(count + len(edges), count)), fine.reshape(-1, 3).astype(np.int64)


def hang_from(
    vertices: Float[np.ndarray, "G 3"], links: Int[np.ndarray, "L 2"], pinned: Bool[np.ndarray, "G"]
) -> tuple[Int64[np.ndarray, "K 2"], Float[np.ndarray, "K"]]:
    """The nearest pin of every free vertex, and how far it is along the cloth."""
    lengths = np.linalg.norm(vertices[links[:, 0]] - vertices[links[:, 1]], axis=1)
    graph = sparse.csr_matrix((lengths, links.T), shape=(len(vertices),) * 2)
    distance, _, source = csgraph.dijkstra(graph, directed=False, indices=np.flatnonzero(pinned), return_predecessors=True, min_only=True)
    free = np.flatnonzero(~pinned & np.isfinite(distance))
    return np.stack([free, source[free]], axis=1).astype(np.int64), distance[free]


def boundary_edges(faces: Int[np.ndarray, "F 3"]) -> Int[np.ndarray, "B 2"]:
    """Edges of one triangle alone: a garment's rims."""
    pairs = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    edges, counts = np.unique(pairs, axis=0, return_counts=True)
    return edges[counts == 1]


def find_hinges(faces: Int[np.ndarray, "F 3"]) -> Int64[np.ndarray, "H 4"]:
    """Edges between two triangles: both ends of the edge, then the two corners that face each other across it."""
    pairs = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    opposite = np.concatenate([faces[:, 2], faces[:, 0], faces[:, 1]])
    order = np.lexsort((opposite, pairs[:, 1], pairs[:, 0]))
    pairs, opposite = pairs[order], opposite[order]
    twice = np.flatnonzero((pairs[1:] == pairs[:-1]).all(axis=1))
    return np.concatenate([pairs[twice], opposite[twice, None], opposite[twice + 1, None]], axis=1).astype(np.int64)


def flat_weights(corners: Float[np.ndarray, "H 4 3"]) -> Float[np.ndarray, "H 4"]:
    """Weights by which the four corners of a hinge sum to zero when it lies flat: where the line between the outer two meets the edge.

    Each row sums to zero, the inner two to minus one.
    """
    start, end, first, second = np.moveaxis(corners, 1, 0)
    along = end - start
    length = np.linalg.norm(along, axis=1)
    along = along / length[:, None]

    def flattened(point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:  # place along the edge, distance from it
        place = ((point - start) * along).sum(axis=1)
        return place, np.linalg.norm(point - start - place[:, None] * along, axis=1)

    (place_first, height_first), (place_second, height_second) = flattened(first), flattened(second)
    share = height_first / (height_first + height_second)  # of the way from the first to the second
    crossing = (place_first + share * (place_second - place_first)) / length
    return np.stack([crossing - 1, -crossing, 1 - share, share], axis=1)
