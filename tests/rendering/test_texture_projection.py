"""Images of a known texture, projected back, give that texture."""

import numpy as np
import pytest
import torch

from mitsuba_avatar.rendering.surface import SurfaceRenderer
from mitsuba_avatar.rendering.texture_projection import TextureProjection, project
from tests.rendering import meshes, reference

FILM = (90, 70)


def render(vertices, topology, textures, cameras):
    renderer = SurfaceRenderer(topology, *FILM, samples_per_pixel=16)
    radiance, mask = renderer.render(vertices[None], textures, cameras)
    return radiance, mask


def smooth(size: int) -> torch.Tensor:
    """[3, size, size] that varies slowly beside a pixel's footprint."""
    v, u = torch.meshgrid(torch.linspace(0, 1, size), torch.linspace(0, 1, size), indexing="ij")
    return torch.stack([0.2 + 0.6 * u, 0.9 - 0.5 * v, 0.3 + 0.4 * u * v])


def test_a_known_texture_comes_back():
    vertices, topology = meshes.sphere(3)
    vertices = torch.tensor(vertices, dtype=torch.float32)
    texture = smooth(64)
    projection = TextureProjection(topology, 64)
    for turn in range(2):  # two frames: the mesh moves between them
        moved = vertices + torch.tensor([0.05 * turn, -0.1 * turn, 0.1 * turn])
        cameras = meshes.orbit(6, *FILM, distance=2.6)
        radiance, mask = render(moved, topology, texture.expand(6, -1, -1, -1), cameras)
        projection.add(moved, radiance, mask, cameras)
    mean = projection.mean()
    seen = torch.zeros(64 * 64, dtype=torch.bool)
    seen[projection.covered[projection.weight[:, 0] > 0.05]] = True
    seen = seen.view(64, 64)
    assert seen.sum() > 0.5 * projection.atlas.covered.sum()
    error = (mean - texture).abs()[:, seen]
    assert error.mean() < 0.01
    assert error.quantile(0.9) < 0.02  # along the equator, where the texture jumps, pixels mix both sides
    assert torch.isfinite(mean).all()


def test_hidden_texels_take_nothing_from_what_hides_them():
    """The arms are red and stand before a blue torso: no texel of the torso turns red."""
    vertices, topology = meshes.arms_before_torso()
    vertices = torch.tensor(vertices, dtype=torch.float32)
    texture = torch.zeros(1, 3, 60, 60)
    texture[:, 2, :, :20] = 1.0
    texture[:, 0, :, 20:] = 1.0
    cameras = meshes.orbit(6, *FILM, distance=2.6)
    radiance, mask = render(vertices, topology, texture.expand(6, -1, -1, -1), cameras)
    projection = TextureProjection(topology, 60)
    projection.add(vertices, radiance, mask, cameras)
    torso = projection.atlas.covered & (torch.arange(60) < 18)
    seen = torch.zeros(3600)
    seen[projection.covered] = projection.weight[:, 0]
    sure = torso & (seen.view(60, 60) > 0.2)
    assert sure.sum() > 100
    assert projection.mean()[0][sure].mean() < 0.05  # only pixels that straddle a contour mix


def test_a_mesh_that_no_camera_sees_is_refused():
    vertices, topology = meshes.cube()
    projection = TextureProjection(topology, 32)
    with pytest.raises(ValueError, match="no camera saw the mesh inside its mask"):
        projection.mean()
    projection.add(
        torch.tensor(vertices, dtype=torch.float32), torch.ones(2, 3, 20, 30), torch.zeros(2, 1, 20, 30), meshes.orbit(2, 30, 20)
    )
    with pytest.raises(ValueError, match="no camera saw the mesh inside its mask"):
        projection.mean()


def test_projection_of_points():
    cameras = meshes.orbit(3, *FILM)
    points = np.random.default_rng(0).normal(size=(20, 3)) * 0.3
    pixels, depth = project(cameras, torch.tensor(points, dtype=torch.float32))
    for view in range(3):
        rotation, translation, (fx, fy, cx, cy) = reference.rows(cameras, view)
        expected = points @ rotation.T + translation
        np.testing.assert_allclose(depth[view], expected[:, 2], rtol=1e-5)
        np.testing.assert_allclose(pixels[view, :, 0], fx * expected[:, 0] / expected[:, 2] + cx, rtol=1e-4)
        np.testing.assert_allclose(pixels[view, :, 1], fy * expected[:, 1] / expected[:, 2] + cy, rtol=1e-4)
