"""What a run is measured by, on a fitted avatar and on constructed ones whose answer is known."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from mitsuba_avatar.analysis.measures import (
    Splits,
    Study,
    disentanglement,
    geometry_errors,
    image_errors,
    spurious_effects,
)
from mitsuba_avatar.captures.arrays import save_frame_array
from mitsuba_avatar.captures.folder import Capture
from mitsuba_avatar.filming.truth import GARMENT
from mitsuba_avatar.loaded_run import LoadedRun
from mitsuba_avatar.reporting.metrics import psnr_from_mse

pytestmark = pytest.mark.usefixtures("one_thread", "private_cache")


@pytest.fixture(scope="module")
def loaded(fitted_run: Path) -> LoadedRun:
    return LoadedRun.open(fitted_run)


@pytest.fixture
def study(loaded: LoadedRun) -> Study:
    return Study.of(loaded.avatar, loaded.run.rig, loaded.capture)


def test_stress_frames_are_a_split_of_their_own(loaded: LoadedRun):
    capture = Capture.open(loaded.capture.path)
    capture.frames = tuple(dataclasses.replace(frame, segment="stress_x") if i == 9 else frame for i, frame in enumerate(capture.frames))
    assert Splits.of(capture, 3).frames == {"train": [0, 4, 7], "test": [8], "stress": [9]}


def test_image_errors_are_those_of_the_evaluation(loaded: LoadedRun):
    evaluator = loaded.evaluator()
    errors = image_errors(evaluator, Splits({"test": [8, 9]}))["test"]
    means = evaluator.measure({"test": [8, 9]}, ["avatar"]).means()["avatar"]["test"]
    mse = (4 * means["seen"]["mse"] + means["held_out"]["mse"]) / 5  # of five cameras one is held out
    assert errors["mse"] == pytest.approx(mse, rel=1e-6) and errors["held_out_mse"] == pytest.approx(means["held_out"]["mse"], rel=1e-6)
    assert errors["psnr"] == pytest.approx(psnr_from_mse(mse)) and errors["pictures"] == 10


def test_geometry_is_measured_against_the_truth_where_there_is_one(study: Study):
    noise = np.random.default_rng(0).normal(size=study.exact.shape).astype(np.float32)
    noise *= 0.004 / np.linalg.norm(noise, axis=-1, keepdims=True)
    exact = study.exact + noise
    garment = np.arange(7)
    off = np.array(exact)
    off[:, garment] += noise[:, garment]
    errors = geometry_errors(dataclasses.replace(study, exact=off, garment=garment), most=2)["train"]
    assert errors["registered_garment_mm"] == pytest.approx(8.0, rel=1e-3)
    assert 4.0 < errors["registered_mm"] < 8.0
    assert errors["driven_mm"] > 0 and errors["decoded_mm"] > 0


def test_truth_and_garment_are_read_from_the_captures_truth(loaded: LoadedRun, tmp_path: Path):
    capture = Capture.open(loaded.capture.path)
    truth = tmp_path / "truth"
    truth.mkdir()
    save_frame_array(truth, "vertices", np.asarray(capture.vertices) + 1, len(capture.frames))
    np.save(truth / GARMENT, np.array([3, 5]))
    capture.path = tmp_path
    study = Study.of(loaded.avatar, loaded.run.rig, capture)
    np.testing.assert_allclose(study.exact, np.asarray(capture.vertices) + 1)
    assert np.flatnonzero(study.groups()["garment"]).tolist() == [3, 5]


def test_an_avatar_without_latent_code_is_measured_by_spurious_effects_alone(study: Study):
    assert set(disentanglement(dataclasses.replace(study, posterior=None))) == {"spurious"}
    assert {"kl_nats", "active_entries", "latent_swap", "drive_swap", "spurious"} <= set(disentanglement(study))


def test_a_face_that_moves_the_body_is_found(study: Study, monkeypatch: pytest.MonkeyPatch):
    def leaking(theta, face, z):
        offset = torch.zeros(len(theta), study.rig.topology.num_vertices, 3)
        offset[:, :, 0] = 0.01 * face.sum(1, keepdim=True) / study.drive.face.sum(1).std()
        return study.avatar.template_vertices + offset

    honest = spurious_effects(study)
    monkeypatch.setattr(study.avatar, "decode_rest_vertices", leaking)
    leak = spurious_effects(study)
    assert leak["face_moves_body_mm"] > 5 > honest["face_moves_body_mm"]
    assert leak["pose_moves_face_mm"] == 0
