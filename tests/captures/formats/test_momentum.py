"""Momentum models: posing against its definition, files there and back, and the rig that they become."""

import dataclasses
import json
import pickle

import numpy as np
import pytest
import torch

from mitsuba_avatar.body.driving import driving_masks, face_keypoints
from mitsuba_avatar.body.momentum_rig import face_signal, momentum_from_rig, momentum_poses, rig_from_momentum
from mitsuba_avatar.body.skeleton import Skeleton
from mitsuba_avatar.body.skinning import pose_vertices, unpose_vertices
from mitsuba_avatar.captures.formats.goliath import MomentumTracking
from mitsuba_avatar.captures.formats.momentum import CHANNELS, save_momentum
from mitsuba_avatar.captures.formats.momentum_files import configuration_text, load_momentum, model_document, parse_configuration
from tests.captures.formats.momentum_model import LOCAL, make_momentum_model, random_poses, reference_vertices
from tests.small_capture import make_poses, posed_vertices
from tests.small_rig import make_small_rig

TURNED = np.array([[1.0, 0, 0, 0.2], [0, 0, -1, 0.1], [0, 1, 0, -0.3], [0, 0, 0, 1]])  # our world from the model's, whose Y is up


def posed(rig, theta, root):
    """[N, V, 3] of a rig."""
    with torch.no_grad():
        transforms = Skeleton(rig)(torch.from_numpy(theta), torch.from_numpy(root))
        rest = torch.from_numpy(rig.rest_vertices).expand(len(theta), -1, -1)
        return pose_vertices(rest, transforms, torch.from_numpy(rig.skinning_weights)).numpy()


def test_posing_follows_its_definition():
    """Parents of parents, pre-rotations, scales as powers of two, parameters that move several joints; two poses at once."""
    model, poses = make_momentum_model(), random_poses(2)
    scales = np.array([0.1, -0.2])
    for pose in poses:
        expected = reference_vertices(model, model.rest_vertices, np.concatenate([pose, scales]))
        np.testing.assert_allclose(model.pose_vertices(model.rest_vertices, pose, scales), expected, atol=1e-6)
    states, single = model.joint_states(poses, scales), model.joint_states(poses[1], scales)
    np.testing.assert_allclose(states.translations[1], single.translations)


def tracking(scales, count=3):
    model = make_momentum_model()
    return MomentumTracking(model, model.rest_vertices, np.array(scales), random_poses(count), TURNED)


def test_the_rig_poses_as_the_model_does_from_104_values():
    """Root, 98 local angles, a parameter that drives two joints, and a scale of the whole body: within a thousandth of a millimetre."""
    given = tracking([0.07, 0.0])
    tracked = rig_from_momentum(given)
    vertices = posed(tracked.rig, tracked.theta, tracked.root)
    for index, pose in enumerate(given.poses):
        millimetres = given.model.pose_vertices(given.template, pose, given.scales)
        expected = 1e-3 * millimetres @ TURNED[:3, :3].T + TURNED[:3, 3]
        assert np.abs(vertices[index] - expected).max() < 2e-6
    assert given.poses.shape[1] == 104 and tracked.rig.rest_vertices[:, 2].min() == pytest.approx(0, abs=1e-6)
    assert np.ptp(tracked.rig.rest_vertices, axis=0).argmax() == 2, "the rest surface stands up"
    assert not tracked.notes


def test_angles_keep_the_order_and_the_limits_of_the_parameters():
    model = make_momentum_model()
    rig = rig_from_momentum(tracking([0.0, 0.0])).rig
    own = [name for name in model.parameter_names if name in rig.dofs.names]
    assert len(own) > LOCAL - 10 and "b20.ry" in rig.dofs.names, "a coupled channel has the joint's name"
    place = rig.dofs.names.index("b2_x")
    assert (rig.dofs.lower[place], rig.dofs.upper[place]) == (-1.0, 2.0)
    for joint in range(len(rig.joint_names)):
        names = [name[-1] for name, owner in zip(rig.dofs.names, rig.dofs.joints, strict=True) if owner == joint]
        assert names == sorted(names, reverse=True), "rz acts after ry after rx"


def test_the_trap_of_another_order_of_angles_shows():
    given = tracking([0.0, 0.0], 1)
    tracked = rig_from_momentum(given)
    dofs = tracked.rig.dofs
    joint = int(dofs.joints[0])
    rows = np.flatnonzero(dofs.joints == joint)
    axes = dofs.axes.copy()
    axes[rows] = axes[rows[::-1]]
    theta = tracked.theta.copy()
    theta[:, rows] = theta[:, rows[::-1]]
    wrong = dataclasses.replace(tracked.rig, dofs=dataclasses.replace(dofs, axes=axes))
    assert np.abs(posed(wrong, theta, tracked.root) - posed(tracked.rig, tracked.theta, tracked.root)).max() > 1e-3


def test_a_scale_of_one_joint_goes_into_the_rest_surface_and_shifts_are_reported():
    """With different scales around a vertex the rig is an approximation; its error is bounded here."""
    given = tracking([0.0, 0.15])
    tracked = rig_from_momentum(given)
    vertices = posed(tracked.rig, tracked.theta, tracked.root)
    millimetres = given.model.pose_vertices(given.template, given.poses[0], given.scales)
    expected = 1e-3 * millimetres @ TURNED[:3, :3].T + TURNED[:3, 3]
    assert np.abs(vertices[0] - expected).mean() < 2e-3
    model = make_momentum_model()
    model.transform[7 * 9 + 1, 40] = 2.0
    notes = rig_from_momentum(MomentumTracking(model, model.rest_vertices, np.zeros(2), random_poses(2), TURNED)).notes
    assert "poses shift 1 joints" in notes[0] and "(b9)" in notes[0]


def test_the_face_signal_is_that_of_the_driving_masks_module():
    tracked = rig_from_momentum(tracking([0.0, 0.0], 5))
    vertices = posed(tracked.rig, tracked.theta, tracked.root) + 0.001
    signal = face_signal(tracked.rig, tracked.theta, tracked.root, vertices)
    with torch.no_grad():
        transforms = Skeleton(tracked.rig)(torch.from_numpy(tracked.theta), torch.from_numpy(tracked.root))
        rest = unpose_vertices(torch.from_numpy(vertices), transforms, torch.from_numpy(tracked.rig.skinning_weights))
    np.testing.assert_allclose(signal, face_keypoints(tracked.rig, rest).numpy(), atol=1e-5)


def test_our_rig_as_a_momentum_model_and_back():
    """Angles about slanted axes become bones; posed, both agree, and the way back restores names, limits and axes."""
    rig = make_small_rig()
    theta, root = make_poses()
    model, poses = momentum_from_rig(rig), momentum_poses(theta, root)
    assert poses.shape == (4, 6 + len(rig.dofs.names))
    expected = posed_vertices(rig, theta, root)
    for index, pose in enumerate(poses):
        np.testing.assert_allclose(1e-3 * model.pose_vertices(model.rest_vertices, pose, np.zeros(0)), expected[index], atol=1e-6)
    back = rig_from_momentum(MomentumTracking(model, model.rest_vertices, np.zeros(0), poses, np.eye(4)))
    assert back.rig.dofs.names == rig.dofs.names and back.rig.joint_names == rig.joint_names, "bare bones of one place are merged"
    np.testing.assert_allclose(back.theta, theta, atol=1e-6)
    np.testing.assert_allclose(back.rig.dofs.lower, rig.dofs.lower)
    np.testing.assert_allclose(back.rig.dofs.axes, rig.dofs.axes, atol=1e-6)
    np.testing.assert_allclose(posed(back.rig, back.theta, back.root), expected, atol=2e-6)
    assert driving_masks(back.rig).theta.sum(dim=(1, 2)).min() > 0


def assert_same_model(one, other):
    for name in ("joint_names", "parameter_names", "num_scales"):
        assert getattr(one, name) == getattr(other, name)
    pose, scales = random_poses(1)[0], np.array([0.1, 0.05])
    np.testing.assert_allclose(
        one.pose_vertices(one.rest_vertices, pose, scales), other.pose_vertices(other.rest_vertices, pose, scales), atol=1e-3
    )
    np.testing.assert_array_equal(one.uv_faces, other.uv_faces)


def release_assets(model) -> dict:
    """A dictionary in the shape of static_assets_body.pt, with arrays and tensors mixed as they come."""
    config = parse_configuration(configuration_text(model), model.joint_names)
    return {
        "topology": {"vi": torch.from_numpy(model.faces), "vt": model.uv, "vti": model.uv_faces},
        "lbs_model_json": model_document(model),
        "lbs_config_dict": config,
        "global_scaling": [10.0, 10.0, 10.0],
        "face_mask": torch.ones(1, 16, 16),
    }


def test_models_survive_npz_json_with_text_and_release_assets(tmp_path):
    model = make_momentum_model()
    save_momentum(tmp_path / "body.npz", model)
    assert_same_model(load_momentum(tmp_path / "body.npz"), model)
    assert load_momentum(tmp_path / "body.npz").limits == model.limits
    (tmp_path / "body.json").write_text(json.dumps(model_document(model)))
    (tmp_path / "body.cfg").write_text(configuration_text(model).rstrip("\n"))  # no newline at the end: the last line still counts
    assert_same_model(load_momentum(tmp_path / "body.json"), model)
    torch.save(release_assets(model), tmp_path / "static_assets_body.pt")
    loaded = load_momentum(tmp_path / "static_assets_body.pt")
    assert_same_model(loaded, model)
    assert loaded.face_weights.min() == 1.0 and loaded.limits == model.limits
    assert model_document(model)["Skeleton"]["Bones"][0]["Parent"] == 4294967295


def test_the_configuration_text_is_read_as_written():
    text = "# a comment\nparameterset all a b\na.rx = 1.0 * bend + 0.5*twist # half\na.tx = slide\na.rz = 0.25\n"
    text += "b.sc = 1.0 * scale_b\nlimit bend minmax [-0.5, 1.5] 2.0\nlimit a.rx minmax_passive [-1,1] 1\nb.ry = -2e-1 * twist"
    config = parse_configuration(text, ("a", "b"))
    assert config["parameter_names"] == ["bend", "twist", "slide", "scale_b"] and config["nr_scaling_params"] == 1
    expected = np.zeros((14, 4))
    expected[3, :2], expected[0, 2], expected[13, 3], expected[11, 1] = (1.0, 0.5), 1.0, 1.0, -0.2
    np.testing.assert_array_equal(config["transform"], expected)
    assert config["transform_offsets"][0, 5] == 0.25 and CHANNELS[5] == "rz"
    assert config["limits"][0] == {"name": "bend", "type": "minmax", "range": (-0.5, 1.5), "weight": 2.0}
    for line in ("c.rx = 1.0 * bend\n", "a.qx = 1.0 * bend\n", "a.rx\n"):
        with pytest.raises(ValueError, match="of a known joint in line 1"):
            parse_configuration(line, ("a", "b"))


class Harm:
    def __reduce__(self):
        return print, ("harm",)


def test_bad_models_are_named(tmp_path, capsys):
    with (tmp_path / "harm.pt").open("wb") as file:
        pickle.dump({"lbs_model_json": Harm()}, file, protocol=2)
    torch.save({"lbs_model_json": Harm()}, tmp_path / "harm2.pt")
    for name in ("harm.pt", "harm2.pt"):
        with pytest.raises(ValueError, match="expected tensors, arrays and plain containers in .*harm"):
            load_momentum(tmp_path / name)
    assert "harm" not in capsys.readouterr().out
    torch.save({"something": 1}, tmp_path / "other.pt")
    with pytest.raises(ValueError, match="expected a skeleton, a skinned mesh and their parameter transform in .*other.pt"):
        load_momentum(tmp_path / "other.pt")
    np.savez(tmp_path / "rig.npz", faces=np.zeros(3))
    with pytest.raises(ValueError, match="expected a body model of version 1 in .*rig.npz"):
        load_momentum(tmp_path / "rig.npz")
    with pytest.raises(FileNotFoundError, match="--assets"):
        load_momentum(tmp_path / "none.pt")
    with pytest.raises(ValueError, match="expected 104 pose and 2 scale values for this model; got 103 and 2"):
        make_momentum_model().channels(np.zeros(103), np.zeros(2))
