import dataclasses

import numpy as np
import pytest
import torch
from scipy import sparse
from scipy.sparse import csgraph

from mitsuba_avatar.body.skeleton import Skeleton
from mitsuba_avatar.body.skinning import unpose_vertices
from mitsuba_avatar.filming.anatomy import Anatomy
from mitsuba_avatar.filming.cloth_simulation import BodyMotion, ClothSimulator
from mitsuba_avatar.filming.garment_layers import body_under_cloth, distance_from_hems, register_garment
from mitsuba_avatar.filming.garment_mesh import boundary_edges, find_hinges, flat_weights, hang_from, subdivide
from mitsuba_avatar.filming.settings import ClothingSettings
from mitsuba_avatar.filming.wardrobe import FABRICS, Outfit, choose_outfit

TWO_TRIANGLES = np.array([[0, 1, 2], [0, 2, 3]])


def test_subdivision_keeps_old_vertices_first_and_halves_edges():
    vertices = np.array([[0, 0, 0], [2, 0, 0], [2, 1, 0], [0, 1, 0]], dtype=np.float64)
    matrix, faces = subdivide(TWO_TRIANGLES, 4)
    fine = matrix @ vertices
    np.testing.assert_array_equal(fine[:4], vertices)
    assert len(fine) == 9 and len(faces) == 8
    area = np.cross(fine[faces[:, 1]] - fine[faces[:, 0]], fine[faces[:, 2]] - fine[faces[:, 0]])[:, 2] / 2
    np.testing.assert_allclose(area, 0.25)  # equal parts, none turned over


def test_hinges_join_the_corners_across_an_edge():
    np.testing.assert_array_equal(find_hinges(TWO_TRIANGLES), [[0, 2, 1, 3]])
    assert {tuple(edge) for edge in boundary_edges(TWO_TRIANGLES)} == {(0, 1), (1, 2), (2, 3), (0, 3)}


def test_hinge_weights_sum_to_zero_on_any_flat_hinge_and_measure_folds():
    rng = np.random.default_rng(0)
    corners = np.stack([rng.normal(size=(5, 3)) for _ in range(4)], axis=1)
    corners[:, :2], corners[:, 2, :2], corners[:, 3, :2] = [[0, 0, 0], [1.5, 0, 0]], [0.4, 1.0], [0.9, -0.7]
    corners[..., 2] = 0
    weights = flat_weights(corners)
    np.testing.assert_allclose(np.einsum("hk,hkc->hc", weights, corners), 0, atol=1e-12)
    np.testing.assert_allclose(weights.sum(axis=1), 0, atol=1e-12)
    folded = corners.copy()
    folded[:, 3, 1:] = [0.0, -0.7]  # by a right angle: as long, standing up
    np.testing.assert_allclose(flat_weights(folded), weights, atol=1e-12)
    assert (np.linalg.norm(np.einsum("hk,hkc->hc", weights, folded), axis=1) > 0.3).all()


def test_tethers_lead_to_the_nearest_pin_along_the_cloth():
    vertices = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [1, 4, 0], [9, 9, 9]], dtype=np.float64)
    links = np.array([[0, 1], [1, 2], [2, 3]])
    tethers, lengths = hang_from(vertices, links, np.array([True, False, False, True, False]))
    np.testing.assert_array_equal(tethers, [[1, 0], [2, 0]])
    np.testing.assert_allclose(lengths, [1, 2])  # vertex 4 hangs on nothing


@pytest.fixture(scope="module", params=sorted(FABRICS))
def outfit(request: pytest.FixtureRequest, anatomy: Anatomy) -> Outfit:
    return choose_outfit(anatomy, request.param)


def test_a_garment_is_one_piece_with_the_hems_of_its_kind(outfit: Outfit):
    mesh = outfit.mesh
    count = len(mesh.rest_vertices)
    graph = sparse.csr_matrix((np.ones(len(mesh.edges)), mesh.edges.T), shape=(count, count))
    assert csgraph.connected_components(graph, directed=False)[0] == 1
    rim = boundary_edges(mesh.topology.faces)
    rims = csgraph.connected_components(sparse.csr_matrix((np.ones(len(rim)), rim.T), shape=(count, count)), directed=False)[1]
    assert len(np.unique(rims[rim])) == (3 if mesh.name == "shorts" else 4)
    pinned_rims = np.unique(rims[mesh.pinned])
    assert len(pinned_rims) == 1 and mesh.pinned[rims == pinned_rims[0]].all()  # one whole hem
    assert len(mesh.tethers) == count - mesh.pinned.sum()


def test_coarse_vertices_are_the_bodys_and_the_garment_lies_over_the_obstacle(anatomy: Anatomy, outfit: Outfit):
    mesh = outfit.mesh
    body = outfit.registered_body(anatomy)
    coarse = mesh.rest_vertices[: len(mesh.body_vertices)]
    assert np.linalg.norm(body.vertices[mesh.body_vertices] - coarse, axis=1).max() < 0.035  # hems beneath slide a few
    np.testing.assert_allclose(mesh.skinning_weights[: len(coarse)], anatomy.rig.skinning_weights[mesh.body_vertices], atol=1e-6)
    gap = ((coarse - outfit.obstacle[mesh.body_vertices]) * body.normals[mesh.body_vertices]).sum(axis=1)
    assert np.mean(gap > -0.0005) > 0.97


def test_the_garments_texture_is_the_bodys_atlas(anatomy: Anatomy, outfit: Outfit):
    topology, fine = anatomy.rig.topology, outfit.mesh.topology
    chosen = outfit.garment.covered[topology.faces].all(axis=1)

    def area(uv: np.ndarray) -> float:
        sides = uv[:, 1:] - uv[:, :1]
        return float(np.abs(np.linalg.det(sides.astype(np.float64))).sum())

    assert area(fine.uv[fine.uv_faces]) == pytest.approx(area(topology.uv[topology.uv_faces[chosen]]), rel=1e-4)


def test_an_unknown_outfit_is_refused(anatomy: Anatomy):
    with pytest.raises(ValueError, match="expected one of .*'shirt'.* got 'toga'"):
        choose_outfit(anatomy, "toga")


def test_skin_is_drawn_in_and_left_out_only_under_cloth(anatomy: Anatomy, shirt_outfit: Outfit):
    under = body_under_cloth(anatomy, shirt_outfit)
    covered = np.zeros(anatomy.rig.topology.num_vertices, dtype=bool)
    covered[shirt_outfit.mesh.body_vertices] = True
    depth = np.linalg.norm(under.inset, axis=1)
    assert depth[~covered].max() == 0 and depth.max() == pytest.approx(0.012, abs=1e-4) and np.median(depth[covered]) > 0.011
    assert under.hidden_faces.sum() > 300 and covered[anatomy.rig.topology.faces[under.hidden_faces]].all()
    distance = distance_from_hems(shirt_outfit.mesh)
    assert distance[np.unique(boundary_edges(shirt_outfit.mesh.topology.faces))].max() == 0 and 0.2 < distance.max() < 0.5


@pytest.fixture(scope="module")
def worn(anatomy: Anatomy, shirt_outfit: Outfit) -> tuple[BodyMotion, np.ndarray]:
    """Three frames in which the person turns, walks along x and lifts an arm."""
    names = anatomy.rig.dofs.names
    theta = np.zeros((3, len(names)), np.float32)
    theta[:, names.index("left_shoulder_abduction")] = [0.0, 0.1, 0.3]
    root = np.tile(np.eye(4, dtype=np.float32), (3, 1, 1))
    root[:, 0, 3] = [1.0, 1.02, 1.06]
    root[:, :2, :2] = [[0, -1], [1, 0]]
    motion = BodyMotion(theta, root, 10.0, shirt_outfit.obstacle)
    settings = dataclasses.replace(ClothingSettings(), settle_time=0.3)
    states = ClothSimulator(anatomy.rig, shirt_outfit, settings).states(motion, "take")
    return motion, np.stack([state.vertices for state in states])


def test_a_worn_shirt_stays_near_its_rest_shape_once_unposed(anatomy: Anatomy, shirt_outfit: Outfit, worn):
    motion, garment = worn
    mesh, skeleton = shirt_outfit.mesh, Skeleton(anatomy.rig)
    coarse = len(mesh.body_vertices)
    with torch.no_grad():
        transforms = skeleton(torch.from_numpy(motion.theta), torch.from_numpy(motion.root))
        rest = unpose_vertices(torch.from_numpy(garment[:, :coarse]), transforms, torch.from_numpy(mesh.skinning_weights[:coarse])).numpy()
    moved = np.linalg.norm(rest - shirt_outfit.mesh.rest_vertices[: rest.shape[1]], axis=-1)
    assert 0.001 < moved.mean() < 0.02 and np.percentile(moved, 99) < 0.06


def test_the_registered_mesh_is_the_body_with_coarse_cloth(anatomy: Anatomy, shirt_outfit: Outfit, worn):
    _, garment = worn
    body = np.zeros((3, anatomy.rig.topology.num_vertices, 3), np.float32)
    registered = register_garment(body, shirt_outfit.mesh, garment)
    coarse = shirt_outfit.mesh.body_vertices
    np.testing.assert_array_equal(registered[:, coarse], garment[:, : len(coarse)])
    assert np.count_nonzero(registered.any(axis=-1)) == 3 * len(coarse) and not body.any()


def test_a_garment_with_frames_missing_is_refused(shirt_outfit: Outfit, worn):
    partial = worn[1].copy()
    partial[1] = np.nan
    with pytest.raises(ValueError, match="NaN in 1, the first is 1"):
        register_garment(np.zeros((3, 20_000, 3), np.float32), shirt_outfit.mesh, partial)
