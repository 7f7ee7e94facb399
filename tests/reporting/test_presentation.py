"""What a run shows: panels have their parts, pictures their cameras, and a path's corners hold the whole body."""

import numpy as np
import torch

from mitsuba_avatar.captures.images import read_image
from mitsuba_avatar.reporting.camera_paths import orbit
from mitsuba_avatar.reporting.presentation import BACKDROP, Presentation, Shot, draw_along, posed_corners
from tests.drawn_capture import HEIGHT, HELD_OUT, WIDTH

SHOTS = [Shot(2, "left"), Shot(8, HELD_OUT)]


def test_a_preview_has_a_row_for_every_shot(evaluator, loaded):
    presentation = Presentation(evaluator, loaded.run.rig)
    one, two = presentation.preview(SHOTS[:1]), presentation.preview(SHOTS)
    assert one.shape[1] == two.shape[1] and 1.5 * one.shape[0] < two.shape[0] < 2.2 * one.shape[0]
    assert two.shape[1] > 7 * WIDTH, "capture, render, error, mesh, texture, occlusion, shadow"


def test_a_comparison_shows_every_method(evaluator, loaded):
    grid = Presentation(evaluator, loaded.run.rig).compare(SHOTS)
    assert grid.shape[0] > 2 * HEIGHT and grid.shape[1] > 4 * WIDTH and grid.std() > 10


def test_held_out_pictures_are_the_avatar_at_the_captures_size(evaluator, loaded, tmp_path):
    paths = Presentation(evaluator, loaded.run.rig).save_held_out_pictures(tmp_path / "out", SHOTS)
    assert [path.name for path in paths] == ["left_000022.png", f"{HELD_OUT}_000028.png"]
    drawn = evaluator.draw("avatar", evaluator.reader.read([8], [[HELD_OUT]]))
    expected = drawn.images[0].permute(1, 2, 0).numpy()
    np.testing.assert_allclose(read_image(paths[1]) / 255, expected, atol=0.5 / 255 + 1e-6)


def test_corners_hold_the_whole_body_in_every_frame(loaded):
    """A camera that frames the corners frames all vertices; 258 vertices leave far fewer corners."""
    frames = [0, 3, 6, 6]
    corners = posed_corners(loaded.avatar, loaded.capture, frames)
    theta, root = (torch.from_numpy(np.array(values[frames])) for values in (loaded.capture.theta, loaded.capture.root))
    with torch.no_grad():
        vertices = loaded.avatar.pose_template(theta, root).reshape(-1, 3).numpy()
    assert len(corners) < 0.5 * len(vertices)
    for direction in np.random.default_rng(0).normal(size=(50, 3)):
        np.testing.assert_allclose((corners @ direction).max(), (vertices @ direction).max(), rtol=1e-5)


def test_an_avatar_is_drawn_along_a_path(loaded, private_cache, one_thread):
    frames = [0, 5, 9]
    cameras = orbit(posed_corners(loaded.avatar, loaded.capture, frames), 3, 30, 44)
    drawn = list(draw_along(loaded.avatar, loaded.capture, frames, cameras, loaded.renderer(30, 44), loaded.occlusion()))
    assert torch.is_grad_enabled(), "the caller's own gradients go on"
    for driven in drawn:
        radiance, mask = driven.radiance, driven.mask[..., 0]
        assert radiance.shape == (44, 30, 3) and mask.shape == (44, 30)
        assert mask.max() > 0.99 and max(mask[0].max(), mask[-1].max(), mask[:, 0].max(), mask[:, -1].max()) < 0.5
        assert (radiance[mask == 0] == 0).all(), "radiance is premultiplied"
        picture = driven.on_backdrop()
        assert picture.dtype == np.uint8 and (picture[mask == 0] == picture[0, 0]).all()
        assert abs(int(picture[0, 0, 0]) - round(255 * (1.055 * BACKDROP ** (1 / 2.4) - 0.055))) <= 1
    assert np.abs(drawn[0].radiance - drawn[1].radiance).mean() > 0.005


def test_geometry_layers_agree_with_the_camera_and_the_mesh(loaded, private_cache, one_thread):
    frames = [2, 7]
    cameras = orbit(posed_corners(loaded.avatar, loaded.capture, frames), 2, 30, 44)
    for driven, camera in zip(
        draw_along(loaded.avatar, loaded.capture, frames, cameras, loaded.renderer(30, 44), loaded.occlusion()), cameras, strict=True
    ):
        inside = driven.mask[..., 0] > 0.999
        pixels, depth = camera.project(driven.position[inside])
        rows, columns = np.nonzero(inside)
        np.testing.assert_allclose(depth, driven.depth[inside][:, 0], rtol=1e-4)
        assert (np.floor(pixels) == np.stack([columns, rows], 1)).mean() > 0.98, "positions project into their own pixels"
        distance = np.linalg.norm(driven.vertices[None] - driven.position[inside][:, None], axis=2).min(axis=1)
        assert distance.max() < 0.1 and np.abs(np.linalg.norm(driven.normal[inside], axis=1) - 1).max() < 1e-3
        assert driven.uv[inside].std(axis=0).min() > 0.01 and set(driven.layers()) == {
            "colour",
            "mask",
            "depth",
            "normal",
            "position",
            "uv",
        }
