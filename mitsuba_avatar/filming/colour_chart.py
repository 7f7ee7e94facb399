"""Pictures of a colour chart on the stage: what per-camera colour calibration is tested with.

The chart has the 24 reflectances of the ColorChecker (X-Rite's values for charts made since November 2014), turned upright and scaled by
`EXPOSURE`, so that its white is not clipped where skin and cloth are exposed well. For each camera it hangs where the person stands,
parallel to the image, is path-traced in the stage's light and recorded by the camera's sensor. What an ideal sensor measures is the
reference.
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64

from mitsuba_avatar.captures.cameras import Camera
from mitsuba_avatar.captures.colour import encode_bytes
from mitsuba_avatar.captures.colour_calibration import ColourChart, patch_means, save_chart
from mitsuba_avatar.captures.images import write_image
from mitsuba_avatar.filming.appearance import Appearance
from mitsuba_avatar.filming.cameras import DISTANCE
from mitsuba_avatar.filming.grids import grid_topology
from mitsuba_avatar.filming.sensor import Sensor
from mitsuba_avatar.filming.settings import StudioSettings
from mitsuba_avatar.filming.stage import Layer, Stage

ROWS, COLUMNS = 6, 4
EXPOSURE = 0.8
SHARE_OF_IMAGE = 0.8  # that the chart takes of the image's tighter side
FRAME = 0.04  # share of a patch's side, on each side, that is black
FRAME_REFLECTANCE = 0.03
TEXELS = 192  # divisible by rows and columns: patches end between texels
CHART_FRAME = 2**31  # frame number of chart pictures, for seeds: no performance is as long
CHECKER = "ColorChecker24 - After November 2014"


def film_charts(folder: Path | str, cameras: Mapping[str, Camera], settings: StudioSettings) -> None:
    """Take a picture of the chart with every camera and write pictures and description into a folder.

    Args:
        folder: is made if need be; what is there of an earlier attempt is written again.
        cameras: of the capture, in its order.
        settings: light, sensor and `cameras.chart_samples_per_pixel`, which must be positive.

    Raises:
        ValueError: if images are so small that a patch has no pixel.
    """
    folder = Path(folder)
    light = dataclasses.replace(settings.light, samples_per_pixel=settings.cameras.chart_samples_per_pixel)
    layer = Layer("chart", grid_topology(2, 2), _appearance(), is_two_sided=True)
    stage = Stage([layer], list(cameras.values()), dataclasses.replace(settings, light=light), together=1)  # a chart before each camera
    sensor = Sensor.of(settings)
    corners, reference = {}, {}
    for index, (name, camera) in enumerate(cameras.items()):
        corners[name] = _corners(camera)
        radiance, coverage = stage.shoot([_surface(camera, corners[name])], settings.seed, cameras=[index])
        reference[name] = patch_means(radiance[0], corners[name], ROWS, COLUMNS)
        composed = radiance + (1 - coverage[..., None]) * np.float32(light.background)
        recorded = sensor.record(composed, CHART_FRAME, cameras=[index])
        write_image(folder / f"{name}.png", encode_bytes(recorded[0], "srgb"))
    save_chart(folder, ColourChart(ROWS, COLUMNS, corners, reference))


def reflectances() -> Float64[np.ndarray, "24 3"]:
    """Linear reflectance of the patches in reading order, in the images' primaries (Rec. 709, D65)."""
    import colour  # takes seconds to load, which filming without charts need not wait for

    checker = colour.CCS_COLOURCHECKERS[CHECKER]
    chromaticities = np.array(list(checker.data.values()))
    values = colour.XYZ_to_RGB(colour.xyY_to_XYZ(chromaticities), "sRGB", illuminant=checker.illuminant)
    # Cyan lies outside these primaries.
    return EXPOSURE * values.clip(0.0, 1.0)


def _appearance() -> Appearance:
    down, across = np.meshgrid((np.arange(TEXELS) + 0.5) / TEXELS, (np.arange(TEXELS) + 0.5) / TEXELS, indexing="ij")
    patch = (np.floor(down * ROWS) * COLUMNS + np.floor(across * COLUMNS)).astype(np.int64)
    is_frame = np.maximum(np.abs(down * ROWS % 1 - 0.5), np.abs(across * COLUMNS % 1 - 0.5)) > 0.5 - FRAME
    texture = np.where(is_frame[..., None], FRAME_REFLECTANCE, reflectances()[patch]).astype(np.float32)
    return Appearance(texture, np.ones((TEXELS, TEXELS), dtype=np.float32), specular=0.0)


def _corners(camera: Camera) -> Float64[np.ndarray, "4 2"]:
    """The chart's corners in the middle of the image, pixels."""
    patch = SHARE_OF_IMAGE * min(camera.width / COLUMNS, camera.height / ROWS)
    half = 0.5 * patch * np.array([COLUMNS, ROWS])
    middle = 0.5 * np.array([camera.width, camera.height])
    return middle + half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])


def _surface(camera: Camera, corners: Float64[np.ndarray, "4 2"]) -> Float32[np.ndarray, "4 3"]:
    """Where the chart hangs, in the order of a grid's vertices: upper left, upper right, lower left, lower right. Metres."""
    grid = corners[[0, 1, 3, 2]]
    rays = np.concatenate([(grid - [camera.cx, camera.cy]) / [camera.fx, camera.fy], np.ones((4, 1))], axis=1)
    world_from_camera = camera.world_from_camera
    return (DISTANCE * rays @ world_from_camera[:3, :3].T + world_from_camera[:3, 3]).astype(np.float32)
