import dataclasses

import numpy as np
import pytest

from mitsuba_avatar.body.rig import Rig
from mitsuba_avatar.filming.anatomy import ARM, LEG, Anatomy, smooth_step
from tests.small_rig import make_small_rig


def test_limbs_are_where_they_belong(anatomy: Anatomy):
    vertices = anatomy.rig.rest_vertices
    left_arm = anatomy.weight(ARM, "L") > 0.9
    assert vertices[left_arm][:, 0].min() > 0.1
    assert vertices[anatomy.weight(LEG, "R") > 0.9][:, 0].max() < 0.02
    np.testing.assert_allclose(anatomy.weight(ARM), anatomy.weight(ARM, "L") + anatomy.weight(ARM, "R"), atol=1e-6)


def test_the_skin_is_piece_zero(anatomy: Anatomy):
    counts = np.bincount(anatomy.piece)
    assert len(counts) == 4 and counts[0] == counts.max()


def test_smoothing_keeps_a_constant_and_held_vertices(anatomy: Anatomy, rng_seed: int = 3):
    values = np.random.default_rng(rng_seed).normal(size=(len(anatomy.piece), 2))
    free = np.arange(len(values)) % 3 > 0
    smoothed = anatomy.smooth(values, 2, free=free)
    np.testing.assert_array_equal(smoothed[~free], values[~free])
    assert smoothed[free].std() < 0.8 * values[free].std()
    np.testing.assert_allclose(anatomy.smooth(np.full((len(values), 1), 2.5), 3), 2.5, atol=1e-12)


def test_a_rig_of_other_joints_is_refused():
    with pytest.raises(ValueError, match=r"Anatomy.of\(\): expected Anny's joints; .*upperarm01.L"):
        Anatomy.of(make_small_rig())


def test_smooth_step_rises_and_falls():
    values = smooth_step(np.array([0.0, 1.0, 1.5, 2.0, 3.0]), 1.0, 2.0)
    np.testing.assert_allclose(values, [0, 0, 0.5, 1, 1])
    np.testing.assert_allclose(smooth_step(np.array([0.0, 1.5, 3.0]), 2.0, 1.0), [1, 0.5, 0])


def test_the_rig_is_not_changed(rig: Rig):
    before = rig.rest_vertices.copy()
    Anatomy.of(dataclasses.replace(rig))
    np.testing.assert_array_equal(rig.rest_vertices, before)
