"""Shards cover a capture without overlap; plans count what will be filmed."""

import pytest

from mitsuba_avatar.filming.plan import Shard, plan_filming
from mitsuba_avatar.filming.settings import StudioSettings
from mitsuba_avatar.presets import resolve


@pytest.mark.parametrize("count", [1, 3, 7, 40])
def test_shards_cover_every_image_once(count: int):
    made = [
        (frame, camera)
        for index in range(count)
        for frame, cameras in Shard(index, count).images(num_frames=5, num_cameras=4).items()
        for camera in cameras
    ]
    assert sorted(made) == [(frame, camera) for frame in range(5) for camera in range(4)]


def test_a_shard_holds_consecutive_frames():
    frames = list(Shard(1, 3).images(num_frames=60, num_cameras=2))
    assert frames == list(range(20, 40))


def test_shards_are_read_as_people_write_them():
    assert Shard.parse("") == Shard(0, 1) and Shard.parse("2/5") == Shard(2, 5)
    for text in ("5/5", "-1/3", "1", "a/b", "0/0"):
        with pytest.raises(ValueError, match="--shard i/n"):
            Shard.parse(text)


def test_the_plan_of_the_papers_size_counts_seven_million_images():
    plan = plan_filming(resolve("studio/paper", kind=StudioSettings))
    assert (plan.frames, plan.cameras, plan.width, plan.height, plan.images) == (50_000, 140, 2668, 4096, 7_000_000)
    assert "7,000,000 images" in plan.text() and "days" in plan.text()


def test_cost_grows_with_frames_cameras_and_pixels():
    small = plan_filming(resolve("studio/tiny", kind=StudioSettings))
    default = plan_filming(resolve("studio/default", kind=StudioSettings))
    study = plan_filming(resolve("studio/study", kind=StudioSettings))
    assert small.seconds < default.seconds < study.seconds and small.bytes < default.bytes < study.bytes
