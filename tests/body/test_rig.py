"""The rig's file and what a rig refuses."""

import copy
import dataclasses

import numpy as np
import pytest

from mitsuba_avatar.body.rig import FORMAT_VERSION, load_rig, save_rig


def test_saved_rig_reads_back_equal(small_rig, tmp_path):
    save_rig(tmp_path / "rig.npz", small_rig)
    read = load_rig(tmp_path / "rig.npz")
    assert read.fingerprint == small_rig.fingerprint
    assert (read.name, read.joint_names, read.keypoint_names, read.face_keypoint_names) == (
        small_rig.name,
        small_rig.joint_names,
        small_rig.keypoint_names,
        small_rig.face_keypoint_names,
    )
    assert read.dofs.names == small_rig.dofs.names
    for part, names in (
        ("", ("rest_vertices", "joint_parents", "joint_positions", "skinning_weights", "face_region", "face_keypoint_vertices")),
        ("topology", ("faces", "uv", "uv_faces")),
        ("dofs", ("joints", "axes", "lower", "upper")),
    ):
        for name in names:
            stored = getattr(getattr(read, part) if part else read, name)
            original = getattr(getattr(small_rig, part) if part else small_rig, name)
            assert stored.dtype == original.dtype, name
            np.testing.assert_array_equal(stored, original, err_msg=name)


def test_keypoint_joints_are_rows_of_the_named_joints(small_rig):
    chosen = dataclasses.replace(small_rig, keypoint_names=("wrist", "base"))
    assert chosen.keypoint_joints.tolist() == [2, 0]


def test_fingerprint_sees_topology_angles_and_landmarks_but_not_the_shape(small_rig):
    taller = dataclasses.replace(small_rig, rest_vertices=small_rig.rest_vertices * np.float32(1.1))
    assert taller.fingerprint == small_rig.fingerprint
    renamed = dataclasses.replace(small_rig.dofs, names=("other", *small_rig.dofs.names[1:]))
    turned = dataclasses.replace(small_rig.topology, faces=np.roll(small_rig.topology.faces, 1, axis=1))
    moved = small_rig.face_keypoint_vertices + 1
    for other in ({"dofs": renamed}, {"topology": turned}, {"face_keypoint_vertices": moved}):
        assert dataclasses.replace(small_rig, **other).fingerprint != small_rig.fingerprint


def _changed(array, index, value):
    array = array.copy()
    array[index] = value
    return array


@pytest.mark.parametrize(
    ("field", "index", "value", "message"),
    [
        ("skinning_weights", (5, 0), 0.7, "rows of skinning_weights that sum to 1; got .* for vertex 5"),
        ("skinning_weights", (5, 0), -0.1, "skinning_weights >= 0"),
        ("skinning_weights", (5, 0), np.nan, "finite skinning_weights"),
        ("rest_vertices", (3, 1), np.inf, "finite rest_vertices; got 1"),
        ("joint_parents", 1, 2, "every parent before its child.*got parent 2 for joint 1 \\(elbow\\)"),
        ("joint_parents", 2, -1, "-1 for joint 0 alone; got parent -1 for joint 2"),
        ("joint_parents", 0, 0, "-1 for joint 0 alone; got parent 0 for joint 0"),
        ("face_keypoint_vertices", 0, 258, "face_keypoint_vertices in 0..257; got .*258"),
    ],
)
def test_rig_refuses_parts_that_do_not_fit(small_rig, field, index, value, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(small_rig, **{field: _changed(getattr(small_rig, field), index, value)})


def test_rig_refuses_a_mesh_of_another_topology(small_rig):
    other = copy.copy(small_rig)
    object.__setattr__(other, "rest_vertices", small_rig.rest_vertices[:-1])
    with pytest.raises(ValueError, match=r"rest_vertices must be \[258, 3\] for this Topology; got \[257, 3\]"):
        other.__post_init__()  # a constructor would be stopped by the type checks of the tests


def test_rig_refuses_unknown_keypoints(small_rig):
    with pytest.raises(ValueError, match=r"keypoint_names among the joints; got \['knee'\]"):
        dataclasses.replace(small_rig, keypoint_names=("base", "knee"))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"names": ("a", "a", "b", "c", "d")}, r"unique names; got \['a'\]"),
        ({"axes": np.full((5, 3), 0.5, dtype=np.float32)}, "unit axes; got length 0.8660 for 'base_flexion'"),
        ({"lower": np.full(5, 1.2, dtype=np.float32)}, "lower < upper; got 1.200..0.500 for 'wrist_deviation'"),
    ],
)
def test_dof_table_refuses_wrong_rows(small_rig, changes, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(small_rig.dofs, **changes)


def test_topology_refuses_coordinates_outside_the_atlas(small_rig):
    with pytest.raises(ValueError, match=r"uv in \[0, 1\]; got .*1.5000"):
        dataclasses.replace(small_rig.topology, uv=_changed(small_rig.topology.uv, (0, 0), 1.5))


def test_load_rig_names_file_and_remedy(small_rig, tmp_path):
    path = tmp_path / "rig.npz"
    with pytest.raises(FileNotFoundError, match="rig.npz does not exist"):
        load_rig(path)
    path.write_bytes(b"not a zip file")
    with pytest.raises(ValueError, match="rig.npz cannot be read"):
        load_rig(path)
    save_rig(path, small_rig)
    with np.load(path) as stored:
        arrays = dict(stored)
    path.write_bytes(path.read_bytes()[:4000])
    with pytest.raises(ValueError, match="rig.npz cannot be read"):
        load_rig(path)
    np.savez(path, **{key: value for key, value in arrays.items() if key != "uv_faces"})
    with pytest.raises(ValueError, match=r"expected arrays \['uv_faces'\] in .*rig.npz"):
        load_rig(path)
    np.savez(path, **arrays | {"format_version": np.array(FORMAT_VERSION + 1)})
    with pytest.raises(ValueError, match=f"rig.npz has {FORMAT_VERSION + 1}"):
        load_rig(path)
    np.savez(path, **arrays | {"skinning_weights": arrays["skinning_weights"] * 0.5})
    with pytest.raises(ValueError, match="rig.npz does not hold together.*sum to 1"):
        load_rig(path)
