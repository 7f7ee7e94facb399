from pathlib import Path

import numpy as np
import pytest
import torch

from mitsuba_avatar.body.rig import Rig
from mitsuba_avatar.body.skeleton import Skeleton
from mitsuba_avatar.recordings.bvh import BvhRecording, read_bvh
from mitsuba_avatar.recordings.humanoid import Humanoid
from mitsuba_avatar.recordings.retargeting import Retargeted, retarget
from tests.recordings.written import NAMES, Z_UP_FACING_X, Encoding, bvh_text, movement, positions

TIMES = np.arange(11) / 10
BONES = {
    "Arm": ("ForeArm", "upperarm01", "lowerarm01"),
    "ForeArm": ("Hand", "lowerarm01", "wrist"),
    "UpLeg": ("Leg", "upperleg01", "lowerleg01"),
    "Leg": ("Foot", "lowerleg01", "foot"),
}


def read(folder: Path, text: str) -> BvhRecording:
    (folder / "sway.bvh").write_text(text, encoding="utf-8")
    return read_bvh(folder / "sway.bvh")


@pytest.fixture(scope="module")
def followed(rig: Rig, tmp_path_factory: pytest.TempPathFactory) -> Retargeted:
    return retarget(rig, Humanoid.of(read(tmp_path_factory.mktemp("bvh"), bvh_text(*movement()))), TIMES)


def joints_of(rig: Rig, theta: np.ndarray, root: np.ndarray) -> dict[str, np.ndarray]:
    skeleton = Skeleton(rig)
    with torch.no_grad():
        joints = skeleton.posed_joints(skeleton(torch.from_numpy(theta), torch.from_numpy(root))).numpy()
    return {name: joints[:, index] for index, name in enumerate(rig.joint_names)}


def test_limbs_point_where_the_recorded_ones_point(rig: Rig, followed: Retargeted):
    """Heading is relative: the retargeted person faces -Y on average, and so does the recorded one."""
    recorded = positions(*movement())[::3]
    joints = joints_of(rig, followed.theta, followed.root)
    for side in ("Left", "Right"):
        for name, (end, start_joint, end_joint) in BONES.items():
            theirs = recorded[:, NAMES.index(f"{side}{end}")] - recorded[:, NAMES.index(f"{side}{name}")]
            mine = joints[f"{end_joint}.{side[0]}"] - joints[f"{start_joint}.{side[0]}"]
            cosine = (theirs * mine).sum(axis=1) / np.linalg.norm(theirs, axis=1) / np.linalg.norm(mine, axis=1)
            assert np.degrees(np.arccos(cosine)).max() < 8, f"{side}{name}"
    assert np.degrees(followed.direction_error) < 3
    assert followed.clipped_share < 0.05


def test_angles_keep_their_limits_and_limbs_are_not_twisted(rig: Rig, followed: Retargeted):
    assert (followed.theta >= rig.dofs.lower - 1e-6).all() and (followed.theta <= rig.dofs.upper + 1e-6).all()
    twists = [index for index, name in enumerate(rig.dofs.names) if name.endswith(("_twist", "inward_rotation"))]
    assert np.degrees(np.abs(followed.theta[:, twists])).max() < 35
    assert np.abs(np.diff(followed.theta, axis=0)).max() < 0.5


def test_standing_feet_stay_where_they_are_and_on_the_floor(rig: Rig, followed: Retargeted):
    assert followed.standing.all() and followed.clearance.max() == 0
    joints = joints_of(rig, followed.theta, followed.root)
    for name in ("foot.L", "foot.R", "toe1-1.L", "toe1-1.R"):
        assert np.ptp(joints[name][:, :2], axis=0).max() < 0.006, name
        height = joints[name][:, 2] - rig.joint_positions[rig.joint_names.index(name), 2]
        assert np.abs(height).max() < 0.012, name
    assert followed.slide < 0.02


@pytest.mark.parametrize(
    "encoding",
    [
        Encoding(unit=0.0254, order="XYZ", prefix="mixamorig:"),
        Encoding(unit=1.0, axes=Z_UP_FACING_X, order="YXZ"),
        Encoding(arms_down=0.8),
    ],
    ids=["inches, Mixamo", "metres, Z up, facing +X", "A-pose at rest"],
)
def test_the_same_movement_is_the_same_however_it_is_written(rig: Rig, tmp_path: Path, followed: Retargeted, encoding: Encoding):
    again = retarget(rig, Humanoid.of(read(tmp_path, bvh_text(*movement(), encoding))), TIMES)
    np.testing.assert_allclose(again.theta, followed.theta, atol=0.02)
    np.testing.assert_allclose(again.root, followed.root, atol=0.005)


def test_a_larger_person_makes_the_same_movement_with_a_step_of_the_rigs_size(rig: Rig, tmp_path: Path, followed: Retargeted):
    recording = read(tmp_path, bvh_text(*movement(), Encoding(unit=0.01 / 1.15)))
    assert recording.unit == "centimetres"
    again = retarget(rig, Humanoid.of(recording), TIMES)
    np.testing.assert_allclose(again.root[:, :3, 3], followed.root[:, :3, 3], atol=0.01)


def test_a_jump_is_clear_of_the_floor(rig: Rig, tmp_path: Path):
    turns, hips = movement(31)
    hips = hips + np.array([0, 0, 0.3]) * np.clip(np.sin(np.linspace(-1, 4, 31)), 0, 1)[:, None]
    moved = retarget(rig, Humanoid.of(read(tmp_path, bvh_text(turns, hips))), TIMES)
    assert 0.2 < moved.clearance.max() < 0.35 and moved.clearance[0] == 0
    assert not moved.standing[moved.clearance.argmax()].any()


def test_hanging_arms_are_kept_off_the_trunk(rig: Rig, tmp_path: Path):
    turns, hips = movement(4, speed=0.0)
    for side, sign in (("Left", 1), ("Right", -1)):
        for name in ("Arm", "ForeArm", "Hand", "HandMiddle1"):
            turns[:, NAMES.index(f"{side}{name}")] = [[0, 0, sign], [0, 1, 0], [-sign, 0, 0]]  # straight down
    moved = retarget(rig, Humanoid.of(read(tmp_path, bvh_text(turns, hips))), np.array([0.0, 0.1]))
    joints = joints_of(rig, moved.theta, moved.root)
    for side in "LR":
        arm = joints[f"lowerarm01.{side}"] - joints[f"upperarm01.{side}"]
        assert np.degrees(np.arccos(-arm[:, 2] / np.linalg.norm(arm, axis=1))).min() > 17


def test_unknown_joints_are_refused_with_what_is_missing(tmp_path: Path):
    text = bvh_text(*movement(2)).replace("LeftUpLeg", "Bone_17").replace("RightHand", "Claw")
    with pytest.raises(ValueError, match=r"joints for left_thigh, right_hand in sway; .*upleg.*MotionBuilder or Mixamo"):
        Humanoid.of(read(tmp_path, text))


def test_parts_without_counterpart_are_named_in_the_notes(rig: Rig, followed: Retargeted):
    assert any("unit centimetres (taken from the skeleton's height)" in note for note in followed.notes)
    assert "limbs" in followed.summary() and "mm/s" in followed.summary()


def test_where_the_zero_pose_does_not_stand_the_first_frame_is_rest(rig: Rig, tmp_path: Path):
    turns, hips = movement(32)
    turns[0], hips[0] = np.eye(3), hips[1]  # a T-pose
    person = Humanoid.of(read(tmp_path, bvh_text(turns, hips, Encoding(legs_up=True))))
    assert person.rest_is_first_frame and person.start == pytest.approx(1 / 30)
    again = retarget(rig, person, TIMES + person.start - 1e-6)
    limbs = [index for index, name in enumerate(rig.dofs.names) if "knee" in name or "hip_flexion" in name or "elbow" in name]
    start = retarget(rig, Humanoid.of(read(tmp_path, bvh_text(*movement(32)))), TIMES + 1 / 30 - 1e-6)
    np.testing.assert_allclose(again.theta[:, limbs], start.theta[:, limbs], atol=0.06)
    assert "the first frame serves as rest pose" in " ".join(again.notes)


def test_a_recording_that_never_stands_is_refused(tmp_path: Path):
    turns, hips = movement(3)
    for side in ("Left", "Right"):
        for name in ("UpLeg", "Leg", "Foot", "ToeBase"):
            turns[:, NAMES.index(f"{side}{name}")] = np.diag([1.0, -1.0, -1.0])
    with pytest.raises(ValueError, match="stand upright with all rotations zero, or in its first frame"):
        Humanoid.of(read(tmp_path, bvh_text(turns, hips, Encoding(legs_up=True))))


def test_times_outside_the_recording_are_refused(rig: Rig, tmp_path: Path):
    person = Humanoid.of(read(tmp_path, bvh_text(*movement(4))))
    with pytest.raises(ValueError, match=r"within 0..0.10 s of sway; got 0.00..0.20"):
        retarget(rig, person, np.array([0.0, 0.2]))


def test_a_calibration_pose_before_the_motion_is_skipped(tmp_path: Path):
    turns, hips = movement(6)
    assert Humanoid.of(read(tmp_path, bvh_text(turns, hips))).start == 0
    turns[0] = np.eye(3)
    assert Humanoid.of(read(tmp_path, bvh_text(turns, hips))).start == pytest.approx(1 / 30)
