"""View coordinates against a slow reference, and what they must not depend on."""

import pytest
import torch

from mitsuba_avatar.body.mesh import vertex_normals
from mitsuba_avatar.body.skeleton import Skeleton
from mitsuba_avatar.body.skinning import blend_transforms
from mitsuba_avatar.body.uv import UvAtlas
from mitsuba_avatar.model.viewing import ViewMaps


@pytest.fixture
def atlas(rig):
    return UvAtlas(rig.topology, 24)


@pytest.fixture
def view_maps(rig, atlas):
    vertices = torch.from_numpy(rig.rest_vertices)
    normals = vertex_normals(vertices[None], torch.from_numpy(rig.topology.faces))[0]
    return ViewMaps(atlas, vertices, normals, torch.from_numpy(rig.skinning_weights))


def test_unposed_coordinates_are_plain_directions_and_cosines(view_maps, drive):
    centers, joints = drive["camera_centers"], torch.eye(4).expand(2, 3, 4, 4)
    coordinates = view_maps(joints, centers)
    assert coordinates.shape == (2, 3, 4, 24, 24)
    for row, column in ((3, 5), (10, 20), (20, 6)):
        texel = row * 24 + column
        direction = centers[1, 2] - view_maps.positions[texel]
        direction = direction / direction.norm()
        cosine = direction @ view_maps.normals[texel]
        torch.testing.assert_close(coordinates[1, 2, :, row, column], torch.cat([direction, cosine[None]]))


def test_posed_directions_are_turned_back_by_the_texels_own_rotation(rig, atlas, view_maps, drive):
    posed_from_rest = Skeleton(rig)(drive["theta"], drive["root"])
    coordinates = view_maps(posed_from_rest, drive["camera_centers"])
    rows, columns = torch.where(atlas.covered)
    for row, column in list(zip(rows.tolist(), columns.tolist(), strict=True))[::29]:
        texel = row * 24 + column
        transform = blend_transforms(posed_from_rest[:1], view_maps.weights[texel : texel + 1])[0, 0]  # [3, 4]
        posed = transform[:, :3] @ view_maps.positions[texel] + transform[:, 3]
        direction = transform[:, :3].T @ (drive["camera_centers"][0, 1] - posed)
        torch.testing.assert_close(coordinates[0, 1, :3, row, column], direction / direction.norm(), atol=1e-5, rtol=1e-4)


def test_moving_body_and_cameras_together_changes_nothing(rig, view_maps, drive):
    skeleton, root = Skeleton(rig), drive["root"]
    centers = drive["camera_centers"]
    carried = centers @ root[:, :3, :3].transpose(1, 2) + root[:, None, :3, 3]
    still = view_maps(skeleton(drive["theta"], torch.eye(4).expand(2, 4, 4)), centers)
    torch.testing.assert_close(view_maps(skeleton(drive["theta"], root), carried), still, atol=1e-5, rtol=1e-4)


def test_front_faces_see_the_camera_with_a_positive_cosine(view_maps, drive):
    centers = torch.tensor([[[0.0, -4.0, 0.3]], [[4.0, 0.0, 0.3]]])
    cosines = view_maps(torch.eye(4).expand(2, 3, 4, 4), centers)[:, 0, 3].flatten(1)
    towards = view_maps.normals @ torch.tensor([[0.0, 1.0], [-1.0, 0.0], [0.0, 0.0]])  # [T, 2] outward along each camera's axis
    for pose in range(2):
        assert (cosines[pose][towards[:, pose] > 0.5] > 0.3).all()
        assert (cosines[pose][towards[:, pose] < -0.5] < -0.3).all()
