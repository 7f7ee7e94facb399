import numpy as np
import pytest
import torch

from mitsuba_avatar.body.rig import Rig
from mitsuba_avatar.body.skeleton import Skeleton
from mitsuba_avatar.filming.film import Performance
from mitsuba_avatar.filming.motion import Motion, perform
from mitsuba_avatar.filming.settings import MotionSettings, StudioSettings

NAMES = ("eyeBlinkLeft", "eyeBlinkRight", "jawOpen", "mouthSmileLeft")


@pytest.fixture(scope="module")
def motion(rig: Rig) -> Motion:
    return perform(rig, StudioSettings(), NAMES)


def test_one_seed_gives_one_motion(rig: Rig, motion: Motion):
    again = perform(rig, StudioSettings(), NAMES)
    for name in ("theta", "root", "actions"):
        np.testing.assert_array_equal(getattr(motion, name), getattr(again, name))
    other = perform(rig, StudioSettings(seed=1), NAMES)
    assert np.abs(other.theta - motion.theta).max() > 0.1


def test_frames_are_counted_per_split_and_segments_are_runs(rig: Rig, motion: Motion):
    splits = [frame.split for frame in motion.frames]
    assert (splits.count("train"), splits.count("test")) == (120, 30)
    assert [frame.number for frame in motion.frames] == list(range(150))
    segments = motion.segments()
    assert (
        segments[0].start == 0 and segments[-1].stop == 150 and all(a.stop == b.start for a, b in zip(segments, segments[1:], strict=False))
    )
    names = {split: {frame.segment for frame in motion.frames if frame.split == split} for split in ("train", "test")}
    assert len(names["train"]) >= 3 and len(names["test"]) >= 2 and not names["train"] & names["test"]


def test_odd_counts_add_up(rig: Rig):
    motion = perform(rig, StudioSettings(motion=MotionSettings(train_frames=7, test_frames=1)), NAMES)
    assert [frame.split for frame in motion.frames].count("train") == 7 and len(motion.theta) == 8


def test_angles_keep_their_limits_and_move_smoothly(rig: Rig, motion: Motion):
    assert (motion.theta >= rig.dofs.lower - 1e-6).all() and (motion.theta <= rig.dofs.upper + 1e-6).all()
    for segment in motion.segments():
        assert np.abs(np.diff(motion.theta[segment], axis=0)).max() < 0.45  # radians a frame, at 10 frames per second
        assert np.linalg.norm(np.diff(motion.root[segment, :3, 3], axis=0), axis=1).max() < 0.12


def test_every_angle_is_used_in_training(rig: Rig, motion: Motion):
    moved = np.ptp(motion.theta[:120], axis=0)
    assert [name for name, range_ in zip(rig.dofs.names, moved, strict=True) if range_ < 0.03] == []


def test_test_poses_are_unlike_training_poses(motion: Motion):
    train, test = motion.theta[:120], motion.theta[120:]
    nearest = np.linalg.norm(test[:, None] - train[None], axis=-1).min(axis=1)
    assert np.median(nearest) > 2 * np.median(np.linalg.norm(np.diff(train, axis=0), axis=1))


def test_arms_are_off_the_torso(rig: Rig, motion: Motion):
    skeleton = Skeleton(rig)
    with torch.no_grad():
        joints = skeleton.posed_joints(skeleton(torch.from_numpy(motion.theta), torch.from_numpy(motion.root))).numpy()
    at = {
        name: joints[:, rig.joint_names.index(name)]
        for name in ("spine05", "spine01", "upperarm01.L", "lowerarm01.L", "upperarm01.R", "lowerarm01.R")
    }
    down = at["spine05"] - at["spine01"]
    for side in "LR":
        arm = at[f"lowerarm01.{side}"] - at[f"upperarm01.{side}"]
        cosine = (arm * down).sum(axis=1) / np.linalg.norm(arm, axis=1) / np.linalg.norm(down, axis=1)
        assert (np.degrees(np.arccos(cosine)) > 20).mean() > 0.9


def test_the_lowest_point_is_on_the_floor_in_every_frame(performance: Performance):
    np.testing.assert_allclose(performance.vertices[..., 2].min(axis=1), 0, atol=1e-5)
    rotations = performance.motion.root[:, :3, :3]
    np.testing.assert_allclose(rotations @ rotations.transpose(0, 2, 1), np.tile(np.eye(3), (len(rotations), 1, 1)), atol=1e-5)


def test_more_frames_of_the_same_speed_at_another_rate(rig: Rig):
    """Conversation is a function of time: at twice the frame rate, every other frame shows the same pose."""
    slow = perform(rig, StudioSettings(motion=MotionSettings(train_frames=1, test_frames=20)), NAMES)
    fast = perform(rig, StudioSettings(motion=MotionSettings(train_frames=1, test_frames=40, fps=20.0)), NAMES)
    np.testing.assert_allclose(slow.theta[13:], fast.theta[25::2][: len(slow.theta[13:])], atol=1e-5)
