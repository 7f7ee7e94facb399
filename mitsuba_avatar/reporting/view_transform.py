"""From linear radiance to the picture that people see, by a transform that has a name and stands in the file.

| name   | what happens to linear radiance x, after multiplication by 2 ** exposure                                      |
|--------|--------------------------------------------------------------------------------------------------------------|
| `srgb` | cut to 0..1; the curve of IEC 61966-2-1. What is measured on such pictures is measured on radiance.           |
| `soft` | x (1 + x / 16) / (1 + x), Reinhard's curve with white at 4, then as above: highlights roll off, mid-tones darken |

Rec. 709 primaries throughout. A PNG says so twice: its sRGB chunk for programs, a text chunk `view_transform` for people.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, PngImagePlugin

from mitsuba_avatar.captures.colour import encode
from mitsuba_avatar.files import atomic_path
from mitsuba_avatar.reporting.figures import to_bytes

WHITE = 4.0  # radiance that `soft` shows as white
_PERCEPTUAL = b"\x00"  # rendering intent of the sRGB chunk


@dataclass(frozen=True)
class ViewTransform:
    """How pictures are shown.

    Attributes:
        name: a row of the module's table.
        exposure: stops; 1 doubles radiance.
        backdrop: linear radiance behind the person, after exposure; None leaves the picture transparent.
    """

    name: Literal["srgb", "soft"] = "srgb"
    exposure: float = 0.0
    backdrop: float | None = 0.18

    def __post_init__(self) -> None:
        if not np.isfinite(self.exposure) or (self.backdrop is not None and not self.backdrop >= 0):
            raise ValueError(
                f"ViewTransform(): expected a finite exposure and a backdrop >= 0 or None; got {self.exposure} and {self.backdrop}."
            )

    def apply(self, radiance: Float[np.ndarray, "H W 3"], coverage: Float[np.ndarray, "H W"]) -> UInt8[np.ndarray, "H W C"]:
        """Show a picture.

        Args:
            radiance: [H, W, 3] linear, premultiplied by coverage.
            coverage: [H, W] in 0..1.

        Returns:
            [H, W, 3] over the backdrop, or [H, W, 4] with straight alpha, as PNG wants it.
        """
        scene = radiance * np.float32(2.0**self.exposure)
        if self.backdrop is not None:
            return to_bytes(self._shown(scene + (1 - coverage[..., None]) * np.float32(self.backdrop)))
        straight = scene / np.maximum(coverage[..., None], np.float32(1e-6))  # where nothing is seen there is no colour to restore
        return np.concatenate([to_bytes(self._shown(straight)), to_bytes(coverage[..., None])], axis=2)

    def backdrop_bytes(self) -> UInt8[np.ndarray, "3"]:
        """What `apply` shows where nobody is; black without a backdrop."""
        return to_bytes(self._shown(np.full((1, 1, 3), self.backdrop or 0.0, np.float32)))[0, 0]

    def describe(self) -> str:
        """What a file's text chunk says."""
        return f"{self.name}, exposure {self.exposure:g} stops, backdrop {'none' if self.backdrop is None else f'{self.backdrop:g}'}"

    def _shown(self, linear: Float[np.ndarray, "H W 3"]) -> Float[np.ndarray, "H W 3"]:
        if self.name == "soft":
            linear = np.maximum(linear, 0)
            linear = linear * (1 + linear / WHITE**2) / (1 + linear)
        return encode(np.clip(linear, 0, 1), "srgb")


def write_png(path: Path | str, picture: UInt8[np.ndarray, "H W C"], transform: ViewTransform) -> None:
    """Write a picture that `transform` has shown, whole or not at all, with the transform's name in it."""
    facts = PngImagePlugin.PngInfo()
    facts.add(b"sRGB", _PERCEPTUAL)
    facts.add_text("view_transform", transform.describe())
    with atomic_path(path) as temporary:
        Image.fromarray(picture).save(temporary, pnginfo=facts)
