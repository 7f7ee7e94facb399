"""The Mitsuba scene of one or several meshes of one topology: built once, updated in place, asked by rays.

All access to Mitsuba's mesh parameters is here. The meshes of a batch (one per pose) are merged into a single Mitsuba mesh, set
apart along x, so that one launch can trace every view of every pose; which pose a hit belongs to follows from its face index.
The merged mesh sits in a shape group with one instance: Embree then builds its hierarchy at medium quality, three times faster to
update and 8 % slower to trace than the high-quality build of a top-level mesh.

Gradients never flow through Mitsuba's own mesh parameters: derivatives are written by hand in `surface`.
"""

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from mitsuba_avatar.rendering.backend import loaded_mitsuba


class MeshScene:
    """`num_meshes` copies of a topology whose vertices change from call to call.

    Args:
        faces: [F, 3] vertex indices of one mesh, welded (no copies along UV seams).
        num_vertices: V of one mesh.
        num_meshes: P, how many poses one launch holds.
    """

    def __init__(self, faces: Int[np.ndarray, "F 3"], num_vertices: int, num_meshes: int = 1):
        mi = loaded_mitsuba()
        if faces.min() < 0 or faces.max() >= num_vertices:
            raise ValueError(
                f"MeshScene(): faces must index 0..{num_vertices - 1}; got {faces.min()}..{faces.max()}. "
                "Use faces and vertices of the same topology."
            )
        self.num_meshes = num_meshes
        self.num_vertices = num_vertices
        self.num_faces = len(faces)
        properties = mi.Properties()
        properties["face_normals"] = True  # vertex normals are never read; leaving them out saves their update
        mesh = mi.Mesh("avatar", num_meshes * num_vertices, num_meshes * self.num_faces, props=properties)
        mesh_parameters = mi.traverse(mesh)
        shifts = np.arange(num_meshes)[:, None, None] * num_vertices
        mesh_parameters["faces"] = mi.UInt(np.ascontiguousarray((faces[None] + shifts).ravel().astype(np.uint32)))
        mesh_parameters["vertex_positions"] = mi.Float(np.zeros(num_meshes * num_vertices * 3, np.float32))
        mesh_parameters.update()
        self.scene = mi.load_dict(
            {
                "type": "scene",
                "meshes": {"type": "shapegroup", "mesh": mesh},
                "instance": {"type": "instance", "shapegroup": {"type": "ref", "id": "meshes"}},
            }
        )
        self.version = 0  # counts updates, so that a late backward pass can tell whether the meshes are still its own
        self.parameters = mi.traverse(self.scene)
        (self.positions_key,) = [key for key in self.parameters.keys() if key.endswith("vertex_positions")]  # noqa: SIM118 (iteration gives pairs)

    def update(self, positions) -> None:
        """Move the merged mesh: positions is an mi.Float of P * V * 3 metres in scene coordinates. Rebuilds the ray-tracing hierarchy."""
        self.parameters[self.positions_key] = positions
        self.parameters.update()
        self.version += 1


def separation(vertices: Float[Tensor, "P V 3"], camera_centers: Float[Tensor, "B 3"]) -> float:
    """Distance in metres between neighbouring meshes of a merged scene, such that no ray limited to its own mesh reaches another.

    A ray that starts at a camera ends behind its own mesh, at most reach = |camera - mesh centre| + mesh radius away; other meshes are
    kept farther apart than twice that. Powers of two, so that adding the shift costs few bits of the coordinates.
    """
    centers = vertices.mean(dim=1)
    radius = (vertices - centers[:, None]).norm(dim=-1).max()
    reach = torch.cdist(camera_centers, centers).max() + radius if len(camera_centers) else radius
    return float(2.0 ** torch.ceil(torch.log2(2.0 * reach + 2.0 * radius)).item())
