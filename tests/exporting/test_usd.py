"""USD files read back by USD: the point cache as it was written, and a character that USD's own skinning poses as the avatar."""

import dataclasses
import sys

import numpy as np
import pytest

from mitsuba_avatar.exporting.character import CharacterSettings, make_character
from mitsuba_avatar.exporting.usd import load_usd, usd_posing_error_mm, write_usd_cache, write_usd_character
from tests.small_rig import make_small_rig

pytestmark = pytest.mark.usefixtures("one_thread")

RIG = make_small_rig()
MOVING = np.stack([RIG.rest_vertices + np.float32(0.1 * i) for i in range(3)])


@pytest.fixture
def pxr():
    pytest.importorskip("pxr")
    return load_usd()


def test_usd_point_cache(pxr, tmp_path):
    write_usd_cache(tmp_path / "a.usdc", MOVING, RIG.topology, 12.0, "textures/radiance.png")
    stage = pxr.Usd.Stage.Open(str(tmp_path / "a.usdc"))
    mesh = pxr.UsdGeom.Mesh(stage.GetPrimAtPath("/avatar/surface"))
    np.testing.assert_array_equal(np.array(mesh.GetPointsAttr().Get(2)), MOVING[2])
    np.testing.assert_array_equal(np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3), RIG.topology.faces)
    primvar = pxr.UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st")
    np.testing.assert_array_equal(
        np.array(primvar.Get())[np.array(primvar.GetIndices())], RIG.topology.uv[RIG.topology.uv_faces.reshape(-1)]
    )
    assert (stage.GetTimeCodesPerSecond(), stage.GetEndTimeCode(), pxr.UsdGeom.GetStageUpAxis(stage)) == (12.0, 2.0, "Z")
    assert [path.name for path in tmp_path.iterdir()] == ["a.usdc"]


@pytest.mark.parametrize(("is_lit", "shown", "black"), [(False, "emissiveColor", "diffuseColor"), (True, "diffuseColor", "emissiveColor")])
def test_usd_shows_radiance_as_it_is_and_lets_lamps_light_albedo(pxr, tmp_path, is_lit, shown, black):
    write_usd_cache(tmp_path / "a.usdc", MOVING, RIG.topology, 12.0, "textures/a.png", is_lit)
    stage = pxr.Usd.Stage.Open(str(tmp_path / "a.usdc"))  # a prim lives no longer than its stage
    surface = pxr.UsdShade.Shader(stage.GetPrimAtPath("/avatar/material/surface"))
    assert surface.GetInput(shown).HasConnectedSource() and not surface.GetInput(black).HasConnectedSource()
    assert tuple(surface.GetInput(black).Get()) == (0, 0, 0)


def test_usd_poses_the_character_as_the_avatar(pxr, loaded, tmp_path):
    """The small rig has three joints, so four influences lose nothing, and three frames have two shapes."""
    settings = CharacterSettings(pose_shapes=20, face_shapes="principal", face_principals=2)
    character = make_character(loaded.avatar, loaded.run.rig, loaded.capture, [2, 3, 9], settings)
    write_usd_character(tmp_path / "a.usdc", character, "textures/a.png")
    assert usd_posing_error_mm(tmp_path / "a.usdc", character).max() < 2e-3
    wrong = dataclasses.replace(character, motion=dataclasses.replace(character.motion, vertices=character.motion.vertices[::-1]))
    assert usd_posing_error_mm(tmp_path / "a.usdc", wrong).max() > 10
    assert [path.name for path in tmp_path.iterdir()] == ["a.usdc"], "posing leaves the file as it is"


def test_a_character_has_what_programs_look_for(pxr, character, tmp_path):
    write_usd_character(tmp_path / "a.usda", character, "textures/a.png")
    stage = pxr.Usd.Stage.Open(str(tmp_path / "a.usda"))
    assert stage.GetDefaultPrim().IsA(pxr.UsdSkel.Root) and pxr.UsdGeom.GetStageUpAxis(stage) == "Z"
    skeleton = pxr.UsdSkel.Skeleton(stage.GetPrimAtPath("/avatar/skeleton"))
    assert list(skeleton.GetJointsAttr().Get()) == ["base", "base/elbow", "base/elbow/wrist"]
    query = pxr.UsdSkel.Cache().GetSkelQuery(skeleton)
    assert query.HasBindPose() and query.HasRestPose() and query.GetAnimQuery().GetBlendShapeOrder() == list(character.shapes.names)
    rest = np.array(query.ComputeSkinningTransforms(pxr.Usd.TimeCode.Default()))
    assert rest.shape == (3, 4, 4)
    shape = pxr.UsdSkel.BlendShape(stage.GetPrimAtPath("/avatar/surface/pose_00"))
    moved = np.array(shape.GetPointIndicesAttr().Get())
    expected = character.shapes.displacements[character.shapes.names.index("pose_00")]
    np.testing.assert_array_equal(np.array(shape.GetOffsetsAttr().Get()), expected[moved])
    assert len(moved) == np.count_nonzero(expected.any(axis=1))
    times = query.GetAnimQuery().GetJointTransformTimeSamples()
    assert times == list(range(8)) and stage.GetTimeCodesPerSecond() == 10


def test_names_become_what_usd_allows_and_must_still_differ(pxr, character, tmp_path):
    named = dataclasses.replace(
        character, rig=dataclasses.replace(character.rig, joint_names=("base", "arm.L", "hand-1"), keypoint_names=("base",))
    )
    write_usd_character(tmp_path / "a.usda", named, "a.png")
    stage = pxr.Usd.Stage.Open(str(tmp_path / "a.usda"))
    skeleton = pxr.UsdSkel.Skeleton(stage.GetPrimAtPath("/avatar/skeleton"))
    assert list(skeleton.GetJointsAttr().Get())[2] == "base/arm_L/hand_1" and list(skeleton.GetJointNamesAttr().Get())[1] == "arm.L"
    shapes = dataclasses.replace(character.shapes, names=("a.b", "a_b", *character.shapes.names[2:]))
    with pytest.raises(ValueError, match="got 'a.b' and 'a_b', both 'a_b' there"):
        write_usd_character(tmp_path / "b.usda", dataclasses.replace(character, shapes=shapes), "a.png")
    assert [path.name for path in tmp_path.iterdir()] == ["a.usda"]


def test_a_missing_package_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "pxr", None)
    with pytest.raises(ModuleNotFoundError, match=r"expected usd-core; it is missing. pip install 'mitsuba-avatar\[usd\]'"):
        load_usd()
