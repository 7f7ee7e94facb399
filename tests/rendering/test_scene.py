"""The merged scene: which mesh and face a ray meets, updates in place, meshes out of each other's reach."""

import numpy as np
import pytest
import torch

from mitsuba_avatar.rendering.backend import loaded_mitsuba
from mitsuba_avatar.rendering.bridge import flat_array
from mitsuba_avatar.rendering.cameras import CameraBatch
from mitsuba_avatar.rendering.scene import MeshScene, separation
from mitsuba_avatar.rendering.views import place
from tests.rendering import meshes


def test_faces_outside_the_vertices_are_refused():
    with pytest.raises(ValueError, match=r"faces must index 0..6; got 0..7"):
        MeshScene(meshes.cube()[1].faces, 7)


def test_a_ray_meets_the_face_of_its_mesh_after_every_update():
    mi = loaded_mitsuba()
    vertices, topology = meshes.cube()
    scene = MeshScene(topology.faces, 8, num_meshes=3)
    for shift in (0.0, 0.3, -0.2):
        stacked = torch.tensor(np.stack([vertices + [10.0 * i + shift, 0, 0] for i in range(3)]), dtype=torch.float32)
        scene.update(flat_array(stacked))
        ray = mi.Ray3f(mi.Point3f([shift, 10 + shift, 20 + shift, 5.0], -5.0, 0.1), mi.Vector3f(0, 1, 0))
        found = scene.scene.ray_intersect_preliminary(ray)
        faces, is_hit = found.prim_index.numpy(), found.is_valid().numpy()
        assert is_hit.tolist() == [True, True, True, False]
        assert (faces[:3] // 12).tolist() == [0, 1, 2]
        front = topology.faces[faces[:3] % 12]
        assert np.allclose(vertices[front][..., 1], -0.4)  # the side that faces the ray
        np.testing.assert_allclose(found.t.numpy()[:3], 4.6, rtol=1e-6)
    assert scene.version == 3


def test_separated_meshes_are_out_of_reach():
    """The farthest point of its own mesh is always nearer to a camera than any other mesh."""
    rng = np.random.default_rng(1)
    for scale in (0.01, 1.0, 30.0):
        vertices = torch.tensor(rng.normal(size=(3, 40, 3)) * scale + rng.normal(size=(3, 1, 3)) * 5, dtype=torch.float32)
        cameras = meshes.orbit(3, 30, 22, distance=4.0)
        placement = place(vertices, cameras, torch.arange(3))
        centers = placement.views[:, 16:19]
        for view in range(3):
            distance = (placement.scene_vertices - centers[view]).norm(dim=-1)
            others = [mesh for mesh in range(3) if mesh != view]
            assert distance[view].max() < distance[others].min()
        assert separation(vertices, cameras.centers) > 0


def test_local_coordinates_differ_from_scene_coordinates_by_the_offset_exactly():
    """What lets rays and edges agree to the last bit."""
    vertices = torch.tensor(np.random.default_rng(2).normal(size=(4, 50, 3)), dtype=torch.float32)
    cameras = meshes.orbit(4, 30, 22)
    placement = place(vertices, cameras, torch.arange(4))
    exact = placement.scene_vertices.double() - placement.offset.double()[:, None]
    assert torch.equal((placement.scene_vertices - placement.offset[:, None]).double(), exact)
    camera_center = placement.centers[:, :3].double() + placement.offset.double()
    assert torch.equal(camera_center, placement.views[:, 16:19].double())
    relative = exact - placement.centers[:, None, :3].double()
    expected = vertices.double() - cameras.centers.double()[:, None]
    np.testing.assert_allclose(relative, expected, atol=2e-5)


def test_cameras_with_distortion_are_refused():
    from mitsuba_avatar.captures.cameras import Camera

    camera = Camera("left", 30, 22, 30.0, 30.0, 15.0, 11.0, np.eye(4), distortion=(0.1, 0.0, 0.0, 0.0))
    with pytest.raises(ValueError, match="'left' has distortion"):
        CameraBatch.from_cameras([camera])


def test_camera_batch_keeps_what_cameras_say():
    from mitsuba_avatar.captures.cameras import Camera

    pose = np.eye(4)
    pose[:3, :3] = [[0, -1, 0], [0, 0, -1], [1, 0, 0]]
    pose[:3, 3] = [0.1, 0.2, 3.0]
    camera = Camera("left", 30, 22, 31.0, 33.0, 16.0, 10.0, pose)
    batch = CameraBatch.from_cameras([camera, camera])
    np.testing.assert_allclose(batch.centers[1], camera.center_world, atol=1e-6)
    shifted = batch.shifted(torch.tensor([[1.0, 2.0], [3.0, 4.0]]))
    np.testing.assert_allclose(shifted.intrinsics, [[31, 33, 15, 8], [31, 33, 13, 6]])
    np.testing.assert_allclose(batch.intrinsics[0], [31, 33, 16, 10])
    assert len(batch.repeat_interleave(3)) == 6
