"""The Mitsuba scene of one mesh: built once, updated in place, asked by rays that start anywhere.

All access to Mitsuba's mesh parameters is here. The mesh sits in a shape group with one instance: Embree then builds its hierarchy at
medium quality, three times faster to update and 8 % slower to trace than the high-quality build of a top-level mesh.

Camera rays do not need it: see `face_grid`. Gradients never flow through Mitsuba's mesh parameters.
"""

import numpy as np
from jaxtyping import Int

from mitsuba_avatar.rendering.backend import loaded_mitsuba


class MeshScene:
    """A mesh whose vertices change from call to call.

    Args:
        faces: [F, 3] vertex indices, welded (no copies along UV seams).
        num_vertices: V.
    """

    def __init__(self, faces: Int[np.ndarray, "F 3"], num_vertices: int):
        mi = loaded_mitsuba()
        if faces.min() < 0 or faces.max() >= num_vertices:
            raise ValueError(
                f"MeshScene(): faces must index 0..{num_vertices - 1}; got {faces.min()}..{faces.max()}. "
                "Use faces and vertices of the same topology."
            )
        self.num_vertices = num_vertices
        properties = mi.Properties()
        properties["face_normals"] = True  # vertex normals are never read; leaving them out saves their update
        mesh = mi.Mesh("avatar", num_vertices, len(faces), props=properties)
        mesh_parameters = mi.traverse(mesh)
        mesh_parameters["faces"] = mi.UInt(faces.astype(np.uint32).ravel())
        mesh_parameters["vertex_positions"] = mi.Float(np.zeros(num_vertices * 3, np.float32))
        mesh_parameters.update()
        self.scene = mi.load_dict(
            {
                "type": "scene",
                "meshes": {"type": "shapegroup", "mesh": mesh},
                "instance": {"type": "instance", "shapegroup": {"type": "ref", "id": "meshes"}},
            }
        )
        self.parameters = mi.traverse(self.scene)
        (self.positions_key,) = [key for key in self.parameters.keys() if key.endswith("vertex_positions")]  # noqa: SIM118 (iteration gives pairs)

    def update(self, positions) -> None:
        """Move the mesh: positions is an mi.Float of V * 3 metres. Rebuilds the ray-tracing hierarchy."""
        self.parameters[self.positions_key] = positions
        self.parameters.update()
