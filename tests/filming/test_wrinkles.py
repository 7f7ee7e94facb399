import numpy as np
import pytest

from mitsuba_avatar.filming.anatomy import Anatomy
from mitsuba_avatar.filming.clothing import DressedBody
from mitsuba_avatar.filming.wrinkles import KinematicCloth, low_pass
from tests.filming.acted import Acted


@pytest.fixture(scope="module")
def cloth(anatomy: Anatomy, body: DressedBody) -> KinematicCloth:
    return KinematicCloth(anatomy, body, seed=0)


def _theta(anatomy: Anatomy, count: int, **angles: np.ndarray) -> np.ndarray:
    names = anatomy.rig.dofs.names
    theta = np.zeros((count, len(names)), dtype=np.float32)
    for name, values in angles.items():
        theta[:, names.index(name)] = values
    return theta


def test_low_pass_is_the_step_response_of_a_first_order_filter():
    signal = np.concatenate([np.zeros((1, 1)), np.ones((40, 1))])
    response = low_pass(signal, rise=0.8, fall=5.0, fps=10.0)[:, 0]
    np.testing.assert_allclose(response, 1 - np.exp(-np.arange(41) / 8.0), atol=1e-12)


def test_low_pass_falls_with_its_own_constant_and_starts_without_lag():
    signal = np.concatenate([np.full((1, 1), 2.0), np.zeros((20, 1))])
    response = low_pass(signal, rise=0.1, fall=1.5, fps=10.0)[:, 0]
    np.testing.assert_allclose(response, 2 * np.exp(-np.arange(21) / 15.0), atol=1e-12)


def test_at_rest_nothing_folds(anatomy: Anatomy, cloth: KinematicCloth):
    assert np.abs(cloth.displacements(cloth.states(_theta(anatomy, 3), 10.0, [slice(0, 3)]))).max() < 1e-6


def test_only_cloth_folds_and_never_into_the_skin(anatomy: Anatomy, cloth: KinematicCloth, body: DressedBody):
    theta = _theta(anatomy, 2, left_knee_flexion=np.array([1.0, 1.0]), spine03_turn=np.array([0.3, 0.3]))
    offsets = cloth.displacements(cloth.states(theta, 10.0, [slice(0, 2)]))
    bare = (body.coverage["shirt"] + body.coverage["trousers"]) == 0
    assert np.abs(offsets[:, bare]).max() < 1e-6
    assert np.linalg.norm(offsets, axis=-1).max() > 0.004
    gap = ((body.vertices + offsets - body.skin) * body.normals).sum(axis=-1)
    before = ((body.vertices - body.skin) * body.normals).sum(axis=-1)
    assert (gap >= np.minimum(before, 0.0019) - 1e-5).all()


def test_folds_stay_near_the_joint_that_makes_them(anatomy: Anatomy, cloth: KinematicCloth):
    offsets = cloth.displacements(cloth.states(_theta(anatomy, 1, left_knee_flexion=np.array([1.2])), 10.0, [slice(0, 1)]))[0]
    distance = np.linalg.norm(anatomy.rig.rest_vertices - anatomy.joint("lowerleg01.L"), axis=1)
    size = np.linalg.norm(offsets, axis=-1)
    assert size[distance < 0.12].max() > 0.004 and size[distance > 0.6].max() < 1e-4


def test_the_same_pose_differs_by_history_and_pose_explains_most(anatomy: Anatomy, cloth: KinematicCloth):
    ramp = np.concatenate([np.full(10, 0.6), np.full(10, 0.0)])
    after_raising = cloth.displacements(cloth.states(_theta(anatomy, 20, left_shoulder_abduction=ramp), 10.0, [slice(0, 20)]))[10]
    from_rest = cloth.displacements(cloth.states(_theta(anatomy, 1), 10.0, [slice(0, 1)]))[0]
    raised = cloth.displacements(cloth.states(_theta(anatomy, 1, left_shoulder_abduction=ramp[:1]), 10.0, [slice(0, 1)]))[0]
    hidden = np.linalg.norm(after_raising - from_rest, axis=-1).max()
    assert hidden > 0.002
    assert np.linalg.norm(raised - from_rest, axis=-1).max() > hidden


def test_a_segment_does_not_remember_the_one_before(anatomy: Anatomy, cloth: KinematicCloth):
    theta = _theta(anatomy, 12, spine03_bend=np.repeat([0.2, -0.2], 6))
    apart = cloth.displacements(cloth.states(theta, 10.0, [slice(0, 6), slice(6, 12)]))
    np.testing.assert_allclose(apart[6:], cloth.displacements(cloth.states(theta[6:], 10.0, [slice(0, 6)])), atol=1e-7)


def test_the_registered_mesh_is_not_the_skinned_template(performance: Acted):
    offsets = np.linalg.norm(performance.rest_vertices - performance.rig.rest_vertices, axis=-1)
    assert 0.004 < offsets.max() < 0.06
