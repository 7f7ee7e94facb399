"""Driving signals: their frames, clips and what is refused."""

import dataclasses

import numpy as np
import pytest
import torch

from mitsuba_avatar.driving.signals import DrivingSignals, consecutive_runs
from tests.driving.conftest import make_signals


def test_runs_end_where_a_frame_is_missing_or_the_label_changes():
    assert consecutive_runs([4, 5, 7, 8, 9], ["a", "a", "a", "a", "b"]) == (slice(0, 2), slice(2, 4), slice(4, 5))


def test_chosen_frames_keep_their_clips_apart():
    signals = make_signals(10, clips=(slice(0, 4), slice(4, 10)))
    chosen = signals.chosen([2, 3, 4, 5, 9])
    assert chosen.clips == (slice(0, 2), slice(2, 4), slice(4, 5))
    assert torch.equal(chosen.theta, signals.theta[[2, 3, 4, 5, 9]]) and torch.equal(
        chosen.root[:, 0, 3], signals.root[[2, 3, 4, 5, 9], 0, 3]
    )


def test_signals_of_a_capture_are_those_of_its_files(drawn_capture):
    signals = DrivingSignals.of_capture(drawn_capture, drawn_capture.frame_indices("test"))
    assert len(signals) == 2 and signals.fps == 10.0 and signals.clips == (slice(0, 2),)
    np.testing.assert_array_equal(signals.theta.numpy(), drawn_capture.theta[8:])
    both = DrivingSignals.of_capture(drawn_capture)
    assert both.clips == (slice(0, 8), slice(8, 10)), "train and test are other segments"


def test_a_turn_of_the_world_moves_the_root_after_the_pose():
    signals = make_signals(3)
    turn = np.tile(np.array([[0, -1, 0, 2], [1, 0, 0, 0], [0, 0, 1, 0.5], [0, 0, 0, 1]], np.float64), (3, 1, 1))
    moved = signals.turned(turn)
    assert moved.root[2, :3, 3].tolist() == pytest.approx([2.0, float(signals.root[2, 0, 3]), 0.5])
    assert torch.equal(moved.theta, signals.theta)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fps": 0.0}, "positive frame rate; got 0"),
        ({"clips": (slice(0, 2), slice(3, 4))}, "clips that cover 4 frames once"),
        ({"theta": torch.full((4, 5), float("nan"))}, "expected finite theta"),
        ({"face": torch.zeros(3, 3)}, "one row for each frame"),
    ],
)
def test_what_cannot_drive_is_refused(change, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(make_signals(4), **change)
