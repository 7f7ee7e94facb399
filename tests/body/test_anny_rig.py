"""The Anny person: orientation, anatomy of every angle, masks, facial actions, and agreement with Anny's own posing."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from mitsuba_avatar.body.anny_rig import AnnyPhenotype, build_anny_rig, facial_action_displacements
from mitsuba_avatar.body.driving import driving_masks, face_keypoints
from mitsuba_avatar.body.skeleton import Skeleton
from mitsuba_avatar.body.skinning import pose_vertices


def tip(rig, joint: str) -> int:
    """Vertex that follows a joint and lies farthest from it: the end of a finger, toe or eye's cornea."""
    column = rig.joint_names.index(joint)
    distance = np.linalg.norm(rig.rest_vertices - rig.joint_positions[column], axis=1)
    return int((distance * (rig.skinning_weights[:, column] > 0.5)).argmax())


def movement(rig, dof: str, vertex: int) -> np.ndarray:
    """Metres per radian that one angle moves one vertex, by a small step from rest."""
    theta = torch.zeros(2, len(rig.dofs.names), dtype=torch.float64)
    theta[1, rig.dofs.names.index(dof)] = 1e-4
    transforms = Skeleton(rig).double()(theta, torch.eye(4, dtype=torch.float64).expand(2, 4, 4))
    vertices = torch.from_numpy(rig.rest_vertices).double().expand(2, -1, -1)
    posed = pose_vertices(vertices, transforms, torch.from_numpy(rig.skinning_weights).double())[:, vertex]
    return ((posed[1] - posed[0]) / 1e-4).numpy()


def test_the_person_stands_on_the_ground_and_faces_minus_y(anny_rig):
    low, high = anny_rig.rest_vertices.min(axis=0), anny_rig.rest_vertices.max(axis=0)
    assert low[2] == 0
    assert 1.7 < high[2] < 1.85
    landmarks = anny_rig.rest_vertices[anny_rig.face_keypoint_vertices]
    head = anny_rig.joint_positions[anny_rig.joint_names.index("head")]
    assert landmarks[:, 1].max() < head[1], "the face must be on the -Y side of the head"
    assert anny_rig.joint_positions[anny_rig.joint_names.index("wrist.L"), 0] > 0.3, "the left hand must be at +X"


def test_topology_is_closed_and_points_outwards(anny_rig):
    faces = anny_rig.topology.faces
    assert anny_rig.topology.num_vertices == 13718
    assert faces.shape == (27420, 3)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    directed = {tuple(edge) for edge in edges.tolist()}
    assert len(directed) == len(edges)
    assert all((end, start) in directed for start, end in directed)
    corners = anny_rig.rest_vertices[faces].astype(np.float64)
    volume = np.einsum("fi,fi->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6
    assert 0.04 < volume < 0.12  # cubic metres: a person's; negative were inside out


DIRECTIONS = {  # angle of the left side: vertex at the tip of which joint, and the way it must go (left of the person is +X)
    "hip_flexion": ("toe1-2", (0, -1, 0)),
    "hip_abduction": ("toe1-2", (1, 0, 0)),
    "hip_inward_rotation": ("toe1-2", (-1, 0, 0)),
    "thigh_twist": ("toe1-2", (-1, 0, 0)),
    "knee_flexion": ("toe1-2", (0, 1, 0)),
    "shank_twist": ("toe1-2", (-1, 0, 0)),
    "ankle_dorsiflexion": ("toe1-2", (0, 0, 1)),
    "big_toe_flexion": ("toe1-2", (0, 0, -1)),
    "clavicle_elevation": ("finger3-3", (0, 0, 1)),
    "clavicle_protraction": ("finger3-3", (0, -1, 0)),
    "shoulder_flexion": ("lowerarm01", (0, -1, 0)),
    "shoulder_abduction": ("lowerarm01", (1, 0, 1)),
    "shoulder_inward_rotation": ("finger3-3", (-1, 0, 0)),
    "upper_arm_twist": ("finger3-3", (-1, 0, 0)),
    "elbow_flexion": ("finger3-3", (-1, -1, 1)),
    "eye_elevation": ("eye", (0, 0, 1)),
    "eye_abduction": ("eye", (1, 0, 0)),
}


@pytest.mark.parametrize("name", DIRECTIONS)
@pytest.mark.parametrize("side", ["left", "right"])
def test_positive_angles_are_anatomical_on_both_sides(anny_rig, name, side):
    joint, direction = DIRECTIONS[name]
    mirror = 1 if side == "left" else -1
    vertex = tip(anny_rig, f"{joint}.{side[0].upper()}")
    if joint == "eye":  # the cornea, not the farthest point
        mine = anny_rig.skinning_weights[:, anny_rig.joint_names.index(f"eye.{side[0].upper()}")] > 0.9
        vertex = int(np.where(mine, anny_rig.rest_vertices[:, 1], np.inf).argmin())
    expected = np.array(direction, dtype=np.float64) * [mirror, 1, 1]
    moved = movement(anny_rig, f"{side}_{name}", vertex)
    cosine = moved @ expected / np.linalg.norm(moved) / np.linalg.norm(expected)
    assert cosine > 0.5, f"moves {np.round(moved, 3)} m/rad, expected {expected}"


@pytest.mark.parametrize("side", ["left", "right"])
def test_fingers_close_over_the_palm_and_spread_from_the_middle_finger(anny_rig, side):
    letter, mirror = side[0].upper(), np.array([1 if side == "left" else -1, 1, 1])
    joints = [anny_rig.joint_names.index(f"{name}.{letter}") for name in ("wrist", "finger2-1", "finger3-1", "finger5-1")]
    wrist, index, middle, little = anny_rig.joint_positions[joints]
    along, to_little = middle - wrist, little - index
    palm = np.cross(to_little, along) * mirror[0]
    assert palm[2] < 0, "palms face downwards at rest"
    for number, name in enumerate(("thumb", "index", "middle", "ring", "little"), start=1):
        vertex = tip(anny_rig, f"finger{number}-3.{letter}")
        target = palm if number > 1 else to_little
        for part in ("base_flexion", "middle_flexion", "tip_flexion"):
            assert movement(anny_rig, f"{side}_{name}_{part}", vertex) @ target > 0, (name, part)
        away = {1: palm, 2: -to_little, 3: -to_little, 4: to_little, 5: to_little}[number]
        assert movement(anny_rig, f"{side}_{name}_base_abduction", vertex) @ away > 0, name
    fingertip = tip(anny_rig, f"finger3-3.{letter}")
    assert movement(anny_rig, f"{side}_wrist_flexion", fingertip) @ palm > 0
    assert movement(anny_rig, f"{side}_wrist_ulnar_deviation", fingertip) @ to_little > 0
    thumb = tip(anny_rig, f"finger1-3.{letter}")
    assert movement(anny_rig, f"{side}_forearm_pronation", thumb) @ palm > 0, "the thumb leads towards where the palm looks"


def test_trunk_and_head_lean_forwards_bend_and_turn_left(anny_rig):
    nose = anny_rig.face_keypoint_vertices[anny_rig.rest_vertices[anny_rig.face_keypoint_vertices, 1].argmin()]
    crown = int(anny_rig.rest_vertices[:, 2].argmax())
    for joint in ("spine05", "spine03", "spine01", "neck01", "neck03", "head"):
        assert movement(anny_rig, f"{joint}_flexion", nose)[2] < 0, joint
        assert movement(anny_rig, f"{joint}_flexion", crown)[1] < 0, joint
        assert movement(anny_rig, f"{joint}_bend", crown)[0] > 0, joint
        assert movement(anny_rig, f"{joint}_turn", nose)[0] > 0, joint


def test_sides_are_mirror_images(anny_rig):
    dofs = anny_rig.dofs
    for row, name in enumerate(dofs.names):
        if name.startswith("left_"):
            other = dofs.names.index("right_" + name.removeprefix("left_"))
            np.testing.assert_array_equal(dofs.axes[other], dofs.axes[row] * np.array([1, -1, -1], dtype=np.float32))
            assert (dofs.lower[other], dofs.upper[other]) == (dofs.lower[row], dofs.upper[row])
    assert len(dofs.names) == 106
    assert ((dofs.lower < 0) & (dofs.upper > 0)).all(), "the rest pose lies within the limits"


def test_no_mask_is_empty_and_masks_stay_local(anny_rig):
    masks = driving_masks(anny_rig)
    assert masks.theta.shape == (106, 32, 32)
    share = dict(zip(anny_rig.dofs.names, masks.theta.mean(dim=(1, 2)).tolist(), strict=True))
    assert min(share.values()) > 0.01
    assert max(share.values()) < 0.45
    assert share["left_eye_elevation"] < 0.1
    hand, knee = (masks.theta[anny_rig.dofs.names.index(name)] for name in ("left_index_tip_flexion", "right_knee_flexion"))
    assert (hand * knee).sum() == 0
    assert 0.05 < masks.face.mean() < 0.3


def test_face_landmarks_are_mirrored_and_see_every_facial_action(anny_rig):
    names, displacements = facial_action_displacements()
    assert displacements.shape == (52, 13718, 3)
    landmarks = anny_rig.face_keypoint_vertices
    assert len(set(landmarks.tolist())) == len(landmarks) == 48
    left, right = anny_rig.rest_vertices[landmarks[::2]], anny_rig.rest_vertices[landmarks[1::2]]
    np.testing.assert_allclose(left * [-1, 1, 1], right, atol=1e-3)
    rest = torch.from_numpy(anny_rig.rest_vertices)[None]
    signal = face_keypoints(anny_rig, torch.cat([rest, rest + torch.from_numpy(displacements)]))
    change = (signal[1:] - signal[:1]).reshape(52, -1, 3).norm(dim=-1).max(dim=1).values
    unseen = [name for name, most in zip(names, change.tolist(), strict=True) if most < 1e-3]
    assert unseen == ["tongueOut"], f"landmarks must move by a millimetre for every action; they do not for {unseen}"
    assert change.max() < 0.06  # metres


def test_facial_actions_move_the_face_region_alone(anny_rig):
    _, displacements = facial_action_displacements()
    moved = np.linalg.norm(displacements, axis=-1).max(axis=0)
    assert (anny_rig.face_region[moved > 4e-3] == 1).all()
    assert (anny_rig.face_region[moved < 5e-4] == 0).all()
    assert anny_rig.rest_vertices[anny_rig.face_region > 0, 2].min() > 1.4  # above the collar bones


def test_phenotype_out_of_range_is_refused():
    with pytest.raises(ValueError, match="expected weight in 0..1; got 1.3"):
        AnnyPhenotype(weight=1.3)


def test_a_damaged_cache_is_rebuilt(anny_rig, tmp_path, monkeypatch):
    from mitsuba_avatar.body import anny_rig as module

    monkeypatch.setenv("MITSUBA_AVATAR_CACHE", str(tmp_path))
    monkeypatch.setattr(module, "load_anny", lambda facial_actions: None)
    monkeypatch.setattr(module, "_build", lambda anny, phenotype: anny_rig)
    path = module._cache_path("rig", AnnyPhenotype())
    path.write_bytes(b"half a file")
    assert build_anny_rig() is anny_rig
    assert build_anny_rig().fingerprint == anny_rig.fingerprint
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


@pytest.mark.slow
def test_posing_equals_annys_own(anny_rig):
    """Anny, told the world orientation of every bone, poses its vertices where ours go for the same rotations."""
    from anny import Anny

    model = Anny(facial_actions="all", skinning_method="lbs")
    phenotype = dict(vars(AnnyPhenotype()))
    rest = model(phenotype_kwargs=phenotype)
    ground = rest["rest_vertices"][0, :, 2].min()
    dofs = anny_rig.dofs
    theta = torch.from_numpy(np.random.default_rng(0).uniform(dofs.lower, dofs.upper, size=(2, len(dofs.names))))
    root = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    root[1, :3, :3] = torch.from_numpy(Rotation.from_rotvec([0.3, -0.2, 0.9]).as_matrix())
    root[1, :3, 3] = torch.tensor([0.4, -1.0, 0.2])
    transforms = Skeleton(anny_rig).double()(theta, root)
    vertices, weights = (torch.from_numpy(array).double() for array in (anny_rig.rest_vertices, anny_rig.skinning_weights))
    ours = pose_vertices(vertices.expand(2, -1, -1), transforms, weights)
    orientations = torch.eye(4, dtype=torch.float64).repeat(2, 104, 1, 1)
    orientations[:, :, :3, :3] = transforms[:, :, :3, :3] @ rest["rest_bone_poses"][:, :, :3, :3]
    head = rest["rest_bone_heads"][0, 0] - torch.tensor([0, 0, ground])  # our rest space is Anny's, shifted to the ground
    orientations[:, 0, :3, 3] = (transforms[:, 0, :3, :3] @ head) + transforms[:, 0, :3, 3]
    theirs = model(orientations, phenotype_kwargs=phenotype, pose_parameterization="world-orient")["vertices"]
    error = (ours - theirs).norm(dim=-1).max()
    assert error < 2e-6, f"{error:.2e} m"


@pytest.mark.slow
def test_building_again_gives_the_same_rig(anny_rig, tmp_path, monkeypatch):
    monkeypatch.setenv("MITSUBA_AVATAR_CACHE", str(tmp_path))
    built = build_anny_rig()
    assert built.fingerprint == anny_rig.fingerprint
    np.testing.assert_allclose(built.rest_vertices, anny_rig.rest_vertices, atol=1e-6)
    other = build_anny_rig(AnnyPhenotype(height=0.8, gender=0.0))
    assert other.fingerprint == built.fingerprint, "phenotypes share topology, angles and landmarks"
    assert other.rest_vertices[:, 2].max() > built.rest_vertices[:, 2].max() + 0.05
