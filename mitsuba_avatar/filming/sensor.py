"""What a camera's sensor makes of radiance, before an image is encoded: its response to colour, shot noise, read noise.

All of it is an option and off by default; 8-bit quantisation comes later, with the file. Symbols: linear radiance in the image's primaries.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64

from mitsuba_avatar.filming.settings import StudioSettings

CROSSTALK = 1 / 3  # spread between channels, of the spread of gains
_RESPONSES, _NOISE = 88, 99  # name independent streams of random numbers of one seed


@dataclass(frozen=True, eq=False)  # arrays have no truth value to compare by
class Sensor:
    """The sensors of all cameras of a capture.

    Attributes:
        responses: [C, 3, 3] recorded = response @ radiance; the first is the identity, the reference of a calibration.
        shot_noise: standard deviation at radiance 1; it grows with the square root of radiance.
        read_noise: standard deviation at every radiance.
        seed: of the capture.
    """

    responses: Float64[np.ndarray, "C 3 3"]
    shot_noise: float
    read_noise: float
    seed: int

    @classmethod
    def of(cls, settings: StudioSettings) -> "Sensor":
        """The sensors that settings ask for, training cameras first."""
        cameras = settings.cameras
        count = cameras.train + cameras.held_out
        rng = np.random.default_rng([settings.seed, _RESPONSES])
        deviation = rng.normal(size=(count, 3, 3)).clip(-2, 2) * np.where(np.eye(3, dtype=bool), 1.0, CROSSTALK)
        deviation[0] = 0
        return cls(np.eye(3) + cameras.colour_spread * deviation, cameras.shot_noise, cameras.read_noise, settings.seed)

    def record(
        self, radiance: Float32[np.ndarray, "C H W 3"], frame: int, cameras: Sequence[int] | None = None
    ) -> Float32[np.ndarray, "C H W 3"]:
        """What cameras record of radiance that includes the backdrop.

        Args:
            radiance: one image a camera.
            frame: with the seed and the camera's index it decides the noise: images may be made in any order.
            cameras: indices of the cameras that the images are of; None means all, in order.

        Returns:
            linear values, which noise may make negative.
        """
        indices = range(len(radiance)) if cameras is None else cameras
        return np.stack([self._recorded(image, frame, index) for image, index in zip(radiance, indices, strict=True)])

    def _recorded(self, radiance: Float32[np.ndarray, "H W 3"], frame: int, camera: int) -> Float32[np.ndarray, "H W 3"]:
        response = self.responses[camera]
        recorded = radiance if (response == np.eye(3)).all() else (radiance @ response.T).astype(np.float32)
        if not (self.shot_noise or self.read_noise):
            return recorded
        rng = np.random.default_rng([self.seed, _NOISE, frame, camera])
        # Photons are many: their Poisson distribution is normal, and its variance the signal's.
        variance = self.shot_noise**2 * recorded.clip(0, None) + self.read_noise**2
        return recorded + np.sqrt(variance) * rng.standard_normal(recorded.shape, dtype=np.float32)
