"""Path tracing of an avatar's surface in a scene file: right in closed form, like the surface renderer, repeatable."""

import numpy as np
import pytest
import torch

from mitsuba_avatar.captures.cameras import Camera, look_at
from mitsuba_avatar.rendering.cameras import CameraBatch
from mitsuba_avatar.rendering.environment_map import EnvironmentMap
from mitsuba_avatar.rendering.lit_scene import LitScene, far_radiance
from mitsuba_avatar.rendering.path_tracing import PathTracer, SampleBudget
from mitsuba_avatar.rendering.surface import SurfaceRenderer
from mitsuba_avatar.resources import find_resource
from tests.drawn_capture import make_texture

CONSTANT = '<scene version="3.0.0"><emitter type="constant"><rgb name="radiance" value="0.5, 1.0, 2.0"/></emitter>{}</scene>'
WALL = """<shape type="rectangle"><transform name="to_world"><rotate x="1" angle="90"/><translate x="-0.4" y="-0.6" z="0.3"/></transform>
<bsdf type="diffuse"><rgb name="reflectance" value="0, 0, 0"/></bsdf></shape>"""
TEXTURE_SIZE = 64


@pytest.fixture(scope="module")
def camera():
    """Off-centre, with pixels that are not square."""
    return Camera("view", 30, 44, 70.0, 64.0, 13.0, 24.0, look_at(np.array([0.5, -1.4, 0.5]), np.array([0.0, 0.0, 0.3])))


@pytest.fixture(scope="module")
def surface(small_rig):
    return torch.from_numpy(small_rig.rest_vertices)


def traced(file, rig, texture, light, camera, samples=64):
    surface = torch.from_numpy(rig.rest_vertices)
    lit = LitScene(file, rig.topology, TEXTURE_SIZE, light)
    lit.place(surface, texture)
    return PathTracer(lit).draw(camera, surface.numpy(), SampleBudget(samples), seed=3)


@pytest.fixture
def constant(tmp_path):
    path = tmp_path / "constant.xml"
    path.write_text(CONSTANT.format(""))
    return path


def test_a_convex_surface_in_constant_light_shows_albedo_times_light(constant, small_rig, camera):
    albedo = torch.tensor([0.6, 0.3, 0.2])[:, None, None].expand(3, TEXTURE_SIZE, TEXTURE_SIZE)
    picture = traced(constant, small_rig, albedo, "relit", camera)
    inside = picture.coverage == 1
    assert 0.02 < inside.mean() < 0.9
    np.testing.assert_allclose(picture.radiance[inside].mean(axis=0), [0.3, 0.3, 0.4], rtol=0.01)
    assert not picture.radiance[picture.coverage == 0].any() and picture.samples == 64


def test_a_baked_surface_looks_as_the_surface_renderer_draws_it(constant, small_rig, surface, camera):
    texture = make_texture()
    picture = traced(constant, small_rig, texture, "baked", camera)
    renderer = SurfaceRenderer(small_rig.topology, camera.width, camera.height, samples_per_pixel=64)
    radiance, mask = renderer.render(surface[None], texture[None], CameraBatch.from_cameras([camera]), seed=1)
    assert np.abs(picture.coverage - mask[0, 0].numpy()).mean() < 0.004
    reference = radiance[0].permute(1, 2, 0).numpy()
    assert np.abs(picture.radiance - reference).mean() < 0.003, "texture the right way up, light of the scene ignored"
    assert np.abs(picture.radiance - reference[::-1]).mean() > 0.02


def test_an_object_of_the_scene_hides_the_person(constant, tmp_path, small_rig, camera):
    (tmp_path / "wall.xml").write_text(CONSTANT.format(WALL))
    free, hidden = (traced(path, small_rig, make_texture(), "baked", camera, 16) for path in (constant, tmp_path / "wall.xml"))
    assert hidden.radiance.sum() < 0.9 * free.radiance.sum() and hidden.coverage.mean() > 1.5 * free.coverage.mean()


def test_a_seed_gives_the_same_bits_and_another_seed_others(constant, small_rig, surface, camera):
    lit = LitScene(constant, small_rig.topology, TEXTURE_SIZE, "relit")
    tracer = PathTracer(lit)
    lit.place(surface, make_texture())
    first = tracer.draw(camera, surface.numpy(), SampleBudget(32), 5)
    other = tracer.draw(camera, surface.numpy(), SampleBudget(32), 6)
    again = tracer.draw(camera, surface.numpy(), SampleBudget(32), 5)
    np.testing.assert_array_equal(first.radiance, again.radiance)
    np.testing.assert_array_equal(first.coverage, again.coverage)
    assert np.abs(first.radiance - other.radiance).max() > 0


def test_a_pose_is_drawn_alike_whatever_came_before(small_rig, surface, camera):
    """Shadow rays to a dome must reach past the surface from the first pose on."""
    bent = surface.clone()
    bent[:, 0] += 1.5 * bent[:, 2] ** 2
    pictures = []
    for poses in ([bent], [bent, bent], [0.2 * bent, bent]):
        lit = LitScene(find_resource("scenes", "half_lit", ".xml"), small_rig.topology, TEXTURE_SIZE, "relit")
        for pose in poses:
            lit.place(pose, make_texture())
        pictures.append(PathTracer(lit).draw(camera, bent.numpy(), SampleBudget(16), 3).radiance)
    np.testing.assert_array_equal(pictures[0], pictures[1])
    np.testing.assert_array_equal(pictures[0], pictures[2])


def test_noise_is_what_repeated_pictures_differ_by_and_a_budget_is_kept(constant, small_rig, surface, camera):
    lit = LitScene(constant, small_rig.topology, TEXTURE_SIZE, "relit")
    lit.place(surface, make_texture())
    tracer = PathTracer(lit)
    draws = [tracer.draw(camera, surface.numpy(), SampleBudget(noise=0.02), seed) for seed in range(8)]
    assert all(draw.noise <= 0.02 and draw.samples >= 64 for draw in draws)
    rough = tracer.draw(camera, surface.numpy(), SampleBudget(noise=0.2), 0)
    assert rough.samples < max(draw.samples for draw in draws)
    luminance = np.stack([draw.radiance @ np.array([0.2126, 0.7152, 0.0722]) for draw in draws])
    seen = np.stack([draw.coverage for draw in draws]).max(axis=0) > 0
    spread = np.sqrt(luminance.var(axis=0, ddof=1)[seen].mean()) / luminance[:, seen].mean()
    assert spread == pytest.approx(np.mean([draw.noise for draw in draws]), rel=0.35)


def test_light_from_far_away_comes_from_where_the_scene_has_it():
    """Half-lit: bright on +x, dark on -x; the dome brighter above. The map is what EnvironmentMap takes."""
    half_lit = far_radiance(find_resource("scenes", "half_lit", ".xml"), height=16)
    assert half_lit.shape == (3, 16, 32) and half_lit[:, 8, 0].min() > 10 * half_lit[:, 8, 16].max()
    dome = far_radiance(find_resource("scenes", "dome", ".xml"), height=16)
    assert dome[1, 0].mean() > 1.5 * dome[1, -1].mean()
    EnvironmentMap(dome)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<scene", "expected a Mitsuba scene in .*scene.xml; got: "),
        ('<scene version="3.0.0"><emitter type="nonesuch"/></scene>', "nonesuch"),
        ('<scene version="3.0.0"/>', "expected a scene with a lamp to relight by"),
    ],
)
def test_bad_scenes_are_named(tmp_path, small_rig, text, message):
    (tmp_path / "scene.xml").write_text(text)
    with pytest.raises(ValueError, match=message):
        LitScene(tmp_path / "scene.xml", small_rig.topology, TEXTURE_SIZE, "relit")


def test_bad_input_is_refused(constant, tmp_path, small_rig, surface):
    with pytest.raises(FileNotFoundError, match="there is none"):
        LitScene(tmp_path / "none.xml", small_rig.topology, TEXTURE_SIZE, "baked")
    lit = LitScene(constant, small_rig.topology, TEXTURE_SIZE, "baked")
    with pytest.raises(ValueError, match="must be finite"):
        lit.place(surface * float("nan"), make_texture())
    with pytest.raises(ValueError, match="max_depth of at least 2"):
        PathTracer(lit, 1)
    with pytest.raises(ValueError, match="samples >= 1"):
        SampleBudget(0)
    (tmp_path / "lamp.xml").write_text('<scene version="3.0.0"><emitter type="point"/></scene>')
    with pytest.raises(ValueError, match="expected one environment map .* Use uniform"):
        far_radiance(tmp_path / "lamp.xml")
