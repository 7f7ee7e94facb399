"""A tiny avatar on the small rig, with a switch to fill every parameter that starts at zero."""

import dataclasses
from collections.abc import Callable

import pytest
import torch

from mitsuba_avatar.body.rig import Rig
from mitsuba_avatar.model.avatar import Avatar, DrivingStatistics
from mitsuba_avatar.presets import resolve
from mitsuba_avatar.settings import ModelSettings
from tests.small_rig import make_small_rig

FACE_SIZE = 6
POSES, CAMERAS = 2, 3


@pytest.fixture(scope="session")
def rig() -> Rig:
    return make_small_rig()


@pytest.fixture(scope="session")
def settings() -> ModelSettings:
    return resolve("tiny").model


@pytest.fixture
def make_avatar(rig: Rig, settings: ModelSettings) -> Callable[..., Avatar]:
    """make_avatar(trained=True, use_latent=False, ...): weights at random where `trained`, as a fresh avatar has them otherwise."""

    def make(trained: bool = True, **changes: object) -> Avatar:
        torch.manual_seed(3)
        avatar = Avatar(rig, dataclasses.replace(settings, **changes), make_statistics(rig, settings))
        if trained:
            for parameter in avatar.parameters():
                if not parameter.any():
                    torch.nn.init.normal_(parameter, std=0.1)
        return avatar

    return make


def make_statistics(rig: Rig, settings: ModelSettings) -> DrivingStatistics:
    """Statistics without symmetries: nothing is zero, no texel like its neighbour."""
    generator = torch.Generator().manual_seed(1)
    neutral = DrivingStatistics.neutral(rig, FACE_SIZE, settings.texture_size)
    return dataclasses.replace(
        neutral,
        theta_mean=0.1 * torch.randn(neutral.theta_mean.shape, generator=generator),
        theta_std=0.1 + torch.rand(neutral.theta_std.shape, generator=generator),
        face_mean=torch.randn(FACE_SIZE, generator=generator),
        mean_texture=0.05 + torch.rand(neutral.mean_texture.shape, generator=generator),
        mean_displacement=0.004 * torch.randn(neutral.mean_displacement.shape, generator=generator),
    )


@pytest.fixture
def drive(rig: Rig, settings: ModelSettings) -> dict[str, torch.Tensor]:
    """Arguments of `Avatar.decode` but for z: two poses, three cameras each."""
    generator = torch.Generator().manual_seed(2)

    def random(*shape: int) -> torch.Tensor:
        return torch.randn(shape, generator=generator)

    angle = torch.tensor([0.4, -1.1])
    root = torch.eye(4).repeat(POSES, 1, 1)
    root[:, 0, 0], root[:, 0, 1], root[:, 1, 0], root[:, 1, 1] = angle.cos(), -angle.sin(), angle.sin(), angle.cos()
    root[:, :3, 3] = random(POSES, 3)
    return {
        "theta": 0.4 * random(POSES, len(rig.dofs.names)),
        "root": root,
        "face": random(POSES, FACE_SIZE),
        "camera_centers": 2.5 * torch.nn.functional.normalize(random(POSES, CAMERAS, 3), dim=-1),
        "ambient_occlusion": torch.rand((POSES, 1, settings.shadow_size, settings.shadow_size), generator=generator),
    }
