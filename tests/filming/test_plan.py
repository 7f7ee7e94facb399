"""Shards cover a capture without overlap; plans count what will be filmed."""

import dataclasses

import pytest

from mitsuba_avatar.filming.plan import FilmingPlan, Shard, plan_filming
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
    assert plan.preparation > 60, "every shard paints 2048 x 2048 texels and plans 50,000 frames"
    assert f"{plan.preparation:.0f} seconds of it" in plan.text()
    assert plan.seconds_of_shard(plan.suggested_shards()) == pytest.approx(3600, rel=0.01)
    assert plan.seconds_of_shard(1) == plan.seconds


def planned(**changes: dict[str, object]) -> FilmingPlan:
    """The plan of the tiny preset with changes to some of its groups of settings."""
    settings = resolve("studio/tiny", kind=StudioSettings)
    return plan_filming(
        dataclasses.replace(settings, **{name: dataclasses.replace(getattr(settings, name), **values) for name, values in changes.items()})
    )


def test_cost_is_proportional_to_frames():
    once, thrice = planned(), planned(motion={"train_frames": 24, "test_frames": 12})
    assert (once.frames, thrice.frames) == (12, 36)
    assert thrice.seconds - thrice.preparation == pytest.approx(3 * (once.seconds - once.preparation))
    assert thrice.bytes == pytest.approx(3 * once.bytes)


@pytest.mark.parametrize(
    ("more", "much_more"),
    [
        ({"cameras": {"train": 5}}, {"cameras": {"train": 7}}),
        ({"cameras": {"held_out": 2}}, {"cameras": {"held_out": 3}}),
        ({"cameras": {"width": 80}}, {"cameras": {"width": 120}}),
        ({"cameras": {"height": 112}}, {"cameras": {"height": 168}}),
        ({"light": {"samples_per_pixel": 9}}, {"light": {"samples_per_pixel": 14}}),
        ({"light": {"light_samples": 2}}, {"light": {"light_samples": 3}}),
    ],
)
def test_each_step_of_cameras_pixels_and_samples_costs_the_same(more: dict, much_more: dict):
    """Samples cost time and no room on the disk; what a frame costs by itself stays."""
    first, second, third = planned(), planned(**more), planned(**much_more)
    assert second.seconds > first.seconds
    assert third.seconds - first.seconds == pytest.approx(2 * (second.seconds - first.seconds))
    assert third.bytes - first.bytes == pytest.approx(2 * (second.bytes - first.bytes))
    assert (second.bytes > first.bytes) == ("cameras" in more)


def test_simulated_clothes_cost_time():
    assert planned(clothing={"is_simulated": False}).seconds < planned().seconds
    slow, fast = (planned(motion={"fps": fps}).seconds for fps in (10.0, 20.0))
    assert fast < slow, "a frame stands for less time to simulate"
