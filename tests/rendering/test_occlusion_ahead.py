"""Occlusion baked by a process beside the caller: the same bytes, in the order asked for, and an end that is told."""

import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from mitsuba_avatar.body.rig import Rig
from mitsuba_avatar.rendering.ambient_occlusion import AmbientOcclusion, FrameOcclusion
from mitsuba_avatar.rendering.occlusion_ahead import AT_ONCE, OcclusionAhead

FRAMES = 80
PATIENCE = 60.0  # seconds


@pytest.fixture
def theta() -> np.ndarray:
    return np.random.default_rng(5).uniform(0, 1.5, (FRAMES, 5)).astype(np.float32)


def sequence(rig: Rig, theta: np.ndarray, folder: Path) -> FrameOcclusion:
    return FrameOcclusion(AmbientOcclusion(rig.topology, 24, rays=16), rig, torch.from_numpy(rig.rest_vertices), theta, folder)


def wait_until(condition) -> None:
    deadline = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_maps_are_those_that_the_caller_would_bake_and_nothing_is_left_to_it(
    small_rig: Rig, theta: np.ndarray, tmp_path: Path, monkeypatch
):
    expected = sequence(small_rig, theta, tmp_path / "here").maps([7, 79, 3])
    frames = sequence(small_rig, theta, tmp_path / "ahead")
    monkeypatch.setattr(AmbientOcclusion, "bake", lambda *arguments, **keywords: pytest.fail("baked by the caller"))
    read: list[int] = []

    def order() -> Iterator[int]:
        for frame in (*range(20, FRAMES), 30, *range(FRAMES)):
            read.append(frame)
            yield frame

    ahead = OcclusionAhead(frames, order())
    assert len(read) <= AT_ONCE  # what comes later is not asked for yet
    assert torch.equal(ahead.maps([7, 79, 3]), expected)
    assert ahead.maps([0, 1]).shape == (2, 1, 24, 24)
    worker = ahead._worker
    wait_until(lambda: ahead.maps([7]) is not None and worker.poll() is not None)
    assert worker.returncode == 0  # its work done, it has ended
    assert len(list((tmp_path / "ahead").rglob("*.npy"))) == FRAMES


def test_a_worker_that_is_killed_is_told_of(small_rig: Rig, theta: np.ndarray, tmp_path: Path):
    frames = sequence(small_rig, theta, tmp_path)
    ahead = OcclusionAhead(frames, range(FRAMES))
    ahead.maps([2])
    os.kill(ahead._worker.pid, signal.SIGKILL)
    with pytest.raises(ChildProcessError, match="ended with status -9.*Maps baked so far are kept"):
        for frame in range(FRAMES):
            ahead.maps([frame])
    assert frames.is_baked(2)
    assert ahead.maps([FRAMES - 1]).shape == (1, 1, 24, 24)  # by the caller, who would go on


def test_a_closed_worker_ends_and_the_caller_bakes_what_is_missing(small_rig: Rig, theta: np.ndarray, tmp_path: Path):
    ahead = OcclusionAhead(sequence(small_rig, theta, tmp_path), range(FRAMES))
    worker = ahead._worker
    ahead.close()
    ahead.close()
    assert worker.poll() is not None
    assert ahead.maps([FRAMES - 1]).std() > 0


def test_a_worker_does_not_outlive_its_caller(small_rig: Rig, theta: np.ndarray, tmp_path: Path):
    """Its standard input ends with the caller, however that ends."""
    ahead = OcclusionAhead(sequence(small_rig, theta, tmp_path), range(FRAMES))
    ahead._worker.stdin.close()
    assert ahead._worker.wait(PATIENCE) == 0
