"""Offsets from smooth solves, and the optimizer that goes with them."""

import numpy as np
import torch

from mitsuba_avatar.registration.smooth_offsets import SmoothOffsets, UniformAdam
from tests.small_rig import make_small_rig


def offsets_of(smoothness: float) -> tuple[SmoothOffsets, int]:
    rig = make_small_rig()
    return SmoothOffsets(rig.rest_vertices, rig.topology.faces, smoothness), rig.topology.num_vertices


def test_equal_pulls_pass_unchanged_and_a_single_one_spreads():
    smooth, count = offsets_of(20.0)
    same = torch.tensor([0.01, -0.02, 0.03]).expand(2, count, 3).contiguous()
    torch.testing.assert_close(smooth(same), same, atol=1e-6, rtol=1e-5)
    single = torch.zeros(1, count, 3)
    single[0, 40, 1] = 1.0
    spread = smooth(single)[0, :, 1]
    assert spread.argmax() == 40 and 0 < spread[40] < 0.2 and spread.sum().item() > 0.99
    assert (spread > 0.1 * spread[40]).sum() > 15


def test_gradients_are_those_of_the_linear_map():
    smooth, count = offsets_of(5.0)
    generator = torch.Generator().manual_seed(0)
    unknowns = torch.randn(2, count, 3, generator=generator, dtype=torch.float64, requires_grad=True)
    weights, direction = (torch.randn(2, count, 3, generator=generator, dtype=torch.float64) for _ in range(2))
    (smooth(unknowns) * weights).sum().backward()
    numeric = ((smooth(unknowns + 1e-3 * direction) - smooth(unknowns - 1e-3 * direction)) * weights).sum() / 2e-3
    torch.testing.assert_close((unknowns.grad * direction).sum(), numeric.detach(), rtol=1e-6, atol=1e-8)


def test_loose_pieces_move_with_the_nearest_surface():
    """Two grains inside the tube have no edge to it; a pull on the tube takes them along."""
    rig = make_small_rig()
    count = rig.topology.num_vertices
    grain = np.array([[0, 0, 0.3], [0.01, 0, 0.3], [0, 0.01, 0.31]], np.float32)
    vertices = np.concatenate([rig.rest_vertices, grain])
    faces = np.concatenate([rig.topology.faces, [[count, count + 1, count + 2]]])
    smooth = SmoothOffsets(vertices, faces, 50.0)
    pull = torch.zeros(1, count + 3, 3)
    pull[0, :count, 0] = 0.02
    moved = smooth(pull)[0, count:, 0]
    assert (moved > 0.016).all()


def test_uniform_steps_keep_small_gradients_small_and_let_meshes_rest():
    parameter = torch.zeros(3, 50, 3, requires_grad=True)
    mover = UniformAdam(parameter, learning_rate=0.01)
    for _ in range(4):
        parameter.grad = torch.zeros_like(parameter)
        parameter.grad[0, 7, 2], parameter.grad[0, 8, 2], parameter.grad[2, 1, 0] = 1.0, 0.01, -5.0
        mover.step(1.0)
    moved = parameter.detach()
    assert abs(moved[0, 7, 2].item() + 0.04) < 1e-4
    assert abs(moved[0, 8, 2] / moved[0, 7, 2] - 0.01) < 1e-4, "plain Adam would move both as far"
    assert moved[2, 1, 0] > 0.03 and (moved[1] == 0).all() and parameter.grad is None
