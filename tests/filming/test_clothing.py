import numpy as np

from mitsuba_avatar.filming.anatomy import FOOT, HAND, Anatomy
from mitsuba_avatar.filming.clothing import DressedBody, around, hairline, plane, shirt, trousers


def test_cloth_has_real_thickness_and_never_enters_the_skin(body: DressedBody):
    gap = ((body.vertices - body.skin) * body.normals).sum(axis=1)
    for name in ("shirt", "trousers"):
        cloth = body.coverage[name] > 0
        assert np.quantile(gap[cloth], 0.01) > 0.003, name
        assert 0.006 < np.median(gap[cloth]) < 0.025, name


def test_hands_feet_and_face_stay_bare(anatomy: Anatomy, body: DressedBody):
    bare = (anatomy.weight(HAND) > 0.9) | (anatomy.weight(FOOT) > 0.9) | (anatomy.rig.face_region > 0.5)
    np.testing.assert_allclose(body.vertices[bare], anatomy.rig.rest_vertices[bare], atol=1e-6)


def test_hems_are_clean_lines(anatomy: Anatomy, body: DressedBody):
    """Covered vertices next to a hem lie on its plane, to a fraction of an edge's length (19 mm)."""
    garment = shirt(anatomy)
    share = anatomy.smoothing @ garment.covered.astype(np.float64)
    edge = garment.covered & (share < 0.999)
    waist, sleeve = garment.hems[1], garment.hems[2]
    for hem in (waist, sleeve):
        distance = np.abs(hem.field(body.skin[edge & hem.part].astype(np.float64)))
        distance = distance[distance < 0.05]  # the part also holds the edges of other hems
        assert len(distance) >= 12
        assert np.quantile(distance, 0.9) < 0.004


def test_shirt_lies_over_trousers(anatomy: Anatomy):
    top = shirt(anatomy)
    assert not (top.covered & trousers(anatomy, top).covered).any()


def test_fields_are_distances_inwards():
    field = plane(np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, 2.0]))
    np.testing.assert_allclose(field(np.array([[0.3, 0.1, 1.5], [0, 0, 0.0]])), [0.5, -1.0])
    ring = around(np.array([1.0, 0.0, 0.0]), (0.1, 0.1, 0.1))
    np.testing.assert_allclose(ring(np.array([[1.2, 0, 0], [1, 0.05, 0]])), [0.1, -0.05], atol=1e-12)


def test_hair_grows_on_the_crown_and_not_on_the_face(anatomy: Anatomy):
    eyes = 0.5 * (anatomy.joint("eye.L") + anatomy.joint("eye.R")).astype(np.float64)
    crown, nose = eyes + [0, 0.08, 0.11], eyes + [0, -0.02, -0.03]
    heights = hairline(anatomy, np.stack([crown, nose]))
    assert heights[0] > 0 > heights[1]
