"""Data-parallel training: each rank's device, and two CPU ranks against one process."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from mitsuba_avatar.fit import main
from mitsuba_avatar.reporting.metrics import read_records
from mitsuba_avatar.training.distributed import Process, claim_device, join_processes, leave_processes
from mitsuba_avatar.training.run_folder import RunFolder

pytestmark = pytest.mark.usefixtures("one_thread")

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize(
    ("environment", "process", "devices"),
    [
        ({}, Process(0, 1), None),
        ({"CUDA_VISIBLE_DEVICES": "3,4"}, Process(0, 1), "3,4"),
        ({"RANK": "1", "WORLD_SIZE": "2", "LOCAL_RANK": "1"}, Process(1, 2), "1"),
        ({"RANK": "5", "WORLD_SIZE": "8", "LOCAL_RANK": "1", "CUDA_VISIBLE_DEVICES": "3,4"}, Process(5, 8), "4"),
    ],
)
def test_each_rank_claims_one_device(monkeypatch, environment, process, devices):
    for name in ("RANK", "WORLD_SIZE", "LOCAL_RANK", "CUDA_VISIBLE_DEVICES"):
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    assert claim_device() == process and os.environ.get("CUDA_VISIBLE_DEVICES") == devices
    assert process.is_main == (process.rank == 0) and process.is_distributed == (process.num_ranks > 1)


def test_a_single_process_joins_nobody():
    join_processes(Process(), on_gpu=False)
    assert not torch.distributed.is_initialized()
    leave_processes(Process())


def test_two_ranks_train_like_one(drawn_capture, private_cache, tmp_path):
    """The same global batches of two poses, one on each rank: the same losses within the noise of the renderer's samples."""
    words = ["--config", "tiny", "--capture", str(drawn_capture.path), "training.iterations=10", "training.checkpoint_every=10"]
    words += ["training.validate_every=10", "training.preview_every=10", "training.learning_rate=2e-3"]
    words += ["evaluation.frames_per_split=1", "evaluation.orbit_frames=1", "evaluation.samples_per_pixel=1"]
    words += ["loss.mutual_information=0.1", "loss.perturbation=0.1"]
    assert main([*words, "--run", str(tmp_path / "one")]) == 0
    launcher = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc_per_node", "2", "-m", "mitsuba_avatar.fit"]
    ended = subprocess.run(
        [*launcher, *words, "--run-folder", str(tmp_path / "two")],
        env=os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )
    assert ended.returncode == 0, ended.stderr
    assert ended.stderr.count("Done in") == 1, "one rank speaks"
    assert "Warning" not in ended.stderr
    (one,), (two,) = (read_records(tmp_path / name / "metrics.jsonl") for name in ("one", "two"))
    tolerances = {"image": 0.05, "mask": 0.1, "geometry": 0.05, "laplacian": 0.15, "loss": 0.05}
    tolerances |= {"kl": 0.5, "perturbation": 1.0}  # nearly zero here: the encoder begins near the prior, keypoints settle in a few steps
    for term, tolerance in tolerances.items():
        assert two[term] == pytest.approx(one[term], rel=tolerance), term
    assert two["validation_psnr"] == pytest.approx(one["validation_psnr"], abs=0.2)
    first, second = (RunFolder.open(tmp_path / name).load_avatar("last").state_dict() for name in ("one", "two"))
    assert first.keys() == second.keys()
    states = [RunFolder.open(tmp_path / name).checkpoints.load_training()[1]["mutual_information"] for name in ("one", "two")]
    assert states[0]["numbers"][0] == states[1]["numbers"][0] == 20, "the memory holds the poses of both ranks"
    (mu, logvar, driving), (other_mu, other_logvar, other_driving) = (state["memory"] for state in states)
    assert mu[:20].all(dim=1).all()
    torch.testing.assert_close(driving, other_driving)
    torch.testing.assert_close((mu, logvar), (other_mu, other_logvar), rtol=0, atol=0.05)
    difference = torch.cat([(first[name] - second[name]).abs().flatten() for name in first])
    assert difference.mean() < 1e-3, f"ten steps of at most 2e-3 each, and {difference.mean():.1e} apart"
