import numpy as np

from mitsuba_avatar.filming.sensor import Sensor
from mitsuba_avatar.filming.settings import CameraSettings, StudioSettings

GREY = np.broadcast_to(np.linspace(0.05, 0.9, 4, dtype=np.float32)[:, None, None, None], (4, 60, 80, 3)).copy()  # a level a camera


def _sensor(**options: float) -> Sensor:
    return Sensor.of(StudioSettings(seed=3, cameras=CameraSettings(train=3, held_out=1, **options)))


def test_without_options_a_sensor_changes_nothing():
    np.testing.assert_array_equal(_sensor().record(GREY, frame=0), GREY)


def test_noise_has_the_asked_for_strength_at_every_radiance():
    """Variance: shot^2 L + read^2; the mean stays."""
    recorded = _sensor(shot_noise=0.05, read_noise=0.01).record(GREY, frame=2)
    expected = np.sqrt(0.05**2 * GREY[:, 0, 0, 0] + 0.01**2)
    np.testing.assert_allclose(recorded.std(axis=(1, 2, 3)), expected, rtol=0.03)
    np.testing.assert_allclose(recorded.mean(axis=(1, 2, 3)), GREY[:, 0, 0, 0], atol=0.002)


def test_noise_depends_on_frame_and_camera_and_not_on_what_else_is_recorded():
    sensor = _sensor(shot_noise=0.05)
    image = GREY[2:3]
    all_cameras = sensor.record(np.repeat(image, 4, axis=0), frame=5)
    np.testing.assert_array_equal(sensor.record(image, frame=5, cameras=[3])[0], all_cameras[3])
    assert (all_cameras[3] != all_cameras[1]).mean() > 0.9
    assert (sensor.record(image, frame=6, cameras=[3])[0] != all_cameras[3]).mean() > 0.9


def test_the_first_camera_is_the_reference_and_the_others_differ_by_the_spread():
    responses = np.concatenate(
        [Sensor.of(StudioSettings(seed=seed, cameras=CameraSettings(train=20, colour_spread=0.06))).responses for seed in range(5)]
    )
    np.testing.assert_array_equal(responses[::23], np.broadcast_to(np.eye(3), (5, 3, 3)))
    others = np.delete(responses, np.s_[::23], axis=0) - np.eye(3)
    gains, crosstalk = others[:, np.eye(3, dtype=bool)], others[:, ~np.eye(3, dtype=bool)]
    assert 0.045 < gains.std() < 0.07 and 0.015 < crosstalk.std() < 0.025


def test_a_response_mixes_channels():
    sensor = _sensor(colour_spread=0.1)
    red = np.zeros((1, 2, 3, 3), dtype=np.float32)
    red[..., 0] = 0.5
    np.testing.assert_allclose(sensor.record(red, 0, cameras=[2])[0, 1, 1], 0.5 * sensor.responses[2][:, 0], rtol=1e-6)
