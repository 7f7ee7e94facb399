"""Pictures of a scene by path tracing: in passes, until a number of samples or a noise is reached.

Camera rays are made here, so that any pinhole camera is exact (also off-centre, also with pixels that are not square), the same seed gives
the same bits (sums have a fixed order), and memory is bounded at any size. Mitsuba's `path` integrator follows them: it samples lamps
and surfaces. Where nothing is seen a picture is transparent: light from far away does not show.

Noise is what the passes themselves say: each pixel's standard error of luminance from the spread of its passes, root mean square over the
pixels that see something, relative to their mean luminance.
"""

import math
import time
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32

from mitsuba_avatar.captures.cameras import Camera
from mitsuba_avatar.rendering.backend import loaded_mitsuba
from mitsuba_avatar.rendering.camera_rays import LARGEST_LAUNCH, NEAR, camera_row, jittered_rays
from mitsuba_avatar.rendering.lit_scene import LitScene

SAMPLES_PER_PASS = 16  # a 4x4 grid that the sampler stratifies
FEWEST_PASSES = 4  # before their spread is believed
MOST_SAMPLES = 1 << 16  # where a noise budget gives up
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # Rec. 709


@dataclass(frozen=True)
class SampleBudget:
    """When a picture is done: after `samples` a pixel or, where `noise` is above zero, at the first pass that has reached it.

    Raises:
        ValueError: no samples, or a negative noise.
    """

    samples: int = 64
    noise: float = 0.0

    def __post_init__(self) -> None:
        if self.samples < 1 or self.noise < 0:
            raise ValueError(f"SampleBudget(): expected samples >= 1 and noise >= 0; got {self.samples} and {self.noise}.")

    @property
    def most_passes(self) -> int:
        """Passes after which to stop at the latest."""
        return math.ceil((MOST_SAMPLES if self.noise else self.samples) / SAMPLES_PER_PASS)


@dataclass(frozen=True, eq=False)
class TracedPicture:
    """A picture and what it took.

    Attributes:
        radiance: [H, W, 3] linear, premultiplied by coverage.
        coverage: [H, W] share of each pixel that sees a surface, of the avatar or an object.
        samples: a pixel; noise: relative, see the module (infinite after a single pass).
    """

    radiance: Float32[np.ndarray, "H W 3"]
    coverage: Float32[np.ndarray, "H W"]
    samples: int
    noise: float


class PathTracer:
    """Traces one lit scene; the avatar in it may move between pictures.

    Args:
        lit: scene with the avatar.
        max_depth: segments of a path, counting the camera's: 2 is light that was reflected once.
    """

    def __init__(self, lit: LitScene, max_depth: int = 4):
        if max_depth < 2:
            raise ValueError(f"PathTracer(): expected max_depth of at least 2; got {max_depth}. 2 is direct light alone.")
        mi = loaded_mitsuba()
        self.lit = lit
        self._glowing = mi.ShapePtr(lit.avatar) if lit.light == "baked" else None
        self._integrator = mi.load_dict({"type": "path", "max_depth": max_depth})
        self._sampler = mi.load_dict({"type": "multijitter", "sample_count": SAMPLES_PER_PASS})
        self._sampler.set_samples_per_wavefront(SAMPLES_PER_PASS)

    def draw(self, camera: Camera, vertices: Float[np.ndarray, "V 3"], budget: SampleBudget, seed: int) -> TracedPicture:
        """Draw the scene as it stands.

        Args:
            camera: without distortion.
            vertices: [V, 3] of the avatar as placed, metres: where there are no objects, only their surroundings are traced.
            budget: when to stop.
            seed: of this picture; equal seeds and budgets give equal bits.

        Raises:
            ValueError: a camera with distortion.
        """
        if camera.is_distorted:
            raise ValueError(f"draw(): expected a pinhole camera; {camera.name!r} has distortion. Set it to zero for novel views.")
        pixels = np.ones((camera.height, camera.width), bool) if self.lit.has_objects else _surroundings(camera, vertices)
        chosen, row = np.flatnonzero(pixels), camera_row(camera)
        total, squares, passes, noise = np.zeros((len(chosen), 4)), np.zeros(len(chosen)), 0, math.inf
        while passes < budget.most_passes:
            mean = self._pass(row, camera.width, chosen, np.random.SeedSequence((seed, passes)))
            total += mean
            squares += (mean[:, :3] @ _LUMINANCE) ** 2
            passes += 1
            noise = _noise(total, squares, passes)
            if budget.noise and passes >= FEWEST_PASSES and noise <= budget.noise:
                break
        image = np.zeros((camera.height * camera.width, 4), np.float32)
        image[chosen] = total / max(passes, 1)
        image = image.reshape(camera.height, camera.width, 4)
        radiance, coverage = np.ascontiguousarray(image[..., :3]), np.ascontiguousarray(image[..., 3])
        return TracedPicture(radiance, coverage, passes * SAMPLES_PER_PASS, noise)

    def samples_within(self, seconds: float, camera: Camera, vertices: Float[np.ndarray, "V 3"]) -> int:
        """How many samples a pixel this machine traces in a time, for a picture like this one; whole passes, at least one."""
        self.draw(camera, vertices, SampleBudget(SAMPLES_PER_PASS), seed=0)  # compiles kernels
        started = time.perf_counter()
        self.draw(camera, vertices, SampleBudget(2 * SAMPLES_PER_PASS), seed=0)
        a_pass = (time.perf_counter() - started) / 2
        return SAMPLES_PER_PASS * min(max(1, int(seconds / a_pass)), MOST_SAMPLES // SAMPLES_PER_PASS)

    def _pass(self, row: list, width: int, chosen: np.ndarray, seeds: np.random.SeedSequence) -> Float[np.ndarray, "P 4"]:
        """Mean radiance and coverage of one pass."""
        at_once = LARGEST_LAUNCH // SAMPLES_PER_PASS
        chunks = [chosen[start : start + at_once] for start in range(0, len(chosen), at_once)]
        states = seeds.generate_state(max(1, len(chunks)))
        parts = [self._launch(row, width, chunk, int(state)) for chunk, state in zip(chunks, states, strict=False)]
        return np.concatenate([np.zeros((0, 4)), *parts])

    def _launch(self, row: list, width: int, chosen: np.ndarray, seed: int) -> Float[np.ndarray, "P 4"]:
        import drjit as dr

        mi = loaded_mitsuba()
        sampler, scene = self._sampler, self.lit.scene
        ray = jittered_rays(row, width, chosen, SAMPLES_PER_PASS, sampler, seed)
        # Asked here and not of the integrator, which has no way to show emitting surfaces and hide light from far away.
        hit = scene.ray_intersect(ray)
        is_seen = hit.is_valid()
        is_glowing = is_seen & (hit.shape == self._glowing) if self._glowing is not None else mi.Mask(False)
        radiance, _, _ = self._integrator.sample(scene, sampler, ray, active=is_seen & ~is_glowing)
        if self._glowing is not None:
            hit.wi = mi.Vector3f(0, 0, 1)  # as from straight above: a captured texture is seen from both sides, Mitsuba's emitters from one
            radiance = dr.select(is_glowing, hit.emitter(scene, is_glowing).eval(hit, is_glowing), radiance)
        seen = dr.select(is_seen, radiance, 0)
        channels = [seen.x, seen.y, seen.z, dr.select(is_seen, mi.Float(1), 0)]
        dr.eval(channels)  # or each of the sums would trace all paths for itself
        means = [dr.block_sum(channel, SAMPLES_PER_PASS) / SAMPLES_PER_PASS for channel in channels]
        return np.stack([np.array(mean, dtype=np.float64) for mean in means], axis=1)


def _noise(total: Float[np.ndarray, "P 4"], squares: Float[np.ndarray, "P"], passes: int) -> float:  # noqa: F821
    """Relative noise after some passes; infinite while there is no spread to judge by."""
    seen = total[:, 3] > 0
    if passes < 2 or not seen.any():
        return 0.0 if passes >= 2 else math.inf
    mean = total[seen, :3] @ _LUMINANCE / passes
    variance = np.clip(squares[seen] / passes - mean**2, 0, None) / (passes - 1)  # of the mean of all passes
    return float(np.sqrt(variance.mean()) / max(mean.mean(), 1e-12))  # a black picture has no noise


def _surroundings(camera: Camera, vertices: Float[np.ndarray, "V 3"]) -> Bool[np.ndarray, "H W"]:
    """[H, W] the box around the projected vertices, all pixels where one is too near to be projected."""
    pixels, depth = camera.project(vertices)
    box = np.zeros((camera.height, camera.width), dtype=bool)
    if depth.min() < NEAR:
        return ~box
    # A pixel more on each side: kernels project in float32.
    left, top = np.floor(pixels.min(axis=0)).astype(int) - 1
    right, bottom = np.floor(pixels.max(axis=0)).astype(int) + 2
    box[max(top, 0) : max(bottom, 0), max(left, 0) : max(right, 0)] = True
    return box
