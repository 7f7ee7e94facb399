"""Three ways of averaging an error over a picture, under names, because papers use all of them and their figures cannot be compared.

| protocol | averaged over | who uses it |
|---|---|---|
| `mask` | the pixels that the capture's mask covers, half-covered ones by half | the paper's tables; ours |
| `image` | every pixel of the picture, background included | neural radiance fields; flatters small people |
| `box` | the smallest upright rectangle that holds the mask | human NeRFs |

Every error is one map over the whole picture, and a protocol is the region that its mean is taken over: nothing is cropped before it is
compared, so that SSIM and FLIP see the same neighbourhoods in all three. PSNR is that of the region's mean squared difference.

Metrics of `mask` bear their plain name (`psnr`), those of the others begin with the protocol's (`box_psnr`). Images are display-encoded
(sRGB), [H, W, 3] in 0..1; masks are [H, W] in 0..1.
"""

from collections.abc import Sequence
from typing import Literal

import flip_evaluator
import numpy as np
from jaxtyping import Float

from mitsuba_avatar.reporting.lpips import Lpips
from mitsuba_avatar.reporting.metrics import difference_maps, mean_over, psnr_from_mse, ssim_map

Protocol = Literal["mask", "image", "box"]
PROTOCOLS: tuple[Protocol, ...] = ("mask", "image", "box")
PIXELS_PER_DEGREE = 67.0206  # FLIP's own default: 0.7 m from a 0.7 m wide display of 3840 pixels


def region(mask: Float[np.ndarray, "H W"], protocol: Protocol) -> Float[np.ndarray, "H W"]:
    """Weight of every pixel in a protocol's means.

    Args:
        mask: the capture's coverage of the person.
        protocol: of PROTOCOLS.

    Raises:
        ValueError: an unknown protocol, or a box around an empty mask.
    """
    if protocol == "mask":
        return mask
    if protocol == "image":
        return np.ones_like(mask)
    if protocol != "box":
        raise ValueError(f"region(): expected a protocol of {PROTOCOLS}; got {protocol!r}. Choose one of them.")
    rows, columns = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
    if not len(rows):
        raise ValueError(
            "region(): expected a mask that covers something; got an empty one. Leave this picture out: the camera sees nobody."
        )
    inside = np.zeros_like(mask)
    inside[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1] = 1
    return inside


def flip_map(
    image: Float[np.ndarray, "H W 3"], reference: Float[np.ndarray, "H W 3"], pixels_per_degree: float = PIXELS_PER_DEGREE
) -> Float[np.ndarray, "H W"]:
    """How different the pictures look when one is flipped to the other, pixel by pixel: 0 equal, 1 as different as can be.

    NVIDIA's own implementation, for pictures of a standard display.

    Source: Andersson et al., FLIP: A Difference Evaluator for Alternating Images, 2020.
    """
    if image.shape != reference.shape:
        raise ValueError(f"flip_map(): expected images of one size; got {image.shape} and {reference.shape}. Render at the capture's size.")
    pictures = (np.ascontiguousarray(np.clip(picture, 0, 1), np.float32) for picture in (reference, image))
    errors, _, _ = flip_evaluator.evaluate(
        *pictures, "LDR", applyMagma=False, computeMeanError=False, parameters={"ppd": pixels_per_degree}
    )
    return errors[..., 0]


def protocol_metrics(
    image: Float[np.ndarray, "H W 3"],
    reference: Float[np.ndarray, "H W 3"],
    mask: Float[np.ndarray, "H W"],
    protocols: Sequence[Protocol] = PROTOCOLS,
    has_flip: bool = True,
    lpips: Lpips | None = None,
) -> dict[str, float]:
    """PSNR (dB), SSIM, L1 and MSE (0..255 values), FLIP if asked and LPIPS if given, of one picture by each protocol.

    LPIPS of the protocol `image` is the published distance; of the others it is the mean of its map.

    Returns:
        metric name -> value; see `metric_name`.

    Raises:
        ValueError: if the sizes differ, or if the mask is empty.
    """
    absolute, squared = difference_maps(image, reference)
    maps = {"ssim": ssim_map(image, reference), "l1": absolute, "mse": squared}
    if has_flip:
        maps["flip"] = flip_map(image, reference)
    if lpips is not None:
        distance, maps["lpips"] = lpips.compare(image, reference)
    values: dict[str, float] = {}
    for protocol in protocols:
        weights = region(mask, protocol)
        means = {name: mean_over(errors, weights, "protocol_metrics") for name, errors in maps.items()}
        means = {"psnr": psnr_from_mse(means["mse"])} | means
        if lpips is not None and protocol == "image":
            means["lpips"] = distance
        values |= {metric_name(name, protocol): value for name, value in means.items()}
    return values


def metric_name(name: str, protocol: Protocol) -> str:
    """Name that a metric has in metrics.json under a protocol."""
    return name if protocol == "mask" else f"{protocol}_{name}"


def protocol_of(metric: str) -> Protocol | None:
    """Protocol of a metric by its name in metrics.json; None for what no protocol applies to (silhouette, vertices, ...)."""
    for protocol in ("image", "box"):
        if metric.startswith(f"{protocol}_"):
            return protocol
    return "mask" if metric in ("psnr", "ssim", "l1", "mse", "flip", "lpips") else None
