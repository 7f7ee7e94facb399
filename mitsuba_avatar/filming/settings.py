"""Every setting of the capture studio, a section for each thing that stands on the stage. Presets are in configs/studio/.

Values out of range are refused as soon as a section is made. Units are SI and pixels or texels unless a name says otherwise.
"""

import re
from dataclasses import dataclass, field
from typing import Literal

from mitsuba_avatar.settings import expect


@dataclass(frozen=True)
class MotionSettings:
    """What the person does."""

    fps: float = 10.0
    train_frames: int = 120
    test_frames: int = 30

    def __post_init__(self) -> None:
        expect(self, "positive", "fps", "train_frames")
        expect(self, "zero or more", "test_frames")


@dataclass(frozen=True)
class ClothingSettings:
    """What the person wears, and how finely it is painted."""

    texture_size: int = 512  # texels along a side of what the person is painted with

    def __post_init__(self) -> None:
        expect(self, "a power of two", "texture_size")


@dataclass(frozen=True)
class CameraSettings:
    """The dome's cameras."""

    train: int = 10
    held_out: int = 3
    width: int = 192
    height: int = 256

    def __post_init__(self) -> None:
        expect(self, "positive", "train", "width", "height")
        expect(self, "zero or more", "held_out")


@dataclass(frozen=True)
class LightSettings:
    """The dome's light, and how it is path-traced."""

    scene: str = "dome"  # a file of scenes/, without its ending, or a path to an XML file
    background: float = 0.06  # linear radiance of the constant backdrop
    samples_per_pixel: int = 16  # camera rays; a square number stratifies best
    light_samples: int = 3  # paths that go on from each camera ray's hit
    max_depth: int = 3  # segments of a path, counting the camera's: 3 is one bounce of indirect light

    def __post_init__(self) -> None:
        expect(self, "positive", "samples_per_pixel", "light_samples", "max_depth")
        expect(self, "between 0 and 1", "background")


@dataclass(frozen=True)
class StudioSettings:
    """What the capture studio films."""

    name: str = "default"
    person: Literal["anny"] = "anny"  # whose body; the parametric body of the package `anny` is the one there is
    seed: int = 0
    motion: MotionSettings = field(default_factory=MotionSettings)
    clothing: ClothingSettings = field(default_factory=ClothingSettings)
    cameras: CameraSettings = field(default_factory=CameraSettings)
    light: LightSettings = field(default_factory=LightSettings)

    def __post_init__(self) -> None:
        expect(self, "zero or more", "seed")
        if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]*", self.name):
            raise ValueError(
                f"StudioSettings(): expected name to be letters, digits, '_', '-' and '.', since it names a folder; "
                f"got {self.name!r}. Choose another."
            )
