"""The atlas: orientation, rasterisation, seams, round trips, gradients."""

import numpy as np
import pytest
import torch

from mitsuba_avatar.body.rig import Topology
from mitsuba_avatar.body.uv import UvAtlas, texel_of_uv, uv_of_texel
from tests.body import reference
from tests.small_rig import SEGMENTS


@pytest.fixture(scope="module")
def atlas(small_rig):
    return UvAtlas(small_rig.topology, 96)


def test_orientation_row_zero_is_v_one():
    corners = np.array([[0.0, 1.0], [1.0, 0.0], [0.125, 0.75]])
    np.testing.assert_allclose(texel_of_uv(corners, height=4, width=8), [[-0.5, -0.5], [3.5, 7.5], [0.5, 0.5]])
    uv = np.random.default_rng(0).uniform(size=(7, 2))
    np.testing.assert_allclose(uv_of_texel(texel_of_uv(uv, 5, 9), 5, 9), uv, atol=1e-12)


def test_texels_equal_the_reference(small_rig, atlas):
    values = np.random.default_rng(1).normal(size=(2, 258, 2))
    maps = atlas.texels_from_vertices(torch.from_numpy(values)).numpy()
    texels = np.random.default_rng(2).integers(0, 96, size=(60, 2))
    found = 0
    for row, column in texels:
        expected = reference.texel_value(small_rig.topology, values[1], row, column, 96)
        assert atlas.covered[row, column].item() == (expected is not None), (row, column)
        if expected is not None:
            np.testing.assert_allclose(maps[1, :, row, column], expected, atol=1e-6)
            found += 1
    assert 20 < found < 60


def test_coverage_tables_agree(small_rig, atlas):
    covered = atlas.covered
    assert 0.6 < covered.float().mean() < 0.7  # charts fill 66 % of the small rig's atlas
    assert torch.equal(covered, atlas.face_index >= 0)
    torch.testing.assert_close(atlas.barycentric.sum(-1), covered.float())
    assert atlas.barycentric.min() > -1e-4
    rows, columns = torch.nonzero(covered, as_tuple=True)
    corners = small_rig.topology.uv[small_rig.topology.uv_faces[atlas.face_index[covered].numpy()]]  # [N, 3, 2]
    uv = (atlas.barycentric[covered].numpy()[..., None] * corners).sum(1)
    np.testing.assert_allclose(texel_of_uv(uv, 96, 96), np.stack([rows, columns], axis=1), atol=1e-3)


@pytest.mark.parametrize(("size", "worst_mm", "mean_mm"), [(48, 6.0, 1.0), (128, 1.0, 0.25), (512, 0.2, 0.08)])
def test_round_trip_of_the_small_rig(small_rig, size, worst_mm, mean_mm):
    vertices = torch.from_numpy(small_rig.rest_vertices)[None].expand(2, -1, -1)
    atlas = UvAtlas(small_rig.topology, size)
    error = (atlas.vertices_from_texels(atlas.texels_from_vertices(vertices)) - vertices).norm(dim=-1) * 1e3
    assert error.max() < worst_mm, f"{error.max():.3f} mm"
    assert error.mean() < mean_mm, f"{error.mean():.3f} mm"


def test_round_trip_of_a_person_is_below_a_millimetre(anny_rig):
    vertices = torch.from_numpy(anny_rig.rest_vertices)[None]
    atlas = UvAtlas(anny_rig.topology, 512)
    error = (atlas.vertices_from_texels(atlas.texels_from_vertices(vertices)) - vertices).norm(dim=-1)[0] * 1e3
    assert error.mean() < 0.5, f"{error.mean():.3f} mm"
    assert error.quantile(0.95) < 1.0, f"{error.quantile(0.95):.3f} mm"  # the rest: lips and ears, curved within a texel


def test_linear_continuation_makes_border_lookups_exact(small_rig, atlas):
    """Height is linear in v on the tube's chart, so a bilinear lookup anywhere on its seams must return it exactly."""
    heights = torch.from_numpy(small_rig.rest_vertices[None, :, 2:])
    back = atlas.vertices_from_texels(atlas.texels_from_vertices(heights))[0, :, 0]
    inside = slice(SEGMENTS, -SEGMENTS - 2)  # the first and last ring also lie on the caps' charts, where height is not linear
    torch.testing.assert_close(back[inside], heights[0, inside, 0], atol=2e-6, rtol=0)
    cut = UvAtlas(small_rig.topology, 96)
    blank = cut.texels_from_vertices(heights) * cut.covered
    damaged = (cut.vertices_from_texels(blank)[0, inside, 0] - heights[0, inside, 0]).abs()
    assert damaged.max() > 0.05, "without filled gutters this test would show nothing"


def test_constant_maps_survive_any_map_size(atlas):
    maps = torch.full((2, 3, 24, 40), 0.7)
    torch.testing.assert_close(atlas.vertices_from_texels(maps), torch.full((2, 258, 3), 0.7))


def test_lookup_is_bilinear_and_averages_copies():
    """One triangle and a mirrored one on another chart: vertex 0 has two copies, a ramp along rows is read at both."""
    uv = np.array([[0.1, 0.9], [0.4, 0.9], [0.1, 0.6], [0.9, 0.1], [0.9, 0.4], [0.6, 0.1]], dtype=np.float32)
    topology = Topology(num_vertices=6, faces=np.array([[0, 2, 1], [0, 3, 4]]), uv=uv, uv_faces=np.array([[0, 2, 1], [3, 4, 5]]))
    ramp = torch.arange(10.0)[:, None] + 100 * torch.arange(20.0)  # row + 100 column
    maps = torch.stack([ramp, 2 * ramp])[:, None]
    values = UvAtlas(topology, 16).vertices_from_texels(maps)[..., 0]
    row, column = texel_of_uv(uv.astype(np.float64), 10, 20).T
    read = row + 100 * column
    expected = torch.tensor([(read[0] + read[3]) / 2, read[1], read[2], read[4], read[5], 0.0]).float()
    torch.testing.assert_close(values[0], expected, atol=2e-3, rtol=0)  # vertex 5 is of no face: zero
    torch.testing.assert_close(values[1], 2 * expected, atol=4e-3, rtol=0)


def test_inpaint_fills_from_the_nearest_covered_texel(atlas):
    generator = torch.Generator().manual_seed(3)
    maps = torch.rand(2, 2, 96, 96, generator=generator)
    filled = atlas.inpaint(maps)
    covered = atlas.covered
    assert torch.equal(filled[..., covered], maps[..., covered])
    sources = torch.nonzero(covered)
    for row, column in [(0, 0), (95, 40), (50, 0), (70, 50)]:
        assert not covered[row, column]
        distance = (sources - torch.tensor([row, column])).float().norm(dim=1)
        nearest = sources[distance <= distance.min() + 1e-6]
        candidates = maps[1, 0, nearest[:, 0], nearest[:, 1]]
        assert (filled[1, 0, row, column] - candidates).abs().min() == 0
    again = atlas.inpaint(torch.where(covered, maps, torch.nan))
    assert torch.equal(again, filled), "what empty texels held must not matter"


def test_gradients_equal_finite_differences(small_rig):
    atlas = UvAtlas(small_rig.topology, 12).double()
    generator = torch.Generator().manual_seed(4)
    values = torch.randn(2, 258, 1, dtype=torch.float64, generator=generator).requires_grad_()
    maps = torch.randn(2, 1, 7, 9, dtype=torch.float64, generator=generator).requires_grad_()
    square = torch.randn(2, 1, 12, 12, dtype=torch.float64, generator=generator).requires_grad_()
    assert torch.autograd.gradcheck(atlas.texels_from_vertices, values, fast_mode=True)
    assert torch.autograd.gradcheck(atlas.vertices_from_texels, maps, fast_mode=True)
    assert torch.autograd.gradcheck(atlas.inpaint, square, fast_mode=True)


def test_wrong_sizes_are_refused(small_rig, atlas):
    with pytest.raises(ValueError, match=r"values must be \[B, 258, C\] for this atlas; got \[2, 257, 3\]"):
        atlas.texels_from_vertices(torch.zeros(2, 257, 3))
    with pytest.raises(ValueError, match=r"maps must be \[B, C, 96, 96\] for this atlas; got \[2, 3, 48, 48\]"):
        atlas.inpaint(torch.zeros(2, 3, 48, 48))
    with pytest.raises(ValueError, match="charts under some of 1x1 texel centres"):
        nothing = np.full_like(small_rig.topology.uv, 0.1)
        UvAtlas(Topology(258, small_rig.topology.faces, nothing, small_rig.topology.uv_faces), 1)
