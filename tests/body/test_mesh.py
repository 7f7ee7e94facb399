"""Normals and Laplacian: hand-computed values, then finite differences."""

import numpy as np
import torch

from mitsuba_avatar.body.mesh import Laplacian, unique_edges, vertex_normals
from mitsuba_avatar.body.rig import Topology

# Two triangles that share the edge 0-2, and a vertex 4 of no face.
FACES = np.array([[0, 1, 2], [0, 2, 3]])
TOPOLOGY = Topology(num_vertices=5, faces=FACES, uv=np.array([[0, 0], [1, 0], [1, 1], [0, 1]], dtype=np.float32), uv_faces=FACES)
VERTICES = torch.tensor([[0.0, 0, 0], [2, 0, 0], [2, 1, 0], [0, 1, 0.5], [7, 7, 7]], dtype=torch.float64)


def test_edges_are_listed_once():
    assert unique_edges(FACES).tolist() == [[0, 1], [0, 2], [0, 3], [1, 2], [2, 3]]


def test_laplacian_is_the_mean_of_the_neighbours_minus_the_vertex():
    vertices = torch.stack([VERTICES, 3 * VERTICES])
    result = Laplacian(TOPOLOGY)(vertices)
    torch.testing.assert_close(result[0, 0], VERTICES[[1, 2, 3]].mean(0), atol=1e-7, rtol=0)  # vertex 0 is the origin
    torch.testing.assert_close(result[0, 1], VERTICES[[0, 2]].mean(0) - VERTICES[1], atol=1e-7, rtol=0)
    assert result[0, 4].eq(0).all()
    torch.testing.assert_close(result[1], 3 * result[0], atol=1e-6, rtol=0)
    assert torch.autograd.gradcheck(Laplacian(TOPOLOGY), vertices.requires_grad_())


def test_laplacian_of_a_shifted_mesh_does_not_change(small_rig):
    laplacian = Laplacian(small_rig.topology)
    vertices = torch.from_numpy(small_rig.rest_vertices)[None]
    torch.testing.assert_close(laplacian(vertices + 1.5), laplacian(vertices), atol=1e-6, rtol=0)


def test_normals_are_weighted_by_area():
    normals = vertex_normals(torch.stack([VERTICES, 2 * VERTICES]), torch.from_numpy(FACES))
    first, second = torch.tensor([[0.0, 0, 2], [0.5, -1.0, 2]], dtype=torch.float64)  # by hand: cross products
    torch.testing.assert_close(normals[0, 1], first / first.norm())
    torch.testing.assert_close(normals[0, 3], second / second.norm())
    torch.testing.assert_close(normals[0, 0], (first + second) / (first + second).norm())
    assert normals[0, 4].eq(0).all()
    torch.testing.assert_close(normals[1], normals[0])
    vertices = torch.stack([VERTICES, 2 * VERTICES]).requires_grad_()
    assert torch.autograd.gradcheck(lambda moved: vertex_normals(moved, torch.from_numpy(FACES))[:, :4], vertices)


def test_normals_of_a_closed_surface_point_outwards(small_rig):
    vertices = torch.from_numpy(small_rig.rest_vertices)[None]
    normals = vertex_normals(vertices, torch.from_numpy(small_rig.topology.faces))
    axis = torch.tensor([0.0, 0.0, 0.3])
    assert ((vertices - axis) * normals).sum(-1).min() > 0
