"""Mesh sequences come back as they were written, textures the right way up."""

import numpy as np
import trimesh
from PIL import Image

from mitsuba_avatar.exporting.sequences import ObjSequence, write_ply
from tests.small_rig import make_small_rig

RIG = make_small_rig()
MOVING = np.stack([RIG.rest_vertices + np.float32(0.1 * i) for i in range(3)])
TEXTURE = np.random.default_rng(6).integers(0, 256, (9, 9, 3), dtype=np.uint8)


def test_ply_is_the_welded_mesh(tmp_path):
    write_ply(tmp_path / "a.ply", MOVING[1], RIG.topology)
    mesh = trimesh.load(tmp_path / "a.ply", process=False)
    np.testing.assert_array_equal(np.asarray(mesh.vertices, np.float32), MOVING[1])
    np.testing.assert_array_equal(mesh.faces, RIG.topology.faces)


def test_obj_files_share_one_texture(tmp_path):
    sequence = ObjSequence(tmp_path / "obj", RIG.topology, TEXTURE)
    for number, vertices in enumerate(MOVING):
        sequence.write(f"{number:06d}.obj", vertices)
    assert sorted(path.name for path in (tmp_path / "obj").iterdir()) == [*(f"00000{i}.obj" for i in range(3)), "avatar.mtl", "avatar.png"]
    mesh = trimesh.load(tmp_path / "obj/000002.obj", process=False, maintain_order=True)
    np.testing.assert_allclose(mesh.vertices[mesh.faces], MOVING[2][RIG.topology.faces], atol=1e-6)
    np.testing.assert_allclose(mesh.visual.uv[mesh.faces], RIG.topology.uv[RIG.topology.uv_faces], atol=1e-6)
    np.testing.assert_array_equal(np.asarray(mesh.visual.material.image.convert("RGB")), TEXTURE)
    with Image.open(tmp_path / "obj/avatar.png") as picture:
        assert picture.size == (9, 9)
