from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial import cKDTree

from mitsuba_avatar.body.rig import Rig
from mitsuba_avatar.body.skeleton import Skeleton
from mitsuba_avatar.body.skinning import posed_rest_surface
from mitsuba_avatar.filming.anatomy import Anatomy
from mitsuba_avatar.filming.motion import Motion, body_angles, perform, pose_distances
from mitsuba_avatar.filming.settings import MotionSettings, StudioSettings
from tests.filming.acted import Acted
from tests.recordings.written import bvh_text, movement

NEAR = 0.08  # metres from the trunk
DEEP = 0.05  # metres; farther from the trunk its nearest normal does not tell inside from outside
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


def test_the_lowest_point_is_on_the_floor_in_every_frame(performance: Acted):
    np.testing.assert_allclose(performance.vertices[..., 2].min(axis=1), 0, atol=1e-5)
    rotations = performance.motion.root[:, :3, :3]
    np.testing.assert_allclose(rotations @ rotations.transpose(0, 2, 1), np.tile(np.eye(3), (len(rotations), 1, 1)), atol=1e-5)


def test_more_frames_of_the_same_speed_at_another_rate(rig: Rig):
    """Conversation is a function of time: at twice the frame rate, every other frame shows the same pose."""
    slow = perform(rig, StudioSettings(motion=MotionSettings(train_frames=1, test_frames=20)), NAMES)
    fast = perform(rig, StudioSettings(motion=MotionSettings(train_frames=1, test_frames=40, fps=20.0)), NAMES)
    np.testing.assert_allclose(slow.theta[13:], fast.theta[25::2][: len(slow.theta[13:])], atol=1e-5)


def test_the_default_script_is_the_one_it_was(motion: Motion):
    """Captures filmed before there were other scripts are filmed alike: angles of a hand, an arm and a trunk, place and blinks."""
    expected = {
        50: ((0.0, -0.16425839, -0.13496041, 0.05382777, 0.50454766), (0.00722901, 0.02428935), 0.88347334),
        149: ((0.02032077, -0.20011209, 0.598405, 0.12379961, -0.17160447), (-0.02072158, -0.00137575), 0.23046353),
    }
    for frame, (angles, place, blink) in expected.items():
        np.testing.assert_allclose(motion.theta[frame, [0, 36, 39, 64, 82]], angles, atol=1e-5)
        np.testing.assert_allclose(motion.root[frame, :2, 3], place, atol=1e-5)
        np.testing.assert_allclose(motion.actions[frame, 0], blink, atol=1e-5)
    assert motion.clearance.shape == (150,) and not motion.clearance.any()


@pytest.fixture(scope="module", params=[0, 5], ids=["seed 0", "seed 5"])
def study(rig: Rig, request: pytest.FixtureRequest) -> Motion:
    settings = MotionSettings(script="study", train_frames=1280, validation_frames=160, test_frames=160, stress_frames=30)
    return perform(rig, StudioSettings(seed=request.param, motion=settings), NAMES)


def frames_in(motion: Motion, start: str) -> np.ndarray:
    return np.array([frame.segment.startswith(start) for frame in motion.frames])


def test_study_moves_every_angle_slowly_in_training(rig: Rig, study: Motion):
    train = np.array([frame.split == "train" for frame in study.frames])
    moved = np.ptp(study.theta[train], axis=0)
    assert [name for name, range_ in zip(rig.dofs.names, moved, strict=True) if range_ < 0.05] == []
    body = study.theta[:, body_angles(rig)]
    for segment in study.segments():
        if study.frames[segment.start].segment.startswith(("slow", "test")):
            assert np.degrees(np.linalg.norm(np.diff(body[segment], axis=0), axis=1)).max() < 25  # in a tenth of a second
    assert (study.theta >= rig.dofs.lower - 1e-6).all() and (study.theta <= rig.dofs.upper + 1e-6).all()


def test_study_moves_one_limb_at_a_time(rig: Rig, study: Motion):
    left = frames_in(study, "slow_left_arm")
    still = [i for i, name in enumerate(rig.dofs.names) if name.startswith(("right_shoulder", "right_elbow", "spine", "left_hip"))]
    moving = [i for i, name in enumerate(rig.dofs.names) if name.startswith("left_shoulder")]
    assert np.ptp(study.theta[left][:, still], axis=0).max() < 1e-6
    assert np.degrees(np.ptp(study.theta[left][:, moving], axis=0)).min() > 25


def test_face_and_fingers_move_while_the_body_holds_still(rig: Rig, study: Motion):
    held = frames_in(study, "held_expressions")
    body = study.theta[held][:, body_angles(rig)]
    steps = np.abs(np.diff(body, axis=0)).max(axis=1)
    assert (steps < 1e-6).mean() > 0.55  # the rest is changing from pose to pose
    poses = np.unique(body[1:][steps < 1e-6].round(4), axis=0)
    assert len(poses) >= 3
    fingers = [i for i, name in enumerate(rig.dofs.names) if name.endswith("index_base_flexion")]
    assert np.abs(np.diff(study.theta[held][:, fingers], axis=0))[steps < 1e-6].mean() > 0.02
    assert np.ptp(study.actions[held], axis=0).max() > 0.5


def test_study_tests_are_thirty_to_sixty_degrees_from_training_and_stress_is_farther(rig: Rig, study: Motion):
    distance = np.degrees(pose_distances(rig, study))
    tests = {frame.segment for frame in study.frames if frame.segment.startswith("test")}
    assert len(tests) >= 3
    for name in tests:
        far = distance[frames_in(study, name)]
        assert (25 if "reaches" in name else 32) < np.median(far) < 50, name  # reaching arms are not moved farther: into the trunk
        assert ((far > 15) & (far < 65)).mean() > 0.85, name
    assert np.median(distance[frames_in(study, "stress")]) > 80
    validation = np.array([frame.split == "validation" for frame in study.frames])
    assert np.median(distance[validation]) < 20
    assert distance[[frame.split == "train" for frame in study.frames]].max() == 0


def test_limbs_do_nothing_in_the_tests_that_they_did_not_do_alone_in_training(rig: Rig, study: Motion):
    """What is new is their combination; a trunk that leans where it never leant would be another question."""
    train = np.array([frame.split == "train" for frame in study.frames])
    test = frames_in(study, "test_reaches_and_trunk")
    whole = np.degrees(pose_distances(rig, study))[test]
    for start in ("spine", ("left_shoulder", "left_elbow", "left_forearm"), ("right_shoulder", "right_elbow", "right_forearm")):
        limb = [index for index, name in enumerate(rig.dofs.names) if name.startswith(start)]
        alone = np.degrees(cKDTree(study.theta[train][:, limb]).query(study.theta[test][:, limb])[0])
        assert np.median(alone) < 8 and np.median(alone) < 0.3 * np.median(whole), start


def test_fingers_are_never_still(rig: Rig, study: Motion):
    fingers = [index for index, name in enumerate(rig.dofs.names) if name.endswith("index_base_flexion")]
    for segment in study.segments():
        assert np.ptp(study.theta[segment][:, fingers], axis=0).min() > 0.1, study.frames[segment.start].segment


def test_a_stress_take_changes_no_other_take(rig: Rig):
    settings = MotionSettings(script="study", train_frames=24, validation_frames=6, test_frames=8)
    calm = perform(rig, StudioSettings(motion=settings), NAMES)
    wild = perform(rig, StudioSettings(motion=replace(settings, stress_frames=5)), NAMES)
    count = len(calm.frames)
    assert wild.frames[:count] == calm.frames and len(wild.frames) == count + 5
    for name in ("theta", "root", "actions", "clearance"):
        np.testing.assert_array_equal(getattr(wild, name)[:count], getattr(calm, name))


def test_arms_of_the_study_are_off_the_torso(rig: Rig, study: Motion):
    skeleton = Skeleton(rig)
    with torch.no_grad():
        joints = skeleton.posed_joints(skeleton(torch.from_numpy(study.theta), torch.from_numpy(study.root))).numpy()
    at = {name: joints[:, rig.joint_names.index(name)] for name in rig.joint_names}
    calm = ~frames_in(study, "stress")
    down = at["spine05"] - at["spine01"]
    for side in "LR":
        arm = at[f"lowerarm01.{side}"] - at[f"upperarm01.{side}"]
        cosine = (arm * down).sum(axis=1) / np.linalg.norm(arm, axis=1) / np.linalg.norm(down, axis=1)
        assert np.degrees(np.arccos(cosine))[calm].min() > 17


def test_reaching_brings_forearm_and_hand_close_to_the_trunk_and_not_into_it(rig: Rig, study: Motion):
    anatomy = Anatomy.of(rig)
    reaching = np.flatnonzero(np.char.find([frame.segment for frame in study.frames], "reach") >= 0)[::2]
    arm = anatomy.weight(("upperarm", "lowerarm", "wrist", "metacarpal", "finger", "clavicle", "shoulder"))
    trunk = np.flatnonzero((arm < 0.05) & (anatomy.weight(("head",)) < 0.3) & (anatomy.piece == 0))
    forearms = [np.flatnonzero(anatomy.weight(("lowerarm", "wrist", "metacarpal", "finger"), side) > 0.95)[::5] for side in "LR"]
    place = np.full(rig.topology.num_vertices, -1)
    place[trunk] = np.arange(len(trunk))
    faces = place[rig.topology.faces[np.isin(rig.topology.faces, trunk).all(axis=1)]]
    nearest = []
    for frame in reaching:
        posed = posed_rest_surface(rig, study.theta[frame], np.eye(4))
        surface = trimesh.Trimesh(posed[trunk], faces, process=False)
        for forearm in forearms:
            distance, index = cKDTree(posed[trunk]).query(posed[forearm])
            outwards = ((posed[forearm] - posed[trunk][index]) * surface.vertex_normals[index]).sum(axis=1)
            nearest.append(np.where((outwards < 0) & (distance < DEEP), -distance, distance).min())
    assert min(nearest) > 0.005  # metres
    assert (np.array(nearest) < NEAR).mean() > 0.05


def test_recordings_are_played_with_training_validation_and_test_parts(rig: Rig, tmp_path: Path):
    (tmp_path / "sway.bvh").write_text(bvh_text(*movement(91)), encoding="utf-8")
    settings = MotionSettings(
        script="mocap", bvh=(str(tmp_path / "sway.bvh"),), train_frames=15, validation_frames=4, test_frames=6, stress_frames=3
    )
    motion = perform(rig, StudioSettings(motion=settings), NAMES)
    assert [frame.split for frame in motion.frames].count("validation") == 4
    assert [frame.segment for frame in motion.frames] == ["sway"] * 19 + ["test_sway"] * 6 + ["stress_wild"] * 3
    elbow = motion.theta[:19, rig.dofs.names.index("left_elbow_flexion")]
    assert np.ptp(elbow) > 0.4
    assert any("limbs" in note for note in motion.notes)
    assert motion.actions[:25].max() > 0.2
    with pytest.raises(ValueError, match="expected 150 frames"):
        perform(rig, StudioSettings(motion=MotionSettings(script="mocap", bvh=settings.bvh)), NAMES)


def test_a_recorded_face_replaces_the_scripts_and_turns_the_eyes(rig: Rig, tmp_path: Path):
    rows = [f"00:00:0{second}:00,61,{value},{value},0.5,0.25,0,{value}" for second, value in ((1, 0.0), (2, 0.8))]
    path = tmp_path / "face.csv"
    header = "Timecode,BlendshapeCount,EyeBlinkLeft,EyeBlinkRight,JawOpen,MouthSmileLeft,HeadYaw,EyeLookUpLeft"
    path.write_text("\n".join([header, *rows]), encoding="utf-8")
    names = (*NAMES, "eyeLookUpLeft")
    settings = MotionSettings(train_frames=8, test_frames=3, face_recording=str(path))
    motion = perform(rig, StudioSettings(motion=settings), names)
    np.testing.assert_allclose(motion.actions[:11, 0], 0.8 * np.arange(11) / 10, atol=1e-6)
    np.testing.assert_allclose(motion.actions[:, 2:4], [[0.5, 0.25]] * 11, atol=1e-6)
    np.testing.assert_allclose(motion.theta[10, rig.dofs.names.index("left_eye_elevation")], 0.4, atol=1e-6)
