from pathlib import Path

import numpy as np
import pytest

from mitsuba_avatar.captures.colour import decode_bytes
from mitsuba_avatar.captures.colour_calibration import calibrate_cameras, correct_colours, load_chart, patch_means
from mitsuba_avatar.captures.images import read_image
from mitsuba_avatar.filming.cameras import place_cameras
from mitsuba_avatar.filming.colour_chart import COLUMNS, ROWS, film_charts, reflectances
from mitsuba_avatar.filming.sensor import Sensor
from mitsuba_avatar.filming.settings import CameraSettings, LightSettings, StudioSettings
from tests.filming.posed_body import PosedBody, posed_body

TOLERANCE = 0.01  # of the recovered response's entries, from 8-bit pictures with noise


@pytest.fixture(scope="module")
def posed() -> PosedBody:
    return posed_body()


@pytest.fixture(scope="module")
def chart_settings() -> StudioSettings:
    return StudioSettings(
        cameras=CameraSettings(
            train=3, held_out=1, width=72, height=104, shot_noise=0.02, read_noise=0.003, colour_spread=0.08, chart_samples_per_pixel=16
        ),
        light=LightSettings(light_samples=2),
    )


@pytest.fixture(scope="module")
def charts(posed: PosedBody, chart_settings: StudioSettings, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("capture") / "chart"
    film_charts(folder, place_cameras(posed.vertices, chart_settings).cameras, chart_settings)
    return folder


def test_calibration_recovers_every_cameras_response(charts: Path, chart_settings: StudioSettings):
    """The first camera needs no correction; the others' are the inverse of the response that their pictures were recorded with."""
    matrices = calibrate_cameras(charts, "srgb")
    responses = Sensor.of(chart_settings).responses
    assert list(matrices) == ["train_00", "train_01", "train_02", "held_out_00"]
    for matrix, response in zip(matrices.values(), responses, strict=True):
        np.testing.assert_allclose(matrix[:, :3] @ response, np.eye(3), atol=TOLERANCE)
        np.testing.assert_allclose(matrix[:, 3], 0, atol=TOLERANCE / 4)
    assert max(np.abs(response - np.eye(3)).max() for response in responses) > 5 * TOLERANCE


def test_corrected_pictures_agree_with_the_reference(charts: Path):
    chart, matrices = load_chart(charts), calibrate_cameras(charts, "srgb")
    for name, corners in chart.corners.items():
        recorded = patch_means(decode_bytes(read_image(charts / f"{name}.png"), "srgb"), corners, ROWS, COLUMNS)
        before, after = (np.abs(values - chart.reference[name]).mean() for values in (recorded, correct_colours(recorded, matrices[name])))
        assert after < 0.003 and (before > 3 * after or name == "train_00"), f"{name}: {before:.4f} before, {after:.4f} after"


def test_references_are_the_charts_reflectances_in_the_stages_light(charts: Path):
    """Under a nearly even dome radiance is reflectance times nearly one factor."""
    truth = reflectances()
    assert truth.shape == (24, 3) and truth.min() >= 0 and 0.6 < truth.max() < 0.8
    for reference in load_chart(charts).reference.values():
        ratios = reference[18:22] / truth[18:22]  # greys
        assert ratios.min() > 0.7 and ratios.max() < 1.6 and ratios.max() / ratios.min() < 1.35
