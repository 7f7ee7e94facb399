import dataclasses
from pathlib import Path

import numpy as np
import pytest

from mitsuba_avatar.captures.cameras import Camera
from mitsuba_avatar.captures.images import read_image
from mitsuba_avatar.captures.silhouettes import silhouette
from mitsuba_avatar.filming.anatomy import LEG, Anatomy
from mitsuba_avatar.filming.appearance import Appearance
from mitsuba_avatar.filming.cameras import look_at, place_cameras
from mitsuba_avatar.filming.film import Performance
from mitsuba_avatar.filming.settings import CameraSettings, LightSettings, StudioSettings
from mitsuba_avatar.filming.stage import Stage, sensor_of
from mitsuba_avatar.resources import resource_folder

GREY = Appearance(np.full((64, 64, 3), 0.5, np.float32), np.full((64, 64), 0.8, np.float32))  # only light and shadow vary


@pytest.fixture(scope="module")
def shoot_settings() -> StudioSettings:
    return StudioSettings(
        cameras=CameraSettings(train=3, held_out=0, width=72, height=104), light=LightSettings(samples_per_pixel=16, light_samples=2)
    )


@pytest.fixture(scope="module")
def cameras(performance: Performance, shoot_settings: StudioSettings) -> list[Camera]:
    return list(place_cameras(performance.vertices, shoot_settings).cameras.values())


@pytest.fixture(scope="module")
def stage(performance: Performance, cameras: list[Camera], shoot_settings: StudioSettings) -> Stage:
    """The person painted evenly grey, so that only light and shadow vary."""
    return Stage(performance.rig.topology, GREY, cameras, shoot_settings)


def test_masks_are_the_projected_silhouettes_of_every_camera(stage: Stage, performance: Performance, cameras: list[Camera]):
    for index in (2, 9):
        coverage = stage.shoot(performance.vertices[index], seed=0)[1]
        for camera, mask in zip(cameras, coverage, strict=True):
            projected = silhouette(camera, performance.vertices[index], performance.rig.topology.faces)
            overlap = (projected & (mask > 0.5)).sum() / (projected | (mask > 0.5)).sum()
            assert overlap > 0.95, f"{camera.name}: IoU {overlap:.3f}"
        assert ((coverage > 0.1) & (coverage < 0.9)).any()  # edges are antialiased


def test_one_seed_gives_one_picture(stage: Stage, performance: Performance):
    first, again, other = (stage.shoot(performance.vertices[4], seed=seed)[0] for seed in (3, 3, 4))
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 0


def test_radiance_is_premultiplied_and_within_the_range_of_8_bits(stage: Stage, performance: Performance):
    radiance, coverage = stage.shoot(performance.vertices[0], seed=1)
    assert radiance[coverage == 0].max() == 0
    assert 0.2 < np.median(radiance[coverage == 1]) < 0.8
    assert (radiance > 1).mean() < 0.001


def test_the_body_shadows_itself(performance: Performance, shoot_settings: StudioSettings):
    """Without the right leg, light reaches the left one that it blocked; the head is lit as before."""
    rig = performance.rig
    frontal = look_at(np.array([0.0, -3.6, 0.9]), np.array([0.0, 0.0, 0.9]))
    camera = Camera("front", 72, 104, 180.0, 180.0, 36.0, 52.0, frontal)
    stage = Stage(rig.topology, GREY, [camera], dataclasses.replace(shoot_settings, light=LightSettings(samples_per_pixel=64)))
    legs = {side: Anatomy.of(rig).weight(LEG, side) > 0.5 for side in "LR"}
    whole = rig.rest_vertices.copy()
    one_legged = whole.copy()
    one_legged[legs["R"]] = whole[legs["R"]].mean(axis=0) + [0, 0, 0.4]  # inside the trunk
    shadowed, lit = (stage.shoot(vertices, seed=2)[0][0].mean(axis=-1) for vertices in (whole, one_legged))
    leg = silhouette(camera, whole, rig.topology.faces[legs["L"][rig.topology.faces].all(axis=1)])
    inner_half = leg & (np.cumsum(leg, axis=1) <= 0.5 * leg.sum(axis=1, keepdims=True))  # the person's left is to the right in the image
    head = silhouette(camera, whole, rig.topology.faces[(whole[:, 2] > 1.6)[rig.topology.faces].all(axis=1)])
    assert lit[inner_half].mean() > 1.02 * shadowed[inner_half].mean()
    assert abs(lit[head].mean() / shadowed[head].mean() - 1) < 0.005


def test_frames_do_not_leave_traces(stage: Stage, performance: Performance):
    before = stage.shoot(performance.vertices[1], seed=5)[0]
    stage.shoot(performance.vertices[8], seed=6)
    np.testing.assert_array_equal(stage.shoot(performance.vertices[1], seed=5)[0], before)


def test_the_dome_is_nearly_even_and_brighter_above():
    rows = read_image(resource_folder("scenes") / "dome.exr").mean(axis=(1, 2))
    assert 1.2 < rows[: len(rows) // 2].mean() / rows[len(rows) // 2 :].mean() < 2
    assert rows.max() / rows.min() < 2.5


def test_a_scene_of_the_users_own(performance: Performance, cameras: list[Camera], shoot_settings: StudioSettings, tmp_path: Path):
    """Another integrator, a lamp with a shape, an object: all of the file is on the stage."""
    file = tmp_path / "lamp.xml"
    file.write_text(
        """<scene version="3.0.0"><integrator type="path"><integer name="max_depth" value="2"/><boolean name="hide_emitters" value="true"/>
        </integrator><shape type="rectangle"><transform name="to_world"><lookat origin="0,0,4" target="0,0,0" up="0,1,0"/>
        </transform><emitter type="area"><rgb name="radiance" value="8"/></emitter></shape></scene>"""
    )
    lit = dataclasses.replace(shoot_settings, light=LightSettings(scene=str(file), samples_per_pixel=4))
    radiance, coverage = Stage(performance.rig.topology, GREY, cameras, lit).shoot(performance.vertices[0], seed=0)
    assert np.quantile(radiance[coverage == 1], 0.9) > 0.05


def test_cameras_that_mitsuba_cannot_be_are_refused(cameras: list[Camera], performance: Performance, shoot_settings: StudioSettings):
    with pytest.raises(ValueError, match=r"sensor_of\(\): expected one focal length; 'train_00' has"):
        sensor_of(dataclasses.replace(cameras[0], fy=cameras[0].fy * 1.01))
    with pytest.raises(ValueError, match=r"Stage\(\): expected cameras of one size"):
        Stage(performance.rig.topology, GREY, [cameras[0], cameras[1].resized(0.5)], shoot_settings)
