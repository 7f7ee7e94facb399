"""Silhouettes against a slow rasteriser, and every trap recognised from masks alone."""

from dataclasses import replace

import numpy as np
import pytest

from mitsuba_avatar.captures import silhouettes
from mitsuba_avatar.captures.contact_sheet import Tile, overlay, save_contact_sheet
from mitsuba_avatar.captures.reprojection import TRAPS, Observation, diagnose, silhouette_iou
from mitsuba_avatar.captures.silhouettes import covered_pixels, outline, silhouette
from tests.small_capture import draw, make_cameras
from tests.small_rig import make_small_rig

FACES = make_small_rig().topology.faces


@pytest.fixture(scope="module")
def observations(small_capture):
    """All cameras in all frames, as they should be."""
    return [
        Observation(camera, index, small_capture.mask(name, index) > 0.5, np.array(small_capture.vertices[index], np.float64))
        for index in range(4)
        for name, camera in small_capture.cameras.items()
    ]


# ---- Silhouettes ----


def test_silhouette_equals_slow_rasteriser(small_capture):
    for name, camera in make_cameras(72, 54).items():
        for index in (0, 3):
            vertices = np.array(small_capture.vertices[index])
            np.testing.assert_array_equal(silhouette(camera, vertices, FACES), draw(camera, vertices, FACES)[1], err_msg=f"{name} {index}")


def test_coverage_does_not_depend_on_the_chunk_size(monkeypatch):
    triangles = np.random.default_rng(1).normal(size=(60, 3, 2)) * 20 + [30, 20]
    whole = covered_pixels(triangles, 61, 37)
    monkeypatch.setattr(silhouettes, "CANDIDATES", 40)
    np.testing.assert_array_equal(covered_pixels(triangles, 61, 37), whole)
    assert 0 < whole.sum() < whole.size


def test_a_pixel_belongs_to_the_triangle_that_holds_its_centre():
    triangle = np.array([[[1.4, 0.4], [3.5, 0.4], [1.4, 2.5]]])
    expected = np.zeros((3, 5), dtype=bool)
    expected[0, 1:3] = expected[1, 1] = True
    np.testing.assert_array_equal(covered_pixels(triangle, 5, 3), expected)


def test_meshes_behind_the_camera_leave_no_silhouette(small_capture):
    camera = small_capture.cameras["front"]
    behind = 2 * camera.center_world - np.array(small_capture.vertices[0], np.float64)
    assert not silhouette(camera, behind, FACES).any()
    enormous = np.array(small_capture.vertices[0], np.float64) * 1e12
    assert silhouette(camera, enormous, FACES).shape == (48, 64)


def test_outline_is_the_rim():
    mask = np.zeros((7, 9), dtype=bool)
    mask[2:6, 3:9] = True
    rim = outline(mask)
    assert rim.sum() == 14 and not rim[3:5, 4:].any(), "the side at the image's border is open"


# ---- Traps ----


def moved(change):
    """A mistake in camera_from_world."""
    return lambda given: replace(
        given, camera=replace(given.camera, camera_from_world=change(given.camera.camera_from_world.copy(), given.camera.center_world))
    )


def lens(**change):
    """A mistake in the intrinsics, each value a function of the camera."""
    return lambda given: replace(given, camera=replace(given.camera, **{key: value(given.camera) for key, value in change.items()}))


def scaled_lens(factor):
    """Intrinsics of images of another size."""
    return lens(**{key: lambda camera, key=key: getattr(camera, key) * factor for key in ("fx", "fy", "cx", "cy")})


def transposed(pose, center):
    """R^T with the right t."""
    pose[:3, :3] = pose[:3, :3].T
    return pose


def transposed_about_center(pose, center):
    """R^T with t computed from it."""
    pose[:3, :3] = pose[:3, :3].T
    pose[:3, 3] = -pose[:3, :3] @ center
    return pose


def position_as_translation(pose, center):
    """The camera's position in place of t."""
    pose[:3, 3] = center
    return pose


def scaled_translation(factor):
    """t in another unit."""

    def change(pose, center):
        pose[:3, 3] *= factor
        return pose

    return change


def inverted_root(given):
    """Rest vertices posed by the inverse of a root pose that turns and moves."""
    cosine, sine = np.cos(0.7), np.sin(0.7)
    root = np.array([[cosine, -sine, 0, 0.3], [sine, cosine, 0, -0.2], [0, 0, 1, 0.5], [0, 0, 0, 1]])
    inverse = np.linalg.inv(root)
    rest = given.vertices @ inverse[:3, :3].T + inverse[:3, 3]
    return replace(given, vertices=rest @ inverse[:3, :3].T + inverse[:3, 3], root=inverse)


OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
MISTAKES = {
    "transposed rotation": moved(transposed),
    "transposed rotation, with translations computed from it": moved(transposed_about_center),
    "world_from_camera stored as camera_from_world": moved(lambda pose, center: np.linalg.inv(pose)),
    "OpenGL camera axes (y up, z backward)": moved(lambda pose, center: OPENGL @ pose),
    "OpenGL world_from_camera (NeRF, Blender)": moved(lambda pose, center: np.linalg.inv(pose) @ OPENGL),
    "camera positions stored as translations": moved(position_as_translation),
    "camera translations in millimetres": moved(scaled_translation(1000)),
    "camera translations in centimetres": moved(scaled_translation(100)),
    "mesh in millimetres": lambda given: replace(given, vertices=given.vertices * 1000),
    "mesh in centimetres": lambda given: replace(given, vertices=given.vertices * 100),
    "mesh with y up": lambda given: replace(given, vertices=given.vertices[:, [0, 2, 1]] * [1, 1, -1]),
    "intrinsics of images half the size": scaled_lens(0.5),
    "intrinsics of images twice the size": scaled_lens(2.0),
    "lost principal point (K read transposed)": lens(cx=lambda camera: 0.0, cy=lambda camera: 0.0),
    "x and y of the intrinsics exchanged": lens(
        fx=lambda camera: camera.fy, fy=lambda camera: camera.fx, cx=lambda camera: camera.cy, cy=lambda camera: camera.cx
    ),
    "inverted root pose": inverted_root,
    "half a pixel: the principal point counts from the first pixel's centre": lens(
        cx=lambda camera: camera.cx - 0.5, cy=lambda camera: camera.cy - 0.5
    ),
    "half a pixel: 0.5 was added to the principal point twice": lens(cx=lambda camera: camera.cx + 0.5, cy=lambda camera: camera.cy + 0.5),
}


def test_a_good_capture_is_left_in_peace(observations):
    diagnosis = diagnose(observations, FACES)
    assert diagnosis.is_good and diagnosis.trap is None
    assert list(diagnosis.iou) == ["front", "left", "high"] and min(diagnosis.iou.values()) == 1.0


@pytest.mark.parametrize("trap", TRAPS, ids=lambda trap: trap.name)
def test_every_trap_is_named(observations, trap):
    """Each mistake, made by formulas of this file's own, is recognised among all others."""
    diagnosis = diagnose([MISTAKES[trap.name](observation) for observation in observations], FACES)
    assert diagnosis.trap is trap, diagnosis.trials[:3]
    assert not diagnosis.is_good and diagnosis.trap_iou > 0.7


def test_half_a_stored_pixel_in_smaller_images(small_capture):
    """With images at half size the stored half pixel is a quarter of a pixel."""
    half_size = {name: camera.resized(2.0) for name, camera in small_capture.cameras.items()}
    given = []
    for index in range(4):
        vertices = np.array(small_capture.vertices[index])
        for camera in half_size.values():
            wrong = replace(camera, cx=camera.cx - 0.5, cy=camera.cy - 0.5)
            given.append(Observation(wrong, index, silhouette(camera, vertices, FACES), vertices))
    assert "counts from the first pixel's centre" in diagnose(given, FACES, pixel=1.0).trap.name
    assert diagnose(given, FACES, pixel=0.1).trap is None, "a tenth of the shift leaves most of the disagreement"


def test_loose_clothes_are_no_trap(observations):
    """Masks 2 pixels larger than the body all round: low agreement, for which no convention is to blame."""
    from scipy import ndimage

    dressed = [replace(observation, mask=ndimage.binary_dilation(observation.mask, iterations=2)) for observation in observations]
    diagnosis = diagnose(dressed, FACES, minimum_iou=0.3)
    assert 0.3 < min(diagnosis.iou.values()) < 0.75 and diagnosis.is_good
    strict = diagnose(dressed, FACES, minimum_iou=0.9)
    assert strict.trap is None and len(strict.low_cameras) == 3 and len(strict.trials) == len(TRAPS) - 1, "the root is unknown here"


def test_one_wrong_camera_is_told_apart(observations):
    wrong = [MISTAKES["transposed rotation"](given) if given.camera.name == "left" else given for given in observations]
    diagnosis = diagnose(wrong, FACES)
    assert diagnosis.low_cameras == ("left",) and diagnosis.trap.name == "transposed rotation"


def test_empty_views_agree(observations):
    """A person outside a camera's view: neither mask nor mesh has a pixel."""
    away = [replace(given, vertices=given.vertices + [0, 0, 40.0], mask=np.zeros_like(given.mask)) for given in observations[:3]]
    assert set(silhouette_iou(away, FACES).values()) == {1.0}


# ---- Contact sheet ----


def test_overlay_keeps_the_image_and_marks_both_outlines(observations):
    given = observations[1]
    image = np.full((48, 64, 3), 90, np.uint8)
    shifted = np.roll(given.mask, 3, axis=1)
    drawn = overlay(image, shifted, given.camera, given.vertices, FACES, height=144)
    assert drawn.shape == (144, 192, 3) and (drawn[:5] == 90).all()
    assert (drawn == (255, 145, 20)).all(axis=2).sum() > 100 and (drawn == (40, 150, 255)).all(axis=2).sum() > 100


def test_sheet_has_all_tiles(tmp_path):
    from PIL import Image

    tiles = [[Tile(np.full((40, 60, 3), 30 * row + 70 * column, np.uint8), "a", column == 1) for column in range(3)] for row in range(2)]
    save_contact_sheet(tmp_path / "new/sheet.png", tiles, "title")
    sheet = np.array(Image.open(tmp_path / "new/sheet.png"))
    assert all((sheet == 30 * row + 70 * column).all(axis=2).sum() >= 2400 for row in range(2) for column in range(3))
    with pytest.raises(ValueError, match=r"expected tiles in every row; got \[0\]"):
        save_contact_sheet(tmp_path / "none.png", [[]], "title")
