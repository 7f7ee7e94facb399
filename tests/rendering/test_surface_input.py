"""Bad and borderline input: defined behaviour, named in the error where it is one."""

import numpy as np
import pytest
import torch

from mitsuba_avatar.rendering.cameras import CameraBatch
from mitsuba_avatar.rendering.surface import SurfaceRenderer
from tests.rendering import meshes

FILM = (30, 22)


@pytest.fixture(scope="module")
def scene():
    vertices, topology = meshes.sphere(1)
    return torch.tensor(vertices, dtype=torch.float32)[None], topology, SurfaceRenderer(topology, *FILM)


def gradients(renderer, vertices, cameras) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Mask, and gradients of vertices and textures of a loss over radiance and mask."""
    vertices = vertices.clone().requires_grad_()
    textures = meshes.waves(len(cameras), 16, 20).requires_grad_()
    radiance, mask = renderer.render(vertices, textures, cameras)
    (radiance.square().sum() + (mask * meshes.pixel_weights(len(cameras), 1, 22, 30)).sum()).backward()
    assert torch.isfinite(radiance).all()
    assert torch.isfinite(vertices.grad).all()
    assert torch.isfinite(textures.grad).all()
    return mask.detach(), vertices.grad, textures.grad


@pytest.mark.usefixtures("without_shape_checks")
class TestMessages:
    def test_vertices_of_another_topology(self, scene):
        vertices, _, renderer = scene
        with pytest.raises(ValueError, match=r"vertices must be \[P, 42, 3\] for this topology; got \[1, 41, 3\]"):
            renderer.render(vertices[:, :41], meshes.waves(2, 16, 20), meshes.orbit(2, *FILM))

    def test_textures_of_another_shape(self, scene):
        vertices, _, renderer = scene
        with pytest.raises(ValueError, match=r"textures must be \[B, 3, h, w\]; got \[2, 4, 16, 20\]"):
            renderer.render(vertices, torch.zeros(2, 4, 16, 20), meshes.orbit(2, *FILM))

    def test_double_precision(self, scene):
        vertices, _, renderer = scene
        with pytest.raises(TypeError, match=r"vertices must be float32; got torch.float64"):
            renderer.render(vertices.double(), meshes.waves(2, 16, 20), meshes.orbit(2, *FILM))
        with pytest.raises(TypeError, match=r"textures must be float32; got torch.float16"):
            renderer.render(vertices, meshes.waves(2, 16, 20).half(), meshes.orbit(2, *FILM))

    def test_more_cameras_than_textures(self, scene):
        vertices, _, renderer = scene
        with pytest.raises(ValueError, match="got 2 textures and 3 cameras"):
            renderer.render(vertices, meshes.waves(2, 16, 20), meshes.orbit(3, *FILM))

    def test_views_that_meshes_cannot_share(self, scene):
        vertices, _, renderer = scene
        with pytest.raises(ValueError, match="3 views cannot be shared evenly by 2 meshes"):
            renderer.render(vertices.repeat(2, 1, 1), meshes.waves(3, 16, 20), meshes.orbit(3, *FILM))

    def test_mesh_index_out_of_range(self, scene):
        vertices, _, renderer = scene
        with pytest.raises(ValueError, match=r"mesh_index must hold 2 values in 0..0; got \[0, 1\]"):
            renderer.render(vertices, meshes.waves(2, 16, 20), meshes.orbit(2, *FILM), torch.tensor([0, 1]))

    def test_vertices_that_are_not_finite(self, scene):
        vertices, _, renderer = scene
        broken = vertices.repeat(2, 1, 1)
        broken[1, 7, 2] = float("nan")
        with pytest.raises(ValueError, match=r"vertices of mesh \[1\] are not finite"):
            renderer.render(broken, meshes.waves(2, 16, 20), meshes.orbit(2, *FILM))

    def test_cameras_that_are_not_finite(self, scene):
        vertices, _, renderer = scene
        cameras = meshes.orbit(2, *FILM)
        cameras.intrinsics[1, 0] = float("inf")
        with pytest.raises(ValueError, match=r"cameras of view \[1\] are not finite"):
            renderer.render(vertices, meshes.waves(2, 16, 20), cameras)

    def test_sizes_and_samples_below_one(self, scene):
        with pytest.raises(ValueError, match="must be at least 1; got 30, 0, 1, 4"):
            SurfaceRenderer(scene[1], 30, 0)


def test_a_mesh_beside_the_image_gives_an_empty_image_and_no_gradient(scene):
    vertices, _, renderer = scene
    mask, vertex_gradient, texture_gradient = gradients(renderer, vertices + torch.tensor([40.0, 0.0, 60.0]), meshes.orbit(2, *FILM))
    assert (mask == 0).all()
    assert (vertex_gradient == 0).all()
    assert (texture_gradient == 0).all()


def test_a_mesh_behind_the_camera_gives_an_empty_image(scene):
    vertices, _, renderer = scene
    cameras = meshes.orbit(1, *FILM)
    mask, vertex_gradient, _ = gradients(renderer, vertices + 2 * cameras.centers[0], cameras)
    assert (mask == 0).all()
    assert (vertex_gradient == 0).all()


def test_a_camera_inside_the_mesh_sees_it_everywhere(scene):
    """Edges that cross the camera's plane are left out of the silhouette; all else is drawn, and nothing becomes infinite."""
    vertices, _, renderer = scene
    mask, _, texture_gradient = gradients(renderer, vertices, meshes.orbit(2, *FILM, distance=0.1))
    assert (mask == 1).all()
    assert (texture_gradient != 0).any()


def test_an_image_half_outside_the_film(scene):
    vertices, _, renderer = scene
    cameras = meshes.orbit(2, *FILM).shifted(torch.tensor([[-16.0, 0.0], [3.0, 12.0]]))
    mask, vertex_gradient, _ = gradients(renderer, vertices, cameras)
    assert 0 < float(mask.sum()) < 2 * 22 * 30
    assert (vertex_gradient != 0).any()


def test_triangles_without_area_change_nothing(scene):
    """A vertex pushed onto its neighbour flattens the faces between them: gradients stay finite, the rest of the mesh keeps its own."""
    vertices, topology, renderer = scene
    flattened = vertices.clone()
    a, b, _ = topology.faces[30]
    flattened[0, a] = flattened[0, b]
    mask, vertex_gradient, _ = gradients(renderer, flattened, meshes.orbit(2, *FILM))
    assert float(mask.sum()) > 20
    assert (vertex_gradient != 0).any()
    all_flat = vertices * torch.tensor([1.0, 1.0, 0.0])
    gradients(renderer, all_flat, meshes.orbit(2, *FILM))
    gradients(renderer, torch.zeros_like(vertices), meshes.orbit(2, *FILM))


def test_no_view_at_all(scene):
    vertices, _, renderer = scene
    cameras = meshes.orbit(1, *FILM)
    nothing = CameraBatch(cameras.intrinsics[:0], cameras.camera_from_world[:0])
    with pytest.raises(ValueError, match="at least one view and one mesh"):
        renderer.render(vertices, meshes.waves(1, 16, 20)[:0], nothing)


def test_textures_of_one_texel_and_of_one_row(scene):
    vertices, _, renderer = scene
    for size in ((1, 1), (1, 5)):
        textures = torch.rand(2, 3, *size).requires_grad_()
        radiance, mask = renderer.render(vertices, textures, meshes.orbit(2, *FILM))
        radiance.sum().backward()
        np.testing.assert_allclose(textures.grad.sum(dim=(2, 3)), mask.detach().sum(dim=(2, 3)).repeat(1, 3), rtol=1e-4)
