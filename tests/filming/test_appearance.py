import numpy as np
import pytest

from mitsuba_avatar.body.uv import texel_of_uv
from mitsuba_avatar.filming.anatomy import Anatomy
from mitsuba_avatar.filming.appearance import ATTIRES, Appearance, paint, paint_garment
from mitsuba_avatar.filming.canvas import Canvas, Paint, Surface, bands, within
from mitsuba_avatar.filming.clothing import DressedBody
from mitsuba_avatar.filming.prints import EMBLEM, SHIRT, STRIPES

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
    noise = Canvas(anatomy, Surface.of_body(anatomy, body), 64, seed=5).noise(0.01)
    assert abs(noise.mean()) < 0.15 and abs(noise.std() - 1) < 0.2


def test_bands_and_edges():
    assert bands(np.array([[0.5, 0.0, 1.5]]), period=1.0, fill=0.4).tolist() == [[1, 0, 1]]
    np.testing.assert_allclose(within(np.array([[0.0, 1.0, 2.0]]), edge=1.0, softness=0.5), [[1, 0.5, 0]])


def test_attires_differ_in_clothes_and_hair_and_agree_in_skin(anatomy: Anatomy, body: DressedBody):
    first, second = (paint(anatomy, body, SIZE, 0, attire) for attire in ("striped", "leafy"))
    places = {
        "chest": anatomy.joint("spine01") + [-0.05, -0.12, 0],
        "knee": anatomy.joint("lowerleg01.L") + [0, 0.1, 0],
        "hair": anatomy.joint("eye.L") + [0, 0.05, 0.12],
        "hand": anatomy.joint("finger3-1.L"),
    }
    difference = {
        name: np.abs(_colour_at(anatomy, first, place) - _colour_at(anatomy, second, place)).max() for name, place in places.items()
    }
    assert min(difference[name] for name in ("chest", "knee", "hair")) > 0.08 and difference["hand"] == 0
    with pytest.raises(ValueError, match=r"paint\(\): expected an attire of striped, plain, leafy; got 'checked'"):
        paint(anatomy, body, SIZE, 0, "checked")


def test_the_plain_shirt_is_the_striped_one_without_stripes(anatomy: Anatomy, body: DressedBody):
    striped, plain = (paint(anatomy, body, SIZE, 0, attire).base_colour for attire in ("striped", "plain"))
    differs = np.abs(striped - plain).max(axis=-1) > 1e-3
    stripes = np.abs(striped - STRIPES).max(axis=-1) < 0.06
    assert 0.01 < differs.mean() < 0.5 and stripes[differs].mean() > 0.7, "what differs is stripes"
    emblem = (np.abs(plain - EMBLEM).max(axis=-1) < 0.05) & ~differs
    assert emblem.any() and np.abs(plain[differs] - SHIRT).mean() < 0.05


def test_a_garment_with_a_mesh_of_its_own_is_cloth_all_over(anatomy: Anatomy, body: DressedBody):
    """On the body's own surface the garment's painter gives what the dressed body shows where the garment is."""
    topology = anatomy.rig.topology
    surface = Surface.of_garment(anatomy, topology, body.skin)
    for attire in ATTIRES:
        for name in ("shirt", "shorts"):
            cloth = paint_garment(anatomy, name, surface, 48, 0, attire)
            assert cloth.roughness.min() > 0.6 and np.isfinite(cloth.base_colour).all()
    chest = anatomy.joint("spine01") + [-0.05, -0.12, 0]
    shirt = paint_garment(anatomy, "shirt", surface, SIZE, 0)
    np.testing.assert_allclose(_colour_at(anatomy, shirt, chest), _colour_at(anatomy, paint(anatomy, body, SIZE, 0), chest), atol=0.12)
    with pytest.raises(ValueError, match=r"paint_garment\(\): expected a garment of"):
        paint_garment(anatomy, "hat", surface, SIZE, 0)


def test_part_of_the_body_gets_its_charts_enlarged(anatomy: Anatomy):
    faces = (anatomy.piece == 2)[anatomy.rig.topology.faces].all(axis=1)
    part = Surface.of_part(anatomy, faces)
    np.testing.assert_array_equal(part.points[part.topology.faces], anatomy.rig.rest_vertices[anatomy.rig.topology.faces[faces]])
    assert 0 < part.topology.uv.min() < 0.02 and 0.98 < part.topology.uv.max() < 1
