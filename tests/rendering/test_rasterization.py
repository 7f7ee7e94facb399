"""What a camera ray meets first, found by rasterization: against every triangle in float64, and against Mitsuba's own rays."""

import drjit as dr
import numpy as np
import pytest
import torch

from mitsuba_avatar.rendering.backend import loaded_mitsuba
from mitsuba_avatar.rendering.batch import SurfaceBatch
from mitsuba_avatar.rendering.bridge import flat_array
from mitsuba_avatar.rendering.cameras import CameraBatch
from mitsuba_avatar.rendering.face_boxes import FilmUnits
from mitsuba_avatar.rendering.pixel_sampling import PIXELS, jitter, random_shift
from mitsuba_avatar.rendering.rasterization import nearest_faces
from mitsuba_avatar.rendering.scene import MeshScene
from mitsuba_avatar.rendering.surface import SurfaceRenderer
from mitsuba_avatar.rendering.views import View, place
from mitsuba_avatar.rendering.visibility import meeting_point, tile_bits, trace_views
from tests.rendering import meshes, reference

FILM = (90, 66)


def make_batch(renderer: SurfaceRenderer, vertices: torch.Tensor, cameras: CameraBatch, mesh_index: list[int]) -> SurfaceBatch:
    mi = loaded_mitsuba()
    placement = place(vertices, cameras, torch.tensor(mesh_index))
    tables = tuple(mi.TensorXf(table) for table in (placement.vertices, placement.views, placement.centers))
    return renderer.batch(mi.TensorXf(meshes.waves(len(cameras), 4, 6)), tables, seed=0)


def look(batch: SurfaceBatch, view_index: np.ndarray, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Depth (infinite for a miss) and face along rays through positions [N, 2] of views [N]."""
    mi = loaded_mitsuba()
    index = mi.UInt32(view_index.astype(np.uint32))
    position = mi.Point2f(*(mi.Float(column.astype(np.float32)) for column in pixels.T))
    is_met, face = nearest_faces(batch, index, position, mi.Bool(True))
    _, depth = meeting_point(batch, View.gather(batch.views, index), index, face, position)
    return dr.select(is_met, depth, dr.inf).numpy(), face.numpy()


def positions(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0, FILM, size=(count, 2)).astype(np.float32)


@pytest.mark.parametrize("distance", [2.2, 0.9, 0.35], ids=["before the camera", "across its plane", "all around it"])
@pytest.mark.parametrize("name", ["arms", "sheet", "sphere"])
def test_rays_meet_what_they_meet_among_all_triangles(name, distance):
    vertices, topology = {"arms": meshes.arms_before_torso, "sheet": meshes.open_sheet, "sphere": lambda: meshes.sphere(2)}[name]()
    cameras = meshes.orbit(2, *FILM, distance=distance)
    batch = make_batch(SurfaceRenderer(topology, *FILM), torch.tensor(vertices, dtype=torch.float32)[None], cameras, [0, 0])
    pixels = positions(1500)
    num_hits = 0
    for view in range(2):
        depth, face = look(batch, np.full(1500, view), pixels)
        expected, expected_face, _, _ = reference.nearest_hits(vertices, topology.faces, cameras, view, pixels.astype(np.float64))
        is_hit = np.isfinite(expected)
        num_hits += is_hit.sum()
        # Rays through an edge may go to either side of it.
        assert (np.isfinite(depth) != is_hit).mean() < 2e-3
        assert (face != expected_face)[is_hit & np.isfinite(depth)].mean() < 5e-3
        np.testing.assert_allclose(np.median(depth[is_hit] / expected[is_hit]), 1, atol=1e-5)
    assert num_hits > 200


def test_meshes_of_a_batch_do_not_see_each_other():
    vertices, topology = meshes.sphere(2)
    stacked = torch.tensor(np.stack([vertices, 0.5 * vertices, vertices + [0.2, 0.0, 0.1]]), dtype=torch.float32)
    cameras, mesh_index = meshes.orbit(4, *FILM), [2, 0, 0, 1]
    batch = make_batch(SurfaceRenderer(topology, *FILM), stacked, cameras, mesh_index)
    pixels = positions(800)
    for view, mesh in enumerate(mesh_index):
        depth, _ = look(batch, np.full(800, view), pixels)
        expected, *_ = reference.nearest_hits(stacked[mesh].double().numpy(), topology.faces, cameras, view, pixels.astype(np.float64))
        agree = np.isfinite(depth) == np.isfinite(expected)
        assert agree.mean() > 0.995
        np.testing.assert_allclose(depth[agree & np.isfinite(depth)], expected[agree & np.isfinite(depth)], rtol=1e-4)


def test_rays_meet_what_mitsubas_rays_meet():
    """On a mesh of many small triangles, at another place than the origin."""
    mi = loaded_mitsuba()
    vertices, topology = meshes.sphere(5)
    vertices = torch.tensor(vertices + [0.1, -0.2, 0.05], dtype=torch.float32)
    cameras = meshes.orbit(3, *FILM, distance=2.0)
    batch = make_batch(SurfaceRenderer(topology, *FILM), vertices[None], cameras, [0, 0, 0])
    scene = MeshScene(topology.faces, topology.num_vertices)
    scene.update(flat_array(vertices))
    pixels = positions(6000)
    for view in range(3):
        depth, face = look(batch, np.full(6000, view), pixels)
        rotation, _, (fx, fy, cx, cy) = reference.rows(cameras, view)
        in_camera = np.stack([(pixels[:, 0] - cx) / fx, (pixels[:, 1] - cy) / fy, np.ones(6000)], axis=1)
        columns = [mi.Float(column.astype(np.float32)) for column in (in_camera @ rotation).T]
        found = scene.scene.ray_intersect_preliminary(mi.Ray3f(mi.Point3f(*cameras.centers[view].tolist()), mi.Vector3f(*columns)))
        is_hit = found.is_valid().numpy()
        assert 1000 < is_hit.sum() < 5000
        assert (np.isfinite(depth) != is_hit).sum() <= 3
        both = is_hit & np.isfinite(depth)
        assert (face[both] != found.prim_index.numpy()[both]).mean() < 5e-3
        np.testing.assert_allclose(depth[both], found.t.numpy()[both], rtol=1e-4)


@pytest.mark.parametrize("distance", [2.2, 0.1], ids=["outside", "inside"])
def test_only_faces_that_can_be_met_first_are_listed(distance):
    """Of a closed mesh, from outside, those seen from the front; from inside, the others are all there is."""
    vertices, topology = meshes.sphere(2)
    cameras = meshes.orbit(2, *FILM, distance=distance)
    batch = make_batch(SurfaceRenderer(topology, *FILM), torch.tensor(vertices, dtype=torch.float32)[None], cameras, [0, 0])
    listed = np.unique(batch.boxes.face.numpy())
    normals = np.cross(*(vertices[topology.faces[:, k]] - vertices[topology.faces[:, 0]] for k in (1, 2)))
    heights = ((cameras.centers.double().numpy()[:, None] - vertices[topology.faces[:, 0]]) * normals).sum(axis=2)
    is_front = (heights > 0).any(axis=0)
    assert np.array_equal(listed, np.flatnonzero(is_front)) if distance > 1 else len(listed) > 20 and not is_front[listed].any()


def test_an_open_mesh_is_listed_from_behind_too():
    vertices, topology = meshes.open_sheet()
    cameras = meshes.orbit(2, *FILM)
    for turned in (vertices, vertices * [-1, -1, 1]):  # by half a turn about the vertical axis
        turned = torch.tensor(turned, dtype=torch.float32)[None]
        batch = make_batch(SurfaceRenderer(topology, *FILM), turned, cameras, [0, 0])
        assert np.array_equal(np.unique(batch.boxes.face.numpy()), np.arange(len(topology.faces)))


def test_tiles_and_bins_grow_with_the_film():
    films = ((30, 22), (128, 90), (160, 256), (512, 512), (2668, 4096))
    assert [1 << tile_bits(film) for film in films] == [1, 1, 2, 4, 32]
    assert [FilmUnits.of(film).bins for film in films] == [(240, 176), (256, 180), (160, 256), (256, 256), (167, 256)]


@pytest.mark.parametrize("samples_per_pixel", [1, 3, 5, 8])
def test_pixels_show_what_single_rays_meet(samples_per_pixel):
    """The two ways through a film agree: samples of pixels under a face's box, and the same positions sorted into bins."""
    mi = loaded_mitsuba()
    vertices, topology = meshes.sphere(3)
    vertices = torch.tensor(np.stack([vertices, 0.6 * vertices + [0.3, 0.1, 0.2]]), dtype=torch.float32)
    renderer = SurfaceRenderer(topology, 300, 220, samples_per_pixel=samples_per_pixel)
    batch = make_batch(renderer, vertices, meshes.orbit(3, 300, 220), [0, 1, 1])
    hits = trace_views(batch)
    view_index, x, y = hits.tiles.pixel_of_slot(hits.slot // samples_per_pixel)
    offset = jitter(random_shift(hits.pixel, PIXELS, batch.seed, samples_per_pixel), hits.slot % samples_per_pixel, samples_per_pixel)
    is_met, face = nearest_faces(batch, view_index, mi.Point2f(x, y) + offset, mi.Bool(True))
    assert hits.count > 3000 * samples_per_pixel and dr.all(is_met)
    assert (face.numpy() != hits.face.numpy()).mean() < 1e-4
    assert len(np.unique(hits.slot.numpy())) == hits.count


def test_equal_seeds_give_equal_images_to_the_last_bit():
    """Samples of a pixel are added in their own order, however the lists of faces were filled and the threads took turns."""
    vertices, topology = meshes.sphere(4)
    vertices = torch.tensor(vertices, dtype=torch.float32)[None]
    textures, cameras = torch.rand(2, 3, 40, 60, generator=torch.Generator().manual_seed(0)), meshes.orbit(2, 300, 220)
    renderer = SurfaceRenderer(topology, 300, 220, samples_per_pixel=5)
    first = [image.clone() for image in renderer.render(vertices, textures, cameras, seed=3)]
    for _ in range(12):
        again = renderer.render(vertices, textures, cameras, seed=3)
        assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))
