import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mitsuba_avatar.body.anny_rig import facial_action_displacements
from mitsuba_avatar.filming.anatomy import Anatomy
from mitsuba_avatar.filming.clothing import DressedBody
from mitsuba_avatar.filming.face_parts import eyes, teeth
from mitsuba_avatar.filming.grids import grid_topology, stacked
from mitsuba_avatar.filming.headset import headset
from tests.filming.posed_body import PosedBody, posed_body


@pytest.fixture(scope="module")
def posed() -> PosedBody:
    return posed_body()


def _moved(points: np.ndarray) -> np.ndarray:
    return (Rotation.from_rotvec([0.3, -0.8, 1.9]).apply(points) + [0.4, -1.2, 0.3]).astype(np.float32)


def test_rigid_things_follow_a_rigid_motion_of_the_body_exactly(anatomy: Anatomy, body: DressedBody):
    for prop in (headset(anatomy, body), *teeth(anatomy, body)):
        np.testing.assert_allclose(prop.surface(body.vertices), prop.rest_vertices, atol=1e-6)
        np.testing.assert_allclose(prop.surface(_moved(body.vertices)), _moved(prop.rest_vertices), atol=2e-6)


def test_a_headset_follows_the_head_whatever_the_face_does(anatomy: Anatomy, body: DressedBody, posed: PosedBody):
    """In a posed frame with facial actions, the headset moves as the head's joint does."""
    worn, frame = headset(anatomy, body), 6
    head = posed.transforms[frame, posed.rig.joint_names.index("head")]
    expected = worn.rest_vertices @ head[:3, :3].T + head[:3, 3]
    np.testing.assert_allclose(worn.surface(posed.vertices[frame]), expected, atol=2e-3)


def test_a_headset_hides_the_eyes_and_shows_the_mouth(anatomy: Anatomy, body: DressedBody):
    visor = headset(anatomy, body).rest_vertices[: 25 * 64]
    for side in "LR":
        eye = anatomy.joint(f"eye.{side}")
        assert (visor.min(axis=0) < eye + [0, -0.03, 0]).all() and (visor.max(axis=0)[[0, 2]] > eye[[0, 2]]).all()
    assert visor[:, 2].min() > anatomy.joint("eye.L")[2] - 0.065  # lips begin 0.06 below the eyes
    head = body.vertices[anatomy.weight(("head",)) > 0.9]
    assert visor[:, 1].min() < head[:, 1].min() - 0.02  # in front of the nose


def test_lower_teeth_open_with_the_jaw_and_upper_ones_stay(anatomy: Anatomy, body: DressedBody):
    names, displacements = facial_action_displacements()
    opened = body.vertices + displacements[names.index("jawOpen")].astype(np.float32)
    upper, lower = teeth(anatomy, body)
    assert np.abs(upper.surface(opened) - upper.rest_vertices).max() < 5e-4
    assert (lower.rest_vertices - lower.surface(opened))[:, 2].mean() > 0.01


def test_teeth_are_hidden_behind_closed_lips(anatomy: Anatomy, body: DressedBody):
    """In front of every tooth there is skin."""
    skin = body.vertices[anatomy.piece == 0]
    for row in teeth(anatomy, body):
        for tooth in row.rest_vertices[::3]:
            near = skin[np.linalg.norm(skin[:, [0, 2]] - tooth[[0, 2]], axis=1) < 0.006]
            assert near[:, 1].min() < tooth[1] - 0.001


def test_eyes_are_the_bodys_own_with_an_atlas_that_they_fill(anatomy: Anatomy, body: DressedBody):
    part = eyes(anatomy, seed=0, size=64)
    topology = anatomy.rig.topology
    surface = part.surface(body.vertices)
    for own, faces in ((surface[part.layer.topology.faces], topology.faces[part.faces]),):
        np.testing.assert_array_equal(own, body.vertices[faces])
    assert np.ptp(part.layer.topology.uv, axis=0).min() > 0.95 and part.faces.sum() == 280
    colours = part.layer.appearance.base_colour.reshape(-1, 3)
    assert colours.min() < 0.03 and colours.max() > 0.4  # pupil and white


@pytest.mark.parametrize("is_closed", [False, True])
def test_a_grid_is_covered_once_by_faces_and_texture(is_closed: bool):
    topology = grid_topology(3, 5, is_closed)
    assert topology.num_vertices == 15 and len(topology.faces) == 2 * 2 * (4 + is_closed)
    corners = topology.uv[topology.uv_faces]
    edges = corners[:, 1:] - corners[:, :1]
    assert abs(np.abs(edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]).sum() / 2 - 1) < 1e-6
    assert np.allclose(topology.uv[topology.uv_faces[topology.faces == 0]][:, 1], 1)  # the first vertex is in the texture's first row


def test_stacked_meshes_keep_apart():
    first, second = grid_topology(2, 3), grid_topology(3, 2)
    both = stacked([first, second])
    assert both.num_vertices == 12 and both.faces[len(first.faces) :].min() == 6
    assert both.uv[both.uv_faces[: len(first.faces)]][..., 1].min() >= 0.5 >= both.uv[both.uv_faces[len(first.faces) :]][..., 1].max()
