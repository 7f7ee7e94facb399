"""Edges, seams and texture lookups of the renderer's tables."""

import drjit as dr
import numpy as np
import pytest
import torch

from mitsuba_avatar.body.uv import uv_of_texel
from mitsuba_avatar.rendering.backend import loaded_mitsuba
from mitsuba_avatar.rendering.surface_tables import NO_FACE, SurfaceTables, edge_tables
from mitsuba_avatar.rendering.texture_lookup import Footprint
from tests.rendering import meshes, reference


def test_edges_of_a_closed_mesh_have_two_faces_that_wind_them_oppositely():
    _, topology = meshes.cube()
    edges, opposite, edge_uv = edge_tables(topology.faces, topology.uv[topology.uv_faces])
    assert edges.shape == (18, 4)
    for (a, b, first, second), across, uv in zip(edges, opposite, edge_uv, strict=True):
        directed = [(topology.faces[first][i], topology.faces[first][(i + 1) % 3]) for i in range(3)]
        assert (a, b) in directed
        assert {a, b, across} == set(topology.faces[second])
        for face, ends in ((first, uv[:4]), (second, uv[4:])):
            corners = dict(zip(topology.faces[face], topology.uv[topology.uv_faces[face]], strict=True))
            np.testing.assert_allclose(ends, np.concatenate([corners[a], corners[b]]))


def test_seams_come_first():
    """Twelve edges of a cube lie between charts; the six diagonals of its sides do not."""
    _, topology = meshes.cube()
    tables = SurfaceTables(topology.faces, topology.uv, topology.uv_faces)
    assert (tables.num_edges, tables.num_seams) == (18, 12)
    edge_uv = tables.edge_uv.numpy().reshape(18, 8)
    differs = (edge_uv[:, :4] != edge_uv[:, 4:]).any(axis=1)
    assert differs.tolist() == [True] * 12 + [False] * 6


def test_open_edges_have_one_face():
    _, topology = meshes.open_sheet()
    edges, _, _ = edge_tables(topology.faces, topology.uv[topology.uv_faces])
    assert (edges[:, 3] == NO_FACE).sum() == 4


def test_edges_of_three_faces_are_refused():
    faces = np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4]])
    with pytest.raises(ValueError, match=r"edge \(0, 1\) has 3. Split the non-manifold edge"):
        edge_tables(faces, np.zeros((3, 3, 2)))


def test_faces_that_wind_alike_are_refused():
    faces = np.array([[0, 1, 2], [0, 1, 3]])
    with pytest.raises(ValueError, match="faces 0 and 1 wind their common edge the same way"):
        edge_tables(faces, np.zeros((2, 3, 2)))


def lookup(texture: torch.Tensor, uv: np.ndarray):
    """Value, derivative by u and by v, each [N, 3], of the package's lookup."""
    mi = loaded_mitsuba()
    height, width = texture.shape[1:]
    packed = torch.nn.functional.pad(texture.permute(1, 2, 0), (0, 1)).contiguous()
    point = mi.Point2f(mi.Float(uv[:, 0].astype(np.float32)), mi.Float(uv[:, 1].astype(np.float32)))
    footprint = Footprint.at(point, dr.zeros(mi.UInt32, len(uv)), height, width)
    textures = mi.TensorXf(packed).array
    results = [footprint.value(textures), *footprint.derivative(textures, height, width)]
    return [result.numpy().T for result in results]


def test_lookups_are_bilinear_and_continue_the_border():
    texture = meshes.waves(1, 7, 11)[0]
    uv = np.random.default_rng(3).uniform(-0.2, 1.2, (200, 2))
    np.testing.assert_allclose(lookup(texture, uv)[0], reference.bilinear(texture.numpy().astype(np.float64), uv), atol=1e-5)


def test_texel_centres_are_where_the_atlas_says():
    texture = meshes.waves(1, 7, 11)[0]
    texels = np.array([[0.0, 0.0], [6.0, 0.0], [2.0, 9.0]])
    values = lookup(texture, uv_of_texel(texels, 7, 11))[0]
    np.testing.assert_allclose(values, [texture[:, int(i), int(j)].numpy() for i, j in texels], atol=1e-5)


def test_derivatives_of_a_lookup():
    texture = meshes.waves(1, 7, 11)[0]
    texels = np.random.default_rng(4).uniform([0.1, 0.1], [5.9, 9.9], (50, 2))
    texels = np.floor(texels) + 0.2 + 0.6 * (texels % 1)  # not on the border between two footprints
    uv = uv_of_texel(texels, 7, 11)
    _, along_u, along_v = lookup(texture, uv)
    exact = texture.numpy().astype(np.float64)
    for axis, derivative in enumerate((along_u, along_v)):
        offset = np.eye(2)[axis] * 1e-4
        difference = (reference.bilinear(exact, uv + offset) - reference.bilinear(exact, uv - offset)) / 2e-4
        np.testing.assert_allclose(derivative, difference, atol=2e-4)
