import numpy as np

from mitsuba_avatar.body.uv import texel_of_uv
from mitsuba_avatar.filming.anatomy import Anatomy
from mitsuba_avatar.filming.appearance import Appearance, paint
from mitsuba_avatar.filming.canvas import Canvas, Paint, bands, within
from mitsuba_avatar.filming.clothing import DressedBody

SIZE = 128


def _colour_at(anatomy: Anatomy, appearance: Appearance, point: np.ndarray) -> np.ndarray:
    """Base colour at the vertex nearest to a rest position."""
    topology = anatomy.rig.topology
    vertex = np.linalg.norm(anatomy.rig.rest_vertices - point, axis=1).argmin()
    row, column = texel_of_uv(topology.uv[topology.uv_faces[topology.faces == vertex][:1]], SIZE, SIZE)[0].round().astype(int)
    return appearance.base_colour[row, column]


def test_reflectances_are_physical_and_the_same_for_one_seed(anatomy: Anatomy, body: DressedBody):
    first, again, other = (paint(anatomy, body, SIZE, seed) for seed in (0, 0, 1))
    assert first.base_colour.min() >= 0.02 and first.base_colour.max() <= 0.8
    assert first.roughness.min() > 0 and first.roughness.max() <= 1
    np.testing.assert_array_equal(first.base_colour, again.base_colour)
    assert np.abs(first.base_colour - other.base_colour).max() > 0.01


def test_clothes_are_painted_where_they_are_worn_and_left_differs_from_right(anatomy: Anatomy, body: DressedBody):
    appearance = paint(anatomy, body, SIZE, 0)
    chest = _colour_at(anatomy, appearance, anatomy.joint("spine01") + [-0.05, -0.12, 0])
    knee = _colour_at(anatomy, appearance, anatomy.joint("lowerleg01.L") + [0, 0.1, 0])
    hand = _colour_at(anatomy, appearance, anatomy.joint("finger3-1.L"))
    assert chest.min() > 0.25 and knee.max() < 0.3
    assert hand[0] > 1.3 * hand[1] > 1.3 * hand[2]  # skin is red before green before blue
    sleeves = [_colour_at(anatomy, appearance, anatomy.joint(f"upperarm02.{side}") + [0, -0.1, 0]) for side in "LR"]
    assert np.abs(sleeves[0] - sleeves[1]).max() > 0.05


def test_paint_goes_over_and_under():
    base = Paint(np.zeros((2, 3, 3)), np.full((2, 3), 0.2))
    alpha = np.array([[0, 0.5, 1], [1, 0, 0]])
    over = base.over((1.0, 0.5, 0.0), alpha, roughness=0.6)
    np.testing.assert_allclose(over.colour[0, 1], [0.5, 0.25, 0])
    np.testing.assert_allclose(over.roughness, 0.2 + 0.4 * alpha)
    np.testing.assert_allclose(base.over((1.0, 1.0, 1.0), alpha).roughness, 0.2)
    np.testing.assert_allclose(base.under(Paint(np.ones((2, 3, 3)), np.ones((2, 3))), alpha).colour[..., 0], alpha)


def test_noise_has_zero_mean_and_unit_variance(anatomy: Anatomy, body: DressedBody):
    noise = Canvas(anatomy, body, 64, seed=5).noise(0.01)
    assert abs(noise.mean()) < 0.15 and abs(noise.std() - 1) < 0.2


def test_bands_and_edges():
    assert bands(np.array([[0.5, 0.0, 1.5]]), period=1.0, fill=0.4).tolist() == [[1, 0, 1]]
    np.testing.assert_allclose(within(np.array([[0.0, 1.0, 2.0]]), edge=1.0, softness=0.5), [[1, 0.5, 0]])
