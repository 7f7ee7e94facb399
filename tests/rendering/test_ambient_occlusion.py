"""Occlusion against closed forms and against many rays; the cached sequence; bent normals and irradiance."""

import numpy as np
import pytest
import torch

from mitsuba_avatar.body.rig import Topology
from mitsuba_avatar.body.skeleton import Skeleton
from mitsuba_avatar.body.skinning import pose_vertices
from mitsuba_avatar.rendering.ambient_occlusion import AmbientOcclusion, FrameOcclusion
from mitsuba_avatar.rendering.environment_map import EnvironmentMap
from tests.rendering import meshes

WALL = 0.7  # metres high


def floor_and_wall(split: bool) -> tuple[torch.Tensor, Topology]:
    """A floor (x 0..1, left half of the atlas) before a wall at x = 0 that is very long in y, and so is the floor.

    Where both share vertices (not split), normals lean away from their common edge; split, they are upright.
    """
    far = 200.0
    vertices = torch.tensor([[0, -far, 0], [1, -far, 0], [1, far, 0], [0, far, 0], [0, -far, WALL], [0, far, WALL]])
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 0, 3], [4, 3, 5]])
    uv = np.array([[0.0, 0.0], [0.5, 0.0], [0.5, 1.0], [0.0, 1.0], [1.0, 0.0], [0.55, 0.0], [0.55, 1.0], [1.0, 1.0]], np.float32)
    uv_faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
    if split:
        vertices = torch.cat([vertices, vertices[[0, 3]]])
        faces[2:] = np.select([faces[2:] == 0, faces[2:] == 3], [6, 7], faces[2:])
    return vertices, Topology(num_vertices=len(vertices), faces=faces, uv=uv, uv_faces=uv_faces)


def test_floor_before_a_wall_has_its_closed_form():
    """The wall covers (1 - x / sqrt(x^2 + h^2)) / 2 of the cosine-weighted hemisphere at a distance of x."""
    vertices, topology = floor_and_wall(split=True)
    occlusion = AmbientOcclusion(topology, 40, rays=1024, distance=1000.0).bake(vertices)
    x = (np.arange(20) + 0.5) / 20
    expected = 1 - 0.5 * (1 - x / np.hypot(x, WALL))
    measured = occlusion[10:30, :20].mean(dim=0).numpy()
    np.testing.assert_allclose(measured, expected, atol=0.003)


def test_what_is_beyond_the_distance_does_not_occlude():
    vertices, topology = floor_and_wall(split=True)
    occlusion = AmbientOcclusion(topology, 40, rays=64, distance=0.2).bake(vertices)
    assert (occlusion[10:30, 12:20] == 1).all()
    assert (occlusion[10:30, 0] < 1).all()


def test_a_convex_mesh_is_open_everywhere():
    vertices, topology = meshes.sphere()
    occlusion = AmbientOcclusion(topology, 48).bake(torch.tensor(vertices, dtype=torch.float32))
    assert occlusion.shape == (48, 48)
    # Normals are interpolated, faces are flat: the most grazing rays may meet the surface that they start from.
    assert occlusion.min() > 0.95
    assert occlusion.mean() > 0.999


def test_a_mesh_turned_inside_out_is_enclosed():
    vertices, topology = meshes.sphere()
    inside_out = Topology(
        num_vertices=topology.num_vertices, faces=topology.faces[:, ::-1].copy(), uv=topology.uv, uv_faces=topology.uv_faces[:, ::-1].copy()
    )
    occlusion = AmbientOcclusion(inside_out, 48, distance=5.0).bake(torch.tensor(vertices, dtype=torch.float32))
    assert (occlusion == 0).all()


def posed(rig, theta: np.ndarray) -> torch.Tensor:
    skeleton = Skeleton(rig)
    transforms = skeleton(torch.tensor(theta, dtype=torch.float32)[None], torch.eye(4)[None])
    return pose_vertices(torch.from_numpy(rig.rest_vertices)[None], transforms, torch.from_numpy(rig.skinning_weights))[0]


def test_noise_is_half_that_of_independent_directions(anny_rig):
    """Mean absolute error at 64 rays against 4096, over texels that something occludes: independent directions leave 0.022."""
    vertices = torch.from_numpy(anny_rig.rest_vertices)
    baker = AmbientOcclusion(anny_rig.topology, 64)
    reference = AmbientOcclusion(anny_rig.topology, 64, rays=4096).bake(vertices, seed=9)
    difference = (baker.bake(vertices, seed=1) - reference)[baker.atlas.covered]
    assert difference.abs().mean() < 0.011
    assert difference.mean().abs() < 0.001


def test_other_seeds_give_other_directions(small_rig):
    vertices = posed(small_rig, np.array([0, 0, 1.8, 0, 0]))
    baker = AmbientOcclusion(small_rig.topology, 40, rays=16)
    assert torch.equal(baker.bake(vertices, seed=1), baker.bake(vertices, seed=1))
    assert not torch.equal(baker.bake(vertices, seed=1), baker.bake(vertices, seed=2))


def test_bad_input_is_refused(small_rig):
    with pytest.raises(ValueError, match="expected rays >= 1 and distance > 0 metres; got 0 and 0.6"):
        AmbientOcclusion(small_rig.topology, 40, rays=0)
    baker = AmbientOcclusion(small_rig.topology, 40)
    vertices = torch.from_numpy(small_rig.rest_vertices)
    with pytest.raises(ValueError, match=r"vertices must be \[258, 3\] for this topology; got \[257, 3\]"):
        baker.bake(vertices[:257])
    with pytest.raises(ValueError, match="vertices are not finite"):
        baker.bake(vertices * float("nan"))


def sequence(rig, folder) -> FrameOcclusion:
    theta = np.array([[0, 0, 1.8, 0, 0], [0.3, 0, 0.9, 0, 0], [0, 0, 1.8, 0, 0], [0, 0.2, 2.0, 0, 0]], np.float32)
    return FrameOcclusion(AmbientOcclusion(rig.topology, 40), rig, torch.from_numpy(rig.rest_vertices), theta, folder)


def test_an_interrupted_sequence_goes_on_where_it_stopped(small_rig, tmp_path, monkeypatch):
    def stop(done, total):
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        sequence(small_rig, tmp_path).bake(stop)
    assert len(list(tmp_path.rglob("*.npy"))) == 2

    baked = []
    original = AmbientOcclusion.bake
    monkeypatch.setattr(AmbientOcclusion, "bake", lambda self, *args, **kwargs: baked.append(1) or original(self, *args, **kwargs))
    calls = []
    resumed = sequence(small_rig, tmp_path)
    resumed.bake(lambda done, total: calls.append((done, total)))
    assert calls == [(1, 4), (2, 4), (3, 4), (4, 4)]
    assert len(baked) == 1  # the third frame has the first one's pose, only the fourth was missing
    maps = resumed.maps([3, 0, 2])
    assert maps.shape == (3, 1, 40, 40)
    assert torch.equal(maps[1], maps[2])
    assert len(baked) == 1
    assert len(list(tmp_path.rglob("*.npy"))) == 3


def test_maps_are_those_of_the_posed_template(small_rig, tmp_path):
    frames = sequence(small_rig, tmp_path)
    expected = AmbientOcclusion(small_rig.topology, 40, rays=1024).bake(posed(small_rig, frames.theta[3]))
    difference = frames.maps([3])[0, 0] - expected
    assert expected.min() < 0.7  # the bend occludes
    assert difference.abs().mean() < 0.01
    assert difference.abs().max() < 0.15


def test_a_sequence_of_other_settings_does_not_share_its_maps(small_rig, tmp_path):
    sequence(small_rig, tmp_path).bake()
    rest = torch.from_numpy(small_rig.rest_vertices)
    other = FrameOcclusion(AmbientOcclusion(small_rig.topology, 40, distance=0.1), small_rig, rest, np.zeros((1, 5), np.float32), tmp_path)
    other.bake()
    assert len(list(tmp_path.iterdir())) == 2


def test_irradiance_and_bent_normal_on_a_sphere():
    """A convex mesh under uniform light receives pi times its radiance; under a gradient sky, E = pi (a + 2/3 b n_z); it bends nowhere."""
    vertices, topology = meshes.sphere(3)
    vertices = torch.tensor(vertices, dtype=torch.float32)
    baker = AmbientOcclusion(topology, 48, rays=256)
    polar = (torch.arange(64) + 0.5) / 64 * torch.pi
    sky = torch.tensor([0.3, 0.5, 0.7]).view(3, 1, 1) + 0.2 * torch.cos(polar).view(1, 64, 1).expand(3, 64, 100)
    lighting = baker.bake_lighting(vertices, EnvironmentMap(sky))
    covered = baker.atlas.covered
    normal = torch.nn.functional.normalize(baker.atlas.texels_from_vertices(vertices[None])[0], dim=0)
    expected = torch.pi * (torch.tensor([0.3, 0.5, 0.7]).view(3, 1, 1) + 0.2 * 2 / 3 * normal[2])
    np.testing.assert_allclose(lighting.irradiance[:, covered], expected[:, covered], rtol=0.02)
    assert ((lighting.bent_normal * normal).sum(0)[covered] > 0.99).all()
    assert torch.equal(lighting.ambient_occlusion, baker.bake(vertices))


def test_bent_normals_lean_away_from_what_occludes():
    vertices, topology = floor_and_wall(split=False)
    light = EnvironmentMap(torch.ones(3, 8, 16))
    lighting = AmbientOcclusion(topology, 40, rays=256, distance=1000.0).bake_lighting(vertices, light)
    foot, far = lighting.bent_normal[0, 20, 4], lighting.bent_normal[0, 20, 19]
    assert foot > far > 0.05
    np.testing.assert_allclose(lighting.irradiance[1], torch.pi * lighting.ambient_occlusion, rtol=1e-4)


def test_the_environment_is_looked_up_in_world_axes():
    import drjit as dr

    from mitsuba_avatar.rendering.backend import loaded_mitsuba

    mi = loaded_mitsuba()
    radiance = torch.rand(3, 6, 12)
    directions = np.array([[1, 0.268, 0.2], [-0.3, 1, -0.4], [-1, -0.001, 0.0], [-1, 0.001, 0.0], [0, 0.01, 1]])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    found = EnvironmentMap(radiance).radiance_from(mi.Vector3f(*[mi.Float(column.astype(np.float32)) for column in directions.T]))
    found = np.array(dr.ravel(found)).reshape(-1, 3)
    assert abs(found[2] - found[3]).max() < 0.02  # no seam at azimuth pi
    azimuth, polar = np.arctan2(directions[:, 1], directions[:, 0]) % (2 * np.pi), np.arccos(directions[:, 2])
    for row in (0, 1):
        x, y = azimuth[row] / (2 * np.pi) * 12 - 0.5, polar[row] / np.pi * 6 - 0.5
        i, j = int(y), int(np.floor(x))
        fx, fy = x - j, y - i
        column, row_weights = [j % 12, (j + 1) % 12], np.array([1 - fy, fy])
        block = radiance[:, i : i + 2][:, :, column].numpy()  # [3, 2, 2]
        np.testing.assert_allclose(found[row], np.einsum("cij,i,j->c", block, row_weights, [1 - fx, fx]), atol=1e-4)
