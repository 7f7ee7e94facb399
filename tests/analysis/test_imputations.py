"""Figures of imputations: on an avatar whose surface follows its code in a known way, they are known."""

import dataclasses
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import torch

from mitsuba_avatar.analysis.imputations import drive_of_capture, imputation_figures
from mitsuba_avatar.analysis.measures import Study
from mitsuba_avatar.driving.imputation import ImputationName
from mitsuba_avatar.driving.training_latents import TrainingLatents
from mitsuba_avatar.loaded_run import LoadedRun

pytestmark = pytest.mark.usefixtures("one_thread", "private_cache")


@pytest.fixture(scope="module")
def loaded(fitted_run: Path) -> LoadedRun:
    return LoadedRun.open(fitted_run)


@pytest.fixture(scope="module")
def training(loaded: LoadedRun) -> TrainingLatents:
    return TrainingLatents.encode(loaded.avatar, loaded.capture)


@pytest.fixture
def study(loaded: LoadedRun, training: TrainingLatents, monkeypatch: pytest.MonkeyPatch) -> Study:
    """The first entry of the code moves vertices 2, 3 and 5, which are the clothes, by a millimetre a unit along x; nothing else moves."""
    study = dataclasses.replace(Study.of(loaded.avatar, loaded.run.rig, loaded.capture), garment=np.array([2, 3, 5]))

    def decode(theta, face, z):
        surface = loaded.avatar.template_vertices.repeat(len(theta), 1, 1)
        if z is not None:
            surface[:, study.garment, 0] += 1e-3 * z[:, :1]
        return surface

    monkeypatch.setattr(loaded.avatar, "decode_rest_vertices", decode)
    return study


def test_every_imputation_is_measured_against_the_likely_code_and_from_frame_to_frame(loaded, study, training):
    drive = drive_of_capture(loaded.run, loaded.avatar, loaded.capture.path, training, split="train")
    assert drive.setting == "matched"
    figures = imputation_figures(study, training, drive.signals, seed=3)
    assert set(figures) == set(get_args(ImputationName))
    drawn = torch.randn(len(drive.signals), training.mu.shape[1], generator=torch.Generator().manual_seed(3))[:, 0]
    assert figures["prior"]["moved_mm"] == pytest.approx(float(drawn.abs().mean()), rel=1e-4)
    assert figures["prior"]["step_mm"] == pytest.approx(float(drawn.diff().abs().mean()), rel=1e-4), "one clip"
    assert figures["zero"]["moved_mm"] == figures["zero"]["step_mm"] == figures["clip"]["step_mm"] == 0
    assert figures["clip"]["moved_mm"] == pytest.approx(abs(float(drawn[0])), rel=1e-4)
    assert figures["mean"]["moved_mm"] == pytest.approx(abs(float(training.mu[:, 0].mean())), rel=1e-4)
    assert figures["nearest"]["moved_mm"] == pytest.approx(float(training.mu[:, 0].abs().mean()), rel=1e-4), "each frame finds itself"


def test_a_code_that_moves_the_joints_is_found(loaded, study, training, monkeypatch):
    signals = drive_of_capture(loaded.run, loaded.avatar, loaded.capture.path, training).signals
    faithful = imputation_figures(study, training, signals)

    def decode(theta, face, z):
        return loaded.avatar.template_vertices + (0.0 if z is None else 1e-3 * z[:, :1, None])

    monkeypatch.setattr(loaded.avatar, "decode_rest_vertices", decode)
    led_astray = imputation_figures(study, training, signals)
    assert faithful["prior"]["body_keypoints_mm"] < 0.5 < led_astray["prior"]["body_keypoints_mm"]
    assert led_astray["zero"]["body_keypoints_mm"] == pytest.approx(faithful["zero"]["body_keypoints_mm"], abs=1e-4)


def test_where_the_true_surface_is_known_clothes_are_measured_against_it(loaded, study, training):
    signals = drive_of_capture(loaded.run, loaded.avatar, loaded.capture.path, training).signals
    exact = loaded.avatar.pose_template(signals.theta, signals.root).detach().numpy()
    exact[:, study.garment] += np.array([0.0, 0.0, 2e-3], np.float32)
    exact[:, 0] += 1.0  # no clothes
    figures = imputation_figures(study, training, signals, exact=exact)
    assert figures["zero"]["from_truth_mm"] == pytest.approx(2, rel=1e-3)
    assert figures["prior"]["from_truth_mm"] > 2
    assert imputation_figures(study, training, signals)["zero"]["from_truth_mm"] is None
