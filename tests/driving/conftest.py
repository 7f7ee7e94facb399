"""What the tests of driving share: training frames with a known latent code, and an avatar small enough to decode in milliseconds."""

import numpy as np
import pytest
import torch

from mitsuba_avatar.body.rig import Rig
from mitsuba_avatar.driving.signals import DrivingSignals
from mitsuba_avatar.driving.training_latents import TrainingLatents
from mitsuba_avatar.model.avatar import Avatar, DrivingStatistics
from mitsuba_avatar.settings import ModelSettings
from tests.small_rig import make_small_rig

LATENT_SIZE = 6
MODEL = ModelSettings(
    latent_size=LATENT_SIZE,
    conditioning_size=8,
    latent_channels=(8, 6),
    pose_embedding_channels=4,
    face_embedding_channels=3,
    decoder_channels=(8,),
    geometry_channels=(6,),
    geometry_size=16,
    texture_channels=(6,),
    texture_size=32,
    view_channels=(4,),
    view_size=8,
    encoder_size=16,
    encoder_channels=(4, 6),
    shadow_channels=(4, 4),
)


def make_signals(count: int, seed: int = 0, clips: tuple[slice, ...] = (), fps: float = 10.0) -> DrivingSignals:
    """Smooth angles of the small rig's five joints, a face of three numbers, a root that wanders."""
    phase = torch.arange(count) / fps + seed
    theta = torch.stack([0.4 * torch.sin((k + 1) * 0.7 * phase + k) for k in range(5)], dim=1)
    face = torch.stack([0.01 * torch.cos((k + 2) * phase) for k in range(3)], dim=1)
    root = torch.eye(4).repeat(count, 1, 1)
    root[:, 0, 3] = 0.1 * phase
    return DrivingSignals(theta, root, face, fps, clips)


def make_training(count: int = 120, seed: int = 3) -> TrainingLatents:
    """Codes that follow the first angle with inertia, along a fixed direction, plus a little noise: three clips."""
    clips = (slice(0, count // 3), slice(count // 3, count // 2), slice(count // 2, count))
    signals = make_signals(count, seed, clips)
    generator = torch.Generator().manual_seed(seed)
    direction = torch.randn(LATENT_SIZE, generator=generator)
    state = torch.zeros(count)
    for clip in clips:
        state[clip.start] = 5 * signals.theta[clip.start, 0]
        for frame in range(clip.start + 1, clip.stop):
            state[frame] = 0.8 * state[frame - 1] + signals.theta[frame, 0]
    mu = 0.7 + state[:, None] * direction + 0.02 * torch.randn(count, LATENT_SIZE, generator=generator)
    return TrainingLatents(mu, torch.full_like(mu, -3.0), signals)


@pytest.fixture(scope="session")
def rig() -> Rig:
    return make_small_rig()


@pytest.fixture
def avatar(rig: Rig) -> Avatar:
    """An avatar whose outputs are not zero and depend on everything."""
    torch.manual_seed(1)
    statistics = DrivingStatistics.neutral(rig, 3, MODEL.texture_size)
    made = Avatar(rig, MODEL, statistics)
    with torch.no_grad():
        for parameter in made.parameters():
            parameter.add_(0.05 * torch.randn(parameter.shape))
    return made.eval()


def in_degrees(radians: float) -> float:
    return float(np.degrees(radians))
