"""The three protocols against scikit-image, FLIP against its equations, and each mean over the region that it names."""

import flip_evaluator
import numpy as np
import pytest
from skimage.metrics import mean_squared_error, peak_signal_noise_ratio, structural_similarity

from mitsuba_avatar.reporting.metrics import image_metrics, temporal_flicker
from mitsuba_avatar.reporting.protocols import PROTOCOLS, flip_map, metric_name, protocol_metrics, protocol_of, region


@pytest.fixture
def pair():
    """Two pictures of 31x43 and a soft mask of part of them."""
    random = np.random.default_rng(5)
    reference = random.random((31, 43, 3), dtype=np.float32)
    image = np.clip(reference + random.normal(0, 0.1, reference.shape).astype(np.float32), 0, 1)
    mask = np.zeros((31, 43), dtype=np.float32)
    mask[4:20, 7:29] = np.clip(random.random((16, 22), dtype=np.float32), 0.1, 1)
    mask[3, 12] = 0.25  # a corner that sticks out
    return image, reference, mask


def test_the_image_protocol_equals_scikit_image(pair):
    image, reference, mask = pair
    values = protocol_metrics(image, reference, mask)
    assert values["image_psnr"] == pytest.approx(peak_signal_noise_ratio(reference, image, data_range=1), rel=1e-6)
    assert values["image_mse"] == pytest.approx(255**2 * mean_squared_error(reference, image), rel=1e-6)
    assert values["image_l1"] == pytest.approx(255 * np.abs(image - reference).mean(dtype=np.float64), rel=1e-6)
    assert values["image_ssim"] == pytest.approx(reference_similarity(image, reference).mean(), abs=1e-6)


def test_the_box_protocol_equals_scikit_image_on_the_rectangle(pair):
    image, reference, mask = pair
    box = (slice(3, 20), slice(7, 29))
    values = protocol_metrics(image, reference, mask)
    assert values["box_psnr"] == pytest.approx(peak_signal_noise_ratio(reference[box], image[box], data_range=1), rel=1e-6)
    assert values["box_ssim"] == pytest.approx(reference_similarity(image, reference)[box].mean(), abs=1e-6)
    assert values["box_flip"] == pytest.approx(flip_of(image, reference)[box].mean(), rel=1e-5)


def test_the_mask_protocol_weighs_pixels_and_equals_the_plain_metrics(pair):
    image, reference, mask = pair
    values = protocol_metrics(image, reference, mask)
    assert {name: values[name] for name in ("psnr", "ssim", "l1", "mse")} == pytest.approx(image_metrics(image, reference, mask))
    assert values["ssim"] == pytest.approx((reference_similarity(image, reference) * mask).sum() / mask.sum(), abs=1e-6)
    assert values["flip"] == pytest.approx((flip_of(image, reference) * mask).sum() / mask.sum(), rel=1e-5)


def test_a_small_person_is_flattered_by_the_image_protocol_alone():
    reference = np.full((40, 60, 3), 0.5, np.float32)
    image, mask = reference.copy(), np.zeros((40, 60), np.float32)
    mask[10:14, 20:26] = 1
    image[10:14, 20:26] = 0.75
    values = protocol_metrics(image, reference, mask, has_flip=False)
    assert values["mse"] == pytest.approx(values["box_mse"]) and values["image_mse"] == pytest.approx(values["mse"] / 100)
    assert "flip" not in values and "image_flip" not in values


def test_flip_is_zero_for_equal_pictures_symmetric_in_place_and_at_most_one(pair):
    image, reference, _ = pair
    assert flip_map(reference, reference).max() == 0
    black, white = np.zeros((9, 14, 3), np.float32), np.ones((9, 14, 3), np.float32)
    assert 0.9 < flip_map(black, white).mean() <= 1
    changed = reference.copy()
    changed[5, 30] = 1 - changed[5, 30]
    errors = flip_map(changed, reference)
    assert errors.shape == (31, 43) and np.unravel_index(errors.argmax(), errors.shape) == (5, 30)
    assert errors[20:, :10].max() < 1e-6 < errors[5, 29], "what is far away is not touched, what is near is"


@pytest.mark.parametrize(
    ("colour", "other"),
    [
        ((0.2, 0.5, 0.7), (0.25, 0.45, 0.7)),
        ((0.9, 0.1, 0.3), (0.1, 0.6, 0.3)),
        ((0, 1, 0), (0, 0, 1)),
        ((0.5, 0.5, 0.5), (0.52, 0.52, 0.52)),
    ],
)
def test_flip_of_plain_pictures_is_that_of_its_equations(colour, other):
    """No filter changes a plain picture and it has no edges: what is left is the colour difference, on both branches of its remapping."""
    image, reference = (np.broadcast_to(np.float32(values), (23, 36, 3)).copy() for values in (colour, other))
    assert flip_map(image, reference) == pytest.approx(plain_flip(colour, other), abs=2e-3)


def test_flip_forgives_what_is_too_small_to_see():
    """Stripes a pixel wide: the farther away, the greyer."""
    stripes = np.broadcast_to((np.arange(80) % 2)[None, :, None], (50, 80, 3)).astype(np.float32)
    grey = np.full_like(stripes, 0.735)  # half of the stripes' radiance, display-encoded
    near, far = (float(flip_map(stripes, grey, pixels_per_degree)[15:35, 20:60].mean()) for pixels_per_degree in (15.0, 120.0))
    assert far < 0.5 * near


def test_names_tell_the_protocol(pair):
    values = protocol_metrics(*pair)
    assert len(values) == 15 and list(values)[:5] == ["psnr", "ssim", "l1", "mse", "flip"]
    for protocol in PROTOCOLS:
        assert sum(protocol_of(name) == protocol for name in values) == 5
        assert protocol_of(metric_name("ssim", protocol)) == protocol
    assert protocol_of("vertex_mm") is None and protocol_of("images") is None
    assert list(protocol_metrics(*pair, protocols=("box",), has_flip=False)) == ["box_psnr", "box_ssim", "box_l1", "box_mse"]


def test_wrong_input_is_refused(pair, without_shape_checks):
    image, reference, mask = pair
    with pytest.raises(ValueError, match="expected a protocol of"):
        region(mask, "crop")
    with pytest.raises(ValueError, match="expected a mask that covers something"):
        protocol_metrics(image, reference, np.zeros_like(mask), ("box",), has_flip=False)
    with pytest.raises(ValueError, match="expected images of one size"):
        flip_map(image[:20], reference)


def test_flicker_is_what_changes_otherwise_than_the_capture():
    references = np.full((2, 4, 6, 3), 0.4, np.float32)
    references[1] += 0.1
    masks = np.zeros((2, 4, 6), np.float32)
    masks[0, 1, 1:3] = masks[1, 2, 1:3] = 1  # four pixels in all
    wrong_but_steady = references + np.float32(0.2)
    assert temporal_flicker(wrong_but_steady, references, masks) == pytest.approx(0, abs=1e-4)
    flickering = references.copy()
    flickering[1, 2, 2] += 0.2
    flickering[1, 0, 0] += 0.5  # outside both masks
    assert temporal_flicker(flickering, references, masks) == pytest.approx(255 * 0.2 / 4, rel=1e-5)
    frozen = np.stack([references[0], references[0]])
    assert temporal_flicker(frozen, references, masks) == pytest.approx(25.5, rel=1e-5)


def reference_similarity(image: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """scikit-image's map of SSIM with the parameters of Wang et al., mean over the channels."""
    _, similarity = structural_similarity(
        reference.astype(np.float64),
        image.astype(np.float64),
        data_range=1,
        channel_axis=-1,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        full=True,
    )
    return similarity.mean(axis=-1)


def flip_of(image: np.ndarray, reference: np.ndarray) -> np.ndarray:
    errors, _, _ = flip_evaluator.evaluate(reference, image, "LDR", applyMagma=False)
    return errors[..., 0]


def plain_flip(colour: tuple[float, float, float], other: tuple[float, float, float]) -> float:
    """FLIP of two plain pictures in float64: Andersson et al. 2020, section 4.1 (Hunt-adjusted CIELAB, HyAB distance, remapping)."""

    def adjusted(values: tuple[float, float, float]) -> np.ndarray:
        encoded = np.array(values, np.float64)
        linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
        matrix = np.array([[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]])
        ratio = matrix @ linear / matrix.sum(axis=1)
        root = np.where(ratio > (6 / 29) ** 3, np.cbrt(ratio), ratio / (3 * (6 / 29) ** 2) + 4 / 29)
        lightness = 116 * root[1] - 16
        return np.array([lightness, 0.01 * lightness * 500 * (root[0] - root[1]), 0.01 * lightness * 200 * (root[1] - root[2])])

    def distance(first: tuple[float, float, float], second: tuple[float, float, float]) -> float:
        change = adjusted(first) - adjusted(second)
        return (abs(change[0]) + np.hypot(change[1], change[2])) ** 0.7

    largest = distance((0, 1, 0), (0, 0, 1))
    share = distance(colour, other) / largest
    return 0.95 * share / 0.4 if share < 0.4 else 0.95 + 0.05 * (share - 0.4) / 0.6
