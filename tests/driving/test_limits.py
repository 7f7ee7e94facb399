"""Driving out of range: held, projected, reported."""

import dataclasses

import numpy as np
import pytest
import torch

from mitsuba_avatar.driving.limits import RangeReport, TrainingSubspace, clamped, projected
from tests.driving.conftest import in_degrees, make_signals


def test_angles_beyond_the_limits_are_held_and_counted(rig):
    signals = make_signals(6)
    theta = signals.theta.clamp(torch.from_numpy(rig.dofs.lower), torch.from_numpy(rig.dofs.upper)).clone()
    theta[2, 1], theta[3, 1], theta[3, 4] = 1.5 + 0.2, 1.5 + 0.4, -0.5 - 0.1  # twist up to 1.5, deviation from -0.5
    held, report = clamped(dataclasses.replace(signals, theta=theta), rig)
    assert held.theta[3, 1].item() == pytest.approx(1.5) and held.theta[3, 4].item() == pytest.approx(-0.5)
    assert report.changed_frames == 2 and list(report.largest) == ["base_twist", "wrist_deviation"]
    assert report.largest["base_twist"] == pytest.approx(0.4, abs=1e-5) and report.mean == pytest.approx(0.7 / 3, abs=1e-5)
    assert (
        f"changed 2 of 5 angles in 2 of 6 frames, by {in_degrees(0.7 / 3):.1f} degrees on average; farthest base_twist 22.9"
        in report.summary()
    )
    assert torch.equal(held.face, signals.face) and torch.equal(held.root, signals.root)


def test_angles_in_range_are_left_alone():
    report = RangeReport.compare("held", ("a", "b"), torch.zeros(3, 2), torch.zeros(3, 2))
    assert report.summary() == "held: all 2 angles of 3 frames were in range"


def test_a_projection_keeps_training_poses_and_brings_others_into_their_span(rig):
    training = make_signals(80)
    flat = training.theta.clone()
    flat[:, 3:] = torch.stack([0.5 * flat[:, 0], -0.3 * flat[:, 1]], dim=1)  # three directions of freedom in five angles
    lower, upper = torch.from_numpy(rig.dofs.lower), torch.from_numpy(rig.dofs.upper)
    training = dataclasses.replace(training, theta=flat.clamp(lower, upper))
    inside, _ = projected(training, training, rig)
    assert (inside.theta - training.theta).abs().max() < 0.12
    wild = dataclasses.replace(training, theta=training.theta + torch.tensor([0.0, 0.0, 0.0, 0.6, 0.0]))
    brought, report = projected(wild, training, rig)
    away = (wild.theta[:, 3] - 0.5 * wild.theta[:, 0]).abs().mean()
    assert (brought.theta[:, 3] - 0.5 * brought.theta[:, 0]).abs().mean() < 0.4 * away
    assert report.changed_frames == 80 and "projected onto the training poses" in report.summary()


def test_a_projection_ends_where_the_training_frames_ended():
    rng = np.random.default_rng(0)
    values = torch.from_numpy(rng.uniform(-1, 1, (200, 1)) @ np.array([[0.6, 0.8, 0.0]])).float()
    space = TrainingSubspace.of(values)
    assert space.directions.shape == (1, 3)
    far = space.project(torch.tensor([[6.0, 8.0, 3.0], [0.3, 0.4, 0.0]]))
    assert far[0].norm().item() == pytest.approx(1.25, abs=0.05) and far[0, 2].abs() < 1e-5
    torch.testing.assert_close(far[1], torch.tensor([0.3, 0.4, 0.0]), atol=1e-5, rtol=0)
