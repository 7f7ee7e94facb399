"""Losses: values by hand, zero at the target, sign symmetry, units that do not change with size, gradients, schedule."""

import math

import pytest
import torch

from mitsuba_avatar.body.mesh import Laplacian
from mitsuba_avatar.body.rig import Topology
from mitsuba_avatar.model.encoder import Posterior
from mitsuba_avatar.settings import LossSettings
from mitsuba_avatar.training import losses
from mitsuba_avatar.training.losses import (
    LossInputs,
    evaluate_losses,
    geometry_loss,
    image_loss,
    kl_loss,
    laplacian_loss,
    loss_weights,
    mask_loss,
    perturbation_loss,
    weighted_sum,
)
from tests.small_rig import make_small_rig


@pytest.fixture(scope="module")
def topology() -> Topology:
    return make_small_rig().topology


def make_images() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Two images of 4 x 6 pixels, targets and a mask over part of them (10 of 48 pixels)."""
    generator = torch.Generator().manual_seed(0)
    mask = torch.zeros(2, 1, 4, 6)
    mask[0, 0, 1:3, 1:4], mask[1, 0, :, 5] = 1, 1
    return torch.rand((2, 3, 4, 6), generator=generator), torch.rand((2, 3, 4, 6), generator=generator), mask


def make_meshes(topology: Topology) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(1)
    shape = (2, topology.num_vertices, 3)
    return torch.randn(shape, generator=generator), torch.randn(shape, generator=generator)


def test_image_loss_by_hand():
    target, mask = torch.full((2, 3, 4, 6), 0.4), torch.zeros(2, 1, 4, 6)
    mask[1, 0, 2, 1:5] = 1.0  # four foreground pixels
    image = target.clone()
    image[1, 0, 2, 3] += 0.3  # inside
    image[0, 2, 0, 0] -= 0.5  # outside counts too
    assert float(image_loss(image, target, mask)) == pytest.approx(0.8 / (3 * 4))


def test_mask_loss_by_hand():
    target, mask = torch.zeros(2, 1, 4, 6), torch.zeros(2, 1, 4, 6)
    target[0, 0, 1, :5] = 1.0
    mask[0, 0, 1, :4], mask[0, 0, 3, 3] = 1.0, 0.5  # one pixel missing, half a pixel too much
    assert float(mask_loss(mask, target)) == pytest.approx((1.0 + 0.25) / 5)


def test_a_view_without_the_person_gives_no_division_by_zero():
    image, target, mask = make_images()
    assert float(image_loss(image, target, torch.zeros_like(mask))) == pytest.approx(float((image - target).abs().sum() / 3), rel=1e-5)


def test_more_background_changes_nothing():
    image, target, mask = make_images()
    wider = [torch.nn.functional.pad(values, (3, 5, 2, 0)) for values in (image, target, mask)]
    torch.testing.assert_close(image_loss(*wider), image_loss(image, target, mask))
    torch.testing.assert_close(mask_loss(wider[2], wider[2] * 0.5), mask_loss(mask, mask * 0.5))


def test_geometry_loss_is_in_square_centimetres():
    tracked = torch.randn(2, 5, 3)
    vertices = tracked.clone()
    vertices[0, 3] += torch.tensor([0.03, 0.0, -0.04])  # 5 cm
    assert float(geometry_loss(vertices, tracked)) == pytest.approx(25.0 / 10, rel=1e-4)


def test_laplacian_loss_by_hand(topology):
    _, tracked = make_meshes(topology)
    vertices = tracked.clone()
    vertices[1, 40, 2] += 0.02
    neighbours = {int(v) for face in topology.faces if 40 in face for v in face} - {40}
    degrees = [len({int(v) for face in topology.faces if neighbour in face for v in face} - {neighbour}) for neighbour in neighbours]
    expected = 4.0 * (1 + sum(1 / degree**2 for degree in degrees)) / (2 * topology.num_vertices)
    assert float(laplacian_loss(vertices, tracked, Laplacian(topology))) == pytest.approx(expected, rel=1e-4)


def test_laplacian_loss_does_not_see_a_translation(topology):
    _, tracked = make_meshes(topology)
    assert float(laplacian_loss(tracked + torch.tensor([0.1, -0.2, 0.3]), tracked, Laplacian(topology))) < 1e-6


def test_kl_loss_by_hand_and_against_torch():
    posterior = Posterior(mu=torch.tensor([[1.0, 0.0], [0.0, -2.0]]), logvar=torch.tensor([[0.0, math.log(4.0)], [0.0, -1.0]]))
    first, second = 0.5 * (1 + 3 - math.log(4.0)), 0.5 * (4 + math.exp(-1.0))
    assert float(kl_loss(posterior)) == pytest.approx((first + second) / 2)
    gaussian = torch.distributions.Normal(posterior.mu, (0.5 * posterior.logvar).exp())
    reference = torch.distributions.kl_divergence(gaussian, torch.distributions.Normal(0.0, 1.0)).sum(-1).mean()
    torch.testing.assert_close(kl_loss(posterior), reference)


def test_every_term_is_zero_at_its_target_and_only_there(topology):
    image, target, mask = make_images()
    vertices, tracked = make_meshes(topology)
    laplacian = Laplacian(topology)
    assert image_loss(target, target, mask) == 0 < image_loss(image, target, mask)
    assert mask_loss(mask, mask) == 0 < mask_loss(mask * 0.9, mask)
    assert geometry_loss(tracked, tracked) == 0 < geometry_loss(vertices, tracked)
    assert laplacian_loss(tracked, tracked, laplacian) == 0 < laplacian_loss(vertices, tracked, laplacian)
    assert kl_loss(Posterior(torch.zeros(2, 3), torch.zeros(2, 3))) == 0 < kl_loss(Posterior(torch.zeros(2, 3), torch.ones(2, 3)))


def test_terms_are_symmetric_in_the_sign_of_the_error(topology):
    image, target, mask = make_images()
    vertices, tracked = make_meshes(topology)
    laplacian = Laplacian(topology)
    torch.testing.assert_close(image_loss(image, target, mask), image_loss(2 * target - image, target, mask))
    torch.testing.assert_close(geometry_loss(vertices, tracked), geometry_loss(2 * tracked - vertices, tracked))
    torch.testing.assert_close(laplacian_loss(vertices, tracked, laplacian), laplacian_loss(2 * tracked - vertices, tracked, laplacian))
    torch.testing.assert_close(mask_loss(mask + 0.1, mask), mask_loss(mask - 0.1, mask))
    mu = torch.randn(2, 3)
    torch.testing.assert_close(kl_loss(Posterior(mu, torch.zeros(2, 3))), kl_loss(Posterior(-mu, torch.zeros(2, 3))))


def test_gradients_equal_finite_differences(topology):
    check = torch.autograd.gradcheck
    image, target, mask = (values.double() for values in make_images())
    assert check(lambda values: image_loss(values, target, mask), image.requires_grad_())
    assert check(lambda values: mask_loss(values, mask), torch.rand_like(mask).requires_grad_())
    mu, logvar = (torch.randn(2, 3, dtype=torch.float64, requires_grad=True) for _ in range(2))
    assert check(lambda *values: kl_loss(Posterior(*values)), (mu, logvar))
    vertices, tracked = (values[:, :, :].double() for values in make_meshes(topology))
    laplacian = Laplacian(topology).double()
    for loss in (lambda values: geometry_loss(values, tracked), lambda values: laplacian_loss(values, tracked, laplacian)):
        assert check(loss, vertices.requires_grad_(), fast_mode=True)


def test_mesh_supervision_steps_back_after_its_iterations():
    settings = LossSettings(geometry=2.0, geometry_iterations=10, geometry_after=0.25, mask=0.0, kl=1e-3)
    assert loss_weights(settings, 9) == {"image": 1.0, "geometry": 2.0, "laplacian": 1.0, "kl": 1e-3}
    assert loss_weights(settings, 10)["geometry"] == 0.5
    assert "geometry" not in loss_weights(LossSettings(geometry_iterations=10, geometry_after=0.0), 10)


def test_the_kl_term_warms_up_in_equal_steps():
    settings = LossSettings(kl=1e-3, kl_warm_up=4)
    weights = [loss_weights(settings, iteration)["kl"] for iteration in range(6)]
    assert weights == pytest.approx([2.5e-4, 5e-4, 7.5e-4, 1e-3, 1e-3, 1e-3])
    assert loss_weights(LossSettings(kl=1e-3), 0)["kl"] == 1e-3


def test_only_terms_with_a_weight_are_evaluated(monkeypatch):
    monkeypatch.setattr(losses, "mask_loss", None)  # calling it would raise
    image, target, mask = make_images()
    terms = evaluate_losses(LossInputs(image=image, target_image=target, target_mask=mask), {"image": 2.0})
    assert list(terms) == ["image"]
    torch.testing.assert_close(terms["image"], image_loss(image, target, mask))


def test_the_loss_is_the_weighted_sum_of_all_terms(topology):
    image, target, mask = make_images()
    vertices, tracked = make_meshes(topology)
    posterior, laplacian = Posterior(torch.randn(2, 3), torch.randn(2, 3)), Laplacian(topology)
    weights = {"image": 2.0, "mask": 0.5, "geometry": 3.0, "laplacian": 0.25, "kl": 0.1}
    inputs = LossInputs(image, mask * 0.5, target, mask, vertices, tracked, posterior, laplacian)
    terms = evaluate_losses(inputs, weights)
    expected = (
        2.0 * image_loss(image, target, mask)
        + 0.5 * mask_loss(mask * 0.5, mask)
        + 3.0 * geometry_loss(vertices, tracked)
        + 0.25 * laplacian_loss(vertices, tracked, laplacian)
        + 0.1 * kl_loss(posterior)
    )
    torch.testing.assert_close(weighted_sum(terms, weights), expected)


def test_a_term_that_lacks_its_target_is_refused_by_name():
    with pytest.raises(ValueError, match=r"the term 'geometry' needs \['tracked_vertices'\]; got None.*set loss.geometry to 0"):
        evaluate_losses(LossInputs(vertices=torch.zeros(2, 4, 3)), {"geometry": 1.0})


def test_perturbation_loss_by_hand():
    """Two poses, two keypoints; one is 3 cm off along x and 4 cm along z."""
    driven = torch.randn((2, 2, 3), generator=torch.Generator().manual_seed(0))
    keypoints = driven.clone().requires_grad_()
    shifted = keypoints + torch.tensor([[[0.0, 0, 0], [0.03, 0, 0.04]], [[0.0, 0, 0], [0, 0, 0]]])
    loss = perturbation_loss(shifted, driven)
    assert float(loss.detach()) == pytest.approx(25 / 4, rel=1e-4)
    loss.backward()
    assert (keypoints.grad.abs().sum(-1) > 0).tolist() == [[False, True], [False, False]]


def test_disentangling_terms_count_where_they_have_a_weight():
    settings = LossSettings(0.0, 0.0, 0.0, 0.0, 0.0, mutual_information=0.2, perturbation=3.0)
    weights = loss_weights(settings, 0)
    keypoints = torch.tensor([[[0.01, 0.0, 0.0]]])
    inputs = LossInputs(mutual_information=torch.tensor(1.5), keypoints=keypoints, driven_keypoints=torch.zeros(1, 1, 3))
    terms = evaluate_losses(inputs, weights)
    assert {name: pytest.approx(float(value)) for name, value in terms.items()} == {"mutual_information": 1.5, "perturbation": 1.0}
    assert float(weighted_sum(terms, weights)) == pytest.approx(0.2 * 1.5 + 3.0)
    with pytest.raises(ValueError, match="the term 'perturbation' needs"):
        evaluate_losses(LossInputs(mutual_information=torch.tensor(1.5)), weights)
