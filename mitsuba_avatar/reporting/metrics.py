"""How far an avatar is from the capture: image, silhouette and vertex errors, and their means per method, split and camera group.

Images are display-encoded (sRGB), [H, W, 3] in 0..1, because that is what eyes and published figures compare; masks are [H, W] in
0..1 and weigh the pixels, so that a half-covered pixel counts half. Sums run in float64.
"""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter

from mitsuba_avatar.files import atomic_path

Split = Literal["train", "test"]
CameraGroup = Literal["seen", "held_out"]

# Mean square of the rounding error of an 8-bit image, in 0..255 values. Two equal images count as this far apart, not as 0, so that
# PSNR stays finite (58.9 dB) and means of it exist.
_ROUNDING_MSE = 1 / 12


def l1_in_mask(image: Float[np.ndarray, "H W 3"], reference: Float[np.ndarray, "H W 3"], mask: Float[np.ndarray, "H W"]) -> float:
    """Mean absolute difference inside the mask, in 0..255 values, over pixels and channels."""
    return _mean_in_mask(255 * np.abs(_difference("l1_in_mask", image, reference)).mean(axis=-1), mask, "l1_in_mask")


def mse_in_mask(image: Float[np.ndarray, "H W 3"], reference: Float[np.ndarray, "H W 3"], mask: Float[np.ndarray, "H W"]) -> float:
    """Mean squared difference inside the mask, in squared 0..255 values: the error that the paper's tables give."""
    return _mean_in_mask(np.square(255 * _difference("mse_in_mask", image, reference)).mean(axis=-1), mask, "mse_in_mask")


def psnr_from_mse(mse: float) -> float:
    """Peak signal-to-noise ratio in dB of a mean squared difference in 0..255 values; at most 58.9, an 8-bit image's rounding."""
    return 10 * math.log10(255**2 / max(mse, _ROUNDING_MSE))


def ssim_in_mask(image: Float[np.ndarray, "H W 3"], reference: Float[np.ndarray, "H W 3"], mask: Float[np.ndarray, "H W"]) -> float:
    """Structural similarity, computed on the whole image channel by channel, then averaged inside the mask. 1 where equal.

    Gaussian window of 11x11 pixels with sigma 1.5, K1 = 0.01, K2 = 0.03, range 1, weighted (population) variances; the image is
    mirrored at its border.

    Source: Wang et al., Image Quality Assessment: From Error Visibility to Structural Similarity, 2004, equations 13 to 16.
    """
    _difference("ssim_in_mask", image, reference)
    x, y = image.astype(np.float64), reference.astype(np.float64)
    mean_x, mean_y = _window_mean(x), _window_mean(y)
    variance_x = _window_mean(x * x) - mean_x**2
    variance_y = _window_mean(y * y) - mean_y**2
    covariance = _window_mean(x * y) - mean_x * mean_y
    c1, c2 = 0.01**2, 0.03**2
    similarity = (2 * mean_x * mean_y + c1) * (2 * covariance + c2) / ((mean_x**2 + mean_y**2 + c1) * (variance_x + variance_y + c2))
    return _mean_in_mask(similarity.mean(axis=-1), mask, "ssim_in_mask")


def silhouette_iou(mask: Float[np.ndarray, "H W"], reference: Float[np.ndarray, "H W"]) -> float:
    """Intersection over union of two masks cut at one half; 1 where both are empty."""
    if mask.shape != reference.shape:
        raise ValueError(f"silhouette_iou(): expected masks of one size; got {mask.shape} and {reference.shape}. Resize one of them.")
    inside, reference_inside = mask > 0.5, reference > 0.5
    union = np.count_nonzero(inside | reference_inside)
    return np.count_nonzero(inside & reference_inside) / union if union else 1.0


def vertex_error_mm(vertices: Float[np.ndarray, "V 3"], reference: Float[np.ndarray, "V 3"]) -> float:
    """Mean distance between corresponding vertices: metres in, millimetres out."""
    if vertices.shape != reference.shape:
        raise ValueError(
            f"vertex_error_mm(): expected meshes of one topology; got {vertices.shape} and {reference.shape}. "
            "Use the capture that the rig is of."
        )
    return float(1000 * np.linalg.norm(vertices.astype(np.float64) - reference, axis=-1).mean())


def image_metrics(
    image: Float[np.ndarray, "H W 3"], reference: Float[np.ndarray, "H W 3"], mask: Float[np.ndarray, "H W"]
) -> dict[str, float]:
    """All image errors of one picture: `psnr` in dB, `ssim`, `l1` and `mse` in 0..255 values, each inside the capture's mask.

    Raises:
        ValueError: if the sizes differ, or if the mask is empty.
    """
    mse = mse_in_mask(image, reference, mask)
    return {"psnr": psnr_from_mse(mse), "ssim": ssim_in_mask(image, reference, mask), "l1": l1_in_mask(image, reference, mask), "mse": mse}


class MetricsAccumulator:
    """Means over pictures, keyed `[method][split][cameras][metric]`; `images` is how many pictures went into them."""

    def __init__(self) -> None:
        self._values: dict[tuple[str, str, str], dict[str, list[float]]] = {}

    def add(self, method: str, split: Split, cameras: CameraGroup, values: Mapping[str, float]) -> None:
        """Count one picture.

        Args:
            method: `avatar`, or a baseline: `template_mean_texture`, `nearest_frame`.
            split: of the frame.
            cameras: whether the camera was seen in training.
            values: metric name -> value; the same names for every picture of a key.

        Raises:
            ValueError: a value that is not finite, or names other than the first picture's.
        """
        key = (method, split, cameras)
        for name, value in values.items():
            if not math.isfinite(value):
                raise ValueError(
                    f"MetricsAccumulator.add(): expected finite {name} for {key}; got {value}. Find the picture that it comes from."
                )
        known = self._values.setdefault(key, {name: [] for name in values})
        if known.keys() != values.keys():
            raise ValueError(
                f"MetricsAccumulator.add(): expected metrics {sorted(known)} for {key}; got {sorted(values)}. Measure all or none."
            )
        for name, value in values.items():
            known[name].append(float(value))

    def means(self) -> dict[str, Any]:
        """Nested dictionaries `[method][split][cameras][metric]`, in the order in which the keys came."""
        result: dict[str, Any] = {}
        for (method, split, cameras), values in self._values.items():
            means: dict[str, float] = {name: math.fsum(numbers) / len(numbers) for name, numbers in values.items()}
            means["images"] = max(map(len, values.values()), default=0)
            result.setdefault(method, {}).setdefault(split, {})[cameras] = means
        return result

    def save(self, path: Path | str) -> None:
        """Write the means as `metrics.json`, whole or not at all."""
        with atomic_path(path) as temporary:
            temporary.write_text(json.dumps(self.means(), indent=2, allow_nan=False) + "\n", encoding="utf-8")


def load_metrics(path: Path | str) -> dict[str, Any]:
    """Read `metrics.json`: `[method][split][cameras][metric]`.

    Raises:
        FileNotFoundError: if the run was not evaluated.
        ValueError: if the file is not JSON.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(
            f"load_metrics(): expected {path}; there is none. Run `python -m mitsuba_avatar.evaluate {path.parent}` first."
        )
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except json.JSONDecodeError as error:
        raise ValueError(f"load_metrics(): expected JSON in {path}; got {error}. Evaluate the run again.") from error


def read_records(path: Path | str) -> list[dict[str, Any]]:
    """Read a run's JSONL log, one record a line. A last line cut short by a crash is left out.

    Raises:
        ValueError: a line before the last is not JSON.
    """
    lines = Path(path).read_text(encoding="utf-8").splitlines()
    records = []
    for number, line in enumerate(lines, start=1):
        try:
            records.append(json.loads(line))
        except json.JSONDecodeError as error:
            if number == len(lines):
                break
            raise ValueError(f"read_records(): expected JSON in line {number} of {path}; got {line[:60]!r}. Remove the line.") from error
    return records


def _difference(caller: str, image: np.ndarray, reference: np.ndarray) -> np.ndarray:
    if image.shape != reference.shape:
        raise ValueError(f"{caller}(): expected images of one size; got {image.shape} and {reference.shape}. Render at the capture's size.")
    return image.astype(np.float64) - reference


def _mean_in_mask(values: np.ndarray, mask: np.ndarray, caller: str) -> float:
    if values.shape != mask.shape:
        raise ValueError(f"{caller}(): expected a mask of {values.shape}; got {mask.shape}. Resize image and mask together.")
    weight = mask.sum(dtype=np.float64)
    if weight <= 0:
        raise ValueError(
            f"{caller}(): expected a mask that covers something; got an empty one. Leave this picture out: the camera sees nobody."
        )
    return float((values * mask).sum() / weight)


def _window_mean(channels: np.ndarray) -> np.ndarray:
    # scipy takes int(truncate * sigma + 0.5) = 5 pixels to each side: 11 in all.
    return gaussian_filter(channels, sigma=(1.5, 1.5, 0), truncate=3.5)
