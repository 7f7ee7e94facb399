"""Radiance and mask against an independent float64 ray tracer; batches, crops and seeds."""

import numpy as np
import pytest
import torch

from mitsuba_avatar.rendering.cameras import CameraBatch
from mitsuba_avatar.rendering.surface import SurfaceRenderer
from tests.rendering import meshes, reference

FILM = (30, 22)
MESHES = {"cube": meshes.cube, "sphere": lambda: meshes.sphere(1), "arms": meshes.arms_before_torso, "sheet": meshes.open_sheet}


def to_torch(array) -> torch.Tensor:
    return torch.tensor(array, dtype=torch.float32)


@pytest.mark.parametrize("name", MESHES)
def test_image_is_that_of_the_reference(name):
    vertices, topology = MESHES[name]()
    cameras, textures = meshes.orbit(3, *FILM, distance=2.2), meshes.waves(3, 16, 20)
    renderer = SurfaceRenderer(topology, *FILM, samples_per_pixel=256)
    radiance, mask = renderer.render(to_torch(vertices)[None], textures, cameras)
    assert radiance.shape == (3, 3, 22, 30)
    assert mask.shape == (3, 1, 22, 30)
    for view in (0, 2):
        expected, coverage = reference.traced_image(vertices, topology, textures[view], cameras, view, FILM)
        # Both sample: an edge pixel differs by its share of a sample or two, sums by far less.
        np.testing.assert_allclose(mask[view, 0], coverage, atol=0.03)
        np.testing.assert_allclose(radiance[view], expected, atol=0.03)
        np.testing.assert_allclose(radiance[view].sum(), expected.sum(), rtol=3e-3)
        np.testing.assert_allclose(mask[view].sum(), coverage.sum(), rtol=3e-3)


def test_mask_is_the_exact_coverage_of_a_convex_mesh():
    vertices, topology = meshes.sphere(1)
    cameras = meshes.orbit(2, *FILM, distance=2.2)
    renderer = SurfaceRenderer(topology, *FILM, samples_per_pixel=256)
    _, mask = renderer.render(to_torch(vertices)[None], meshes.waves(2, 16, 20), cameras)
    for view in range(2):
        exact = reference.convex_image(vertices, topology.faces, np.ones((len(topology.faces), 3)), cameras, view, FILM)[3]
        np.testing.assert_allclose(mask[view, 0], exact, atol=0.03)


def test_one_sample_a_pixel_is_right_on_average():
    vertices, topology = meshes.arms_before_torso()
    cameras, textures = meshes.orbit(2, *FILM, distance=2.2), meshes.waves(2, 16, 20)
    renderer = SurfaceRenderer(topology, *FILM)
    images = torch.stack([renderer.render(to_torch(vertices)[None], textures, cameras, seed=seed)[0] for seed in range(200)])
    expected, _ = reference.traced_image(vertices, topology, textures[1], cameras, 1, FILM)
    error = images[:, 1].std(0) / 200**0.5
    difference = (images[:, 1].mean(0) - torch.tensor(expected)).abs()
    assert float((difference > 4 * error + 0.02).float().mean()) < 0.005


def test_a_background_shows_where_the_surface_does_not():
    """One colour, one a view, plates: each pixel is the premultiplied image plus the uncovered share of what lies behind."""
    vertices, topology = meshes.sphere(1)
    cameras, textures = meshes.orbit(2, *FILM), meshes.waves(2, 16, 20)
    renderer = SurfaceRenderer(topology, *FILM, samples_per_pixel=4)
    premultiplied, mask = renderer.render(to_torch(vertices)[None], textures, cameras)
    plates = torch.rand(2, 3, 22, 30, generator=torch.Generator().manual_seed(0))
    for background in (plates, plates[:, :, 3, 5], plates[0, :, 3, 5]):
        image, same_mask = renderer.render(to_torch(vertices)[None], textures, cameras, background=background)
        behind = background if background.ndim == 4 else background.reshape(-1, 3, 1, 1).expand(2, -1, 22, 30)
        assert torch.equal(mask, same_mask)
        for y, x in ((0, 0), (11, 15), (9, 8)):
            expected = premultiplied[:, :, y, x] + (1 - mask[:, :, y, x]) * behind[:, :, y, x]
            torch.testing.assert_close(image[:, :, y, x], expected)
    for wrong in (plates[:1], plates[:, :, :, :-1], plates[..., 0, 0, 0]):
        with pytest.raises(ValueError, match=r"background must be \[3\], \[2, 3\] or \[2, 3, 22, 30\]"):
            renderer.render(to_torch(vertices)[None], textures, cameras, background=wrong)


def test_silhouettes_feel_the_background():
    """Over a background of the surface's own colour nothing changes where the surface moves: the vertex gradient is zero."""
    vertices, topology = meshes.sphere(1)
    cameras, textures = meshes.orbit(2, *FILM), torch.full((2, 3, 4, 6), 0.5)
    renderer = SurfaceRenderer(topology, *FILM, samples_per_pixel=4, boundary_samples_per_edge=4)
    gradients = []
    for behind in (0.0, 0.5):
        moved = to_torch(vertices)[None].requires_grad_()
        image, _ = renderer.render(moved, textures, cameras, background=torch.full((3,), behind))
        weights = torch.linspace(0, 1, 30) * torch.linspace(1, 2, 22)[:, None]
        gradients.append(torch.autograd.grad((image * weights).sum(), moved)[0].abs().sum())
    assert gradients[1] < 1e-3 * gradients[0]


def test_equal_seeds_give_equal_images_and_others_do_not():
    vertices, topology = meshes.sphere(1)
    cameras, textures = meshes.orbit(2, *FILM), meshes.waves(2, 16, 20)
    renderer = SurfaceRenderer(topology, *FILM)
    first, again, other = (renderer.render(to_torch(vertices)[None], textures, cameras, seed=seed)[0] for seed in (4, 4, 5))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_several_meshes_in_one_launch_equal_separate_launches():
    """Images and gradients; views take meshes in any order."""
    vertices, topology = meshes.arms_before_torso()
    poses = torch.stack([to_torch(vertices), to_torch(vertices) * 1.2 + torch.tensor([0.1, 0.3, -0.2]), to_torch(vertices)[:, [1, 2, 0]]])
    cameras, textures = meshes.orbit(5, *FILM, distance=2.5), meshes.waves(5, 16, 20)
    mesh_index = torch.tensor([2, 0, 1, 0, 2])
    renderer = SurfaceRenderer(topology, *FILM, samples_per_pixel=64, boundary_samples_per_edge=64)
    together, textures_together = poses.clone().requires_grad_(), textures.clone().requires_grad_()
    radiance, mask = renderer.render(together, textures_together, cameras, mesh_index)
    (radiance.square().sum() + mask.square().sum()).backward()

    gradient = torch.zeros_like(poses)
    for view, mesh in enumerate(mesh_index.tolist()):
        alone, texture_alone = poses[mesh : mesh + 1].clone().requires_grad_(), textures[view : view + 1].clone().requires_grad_()
        camera = CameraBatch(cameras.intrinsics[view : view + 1], cameras.camera_from_world[view : view + 1])
        radiance_alone, mask_alone = renderer.render(alone, texture_alone, camera)
        (radiance_alone.square().sum() + mask_alone.square().sum()).backward()
        np.testing.assert_allclose(mask_alone[0].detach(), mask[view].detach(), atol=0.08)
        np.testing.assert_allclose(radiance_alone.sum().item(), radiance[view].sum().item(), rtol=2e-3)
        np.testing.assert_allclose(texture_alone.grad[0], textures_together.grad[view], atol=0.03 * float(textures_together.grad.max()))
        gradient[mesh] += alone.grad[0]
    np.testing.assert_allclose(together.grad, gradient, atol=0.02 * float(gradient.abs().max()))


def test_a_crop_by_principal_point_is_the_crop_of_the_large_image():
    vertices, topology = meshes.sphere(1)
    cameras, textures = meshes.orbit(2, 60, 44, distance=2.2), meshes.waves(2, 16, 20)
    whole, whole_mask = SurfaceRenderer(topology, 60, 44, samples_per_pixel=256).render(to_torch(vertices)[None], textures, cameras)
    corners = torch.tensor([[12.0, 7.0], [25.0, 16.0]])
    crop = SurfaceRenderer(topology, *FILM, samples_per_pixel=256)
    radiance, mask = crop.render(to_torch(vertices)[None], textures, cameras.shifted(corners))
    for view, (x, y) in enumerate(corners.int().tolist()):
        np.testing.assert_allclose(radiance[view], whole[view, :, y : y + 22, x : x + 30], atol=0.03)
        np.testing.assert_allclose(mask[view], whole_mask[view, :, y : y + 22, x : x + 30], atol=0.03)


def test_a_surface_of_one_colour_keeps_it_under_every_view():
    """Radiance is premultiplied: it equals colour times coverage exactly."""
    vertices, topology = meshes.arms_before_torso()
    cameras = meshes.orbit(4, *FILM)
    textures = torch.tensor([0.2, 0.5, 0.9]).view(1, 3, 1, 1).repeat(4, 1, 3, 5)
    radiance, mask = SurfaceRenderer(topology, *FILM).render(to_torch(vertices)[None], textures, cameras)
    np.testing.assert_allclose(radiance, mask * textures[:, :, :1, :1], atol=1e-6)


def test_layers_are_the_geometry_behind_the_image():
    vertices, topology = meshes.arms_before_torso()
    cameras, textures = meshes.orbit(4, *FILM, distance=2.2), meshes.waves(4, 16, 20)
    poses = torch.stack([to_torch(vertices), to_torch(vertices) + torch.tensor([0.1, -0.2, 0.05])])
    renderer = SurfaceRenderer(topology, *FILM, samples_per_pixel=4)
    layers = renderer.render_layers(poses, textures, cameras, seed=2)
    radiance, mask = renderer.render(poses, textures, cameras, seed=2)
    assert torch.equal(layers.radiance, radiance)
    assert torch.equal(layers.mask, mask)
    for view in range(4):
        is_hit = layers.depth[view, 0] > 0
        assert is_hit.sum() > 50
        position = layers.position[view][:, is_hit].T.double().numpy()  # [N, 3]
        rotation, translation, (fx, fy, cx, cy) = reference.rows(cameras, view)
        in_camera = position @ rotation.T + translation
        pixels = in_camera[:, :2] / in_camera[:, 2:] * [fx, fy] + [cx, cy]
        row, column = is_hit.nonzero(as_tuple=True)
        assert (np.abs(pixels - np.stack([column + 0.5, row + 0.5], axis=1)) < 0.501).all()  # the sample lies in its pixel
        mesh = poses[view // 2].double().numpy()
        depth, face, b1, b2 = reference.nearest_hits(mesh, topology.faces, cameras, view, pixels)
        np.testing.assert_allclose(layers.depth[view, 0][is_hit], depth, rtol=1e-4)
        corners = mesh[topology.faces[face]]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        agrees = np.abs(layers.normal[view][:, is_hit].T.numpy() - normal).max(axis=1) < 1e-4
        assert agrees.mean() > 0.99  # rays along an edge may take either side
        corner_uv = topology.uv.astype(np.float64)[topology.uv_faces[face]]
        uv = corner_uv[:, 0] + b1[:, None] * (corner_uv[:, 1] - corner_uv[:, 0]) + b2[:, None] * (corner_uv[:, 2] - corner_uv[:, 0])
        np.testing.assert_allclose(layers.uv[view][:, is_hit].T.numpy()[agrees], uv[agrees], atol=1e-3)
        for layer in (layers.normal, layers.position, layers.uv):
            assert (layer[view][:, ~is_hit] == 0).all()


def test_layers_leave_the_gradients_of_the_image_alone():
    vertices, topology = meshes.sphere(1)
    renderer = SurfaceRenderer(topology, *FILM)
    gradients = []
    for draw in (renderer.render, renderer.render_layers):
        x = to_torch(vertices)[None].requires_grad_()
        drawn = draw(x, meshes.waves(2, 16, 20), meshes.orbit(2, *FILM), seed=1)
        radiance, mask = drawn if isinstance(drawn, tuple) else (drawn.radiance, drawn.mask)
        (radiance.square().sum() + mask.square().sum()).backward()
        gradients.append(x.grad)
    np.testing.assert_allclose(gradients[0], gradients[1], atol=1e-4 * float(gradients[0].abs().max()))
