"""Mesh sequences come back as they were written, textures the right way up."""

import numpy as np
import pytest
import trimesh
from PIL import Image

from mitsuba_avatar.exporting.sequences import ObjSequence, write_ply, write_usd
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


def test_usd_point_cache(tmp_path):
    usd = pytest.importorskip("pxr.Usd")
    from pxr import UsdGeom

    write_usd(tmp_path / "a.usdc", MOVING, RIG.topology, 12.0, "textures/radiance.png")
    stage = usd.Stage.Open(str(tmp_path / "a.usdc"))
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/avatar/surface"))
    np.testing.assert_array_equal(np.array(mesh.GetPointsAttr().Get(2)), MOVING[2])
    np.testing.assert_array_equal(np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3), RIG.topology.faces)
    primvar = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st")
    np.testing.assert_array_equal(
        np.array(primvar.Get())[np.array(primvar.GetIndices())], RIG.topology.uv[RIG.topology.uv_faces.reshape(-1)]
    )
    assert (stage.GetTimeCodesPerSecond(), stage.GetEndTimeCode(), UsdGeom.GetStageUpAxis(stage)) == (12.0, 2.0, "Z")
    assert [path.name for path in tmp_path.iterdir()] == ["a.usdc"]


@pytest.mark.parametrize(("is_lit", "shown", "black"), [(False, "emissiveColor", "diffuseColor"), (True, "diffuseColor", "emissiveColor")])
def test_usd_shows_radiance_as_it_is_and_lets_lamps_light_albedo(tmp_path, is_lit, shown, black):
    usd = pytest.importorskip("pxr.Usd")
    from pxr import UsdShade

    write_usd(tmp_path / "a.usdc", MOVING, RIG.topology, 12.0, "textures/a.png", is_lit)
    stage = usd.Stage.Open(str(tmp_path / "a.usdc"))  # a prim lives no longer than its stage
    surface = UsdShade.Shader(stage.GetPrimAtPath("/avatar/material/surface"))
    assert surface.GetInput(shown).HasConnectedSource() and not surface.GetInput(black).HasConnectedSource()
    assert tuple(surface.GetInput(black).Get()) == (0, 0, 0)
