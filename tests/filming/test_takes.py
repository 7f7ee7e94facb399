import pytest

from mitsuba_avatar.filming.performance import steady_enough
from mitsuba_avatar.filming.settings import ClothingSettings, MotionSettings
from mitsuba_avatar.filming.takes import STUDY, frames_of, plan_recordings, plan_takes


def splits(planned: list) -> list[str]:
    return [split for plan in planned for split in plan.splits()]


@pytest.mark.parametrize(("train", "validation", "test", "stress"), [(600, 80, 150, 30), (23, 5, 7, 0), (1, 0, 0, 2)])
def test_frames_add_up_for_every_split(train: int, validation: int, test: int, stress: int):
    settings = MotionSettings(script="study", train_frames=train, validation_frames=validation, test_frames=test, stress_frames=stress)
    found = splits(plan_takes(STUDY, settings))
    assert [found.count(split) for split in ("train", "validation", "test")] == [train, validation, test + stress]


def test_validation_blocks_are_contiguous_and_inside_training_takes():
    planned = plan_takes(STUDY, MotionSettings(script="study", train_frames=600, validation_frames=80))
    blocks = [plan for plan in planned if plan.validation]
    assert len(blocks) >= 8
    for plan in blocks:
        assert plan.take.split == "train"
        assert plan.validation.start > 0.2 * plan.count and plan.validation.stop < plan.count
    assert len({round(plan.validation.start / plan.count, 1) for plan in blocks}) > 3  # at different phases


def test_stress_is_a_test_segment_of_its_own():
    frames = frames_of(plan_takes(STUDY, MotionSettings(script="study", stress_frames=12)), 10.0)
    wild = [frame for frame in frames if frame.segment.startswith("stress")]
    assert len(wild) == 12 and {frame.split for frame in wild} == {"test"} and frames[-1] is wild[-1]
    assert frames[7].number == 7 and frames[7].time == pytest.approx(0.7)


def test_recordings_train_from_their_start_and_test_at_their_end():
    settings = MotionSettings(script="mocap", bvh=("a.bvh", "b.bvh"), train_frames=40, validation_frames=10, test_frames=20)
    planned = plan_recordings([("walk", 45), ("jump", 60)], settings)
    assert [(file, first, plan.take.name, plan.count) for file, first, plan in planned] == [
        (0, 0, "walk", 45),
        (1, 0, "jump", 5),
        (1, 40, "test_jump", 20),
    ]
    found = splits([plan for _, _, plan in planned])
    assert [found.count(split) for split in ("train", "validation", "test")] == [40, 10, 20]


def test_recordings_that_are_too_short_are_refused_with_their_lengths():
    settings = MotionSettings(script="mocap", bvh=("a.bvh",), train_frames=40, test_frames=20)
    with pytest.raises(ValueError, match=r"expected 60 frames at 10 fps in motion.bvh; got 45 \(walk 45\)"):
        plan_recordings([("walk", 45)], settings)


def test_script_and_files_go_together():
    with pytest.raises(ValueError, match="script mocap and 0 files"):
        MotionSettings(script="mocap")
    with pytest.raises(ValueError, match="script study and 1 files"):
        MotionSettings(script="study", bvh=("a.bvh",))


def test_only_wild_motion_is_simulated_in_smaller_steps():
    frames = frames_of(plan_takes(STUDY, MotionSettings(script="study", train_frames=12, test_frames=4, stress_frames=3)), 10.0)
    steps = [steady_enough(ClothingSettings(substeps_per_second=240), frame).substeps_per_second for frame in frames]
    assert steps == [240] * (len(frames) - 3) + [800] * 3
    assert steady_enough(ClothingSettings(substeps_per_second=900), frames[-1]).substeps_per_second == 900
