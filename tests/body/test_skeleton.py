"""Forward kinematics against a recursive float64 reference and finite differences."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from mitsuba_avatar.body.skeleton import Skeleton
from tests.body import reference


def random_root(batch: int, seed: int) -> np.ndarray:
    """[B, 4, 4] rigid transforms."""
    generator = np.random.default_rng(seed)
    root = np.tile(np.eye(4), (batch, 1, 1))
    root[:, :3, :3] = Rotation.from_rotvec(generator.normal(size=(batch, 3))).as_matrix()
    root[:, :3, 3] = generator.normal(size=(batch, 3))
    return root


def random_theta(rig, batch: int, seed: int) -> np.ndarray:
    """[B, D] angles within the rig's limits."""
    return np.random.default_rng(seed).uniform(rig.dofs.lower, rig.dofs.upper, size=(batch, len(rig.dofs.names)))


@pytest.mark.parametrize("name", ["small_rig", "anny_rig"])
def test_transforms_equal_the_recursive_reference(name, request):
    rig = request.getfixturevalue(name)
    theta, root = random_theta(rig, 3, seed=1), random_root(3, seed=2)
    expected = np.stack([reference.posed_from_rest(rig, angles, place) for angles, place in zip(theta, root, strict=True)])
    skeleton = Skeleton(rig)
    single = skeleton(torch.from_numpy(theta).float(), torch.from_numpy(root).float())
    np.testing.assert_allclose(single.numpy(), expected, atol=5e-6)
    double = skeleton.double()(torch.from_numpy(theta), torch.from_numpy(root))
    np.testing.assert_allclose(double.numpy(), expected, atol=2e-7)  # the axes are stored in float32
    joints = skeleton.posed_joints(double).numpy()
    positions = np.concatenate([rig.joint_positions, np.ones((len(rig.joint_positions), 1))], axis=1)
    np.testing.assert_allclose(joints, np.einsum("bjik,jk->bji", expected, positions)[..., :3], atol=2e-7)


def test_rest_pose_is_the_root_alone(anny_rig):
    root = torch.from_numpy(random_root(2, seed=3)).float()
    transforms = Skeleton(anny_rig)(torch.zeros(2, len(anny_rig.dofs.names)), root)
    torch.testing.assert_close(transforms, root[:, None].expand_as(transforms), atol=1e-6, rtol=0)


def test_an_angle_leaves_its_joint_and_ancestors_in_place(small_rig):
    theta = torch.zeros(2, 5)
    theta[0, 2] = 0.9  # elbow_flexion
    moved = Skeleton(small_rig).posed_joints(Skeleton(small_rig)(theta, torch.eye(4).expand(2, 4, 4)))
    shift = (moved[0] - moved[1]).norm(dim=-1)
    assert shift[:2].max() < 1e-7
    assert shift[2] == pytest.approx(2 * np.sin(0.45) * 0.35 * 0.6, rel=1e-5)  # chord of the wrist's circle


def test_gradients_equal_finite_differences(small_rig):
    skeleton = Skeleton(small_rig).double()
    theta = torch.from_numpy(random_theta(small_rig, 2, seed=4)).requires_grad_()
    root = torch.from_numpy(random_root(2, seed=5)).requires_grad_()
    assert torch.autograd.gradcheck(skeleton, (theta, root))


def test_wrong_number_of_angles_is_refused(small_rig):
    with pytest.raises(ValueError, match=r"theta must be \[B, 5\] for this rig; got \[2, 4\]"):
        Skeleton(small_rig)(torch.zeros(2, 4), torch.eye(4).expand(2, 4, 4))
