"""How far an avatar is from the capture: image, silhouette and vertex errors, and their means per method, split and camera group.

Images are display-encoded (sRGB), [H, W, 3] in 0..1, because that is what eyes and published figures compare; masks are [H, W] in
0..1 and weigh the pixels, so that a half-covered pixel counts half. Sums run in float64.
"""

import csv
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

PICTURE_COLUMNS = ("method", "split", "cameras", "camera", "frame")  # of a CSV with a row a picture; metrics follow

# Mean square of the rounding error of an 8-bit image, in 0..255 values. Two equal images count as this far apart, not as 0, so that
# PSNR stays finite (58.9 dB) and means of it exist.
_ROUNDING_MSE = 1 / 12


def l1_in_mask(image: Float[np.ndarray, "H W 3"], reference: Float[np.ndarray, "H W 3"], mask: Float[np.ndarray, "H W"]) -> float:
    """Mean absolute difference inside the mask, in 0..255 values, over pixels and channels."""
    return mean_over(255 * np.abs(_difference("l1_in_mask", image, reference)).mean(axis=-1), mask, "l1_in_mask")


def mse_in_mask(image: Float[np.ndarray, "H W 3"], reference: Float[np.ndarray, "H W 3"], mask: Float[np.ndarray, "H W"]) -> float:
    """Mean squared difference inside the mask, in squared 0..255 values: the error that the paper's tables give."""
    return mean_over(np.square(255 * _difference("mse_in_mask", image, reference)).mean(axis=-1), mask, "mse_in_mask")


def psnr_from_mse(mse: float) -> float:
    """Peak signal-to-noise ratio in dB of a mean squared difference in 0..255 values; at most 58.9, an 8-bit image's rounding."""
    return 10 * math.log10(255**2 / max(mse, _ROUNDING_MSE))


def ssim_in_mask(image: Float[np.ndarray, "H W 3"], reference: Float[np.ndarray, "H W 3"], mask: Float[np.ndarray, "H W"]) -> float:
    """Structural similarity, computed on the whole image channel by channel, then averaged inside the mask. 1 where equal.

    Gaussian window of 11x11 pixels with sigma 1.5, K1 = 0.01, K2 = 0.03, range 1, weighted (population) variances; the image is
    mirrored at its border.

    Source: Wang et al., Image Quality Assessment: From Error Visibility to Structural Similarity, 2004, equations 13 to 16.
    """
    return mean_over(ssim_map(image, reference), mask, "ssim_in_mask")


def ssim_map(image: Float[np.ndarray, "H W 3"], reference: Float[np.ndarray, "H W 3"]) -> Float[np.ndarray, "H W"]:
    """Structural similarity around every pixel, mean of the channels; the parameters are those of `ssim_in_mask`."""
    _difference("ssim_map", image, reference)
    x, y = image.astype(np.float64), reference.astype(np.float64)
    mean_x, mean_y = _window_mean(x), _window_mean(y)
    variance_x = _window_mean(x * x) - mean_x**2
    variance_y = _window_mean(y * y) - mean_y**2
    covariance = _window_mean(x * y) - mean_x * mean_y
    c1, c2 = 0.01**2, 0.03**2
    similarity = (2 * mean_x * mean_y + c1) * (2 * covariance + c2) / ((mean_x**2 + mean_y**2 + c1) * (variance_x + variance_y + c2))
    return similarity.mean(axis=-1)


def difference_maps(
    image: Float[np.ndarray, "H W 3"], reference: Float[np.ndarray, "H W 3"]
) -> tuple[Float[np.ndarray, "H W"], Float[np.ndarray, "H W"]]:
    """Absolute and squared difference of every pixel in 0..255 values, each the mean over its channels."""
    difference = 255 * _difference("difference_maps", image, reference)
    return np.abs(difference).mean(axis=-1), np.square(difference).mean(axis=-1)


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


def mean_over(values: Float[np.ndarray, "H W"], mask: Float[np.ndarray, "H W"], caller: str = "mean_over") -> float:
    """Mean of a map weighted by a mask, in float64; `caller` is who complains of wrong sizes and empty masks."""
    if values.shape != mask.shape:
        raise ValueError(f"{caller}(): expected a mask of {values.shape}; got {mask.shape}. Resize image and mask together.")
    weight = mask.sum(dtype=np.float64)
    if weight <= 0:
        raise ValueError(
            f"{caller}(): expected a mask that covers something; got an empty one. Leave this picture out: the camera sees nobody."
        )
    return float((values * mask).sum() / weight)


def temporal_flicker(
    images: Float[np.ndarray, "2 H W 3"], references: Float[np.ndarray, "2 H W 3"], masks: Float[np.ndarray, "2 H W"]
) -> float:
    """What a render changes from one frame to the next that the capture does not, and the other way round, in 0..255 values.

    The mean absolute difference of the two changes, over the pixels of either mask. A constant error does not flicker: it costs nothing
    here as long as it stays where it is; so does a frozen picture of a frozen person.

    Args:
        images: a method's two pictures of neighbouring frames, seen by one camera.
        references: the capture's.
        masks: the capture's.

    Raises:
        ValueError: if the sizes differ, or if both masks are empty.
    """
    _difference("temporal_flicker", images, references)
    change = (images[1].astype(np.float64) - images[0]) - (references[1].astype(np.float64) - references[0])
    return mean_over(255 * np.abs(change).mean(axis=-1), masks.max(axis=0), "temporal_flicker")


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
        self._pictures: dict[tuple[str, str, str, str, int | None], dict[str, float]] = {}

    def add(
        self,
        method: str,
        split: Split,
        cameras: CameraGroup,
        values: Mapping[str, float],
        picture: tuple[str, int] | None = None,
    ) -> None:
        """Count one picture.

        Args:
            method: `avatar`, or a baseline: `template_mean_texture`, `nearest_frame`.
            split: of the frame.
            cameras: whether the camera was seen in training.
            values: metric name -> value; the same names for every picture of a key.
            picture: camera and frame number, for `save_pictures`; None leaves the picture out there.

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
        if picture is not None:
            self._pictures[(method, split, cameras, *picture)] = {name: float(value) for name, value in values.items()}

    def absorb(self, other: "MetricsAccumulator") -> None:
        """Take over metrics that were measured on their own, over other pictures: `images` keeps the count of what was here.

        Raises:
            ValueError: a metric that is here already.
        """
        for key, values in other._values.items():
            known = self._values.setdefault(key, {})
            repeated = sorted(known.keys() & values.keys())
            if repeated:
                raise ValueError(
                    f"MetricsAccumulator.absorb(): expected new metrics for {key}; got {repeated} again. Measure each of them once."
                )
            known.update({name: list(numbers) for name, numbers in values.items()})
        for key, values in other._pictures.items():
            self._pictures[key] = self._pictures.get(key, {}) | values

    def means(self) -> dict[str, Any]:
        """Nested dictionaries `[method][split][cameras][metric]`, in the order in which the keys came."""
        result: dict[str, Any] = {}
        for (method, split, cameras), values in self._values.items():
            means: dict[str, float] = {name: math.fsum(numbers) / len(numbers) for name, numbers in values.items()}
            means["images"] = len(next(iter(values.values()), ()))  # of the metrics that came first: absorbed ones have their own number
            result.setdefault(method, {}).setdefault(split, {})[cameras] = means
        return result

    def save(self, path: Path | str) -> None:
        """Write the means as `metrics.json`, whole or not at all."""
        with atomic_path(path) as temporary:
            temporary.write_text(json.dumps(self.means(), indent=2, allow_nan=False) + "\n", encoding="utf-8")

    def picture_rows(self) -> list[dict[str, Any]]:
        """What `save_pictures` writes and `load_pictures` reads, without rounding."""
        return [dict(zip(PICTURE_COLUMNS, key, strict=True)) | values for key, values in self._pictures.items()]

    def save_pictures(self, path: Path | str) -> None:
        """Write a CSV with a row for every picture that was added with its camera and frame; what a picture lacks is empty."""
        names = list(dict.fromkeys(name for values in self._pictures.values() for name in values))
        with atomic_path(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, [*PICTURE_COLUMNS, *names], lineterminator="\n")
            writer.writeheader()
            for key, values in self._pictures.items():
                cells = {name: f"{value:.6g}" for name, value in values.items()}
                writer.writerow(dict(zip(PICTURE_COLUMNS, key, strict=True)) | cells)


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


def load_pictures(path: Path | str) -> list[dict[str, Any]]:
    """Read what `MetricsAccumulator.save_pictures` wrote: a dictionary a picture, numbers as floats, `frame` as int, gaps left out.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the file is not of that kind.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"load_pictures(): expected {path}; there is none. Run `python -m mitsuba_avatar.evaluate {path.parent}`.")
    with path.open(newline="", encoding="utf-8") as file:
        reader = csv.DictReader(file)
        if tuple(reader.fieldnames or ())[: len(PICTURE_COLUMNS)] != PICTURE_COLUMNS:
            raise ValueError(
                f"load_pictures(): expected columns {PICTURE_COLUMNS} first in {path}; got {reader.fieldnames}. Evaluate again."
            )
        rows = []
        for row in reader:
            try:
                numbers = {name: float(value) for name, value in row.items() if name not in PICTURE_COLUMNS and value}
                rows.append({name: row[name] for name in PICTURE_COLUMNS} | {"frame": int(row["frame"])} | numbers)
            except (TypeError, ValueError) as error:
                raise ValueError(
                    f"load_pictures(): expected numbers in line {reader.line_num} of {path}; got {error}. Evaluate again."
                ) from error
    return rows


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


def _window_mean(channels: np.ndarray) -> np.ndarray:
    # scipy takes int(truncate * sigma + 0.5) = 5 pixels to each side: 11 in all.
    return gaussian_filter(channels, sigma=(1.5, 1.5, 0), truncate=3.5)
