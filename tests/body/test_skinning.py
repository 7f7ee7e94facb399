"""Skinning against a float64 reference, its inverse, finite differences."""

import numpy as np
import pytest
import torch

from mitsuba_avatar.body.skeleton import Skeleton
from mitsuba_avatar.body.skinning import pose_vertices, rest_directions_from_posed, unpose_vertices
from tests.body import reference
from tests.body.test_skeleton import random_root, random_theta


def posed(rig, batch: int, seed: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Rest vertices with noise [B, V, 3], transforms [B, J, 4, 4] and weights, float64."""
    skeleton = Skeleton(rig).double()
    transforms = skeleton(torch.from_numpy(random_theta(rig, batch, seed)), torch.from_numpy(random_root(batch, seed + 1)))
    noise = np.random.default_rng(seed).normal(scale=0.01, size=(batch, *rig.rest_vertices.shape))
    return torch.from_numpy(rig.rest_vertices + noise), transforms, torch.from_numpy(rig.skinning_weights).double()


@pytest.mark.parametrize("name", ["small_rig", "anny_rig"])
def test_posing_equals_the_reference_and_unposing_undoes_it(name, request):
    rig = request.getfixturevalue(name)
    rest, transforms, weights = posed(rig, 2, seed=6)
    vertices = pose_vertices(rest, transforms, weights)
    for sample in range(2):
        expected = reference.pose_vertices(rest[sample].numpy(), transforms[sample].numpy(), rig.skinning_weights)
        np.testing.assert_allclose(vertices[sample].numpy(), expected, atol=1e-9)
    torch.testing.assert_close(unpose_vertices(vertices, transforms, weights), rest, atol=1e-6, rtol=0)


def test_unposing_in_single_precision_is_good_to_a_tenth_of_a_millimetre(anny_rig):
    rest, transforms, weights = (tensor.float() for tensor in posed(anny_rig, 2, seed=7))
    vertices = pose_vertices(rest, transforms, weights)
    assert (unpose_vertices(vertices, transforms, weights) - rest).norm(dim=-1).max() < 1e-4


def test_gradients_equal_finite_differences(small_rig):
    rest, transforms, weights = posed(small_rig, 2, seed=8)
    few = torch.arange(0, 258, 37)
    rest, transforms, weights = rest[:, few].requires_grad_(), transforms.requires_grad_(), weights[few]
    assert torch.autograd.gradcheck(lambda a, b: pose_vertices(a, b, weights), (rest, transforms))
    assert torch.autograd.gradcheck(lambda a, b: unpose_vertices(a, b, weights), (rest, transforms))
    assert torch.autograd.gradcheck(lambda a, b: rest_directions_from_posed(a, b, weights), (rest, transforms))


def test_a_surface_folded_flat_is_unposed_to_something_bounded(small_rig):
    theta = torch.zeros(2, 5)
    theta[0, 1] = torch.pi  # half a turn about the base; at equal weights opposite rotations cancel
    transforms = Skeleton(small_rig)(theta, torch.eye(4).expand(2, 4, 4)).clone()
    transforms[0, 1:] = torch.eye(4)
    weights = torch.from_numpy(small_rig.skinning_weights)
    rest = torch.from_numpy(small_rig.rest_vertices).expand(2, -1, -1)
    back = unpose_vertices(pose_vertices(rest, transforms, weights), transforms, weights)
    assert back.isfinite().all()
    torch.testing.assert_close(back[1], rest[1])


def test_directions_turn_back_with_the_surface(small_rig):
    """A direction fixed to a rigid part comes back unchanged, for every view."""
    _, transforms, weights = (tensor.float() for tensor in posed(small_rig, 2, seed=9))
    rest = torch.nn.functional.normalize(torch.randn(2, 3, 258, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    joint = weights.argmax(dim=1)
    rigid = weights.max(dim=1).values == 1
    rotations = transforms[:, joint, :3, :3]  # [B, V, 3, 3]
    directions = (rotations[:, None] @ rest[..., None])[..., 0]
    back = rest_directions_from_posed(directions, transforms, weights)
    assert rigid.sum() > 100
    torch.testing.assert_close(back[:, :, rigid], rest[:, :, rigid], atol=1e-5, rtol=0)
    torch.testing.assert_close(back.norm(dim=-1), torch.ones(2, 3, 258))


def test_other_vertex_and_joint_counts_are_refused(small_rig):
    rest, transforms, weights = posed(small_rig, 2, seed=10)
    for function in (pose_vertices, unpose_vertices, rest_directions_from_posed):
        with pytest.raises(ValueError, match=rf"{function.__name__}\(\): vertices must be \[B, 258, 3\] for this rig; got 257"):
            function(rest[:, 1:], transforms, weights)
        with pytest.raises(ValueError, match=r"skinning_weights must be \[V, 2\]"):
            function(rest, transforms[:, 1:], weights)
