"""Posed surfaces as files that every mesh program reads: a PLY or OBJ a frame.

World axes as ours, Z up, metres. PLY holds the welded mesh; OBJ the mesh cut at texture seams, with texture.
"""

from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float32
from PIL import Image

from mitsuba_avatar.body.rig import Topology
from mitsuba_avatar.body.split_mesh import split_at_seams
from mitsuba_avatar.files import atomic_path

DIGITS = 7  # decimals in OBJ files: a tenth of a micrometre


def write_ply(path: Path | str, vertices: Float32[np.ndarray, "V 3"], topology: Topology) -> None:
    """One frame, binary."""
    with atomic_path(path) as temporary:
        trimesh.Trimesh(vertices, topology.faces, process=False).export(temporary)


class ObjSequence:
    """OBJ files of one topology in a folder, with one material and one texture for all.

    Args:
        folder: to write into.
        topology: of all frames.
        texture: [T, T, 3] uint8, sRGB-encoded.
    """

    def __init__(self, folder: Path | str, topology: Topology, texture: np.ndarray):
        self._folder, self._split = Path(folder), split_at_seams(topology)
        white, black = (255, 255, 255, 255), (0, 0, 0, 255)
        material = trimesh.visual.material.SimpleMaterial(Image.fromarray(texture), diffuse=white, ambient=black, specular=black)
        material.name = "avatar"
        self._visual = trimesh.visual.TextureVisuals(uv=self._split.uv, material=material)
        self._has_material = False

    def write(self, name: str, vertices: Float32[np.ndarray, "V 3"]) -> None:
        """One frame; `name` ends in `.obj`."""
        mesh = trimesh.Trimesh(vertices[self._split.welded], self._split.faces, visual=self._visual, process=False)
        text, others = trimesh.exchange.obj.export_obj(
            mesh, include_normals=False, return_texture=True, digits=DIGITS, mtl_name="avatar.mtl"
        )
        if not self._has_material:
            for other, data in others.items():
                with atomic_path(self._folder / other) as temporary:
                    temporary.write_bytes(data if isinstance(data, bytes) else data.encode())
            self._has_material = True
        with atomic_path(self._folder / name) as temporary:
            temporary.write_text(text, encoding="utf-8")
