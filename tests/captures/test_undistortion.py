"""Undistortion: points and images agree with the camera's own projection, and with a direct evaluation of the lens model."""

import dataclasses

import numpy as np
import pytest

from mitsuba_avatar.captures.cameras import Camera
from mitsuba_avatar.captures.undistortion import Lens, distort_points, lens_of, undistort_points, undistorted_camera, undistortion

BARREL = (-0.22, 0.05, 0.002, -0.0015, 0.001)
RATIONAL = (-0.2, 0.04, 0.001, -0.001, 0.002, 0.01, -0.005, 0.001)
FISHEYE = Lens((0.02, -0.01, 0.003, -0.001), "fisheye")


def camera(distortion=BARREL) -> Camera:
    return Camera("c", 90, 60, 80.0, 84.0, 43.0, 31.5, np.eye(4), distortion)


def directions() -> np.ndarray:
    """Points one metre away, inside the view, asymmetric."""
    return np.array([[-0.4, -0.2, 1.0], [0.0, 0.0, 1.0], [0.45, 0.25, 1.0], [-0.3, 0.28, 1.0], [0.1, -0.3, 1.0]])


@pytest.mark.parametrize("distortion", [(), BARREL[:4], BARREL, (0.2, -0.05, 0.004, -0.003, 0.02, 0.35, -0.02, 0.01)])
def test_points_that_the_camera_bends_come_back_to_where_a_pinhole_sees_them(distortion):
    bent, _ = camera(distortion).project(directions())
    target = undistorted_camera(camera(distortion))
    straight, _ = target.project(directions())
    np.testing.assert_allclose(undistort_points(bent, camera(distortion), target=target), straight, atol=1e-4)
    pinhole, _ = camera(()).project(directions())
    np.testing.assert_allclose(distort_points(pinhole, camera(distortion), lens_of(camera(distortion))), bent, atol=1e-6)


@pytest.mark.parametrize("lens", [Lens(RATIONAL), FISHEYE])
def test_lenses_that_a_camera_file_cannot_hold_invert_as_well(lens):
    pinhole, _ = camera(()).project(directions())
    bent = distort_points(pinhole, camera(()), lens)
    assert np.abs(bent - pinhole).max() > 0.5
    np.testing.assert_allclose(undistort_points(bent, camera(()), lens), pinhole, atol=1e-4)


def test_a_fisheye_bends_as_its_equation_says():
    """r = theta (1 + k1 theta^2 + ...), along the ray's own azimuth."""
    rays = directions()[:, :2]
    radius = np.linalg.norm(rays, axis=1, keepdims=True)
    theta = np.arctan(radius)
    k1, k2, k3, k4 = FISHEYE.coefficients
    bent = theta * (1 + k1 * theta**2 + k2 * theta**4 + k3 * theta**6 + k4 * theta**8)
    expected = rays / np.where(radius == 0, 1, radius) * bent * [80.0, 84.0] + [43.0, 31.5]
    pinhole, _ = camera(()).project(directions())
    np.testing.assert_allclose(distort_points(pinhole, camera(()), FISHEYE), expected, atol=1e-6)


def spot_image(places, size, sigma=1.6):
    """[H, W, 3] of Gaussian spots at pixel places (corner origin), one more red, the next more green."""
    x, y = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
    image = np.zeros((size[1], size[0], 3), np.float32)
    for number, (px, py) in enumerate(places):
        image[..., number % 3] += np.exp(-0.5 * ((x - px) ** 2 + (y - py) ** 2) / sigma**2)
    return image


def centroid(image, place, radius=6):
    """Brightness-weighted mean pixel (corner origin) around a place."""
    x, y = np.meshgrid(np.arange(image.shape[1]) + 0.5, np.arange(image.shape[0]) + 0.5)
    weight = np.where(np.hypot(x - place[0], y - place[1]) < radius, image, 0)
    return np.array([(weight * x).sum(), (weight * y).sum()]) / weight.sum()


@pytest.mark.parametrize("lens", [lens_of(camera()), Lens(RATIONAL), FISHEYE])
@pytest.mark.parametrize("size", [(None, None), (64, 50), (30, 20)])
def test_spots_of_a_bent_image_land_where_the_straight_camera_projects_them(lens, size):
    """Images, masks and labels; with another shape, and where averaging three samples a side makes the image smaller."""
    own = camera(())
    target = undistorted_camera(own, lens, *size)
    points = directions()[[1, 2, 3]] * [0.8, 0.8, 1.0]
    bent = distort_points(own.project(points)[0], own, lens)
    image = spot_image(bent, (own.width, own.height))
    remap = undistortion(own, target, lens)
    straight = remap.image(image)
    expected = target.project(points)[0]
    radius = 6 * target.fx / own.fx
    for number, place in enumerate(expected):
        assert np.abs(centroid(straight[..., number], place, radius) - place).max() < 0.12
    mask = remap.mask((image.max(axis=-1) > 0.5).astype(np.float32))
    labels = remap.labels(np.where(image.max(axis=-1) > 0.5, 7, 0).astype(np.uint8))
    assert set(np.unique(labels)) == {0, 7} and np.abs((mask > 0.5).sum() - (labels == 7).sum()) <= 0.35 * (labels == 7).sum()
    shifted = dataclasses.replace(target, cx=target.cx + 0.5)
    assert abs(centroid(straight[..., 0], expected[0], radius)[0] - shifted.project(points[:1])[0][0, 0]) > 0.35, "half a pixel shows"


def test_the_cropped_camera_sees_only_pixels_that_the_lens_saw():
    for lens in (lens_of(camera()), Lens((0.15, -0.02, 0.0, 0.0)), FISHEYE):
        own = camera(())
        target = undistorted_camera(own, lens)
        assert undistortion(own, target, lens).mask(np.ones((60, 90), np.float32))[1:-1, 1:-1].min() > 0.99
        whole = undistorted_camera(own, lens, is_cropped=False)
        np.testing.assert_allclose([whole.fx, whole.fy, whole.cx, whole.cy], [80.0, 84.0, 43.0, 31.5])


def test_without_distortion_the_camera_and_its_images_stay_as_they_are():
    own = camera(())
    target = undistorted_camera(own)
    np.testing.assert_allclose([target.fx, target.fy, target.cx, target.cy], [own.fx, own.fy, own.cx, own.cy])
    image = np.random.default_rng(0).random((60, 90, 3), dtype=np.float32)
    np.testing.assert_allclose(undistortion(own, target).image(image), image, atol=1e-5)
    half = undistorted_camera(own, width=45, height=30)
    np.testing.assert_allclose([half.fx, half.fy, half.cx, half.cy], [40.0, 42.0, 21.5, 15.75])
    np.testing.assert_allclose(undistortion(own, half).image(image), image.reshape(30, 2, 45, 2, 3).mean(axis=(1, 3)), atol=2e-3)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: Lens((0.1, 0.2)), "expected 0 or 4 or 5 or 8 or 12 or 14 finite coefficients"),
        (lambda: Lens((0.1,) * 5, "fisheye"), "expected 4 finite coefficients of a fisheye"),
        (lambda: undistorted_camera(camera((-3.0, 0.0, 0.0, 0.0))), "which fold over. Calibrate again"),
        (lambda: undistortion(camera(), camera()), "expected a straight target at the place of c"),
        (lambda: undistortion(camera(), camera(())).image(np.zeros((90, 60, 3), np.float32)), "expected images of 90x60 pixels"),
    ],
)
def test_what_cannot_be_undistorted_is_named(call, message):
    with pytest.raises(ValueError, match=message.replace("(", r"\(")):
        call()
