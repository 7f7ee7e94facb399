"""A GLB read back by others: trimesh sees our mesh and texture, glTF's rules pose it as the avatar, Khronos' validator is content."""

import dataclasses
import io

import numpy as np
import pygltflib
import pytest
import trimesh
from PIL import Image

from mitsuba_avatar.body.uv import texel_of_uv
from mitsuba_avatar.exporting.character import CharacterSettings, make_character
from mitsuba_avatar.exporting.checking import check_reread, posing_error_mm, validate_gltf
from mitsuba_avatar.exporting.glb import from_gltf, to_gltf, write_glb

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="session")
def picture():
    """[12, 12, 3]: red grows downwards, green to the right."""
    ramp = np.arange(10, 250, 20, dtype=np.uint8)
    return np.stack([ramp[:, None].repeat(12, 1), ramp[None].repeat(12, 0), np.full((12, 12), 77, np.uint8)], axis=2)


@pytest.fixture(scope="session")
def glb(character, picture, tmp_path_factory):
    data = io.BytesIO()
    Image.fromarray(picture).save(data, format="png")
    path = tmp_path_factory.mktemp("glb") / "avatar.glb"
    write_glb(path, character, data.getvalue())
    return path


def test_trimesh_reads_the_mesh_and_the_texture_that_were_written(glb, character, picture):
    check_reread(glb, character)
    (mesh,) = trimesh.load(str(glb), process=False).geometry.values()
    assert len(mesh.vertices) > character.rig.topology.num_vertices, "seams are cut"
    assert mesh.bounds[1][1] > 0.4 and mesh.bounds[0][1] > -0.1, "upright: Y is up"
    image = np.asarray(mesh.visual.material.baseColorTexture.convert("RGB"))
    np.testing.assert_array_equal(image, picture)
    # The texel that a corner names by our convention, and by trimesh's own lookup, which is OBJ's and rounds differently.
    row, column = np.rint(texel_of_uv(mesh.visual.uv, 12, 12)).astype(int).T.clip(0, 11)
    theirs = trimesh.visual.color.uv_to_color(mesh.visual.uv, Image.fromarray(picture))[:, :3].astype(int)
    assert np.abs(picture[row, column] - theirs).max() <= 20 < np.abs(picture[11 - row, column] - theirs).max()


def test_a_mesh_that_is_not_ours_is_noticed(glb, character):
    moved = dataclasses.replace(character, base_vertices=character.base_vertices + np.float32(1e-3))
    with pytest.raises(ValueError, match=r"expected positions .* 0\.00"):
        check_reread(glb, moved)


def test_the_animation_poses_the_mesh_as_the_avatar(glb, character):
    errors = posing_error_mm(glb, character)
    assert errors.shape[0] == 8
    kept = np.sqrt(np.mean(character.motion.vertices.std(axis=0) ** 2)) * 1000
    assert errors.max() < 2 and np.sqrt(np.mean(errors**2)) < 0.05 * kept, "what shapes leave out, and nothing else"


def test_with_all_shapes_the_animation_is_the_avatar(loaded, tmp_path):
    """The small rig has three joints, so four influences lose nothing."""
    settings = CharacterSettings(influences=8, pose_shapes=20, face_shapes="none")
    character = make_character(loaded.avatar, loaded.run.rig, loaded.capture, [2, 3, 9], settings)
    write_glb(tmp_path / "a.glb", character, b"")
    assert posing_error_mm(tmp_path / "a.glb", character).max() < 2e-3
    wrong = dataclasses.replace(character, motion=dataclasses.replace(character.motion, vertices=character.motion.vertices[::-1]))
    assert posing_error_mm(tmp_path / "a.glb", wrong).max() > 10


def test_what_programs_look_for_is_there(glb, character):
    gltf = pygltflib.GLTF2().load(str(glb))
    assert [node.name for node in gltf.nodes[:3]] == ["base", "elbow", "wrist"] and gltf.nodes[0].children == [1]
    assert gltf.meshes[0].extras["targetNames"] == list(character.shapes.names)
    assert character.shapes.names[:3] == ("face_00", "face_01", "face_02") and "pose_00" in character.shapes.names
    assert gltf.extensionsUsed == ["KHR_materials_unlit"]
    paths = {channel.target.path for channel in gltf.animations[0].channels}
    assert paths == {"rotation", "translation", "weights"}
    time = gltf.accessors[gltf.animations[0].samplers[0].input]
    assert time.max == pytest.approx([0.7]) and time.count == 8  # ten frames per second


def test_axes_there_and_back():
    points = np.random.default_rng(1).normal(size=(2, 5, 3)).astype(np.float32)
    np.testing.assert_array_equal(from_gltf(to_gltf(points)), points)
    assert to_gltf(np.array([0.0, -1.0, 2.0])).tolist() == [0.0, 2.0, 1.0]  # forward is +Z, up is +Y


@pytest.mark.parametrize(("influences", "is_lit"), [(4, False), (8, True)])
def test_the_khronos_validator_finds_no_error(loaded, picture, tmp_path, influences, is_lit):
    character = make_character(loaded.avatar, loaded.run.rig, loaded.capture, [0, 1, 2], CharacterSettings(influences=influences))
    data = io.BytesIO()
    Image.fromarray(picture).save(data, format="png")
    write_glb(tmp_path / "a.glb", character, data.getvalue(), is_lit)
    try:
        report = validate_gltf(tmp_path / "a.glb")
    except FileNotFoundError as error:
        pytest.skip(str(error))
    assert (report.errors, report.warnings) == (0, 0), report.messages


def test_a_missing_validator_says_how_to_get_it(glb, monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(
        FileNotFoundError, match="expected node on the PATH; found none. Install Node.js, then `npm install gltf-validator`"
    ):
        validate_gltf(glb)


def test_lit_materials_do_without_the_extension(character, tmp_path):
    write_glb(tmp_path / "a.glb", character, b"", is_lit=True)
    assert pygltflib.GLTF2().load(str(tmp_path / "a.glb")).extensionsUsed == []


def test_facial_actions_of_a_rig_without_any_are_refused(loaded):
    with pytest.raises(ValueError, match="expected a rig with facial actions; 'small' has none"):
        make_character(loaded.avatar, loaded.run.rig, loaded.capture, [0], CharacterSettings(face_shapes="actions"))
    with pytest.raises(ValueError, match="at least one frame"):
        make_character(loaded.avatar, loaded.run.rig, loaded.capture, [], CharacterSettings())
