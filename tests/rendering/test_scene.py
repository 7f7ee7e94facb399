"""The scene that rays are traced in, the coordinates that views are drawn in, and cameras in batches."""

import numpy as np
import pytest
import torch

from mitsuba_avatar.rendering.backend import loaded_mitsuba
from mitsuba_avatar.rendering.bridge import flat_array
from mitsuba_avatar.rendering.cameras import CameraBatch
from mitsuba_avatar.rendering.scene import MeshScene
from mitsuba_avatar.rendering.views import place
from tests.rendering import meshes


def test_faces_outside_the_vertices_are_refused():
    with pytest.raises(ValueError, match=r"faces must index 0..6; got 0..7"):
        MeshScene(meshes.cube()[1].faces, 7)


def test_a_ray_meets_the_mesh_where_it_stands_after_every_update():
    mi = loaded_mitsuba()
    vertices, topology = meshes.cube()
    scene = MeshScene(topology.faces, 8)
    for shift in (0.0, 0.3, -0.2):
        scene.update(flat_array(torch.tensor(vertices + [shift, 0, 0], dtype=torch.float32)))
        found = scene.scene.ray_intersect_preliminary(mi.Ray3f(mi.Point3f([shift, 5.0], -5.0, 0.1), mi.Vector3f(0, 1, 0)))
        assert found.is_valid().numpy().tolist() == [True, False]
        front = topology.faces[found.prim_index.numpy()[0]]
        assert np.allclose(vertices[front][:, 1], -0.4)  # the side that faces the ray
        np.testing.assert_allclose(found.t.numpy()[0], 4.6, rtol=1e-6)


def test_local_coordinates_are_centred_on_each_mesh():
    vertices = torch.tensor(np.random.default_rng(2).normal(size=(4, 50, 3)) + 100, dtype=torch.float32)
    cameras, mesh_index = meshes.orbit(3, 30, 22), torch.tensor([2, 0, 3])
    placement = place(vertices, cameras, mesh_index)
    np.testing.assert_allclose(placement.vertices[..., :3].mean(dim=1), 0, atol=1e-4)
    assert (placement.vertices[..., 3] == 0).all()
    assert placement.centers[:, 3].tolist() == [2, 0, 3]
    np.testing.assert_array_equal(placement.views[:, 13:], placement.centers[:, :3])
    relative = placement.vertices[mesh_index, :, :3] - placement.centers[:, None, :3]
    expected = vertices[mesh_index].double() - cameras.centers.double()[:, None]
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
