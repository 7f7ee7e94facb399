"""Images of a Mitsuba scene: camera rays for the pixels that may show something, the scene's integrator, the mean of every pixel.

Rays are made here and not by Mitsuba's film, for three reasons: pixels that cannot see the person cost nothing (six in seven of a
full-body portrait), sums have a fixed order, so that the same seed gives the same bits, and memory is bounded at any image size.
Small images are traced several in a launch: preparing one in Python costs a quarter of an image of 192 x 256 pixels, whatever it holds.

Symbols: C cameras, P pixels, S samples a pixel, L = P * S lanes of a launch. Pixels and metres.
"""

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from mitsuba_avatar.captures.cameras import Camera
from mitsuba_avatar.rendering.camera_rays import LARGEST_LAUNCH, NEAR, camera_rows, jittered_rays, rows_of_lanes


class Exposure:
    """Takes images of one scene by one integrator."""

    def __init__(self, scene: "mi.Scene", samples_per_pixel: int):
        """Prepare for a scene; its shapes may move between images."""
        self.scene, self.integrator = scene, scene.integrator()
        sampler = mi.load_dict({"type": "multijitter", "sample_count": samples_per_pixel})
        self.samples = sampler.sample_count()  # rounded by the sampler to what it can stratify
        sampler.set_samples_per_wavefront(self.samples)
        self._sampler = sampler

    def begin(self, cameras: Sequence[Camera], pixels: Bool[np.ndarray, "C H W"], seed: Sequence[int]) -> "PendingImages":
        """Start path-tracing some images; on CPUs the work goes on while Python prepares the next ones.

        Args:
            cameras: of one size, without distortion.
            pixels: [C, H, W] which pixels to trace; the others stay zero.
            seed: numbers that together name these images; the same ones, of the same cameras, give the same bits.
        """
        chosen = np.flatnonzero(pixels)  # of all images, one after the other
        at_once = max(1, LARGEST_LAUNCH // self.samples)
        rows = camera_rows(cameras)
        chunks = [chosen[start : start + at_once] for start in range(0, len(chosen), at_once)]
        seeds = np.random.SeedSequence(seed).generate_state(len(chunks)) if chunks else ()
        parts = [(chunk, self._trace(rows, pixels.shape, chunk, int(chunk_seed))) for chunk, chunk_seed in zip(chunks, seeds, strict=True)]
        return PendingImages(pixels.shape, parts)

    def _trace(self, rows: list, shape: tuple[int, int, int], pixels: Int[np.ndarray, "P"], seed: int) -> list:
        """One launch: red, green, blue and coverage of pixels of the images [C, H, W]."""
        camera, pixel = np.divmod(pixels, shape[1] * shape[2])
        row = rows_of_lanes(rows, camera, self.samples)
        ray = jittered_rays(row, shape[2], pixel, self.samples, self._sampler, seed)
        radiance, valid, _ = self.integrator.sample(self.scene, self._sampler, ray)
        lit = dr.select(valid, radiance, 0)
        channels = [lit.x, lit.y, lit.z, dr.select(valid, mi.Float(1), 0)]
        dr.eval(channels)  # or each of the sums would trace all paths for itself
        means = [dr.block_sum(channel, self.samples) / self.samples for channel in channels]
        dr.eval(means)
        return means


class PendingImages:
    """Images that may still be in the making."""

    def __init__(self, shape: tuple[int, int, int], parts: list):
        self._shape, self._parts = shape, parts

    def finish(self) -> Float32[np.ndarray, "C H W 4"]:
        """Wait for them: [C, H, W, 4] linear radiance, premultiplied, and coverage."""
        images = np.zeros((*self._shape, 4), dtype=np.float32)
        flat = images.reshape(-1, 4)
        for pixels, means in self._parts:
            flat[pixels] = np.stack([np.array(mean) for mean in means], axis=-1)
        return images


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
