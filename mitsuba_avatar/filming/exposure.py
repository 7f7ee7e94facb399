"""One image of a Mitsuba scene: camera rays for the pixels that may show something, the scene's integrator, the mean of every pixel.

Rays are made here and not by Mitsuba's film, for three reasons: pixels that cannot see the person cost nothing (six in seven of a
full-body portrait), sums have a fixed order, so that the same seed gives the same bits, and memory is bounded at any image size.

Symbols: P pixels, S samples a pixel, L = P * S lanes of a launch. Pixels and metres.
"""

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from mitsuba_avatar.captures.cameras import Camera
from mitsuba_avatar.rendering.camera_rays import LARGEST_LAUNCH, NEAR, camera_row, jittered_rays


class Exposure:
    """Takes images of one scene by one integrator."""

    def __init__(self, scene: "mi.Scene", samples_per_pixel: int):
        """Prepare for a scene; its shapes may move between images."""
        self.scene, self.integrator = scene, scene.integrator()
        sampler = mi.load_dict({"type": "multijitter", "sample_count": samples_per_pixel})
        self.samples = sampler.sample_count()  # rounded by the sampler to what it can stratify
        sampler.set_samples_per_wavefront(self.samples)
        self._sampler = sampler

    def begin(self, camera: Camera, pixels: Bool[np.ndarray, "H W"], seed: Sequence[int]) -> "PendingImage":
        """Start path-tracing one image; on CPUs the work goes on while Python prepares the next one.

        Args:
            camera: without distortion.
            pixels: [H, W] which pixels to trace; the others stay zero.
            seed: numbers that together name this image; the same ones give the same bits.
        """
        chosen = np.flatnonzero(pixels)
        at_once = max(1, LARGEST_LAUNCH // self.samples)
        row = camera_row(camera)
        chunks = [chosen[start : start + at_once] for start in range(0, len(chosen), at_once)]
        seeds = np.random.SeedSequence(seed).generate_state(len(chunks)) if chunks else ()
        parts = [(chunk, self._trace(row, camera.width, chunk, int(chunk_seed))) for chunk, chunk_seed in zip(chunks, seeds, strict=True)]
        return PendingImage(camera.height, camera.width, parts)

    def _trace(self, row: list, width: int, pixels: Int[np.ndarray, "P"], seed: int) -> list:
        """One launch: red, green, blue and coverage of pixels."""
        ray = jittered_rays(row, width, pixels, self.samples, self._sampler, seed)
        radiance, valid, _ = self.integrator.sample(self.scene, self._sampler, ray)
        lit = dr.select(valid, radiance, 0)
        channels = [lit.x, lit.y, lit.z, dr.select(valid, mi.Float(1), 0)]
        dr.eval(channels)  # or each of the sums would trace all paths for itself
        means = [dr.block_sum(channel, self.samples) / self.samples for channel in channels]
        dr.eval(means)
        return means


class PendingImage:
    """An image that may still be in the making."""

    def __init__(self, height: int, width: int, parts: list):
        self._shape, self._parts = (height, width, 4), parts

    def finish(self) -> Float32[np.ndarray, "H W 4"]:
        """Wait for it: [H, W, 4] linear radiance, premultiplied, and coverage."""
        height, width, channels = self._shape
        image = np.zeros((height * width, channels), dtype=np.float32)
        for pixels, means in self._parts:
            image[pixels] = np.stack([np.array(mean) for mean in means], axis=-1)
        return image.reshape(self._shape)


def visible_pixels(camera: Camera, vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> Bool[np.ndarray, "H W"]:
    """[H, W] pixels inside the bounding box of some triangle's projection: all that may see the mesh, and few more.

    Where a vertex is too near to the camera's plane to be projected, all pixels.
    """
    height, width = camera.height, camera.width
    pixels, depth = camera.project(vertices)
    if depth.min() < NEAR:
        return np.ones((height, width), dtype=bool)
    corners = np.floor(pixels).astype(np.int32)
    first, second, third = (corners[faces[:, corner]] for corner in range(3))
    # A row and a column more on each side: kernels project in float32.
    low = np.clip(np.minimum(np.minimum(first, second), third) - 1, 0, [width, height])
    high = np.clip(np.maximum(np.maximum(first, second), third) + 2, 0, [width, height])
    # +1 and -1 at the corners of each box; summed along both axes this counts the boxes over each pixel.
    counts = np.zeros((height + 1) * (width + 1), dtype=np.int64)
    for x, y, sign in ((low[:, 0], low[:, 1], 1), (high[:, 0], low[:, 1], -1), (low[:, 0], high[:, 1], -1), (high[:, 0], high[:, 1], 1)):
        counts += sign * np.bincount(y * (width + 1) + x, minlength=len(counts))
    grid = counts.reshape(height + 1, width + 1)
    return (grid.cumsum(axis=0).cumsum(axis=1) > 0)[:height, :width]
