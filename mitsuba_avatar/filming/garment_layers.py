"""A simulated garment as a layer over the body, and put back into the body's own topology.

The registered mesh is the posed body with the garment's coarse vertices in place of those that it covers: one surface, fixed topology.
What is filmed is the fine garment over a body from which hidden triangles are left out and whose skin under cloth is drawn in a little,
because a triangle of skin may bulge through cloth that touches it. Metres.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float32
from scipy import sparse
from scipy.sparse import csgraph

from mitsuba_avatar.body.mesh import unique_edges, vertex_normals
from mitsuba_avatar.filming.anatomy import ARM, LEG, Anatomy, smooth_step
from mitsuba_avatar.filming.garment_mesh import GarmentMesh, boundary_edges
from mitsuba_avatar.filming.wardrobe import Outfit

INSET = 0.012  # metres that skin is drawn in under cloth
INSET_FROM, INSET_TO = 0.005, 0.04  # metres under the hem between which it grows
HIDDEN_FROM = 0.12  # metres under the hem from which no movement uncovers the trunk


@dataclass(frozen=True, eq=False)  # arrays have no truth value to compare by
class BodyUnderCloth:
    """The body as filmed beneath a garment.

    Attributes:
        inset: [V, 3] what to add to its rest vertices.
        hidden_faces: [F] triangles that no camera sees, to be left out.
    """

    inset: Float32[np.ndarray, "V 3"]
    hidden_faces: Bool[np.ndarray, "F"]


def body_under_cloth(anatomy: Anatomy, outfit: Outfit) -> BodyUnderCloth:
    """What of the body hides beneath the outfit's garment, measured along the cloth from its hems."""
    topology, mesh = anatomy.rig.topology, outfit.mesh
    distance = np.zeros(topology.num_vertices)
    distance[mesh.body_vertices] = distance_from_hems(mesh)[: len(mesh.body_vertices)]
    normals = vertex_normals(torch.from_numpy(outfit.obstacle)[None], torch.from_numpy(topology.faces))[0].numpy()
    inset = -INSET * smooth_step(distance, INSET_FROM, INSET_TO)[:, None] * normals
    # Limbs stay whole: a sleeve slides far on its arm, and one can look into it.
    is_hidden = (distance > HIDDEN_FROM) & (anatomy.weight(ARM + LEG) < 0.1)
    return BodyUnderCloth(inset.astype(np.float32), is_hidden[topology.faces].all(axis=1))


def distance_from_hems(mesh: GarmentMesh) -> Float32[np.ndarray, "G"]:
    """Metres along the resting cloth from each fine vertex to the nearest hem."""
    edges = unique_edges(mesh.topology.faces)
    lengths = np.linalg.norm(mesh.rest_vertices[edges[:, 0]] - mesh.rest_vertices[edges[:, 1]], axis=1)
    graph = sparse.csr_matrix((lengths, edges.T), shape=(len(mesh.rest_vertices),) * 2)
    rim = np.unique(boundary_edges(mesh.topology.faces))
    return csgraph.dijkstra(graph, directed=False, indices=rim, min_only=True).astype(np.float32)


def register_garment(
    body: Float32[np.ndarray, "N V 3"], mesh: GarmentMesh, garment: Float32[np.ndarray, "N G 3"]
) -> Float32[np.ndarray, "N V 3"]:
    """The registered mesh: posed bodies with the garment's coarse vertices in place of the body's, a new array.

    Args:
        body: posed vertices of `Outfit.registered_body`, world axes.
        mesh: the garment's.
        garment: its fine vertices in the same frames.

    Raises:
        ValueError: if the garment was not simulated in some frame.
    """
    missing = np.flatnonzero(~np.isfinite(garment).all(axis=(1, 2)))
    if len(missing):
        raise ValueError(
            f"register_garment(): expected a garment in every frame; got NaN in {len(missing)}, the first is {missing[0]}. "
            "Simulate all segments."
        )
    registered = body.copy()
    registered[:, mesh.body_vertices] = garment[:, : len(mesh.body_vertices)]
    return registered
