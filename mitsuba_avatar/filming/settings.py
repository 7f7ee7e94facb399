"""Every setting of the capture studio, a section for each thing that stands on the stage. Presets are in configs/studio/.

Values out of range are refused as soon as a section is made. Units are SI and pixels or texels unless a name says otherwise.
"""

import re
from dataclasses import dataclass, field
from typing import Literal

from mitsuba_avatar.settings import expect


@dataclass(frozen=True)
class MotionSettings:
    """What the person does.

    Raises:
        ValueError: if a value is out of range, or script and files do not go together.
    """

    script: Literal["default", "study", "mocap"] = "default"  # which takes: see filming/takes.py; mocap plays `bvh`
    fps: float = 10.0
    train_frames: int = 120
    validation_frames: int = 0  # blocks held out within the training takes, beside `train_frames`
    test_frames: int = 30
    stress_frames: int = 0  # of wild motion far from training, in a test segment of its own that is to be reported apart
    bvh: tuple[str, ...] = ()  # recordings for the script mocap; the end of the last is for testing
    bvh_unit: Literal["auto", "metres", "feet", "cmu", "inches", "centimetres", "millimetres"] = "auto"  # auto: as tall as a person
    face_recording: str = ""  # CSV of Live Link Face that the face follows; empty: the script's own face
    face_signal: Literal["keypoints", "action_codes"] = "keypoints"  # what drives the face: 3D landmarks seen from the head, or strengths

    def __post_init__(self) -> None:
        expect(self, "positive", "fps", "train_frames")
        expect(self, "zero or more", "validation_frames", "test_frames", "stress_frames")
        if (self.script == "mocap") != bool(self.bvh):
            raise ValueError(
                f"MotionSettings(): expected files in bvh with the script mocap, and only then; got script {self.script} and "
                f"{len(self.bvh)} files. Set motion.script and motion.bvh together."
            )


@dataclass(frozen=True)
class ClothingSettings:
    """What the person wears, and how finely it is painted."""

    texture_size: int = 512  # texels along a side of what the person is painted with
    outfit: Literal["shirt", "loose_shirt", "shorts"] = "shirt"  # whose first word is simulated; see filming/wardrobe.py
    attire: Literal["striped", "plain", "leafy"] = "striped"  # colours and prints of clothes, colour of hair
    has_details: bool = False  # eyes and teeth with paint of their own: a third more time, seen from about 400 pixels of height
    headset: bool = False  # a virtual-reality headset hides the upper face
    is_simulated: bool = True  # False: cloth is displaced by pose and a little lag, without simulation
    substeps_per_second: int = 200  # of the simulation; part of what a capture is: another number gives other folds
    settle_time: float = 2.0  # seconds before each segment in which the garment falls and the person gets into the first pose
    self_distance: float = 0.0  # metres that folds keep from each other, 0.006 is good; 0 lets them pass through, a third faster
    start_noise: float = 0.0  # metres (RMS) by which the garment starts elsewhere, to measure how chaotic it is; seeded
    tracking_noise: float = 0.0  # metres (RMS) of error of the registered mesh, shaped like real tracking errors; seeded

    def __post_init__(self) -> None:
        expect(self, "a power of two", "texture_size")
        expect(self, "positive", "substeps_per_second")
        expect(self, "zero or more", "settle_time", "self_distance", "start_noise", "tracking_noise")


@dataclass(frozen=True)
class CameraSettings:
    """The dome's cameras."""

    train: int = 10
    held_out: int = 3
    width: int = 192
    height: int = 256
    shot_noise: float = 0.0  # standard deviation at linear radiance 1; at radiance L it is the square root of L times this
    read_noise: float = 0.0  # standard deviation at every radiance, linear
    colour_spread: float = 0.0  # by which cameras' responses to colour differ: 0.05 is 5 % in gain, a third of it in crosstalk
    chart_samples_per_pixel: int = 0  # of a picture of a colour chart by each camera; 0 takes none

    def __post_init__(self) -> None:
        expect(self, "positive", "train", "width", "height")
        expect(self, "zero or more", "held_out", "shot_noise", "read_noise", "chart_samples_per_pixel")
        expect(self, "between 0 and 1", "colour_spread")


@dataclass(frozen=True)
class LightSettings:
    """The dome's light, and how it is path-traced."""

    scene: str = "dome"  # a file of scenes/, without its ending, or a path to an XML file
    background: float = 0.06  # linear radiance of the constant backdrop
    samples_per_pixel: int = 8  # camera rays, stratified
    light_samples: int = 3  # paths that go on from each camera ray's hit
    max_depth: int = 3  # segments of a path, counting the camera's: 3 is one bounce of indirect light
    occlusion_size: int = 64  # texels along a side of the true ambient occlusion, kept for scoring; 0 keeps none

    def __post_init__(self) -> None:
        expect(self, "positive", "samples_per_pixel", "light_samples", "max_depth")
        expect(self, "between 0 and 1", "background")
        if self.occlusion_size:
            expect(self, "a power of two", "occlusion_size")


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
