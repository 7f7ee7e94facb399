"""An avatar whose hidden layers compute in bfloat16: near float32 in values and gradients, and only in training."""

import torch
from torch import Tensor, nn


def in_both(avatar: nn.Module, compute) -> tuple:
    """What `compute()` gives in float32 and in mixed precision."""
    exact = compute()
    avatar.mixed_precision = True
    mixed = compute()
    avatar.mixed_precision = False
    return exact, mixed


def relative_error(values: Tensor, exact: Tensor, origin: Tensor) -> float:
    """Root mean square error, of what the networks add to an untrained avatar."""
    return float(((values - exact).square().mean() / (exact - origin).square().mean()).sqrt().detach())


def test_what_networks_add_is_off_by_a_few_thousandths_and_not_at_all_when_evaluated(make_avatar, drive):
    avatar, z = make_avatar().train(), torch.randn(2, 16)
    exact, mixed = in_both(avatar, lambda: avatar.decode(**drive, z=z))
    assert {values.dtype for values in vars(mixed).values()} == {torch.float32}
    for name, origin in (("rest_vertices", avatar.template_vertices), ("textures", avatar.mean_texture), ("gain", torch.ones(()))):
        assert 1e-5 < relative_error(getattr(mixed, name), getattr(exact, name), origin) < 0.02
    exact, mixed = in_both(avatar.eval(), lambda: avatar.decode(**drive, z=z))
    assert all(torch.equal(value, vars(mixed)[name]) for name, value in vars(exact).items())


def test_posing_stays_in_full_precision(make_avatar, drive):
    """A matrix of joints in bfloat16 would put a hand a centimetre off."""
    avatar = make_avatar(trained=False).train()
    avatar.mixed_precision = True
    output = avatar.decode(**drive, z=torch.randn(2, 16))
    assert torch.equal(output.vertices, avatar.pose_template(drive["theta"], drive["root"]))


def test_posteriors_are_near(make_avatar):
    avatar = make_avatar().train()
    surface = avatar.template_vertices + 0.01 * torch.randn(3, *avatar.template_vertices.shape)
    exact, mixed = in_both(avatar, lambda: avatar.encode(surface))
    assert mixed.mu.dtype == mixed.logvar.dtype == torch.float32
    torch.testing.assert_close(mixed.divergence(), exact.divergence(), rtol=0.02, atol=0)
    assert not torch.equal(mixed.mu, exact.mu)


def test_gradients_point_the_same_way_and_are_in_full_precision(make_avatar, drive):
    avatar, z = make_avatar().train(), torch.randn(2, 16)

    def gradients() -> list[Tensor]:
        output = avatar.decode(**drive, z=z)
        loss = 100 * output.vertices.square().mean() + output.textures.square().mean()
        return torch.autograd.grad(loss, list(avatar.decoder.parameters()) + list(avatar.shadow.parameters()))

    exact, mixed = in_both(avatar, gradients)
    for one, other in zip(exact, mixed, strict=True):
        assert other.dtype == torch.float32
        assert float(nn.functional.cosine_similarity(one.flatten(), other.flatten(), dim=0)) > 0.99
