"""Metrics against hand values and a slow float64 reference; the accumulator's layout; what it refuses."""

import json
import math

import numpy as np
import pytest

from mitsuba_avatar.reporting.metrics import (
    MetricsAccumulator,
    image_metrics,
    l1_in_mask,
    load_metrics,
    load_pictures,
    mse_in_mask,
    psnr_from_mse,
    read_records,
    silhouette_iou,
    ssim_in_mask,
    vertex_error_mm,
)


@pytest.fixture
def pair():
    """Two pictures of 17x23 and a soft mask of part of them."""
    random = np.random.default_rng(5)
    reference = random.random((17, 23, 3), dtype=np.float32)
    image = np.clip(reference + random.normal(0, 0.1, reference.shape).astype(np.float32), 0, 1)
    mask = np.zeros((17, 23), dtype=np.float32)
    mask[2:14, 5:20] = random.random((12, 15), dtype=np.float32)
    return image, reference, mask


def reference_ssim(image: np.ndarray, reference: np.ndarray, mask: np.ndarray) -> float:
    """Wang et al. 2004, equations 13 to 16, pixel by pixel in float64."""
    offsets = np.arange(-5, 6)
    window = np.exp(-(offsets[:, None] ** 2 + offsets**2) / (2 * 1.5**2))
    window /= window.sum()
    padded = [np.pad(picture.astype(np.float64), ((5, 5), (5, 5), (0, 0)), mode="symmetric") for picture in (image, reference)]
    total = 0.0
    for row, column in np.ndindex(mask.shape):
        for channel in range(3):
            x, y = (picture[row : row + 11, column : column + 11, channel] for picture in padded)
            mean_x, mean_y = (window * x).sum(), (window * y).sum()
            variance_x, variance_y = (window * (x - mean_x) ** 2).sum(), (window * (y - mean_y) ** 2).sum()
            covariance = (window * (x - mean_x) * (y - mean_y)).sum()
            luminance = (2 * mean_x * mean_y + 1e-4) / (mean_x**2 + mean_y**2 + 1e-4)
            total += mask[row, column] * luminance * (2 * covariance + 9e-4) / (variance_x + variance_y + 9e-4) / 3
    return total / mask.sum(dtype=np.float64)


def test_errors_have_hand_computed_values():
    reference = np.zeros((2, 3, 3), dtype=np.float32)
    image = reference.copy()
    image[0, 0] = (0.2, 0.0, -0.4)  # L1 0.2, square 0.2 / 3
    image[1, 2] = 9.0  # outside the mask
    mask = np.array([[1.0, 0.5, 0.0], [0.5, 0.0, 0.0]], dtype=np.float32)
    assert l1_in_mask(image, reference, mask) == pytest.approx(255 * 0.2 / 2)
    assert mse_in_mask(image, reference, mask) == pytest.approx(255**2 * 0.2 / 3 / 2)


def test_psnr_has_hand_computed_values_and_stays_finite():
    assert psnr_from_mse(255.0**2) == 0
    assert psnr_from_mse(65.025) == pytest.approx(30)
    assert psnr_from_mse(0.0) == pytest.approx(58.92, abs=0.01)


def test_ssim_equals_the_slow_reference(pair):
    assert ssim_in_mask(*pair) == pytest.approx(reference_ssim(*pair), abs=1e-10)


def test_equal_pictures_are_best(pair):
    _, reference, mask = pair
    values = image_metrics(reference, reference, mask)
    assert values["l1"] == values["mse"] == 0
    assert values["ssim"] == pytest.approx(1)


def test_errors_do_not_depend_on_which_picture_is_the_reference(pair):
    image, reference, mask = pair
    assert image_metrics(image, reference, mask) == pytest.approx(image_metrics(reference, image, mask))


def test_iou_and_vertex_error_have_hand_computed_values():
    mask = np.array([[1, 1, 0.4], [0, 0.6, 0]], dtype=np.float32)
    reference = np.array([[1, 0, 1], [0, 1, 0]], dtype=np.float32)
    assert silhouette_iou(mask, reference) == 0.5
    assert silhouette_iou(np.zeros_like(mask), np.zeros_like(mask)) == 1.0
    vertices = np.zeros((2, 3), dtype=np.float32)
    assert vertex_error_mm(vertices, np.array([[0.003, 0.004, 0], [0, 0, 0.001]], dtype=np.float32)) == pytest.approx(3)


def test_wrong_sizes_and_empty_masks_are_refused(pair, without_shape_checks):
    image, reference, mask = pair
    with pytest.raises(ValueError, match=r"expected images of one size; got \(16, 23, 3\) and \(17, 23, 3\)"):
        mse_in_mask(image[:16], reference[:17], mask[:16])
    with pytest.raises(ValueError, match="expected a mask that covers something"):
        image_metrics(image, reference, np.zeros_like(mask))
    with pytest.raises(ValueError, match="expected masks of one size"):
        silhouette_iou(mask, mask[:, :5])
    with pytest.raises(ValueError, match="expected meshes of one topology"):
        vertex_error_mm(np.zeros((4, 3), dtype=np.float32), np.zeros((5, 3), dtype=np.float32))


def test_accumulator_means_are_keyed_and_saved(tmp_path):
    metrics = MetricsAccumulator()
    metrics.add("avatar", "test", "held_out", {"psnr": 20.0, "l1": 4.0})
    metrics.add("avatar", "test", "held_out", {"psnr": 30.0, "l1": 1.0})
    metrics.add("nearest_frame", "train", "seen", {"psnr": 10.0})
    metrics.save(tmp_path / "metrics.json")
    assert load_metrics(tmp_path / "metrics.json") == metrics.means()
    assert metrics.means() == {
        "avatar": {"test": {"held_out": {"psnr": 25.0, "l1": 2.5, "images": 2}}},
        "nearest_frame": {"train": {"seen": {"psnr": 10.0, "images": 1}}},
    }


def test_accumulator_refuses_what_would_spoil_a_mean():
    metrics = MetricsAccumulator()
    with pytest.raises(ValueError, match=r"expected finite psnr for \('avatar', 'test', 'seen'\); got nan"):
        metrics.add("avatar", "test", "seen", {"psnr": math.nan})
    metrics.add("avatar", "test", "seen", {"psnr": 1.0})
    with pytest.raises(ValueError, match=r"expected metrics \['psnr'\] .* got \['l1', 'psnr'\]"):
        metrics.add("avatar", "test", "seen", {"psnr": 1.0, "l1": 2.0})
    assert metrics.means()["avatar"]["test"]["seen"] == {"psnr": 1.0, "images": 1}


def test_missing_and_broken_metrics_name_the_file(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"Run `python -m mitsuba_avatar\.evaluate"):
        load_metrics(tmp_path / "metrics.json")
    (tmp_path / "metrics.json").write_text("{")
    with pytest.raises(ValueError, match=r"expected JSON in .*metrics\.json"):
        load_metrics(tmp_path / "metrics.json")


def test_a_log_cut_short_is_read_up_to_its_last_whole_line(tmp_path):
    path = tmp_path / "log.jsonl"
    path.write_text(json.dumps({"iteration": 1}) + "\n" + json.dumps({"iteration": 2}) + '\n{"iterat')
    assert read_records(path) == [{"iteration": 1}, {"iteration": 2}]
    path.write_text('{"iterat\n{"iteration": 2}\n')
    with pytest.raises(ValueError, match="expected JSON in line 1"):
        read_records(path)


def test_every_picture_is_kept_with_its_camera_and_frame(tmp_path):
    metrics = MetricsAccumulator()
    metrics.add("avatar", "test", "seen", {"psnr": 20.5, "l1": 4.0}, ("north", 7))
    metrics.add("avatar", "test", "seen", {"psnr": 22.5, "l1": 3.0})
    flicker = MetricsAccumulator()
    flicker.add("avatar", "test", "seen", {"flicker": 1.25}, ("north", 7))
    flicker.add("avatar", "test", "seen", {"flicker": 1.75}, ("south, low", 8))
    metrics.absorb(flicker)
    metrics.save_pictures(tmp_path / "metrics.csv")
    assert load_pictures(tmp_path / "metrics.csv") == [
        {"method": "avatar", "split": "test", "cameras": "seen", "camera": "north", "frame": 7, "psnr": 20.5, "l1": 4.0, "flicker": 1.25},
        {"method": "avatar", "split": "test", "cameras": "seen", "camera": "south, low", "frame": 8, "flicker": 1.75},
    ]
    assert metrics.means()["avatar"]["test"]["seen"] == {"psnr": 21.5, "l1": 3.5, "flicker": 1.5, "images": 2}
    with pytest.raises(ValueError, match=r"got \['flicker'\] again"):
        metrics.absorb(flicker)


def test_a_damaged_list_of_pictures_names_the_line(tmp_path):
    path = tmp_path / "metrics.csv"
    with pytest.raises(FileNotFoundError, match=r"Run `python -m mitsuba_avatar\.evaluate"):
        load_pictures(path)
    path.write_text("a,b\n1,2\n")
    with pytest.raises(ValueError, match="expected columns"):
        load_pictures(path)
    path.write_text("method,split,cameras,camera,frame,psnr\navatar,test,seen,north,7,oops\n")
    with pytest.raises(ValueError, match="expected numbers in line 2"):
        load_pictures(path)
