"""Difference across the seams of an atlas: zero where a texture is a function of the surface, the step where it is not."""

import numpy as np
import pytest
import torch

from mitsuba_avatar.body.rig import Topology
from mitsuba_avatar.body.uv import UvAtlas
from mitsuba_avatar.captures.colour import encode
from mitsuba_avatar.reporting.seams import SeamSampler
from tests.small_rig import SEGMENTS, make_small_rig


def two_triangles(gap: bool) -> Topology:
    """A square cut along its diagonal; with `gap`, the halves lie apart in the atlas, left and right."""
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    uv = np.array([[0.1, 0.1], [0.3, 0.1], [0.4, 0.9], [0.1, 0.9]], np.float32)
    if not gap:
        return Topology(4, faces, uv, faces)
    right = uv[[0, 2, 3]] + np.array([0.5, 0], np.float32)
    return Topology(4, faces, np.concatenate([uv, right]), np.array([[0, 1, 2], [4, 5, 6]]))


def test_a_step_between_the_charts_is_measured_in_display_values():
    texture = torch.full((3, 20, 20), 0.2)
    texture[:, :, 10:] = torch.tensor([0.2, 0.5, 0.2])[:, None, None]
    step = 255 * float(encode(torch.tensor(0.5), "srgb") - encode(torch.tensor(0.2), "srgb")) / 3
    assert SeamSampler(two_triangles(gap=True)).difference(texture) == pytest.approx(step, rel=1e-4)
    assert SeamSampler(two_triangles(gap=False)).difference(texture) == 0, "no seam, no difference"


def test_both_sides_are_the_same_points_of_the_surface():
    rig = make_small_rig()
    sampler = SeamSampler(rig.topology, samples_per_edge=3)
    assert sampler.sides.shape == (2, 3 * (15 + 2 * SEGMENTS), 2), "the tube's seam and one around each cap"
    # A texture that holds the surface's own position agrees on both sides, up to a texel; random texels do not.
    atlas = UvAtlas(rig.topology, 256)
    position = atlas.texels_from_vertices(torch.from_numpy(rig.rest_vertices)[None])[0]
    noise = torch.rand(3, 256, 256, generator=torch.Generator().manual_seed(1))
    smooth = 0.3 + 0.5 * (position - position.amin()) / (position.amax() - position.amin())
    assert sampler.difference(smooth) < 1.5 < 30 < sampler.difference(noise)
