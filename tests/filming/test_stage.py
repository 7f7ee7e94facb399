import dataclasses
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.ndimage import binary_dilation

import mitsuba_avatar.filming.path_integrator  # noqa: F401 - registers what the scenes name
from mitsuba_avatar.body.rig import Topology
from mitsuba_avatar.captures.cameras import Camera
from mitsuba_avatar.captures.images import read_image
from mitsuba_avatar.captures.silhouettes import silhouette
from mitsuba_avatar.filming.anatomy import ARM, LEG, Anatomy
from mitsuba_avatar.filming.appearance import Appearance
from mitsuba_avatar.filming.cameras import look_at, place_cameras
from mitsuba_avatar.filming.exposure import Exposure, visible_pixels
from mitsuba_avatar.filming.settings import CameraSettings, LightSettings, StudioSettings
from mitsuba_avatar.filming.stage import Layer, Stage
from mitsuba_avatar.resources import resource_folder
from tests.filming.posed_body import PosedBody, posed_body

GREY = Appearance(np.full((64, 64, 3), 0.5, np.float32), np.full((64, 64), 0.8, np.float32))  # only light and shadow vary


@pytest.fixture(scope="module")
def posed() -> PosedBody:
    return posed_body()


@pytest.fixture(scope="module")
def shoot_settings() -> StudioSettings:
    return StudioSettings(
        cameras=CameraSettings(train=3, held_out=0, width=72, height=104), light=LightSettings(samples_per_pixel=16, light_samples=2)
    )


@pytest.fixture(scope="module")
def cameras(posed: PosedBody, shoot_settings: StudioSettings) -> list[Camera]:
    return list(place_cameras(posed.vertices, shoot_settings).cameras.values())


@pytest.fixture(scope="module")
def stage(posed: PosedBody, cameras: list[Camera], shoot_settings: StudioSettings) -> Stage:
    """The person painted evenly grey, so that only light and shadow vary."""
    return Stage([Layer("person", posed.rig.topology, GREY)], cameras, shoot_settings)


def test_masks_are_the_projected_silhouettes_of_every_camera(stage: Stage, posed: PosedBody, cameras: list[Camera]):
    for index in (2, 9):
        coverage = stage.shoot([posed.vertices[index]], seed=0)[1]
        for camera, mask in zip(cameras, coverage, strict=True):
            projected = silhouette(camera, posed.vertices[index], posed.rig.topology.faces)
            overlap = (projected & (mask > 0.5)).sum() / (projected | (mask > 0.5)).sum()
            assert overlap > 0.95, f"{camera.name}: IoU {overlap:.3f}"
        assert ((coverage > 0.1) & (coverage < 0.9)).any()  # edges are antialiased


def test_one_seed_gives_one_picture(stage: Stage, posed: PosedBody):
    first, again, other = (stage.shoot([posed.vertices[4]], seed=seed)[0] for seed in (3, 3, 4))
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 0


def test_radiance_is_premultiplied_and_within_the_range_of_8_bits(stage: Stage, posed: PosedBody):
    radiance, coverage = stage.shoot([posed.vertices[0]], seed=1)
    assert radiance[coverage == 0].max() == 0
    assert 0.2 < np.median(radiance[coverage == 1]) < 0.8
    assert (radiance > 1).mean() < 0.001


def test_the_body_shadows_itself(posed: PosedBody, shoot_settings: StudioSettings):
    """Without the right leg, light reaches the left one that it blocked; the head is lit as before."""
    rig = posed.rig
    frontal = look_at(np.array([0.0, -3.6, 0.9]), np.array([0.0, 0.0, 0.9]))
    camera = Camera("front", 72, 104, 180.0, 180.0, 36.0, 52.0, frontal)
    stage = Stage(
        [Layer("person", rig.topology, GREY)], [camera], dataclasses.replace(shoot_settings, light=LightSettings(samples_per_pixel=64))
    )
    legs = {side: Anatomy.of(rig).weight(LEG, side) > 0.5 for side in "LR"}
    whole = rig.rest_vertices.copy()
    one_legged = whole.copy()
    one_legged[legs["R"]] = whole[legs["R"]].mean(axis=0) + [0, 0, 0.4]  # inside the trunk
    shadowed, lit = (stage.shoot([vertices], seed=2)[0][0].mean(axis=-1) for vertices in (whole, one_legged))
    leg = silhouette(camera, whole, rig.topology.faces[legs["L"][rig.topology.faces].all(axis=1)])
    inner_half = leg & (np.cumsum(leg, axis=1) <= 0.5 * leg.sum(axis=1, keepdims=True))  # the person's left is to the right in the image
    head = silhouette(camera, whole, rig.topology.faces[(whole[:, 2] > 1.6)[rig.topology.faces].all(axis=1)])
    assert lit[inner_half].mean() > 1.02 * shadowed[inner_half].mean()
    assert abs(lit[head].mean() / shadowed[head].mean() - 1) < 0.005


def test_frames_do_not_leave_traces(stage: Stage, posed: PosedBody):
    before = stage.shoot([posed.vertices[1]], seed=5)[0]
    stage.shoot([posed.vertices[8]], seed=6)
    np.testing.assert_array_equal(stage.shoot([posed.vertices[1]], seed=5)[0], before)


def test_the_dome_is_nearly_even_and_brighter_above():
    rows = read_image(resource_folder("scenes") / "dome.exr").mean(axis=(1, 2))
    assert 1.2 < rows[: len(rows) // 2].mean() / rows[len(rows) // 2 :].mean() < 2
    assert rows.max() / rows.min() < 2.5


def test_the_half_lit_dome_is_what_its_file_says():
    """Towards random directions: the dome's light times a soft step across k."""
    directions = np.random.default_rng(0).normal(size=(500, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    dome, half = (_light_from(name, directions) for name in ("dome", "half_lit"))
    t = np.clip((directions @ np.array([1, -0.4, 0.15]) / np.linalg.norm([1, -0.4, 0.15]) + 0.35) / 0.7, 0, 1)
    np.testing.assert_allclose(half, dome * (0.04 + 0.96 * t * t * (3 - 2 * t))[:, None], atol=0.05)


def _light_from(scene: str, directions: np.ndarray) -> np.ndarray:
    """Radiance that arrives from directions [N, 3], by Mitsuba."""
    interaction = dr.zeros(mi.SurfaceInteraction3f, len(directions))
    interaction.wi = -mi.Vector3f(directions.T)
    return np.array(mi.load_file(str(resource_folder("scenes") / f"{scene}.xml")).environment().eval(interaction)).T


def test_a_scene_of_the_users_own(posed: PosedBody, cameras: list[Camera], shoot_settings: StudioSettings, tmp_path: Path):
    """Another integrator, a lamp with a shape, an object: all of the file is on the stage."""
    file = tmp_path / "lamp.xml"
    file.write_text(
        """<scene version="3.0.0"><integrator type="path"><integer name="max_depth" value="2"/><boolean name="hide_emitters" value="true"/>
        </integrator><shape type="rectangle"><transform name="to_world"><lookat origin="0,0,4" target="0,0,0" up="0,1,0"/>
        </transform><emitter type="area"><rgb name="radiance" value="8"/></emitter></shape></scene>"""
    )
    lit = dataclasses.replace(shoot_settings, light=LightSettings(scene=str(file), samples_per_pixel=4))
    stage = Stage([Layer("person", posed.rig.topology, GREY)], cameras, lit)
    radiance, coverage = stage.shoot([posed.vertices[0]], seed=0)
    assert np.quantile(radiance[coverage == 1], 0.9) > 0.05


def test_any_cameras_in_any_order_give_the_same_bits(stage: Stage, posed: PosedBody):
    surface = posed.vertices[3]
    radiance, coverage = stage.shoot([surface], seed=7)
    stage.shoot([posed.vertices[6]], seed=8, cameras=[1])
    for chosen in ([2, 0], [1], [0, 2, 1]):
        some, covered = stage.shoot([surface], seed=7, cameras=chosen)
        np.testing.assert_array_equal(some, radiance[chosen])
        np.testing.assert_array_equal(covered, coverage[chosen])


def test_no_kernel_is_compiled_after_the_first_frame(stage: Stage, posed: PosedBody):
    stage.shoot([posed.vertices[0]], seed=0)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        stage.shoot([posed.vertices[7]], seed=123456)
        kernels = [kernel for kernel in dr.kernel_history() if "cache_hit" in kernel]
    assert len(kernels) >= len(stage.cameras) and all(kernel["cache_hit"] for kernel in kernels)


def test_pixels_of_a_mesh_hold_all_that_is_seen_of_it_and_little_else(stage: Stage, posed: PosedBody):
    faces = posed.rig.topology.faces
    coverage = stage.shoot([posed.vertices[5]], seed=0)[1]
    for camera, mask in zip(stage.cameras, coverage, strict=True):
        pixels = visible_pixels(camera, posed.vertices[5], faces)
        assert pixels.shape == (camera.height, camera.width)
        everywhere = Exposure(stage._exposure.scene, 16).begin([camera], np.ones_like(pixels)[None], (9,)).finish()[0, ..., 3]
        assert not everywhere[~pixels].any(), "the person is seen where no ray was sent"
        assert (mask > 0).sum() <= pixels.sum() < 2 * (mask > 0).sum()
    inside = dataclasses.replace(stage.cameras[0], camera_from_world=look_at(np.array([0, 0.01, 1.2]), np.array([0.0, -1.0, 1.2])))
    assert visible_pixels(inside, posed.vertices[5], faces).all()  # part of the person is behind this camera


def _sheet(height: float, half: float = 0.4) -> tuple[Topology, np.ndarray]:
    """A horizontal square that faces up, metres."""
    corners = np.array([[-half, -half, height], [half, -half, height], [half, half, height], [-half, half, height]], dtype=np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    return Topology(4, faces, np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32), faces), corners


def _paint(colour: tuple[float, float, float]) -> Appearance:
    return Appearance(np.full((4, 4, 3), colour, np.float32), np.full((4, 4), 0.9, np.float32))


def test_layers_have_their_own_paint_cover_each_other_and_count_as_coverage(shoot_settings: StudioSettings):
    """A red sheet under a smaller green one, seen from above; then the green one is carried aside."""
    above = look_at(np.array([0.02, 0.0, 4.0]), np.array([0.0, 0.0, 0.0]))
    camera = Camera("above", 72, 104, 220.0, 220.0, 36.0, 52.0, above)
    (large, low), (small, high) = _sheet(0.5), _sheet(1.0, half=0.15)
    stage = Stage(
        [Layer("red", large, _paint((0.6, 0.05, 0.05))), Layer("green", small, _paint((0.05, 0.6, 0.05)))], [camera], shoot_settings
    )
    centre = (52, 36)
    radiance, coverage = stage.shoot([low, high], seed=0)
    assert radiance[0][centre][1] > 4 * radiance[0][centre][0] and coverage[0][centre] == 1
    away = high + np.array([0.55, 0, 0], np.float32)
    moved, wider = stage.shoot([low, away], seed=0)
    assert moved[0][centre][0] > 4 * moved[0][centre][1] and wider.sum() > 1.1 * coverage.sum()
    with pytest.raises(ValueError, match=r"shoot\(\): expected vertices of 2 layers"):
        stage.shoot([low], seed=0)


def test_the_inside_of_a_two_sided_layer_is_lit_as_its_outside(shoot_settings: StudioSettings):
    """A sheet from above and, turned over, its other side; one that is not two-sided is black behind."""
    above = look_at(np.array([0.02, 0.0, 4.0]), np.array([0.0, 0.0, 0.0]))
    camera = Camera("above", 72, 104, 220.0, 220.0, 36.0, 52.0, above)
    topology, corners = _sheet(0.5)
    turned = corners[[1, 0, 3, 2]]
    for is_two_sided in (True, False):
        stage = Stage([Layer("sheet", topology, _paint((0.4, 0.5, 0.6)), is_two_sided)], [camera], shoot_settings)
        outside, inside = (stage.shoot([surface], seed=1)[0][0, 45:60, 30:42].mean(axis=(0, 1)) for surface in (corners, turned))
        assert outside.min() > 0.2
        np.testing.assert_allclose(inside, outside if is_two_sided else 0, rtol=0.03)


def test_hidden_faces_are_not_seen_and_the_others_keep_their_shading(posed: PosedBody, cameras: list[Camera]):
    topology, surface = posed.rig.topology, posed.vertices[0]
    settings = StudioSettings(light=LightSettings(samples_per_pixel=64))
    arms = (Anatomy.of(posed.rig).weight(ARM) > 0.5)[topology.faces].any(axis=1)
    whole, armless = (
        Stage([Layer("person", topology, GREY, hidden_faces=hidden)], cameras[:1], settings).shoot([surface], seed=0)
        for hidden in (None, arms)
    )
    # Projected silhouettes take a pixel's centre alone.
    trunk = binary_dilation(silhouette(cameras[0], surface, topology.faces[~arms]), iterations=2)
    assert whole[1][0][~trunk].sum() > 30 and not armless[1][0][~trunk].any()
    shared = (armless[1][0] == 1) & (np.arange(104)[:, None] < 40) & ~silhouette(cameras[0], surface, topology.faces[arms])
    assert shared.sum() > 50 and abs(armless[0][0][shared].mean() / whole[0][0][shared].mean() - 1) < 0.05
    with pytest.raises(ValueError, match=r"Layer\(\): hidden_faces of 'person' must be one flag for each"):
        Layer("person", topology, GREY, hidden_faces=np.ones(len(topology.faces), bool))


def test_cameras_and_layers_that_cannot_share_a_stage_are_refused(cameras: list[Camera], posed: PosedBody, shoot_settings: StudioSettings):
    person = Layer("person", posed.rig.topology, GREY)
    with pytest.raises(ValueError, match=r"Stage\(\): expected cameras of one size"):
        Stage([person], [cameras[0], cameras[1].resized(0.5)], shoot_settings)
    with pytest.raises(ValueError, match=r"Stage\(\): expected layers of different names"):
        Stage([person, person], cameras, shoot_settings)
