"""Errors of surface tracking, added to the exact registered mesh: what a reconstruction pipeline would have got wrong.

Tracking errors are no white noise: neighbouring vertices err together, from frame to frame the error wanders, and it is larger where
tracking is hard, at fingers and where cloth folds. The noise is a sum of smooth random fields over the surface, each with its own
smoothly wandering strength per axis. Metres, seconds. The caller keeps the truth.
"""

import numpy as np
from jaxtyping import Float32
from scipy.ndimage import gaussian_filter1d

from mitsuba_avatar.filming.anatomy import HAND, Anatomy

NUM_FIELDS = 96
SMOOTHING_ROUNDS = 24  # over neighbours; correlates errors over a few centimetres
WANDERING_TIME = 0.25  # seconds, standard deviation of the filter in time
AT_HANDS = 2.0  # error there relative to the rest of the body, before scaling to the wanted size
AT_FOLDS = 1.5  # added where the surface is folded most
FOLD_HEIGHT = 0.004  # metres by which a vertex lies farther off its neighbours' mean than at rest where it counts as folded


def tracking_noise(
    anatomy: Anatomy, vertices: Float32[np.ndarray, "N V 3"], segments: list[slice], fps: float, size: float, seed: int
) -> Float32[np.ndarray, "N V 3"]:
    """Errors to add to a registered mesh.

    Args:
        anatomy: of the mesh's rig.
        vertices: exact surface, which says where it is folded.
        segments: runs of consecutive frames; errors of different ones are independent.
        fps: frames per second.
        size: root mean square length of the error over all vertices and frames, metres.
        seed: the same gives the same errors.
    """
    rng = np.random.default_rng([seed, 0x7261636B])  # a stream of its own
    fields = anatomy.smooth(rng.normal(size=(vertices.shape[1], NUM_FIELDS)), SMOOTHING_ROUNDS)
    fields = (fields / np.sqrt((fields**2).mean(axis=1, keepdims=True))).astype(np.float32)  # [V, K], as strong at every vertex
    strengths = np.zeros((len(vertices), NUM_FIELDS, 3))
    for segment in segments:
        strengths[segment] = _wandering(segment.stop - segment.start, fps, rng)
    at_hands = 1 + (AT_HANDS - 1) * anatomy.weight(HAND)
    noise = np.empty_like(vertices)
    for frame, exact in enumerate(vertices):
        error = fields @ strengths[frame].astype(np.float32) / np.float32(np.sqrt(NUM_FIELDS))  # [V, 3], variance 1 per axis
        noise[frame] = (at_hands + AT_FOLDS * _foldedness(anatomy, exact))[:, None] * error
    scale = np.sqrt((noise.astype(np.float64) ** 2).sum(axis=-1).mean())
    return noise * np.float32(size / scale)


def _wandering(count: int, fps: float, rng: np.random.Generator) -> np.ndarray:
    """[count, K, 3] smooth random curves of unit variance."""
    width = WANDERING_TIME * fps
    margin = int(np.ceil(4 * width))
    curves = gaussian_filter1d(rng.normal(size=(count + 2 * margin, NUM_FIELDS, 3)), width, axis=0)[margin : margin + count]
    kernel = gaussian_filter1d(np.eye(1, 2 * margin + 1, margin)[0], width)
    return curves / np.sqrt((kernel**2).sum())


def _foldedness(anatomy: Anatomy, vertices: Float32[np.ndarray, "V 3"]) -> Float32[np.ndarray, "V"]:
    """0 where the surface is even, 1 where it is folded, smoothed over neighbours."""
    height, at_rest = (np.linalg.norm(anatomy.smoothing @ points - points, axis=1) for points in (vertices, anatomy.rig.rest_vertices))
    height = np.abs(height - at_rest)
    return anatomy.smooth(np.minimum(height / FOLD_HEIGHT, 1)[:, None], 4)[:, 0].astype(np.float32)
