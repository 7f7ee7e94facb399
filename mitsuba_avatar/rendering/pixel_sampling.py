"""Where inside its pixel each sample lies, and the point set that this, and occlusion, is made from."""

from mitsuba_avatar.rendering.backend import loaded_mitsuba

TEA_ROUNDS = 6  # fewer rounds leave correlations that bias gradients by tens of per cent (measured with 3)


def random_shift(index, seed):
    """A random shift (Point2f) for each index, of a pixel or texel, and seed, in [0, 1)^2."""
    mi = loaded_mitsuba()
    first, second = mi.sample_tea_32(index, seed, TEA_ROUNDS)
    return mi.Point2f(mi.Float(first) * 2.0**-32, mi.Float(second) * 2.0**-32)


def jitter(shift, sample, samples_per_pixel: int):
    """Position of a sample inside its pixel, in [0, 1)^2: a sequence over the samples, moved by the pixel's shift."""
    return shift if samples_per_pixel == 1 else golden_lattice(sample, samples_per_pixel, shift)


def golden_lattice(index, count: int, shift):
    """Point `index` of `count` evenly spread ones, moved by `shift` on the torus, in [0, 1)^2: i / count against i times the golden ratio.

    As a set of fixed size it is spread more evenly than an open-ended sequence (occlusion at 64 rays: error 13 % below the R2 sequence's).
    """
    import drjit as dr

    mi = loaded_mitsuba()
    step = mi.Float(index)
    point = shift + mi.Point2f(step * (1.0 / count), step * 0.6180339887)
    return point - dr.floor(point)
