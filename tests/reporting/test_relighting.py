"""Albedo is radiance with the captured light divided out."""

import pytest
import torch

from mitsuba_avatar.rendering.environment_map import EnvironmentMap
from mitsuba_avatar.reporting.playback import Playback
from mitsuba_avatar.reporting.relighting import CapturedLight, SurfaceRadiance, estimate_albedo

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def shown(loaded):
    return SurfaceRadiance(Playback(loaded.avatar, loaded.capture, loaded.occlusion()), loaded.run.rig.topology)


def test_in_uniform_light_open_texels_keep_their_radiance(shown):
    light = CapturedLight.of(shown.playback.capture)
    assert light.name == "uniform"
    albedo, radiance = estimate_albedo(shown, light), shown.mean()
    ratio = (albedo / radiance)[:, shown.atlas.covered]
    assert float(ratio.median()) == pytest.approx(1, abs=0.03)


def test_twice_the_light_is_half_the_albedo(shown):
    once, twice = (estimate_albedo(shown, CapturedLight("bright", EnvironmentMap(torch.full((3, 2, 4), value)))) for value in (1.0, 2.0))
    torch.testing.assert_close(once[once < 0.9], 2 * twice[once < 0.9])


def test_texels_in_the_dark_are_taken_for_brighter_paint(shown):
    """Light from +x alone: the same radiance on -x must be a brighter surface, but not beyond all bounds."""
    sky = torch.full((3, 4, 8), 0.1)
    sky[:, :, [0, 7]] = 3.0  # azimuths around +x
    lit = estimate_albedo(shown, CapturedLight("side", EnvironmentMap(sky)))
    even = estimate_albedo(shown, CapturedLight.of(shown.playback.capture, "uniform"))
    normal = torch.nn.functional.normalize(shown.atlas.texels_from_vertices(torch.from_numpy(_outwards(shown))[None])[0], dim=0)[0]
    ratio = (lit / even).mean(dim=0)
    covered = shown.atlas.covered
    assert ratio[covered & (normal < -0.7)].median() > 1.5 * ratio[covered & (normal > 0.7)].median()
    assert lit.max() <= 0.95 and lit.min() >= 0


def test_light_that_is_not_there_is_named(shown):
    capture = shown.playback.capture
    assert CapturedLight.of(capture, "dome").name == "dome"
    with pytest.raises(FileNotFoundError, match="'moon'.* Or say --captured-light uniform"):
        CapturedLight.of(capture, "moon")


def _outwards(shown):
    """[V, 3] from the tube's axis."""
    vertices = shown.playback.avatar.template_vertices.numpy().copy()
    vertices[:, 2] = 0
    return vertices
