"""Settings of `python -m mitsuba_avatar.register`: one frozen dataclass a section, refused when out of range before any work begins.

Pixels named here are pixels of the video as it was filmed, measured at a height of 1920; other heights scale with it. Metres, radians,
seconds otherwise.
"""

from dataclasses import dataclass, field
from typing import Literal

from mitsuba_avatar.captures.cameras import UpAxis
from mitsuba_avatar.settings import expect

ColourCorrection = Literal["auto", "none", "gains", "affine"]
KeypointOrder = Literal["auto", "body_25", "body_25b", "coco", "openpose_coco", "halpe_26"]


@dataclass(frozen=True)
class CalibrationSettings:
    """What a calibration's files may leave open."""

    up: UpAxis = "auto"  # axis of its world that points up; cameras: as they stand; auto: as the format says, else along them
    metres: float = 0.0  # in a unit of its world; 0: as the format says (COLMAP's has no unit)

    def __post_init__(self) -> None:
        expect(self, "zero or more", "metres")


@dataclass(frozen=True)
class OutputSettings:
    """The capture to be written."""

    name: str = ""  # of the capture; empty: the folder's
    width: int = 272  # pixels of images and masks; the undistorted view is cut to this shape
    height: int = 480
    held_out_cameras: tuple[str, ...] = ()  # no training looks at these; silhouettes of these are not fitted either (see refinement)
    test_share: float = 0.15  # of the kept frames, at the end, for testing
    licence: str = ""
    source: str = ""
    colour_correction: ColourCorrection = "auto"  # of each camera's linear radiance; auto takes what agrees best on frames left out
    colour_reference: str = ""  # camera whose colours stay as they are; empty: the one that shares most of the surface with others

    def __post_init__(self) -> None:
        expect(self, "positive", "width", "height")
        expect(self, "between 0 and 1", "test_share")


@dataclass(frozen=True)
class KeypointSettings:
    """2D keypoints and how they become 3D."""

    order: KeypointOrder = "auto"  # of the detector's points; auto tries those of the same number and takes the one that makes a body
    least_confidence: float = 0.15  # detections below it are no detections
    inlier_pixels: float = 40.0  # a view that a triangulated point misses by more is an outlier
    person_pixels: float = 60.0  # two detections whose median triangulation error is larger are different people
    fastest: float = 6.0  # metres a second that somebody moves at most: the gate of tracking
    checks_synchronization: bool = True  # refuses videos of which one shows other moments, as far as the person's motion tells
    refines_cameras: bool = True  # calibrations drift: keypoints of all frames correct where cameras stand and look
    camera_turn: float = 0.01  # radians that a camera may have turned since it was calibrated (one standard deviation)
    camera_shift: float = 0.03  # metres that it may have moved
    ambiguous_distance: float = 0.12  # metres; a second person as near as that to where the followed one should be is a confusion

    def __post_init__(self) -> None:
        expect(self, "between 0 and 1", "least_confidence")
        expect(self, "positive", "inlier_pixels", "person_pixels", "fastest", "ambiguous_distance")
        expect(self, "positive", "camera_turn", "camera_shift")


@dataclass(frozen=True)
class BodySettings:
    """Where the search for the person's shape starts; each 0..1, see `body.anny_rig.AnnyPhenotype`."""

    gender: float = 0.3  # 0 male, 1 female
    age: float = 0.67
    muscle: float = 0.55
    weight: float = 0.5
    height: float = 0.45
    proportions: float = 0.6
    freedom: float = 0.25  # standard deviation of the search about these values
    fixed: tuple[str, ...] = ("age",)  # names above that are not searched for: age and height tell the same story to keypoints

    def __post_init__(self) -> None:
        expect(self, "between 0 and 1", "gender", "age", "muscle", "weight", "height", "proportions")
        expect(self, "positive", "freedom")


@dataclass(frozen=True)
class PoseSettings:
    """The fit of shape and pose to keypoints: a maximum a posteriori estimate, with standard deviations as its units."""

    iterations: int = 300
    learning_rate: float = 0.03
    pixel_deviation: float = 12.0  # of a confident detection
    angle_deviation: float = 0.5  # radians of a pose angle from the rest pose
    twist_deviation: float = 0.12  # the same for twists along a limb, which joints above do as well
    angular_acceleration: float = 80.0  # radians per second squared of a pose angle
    linear_acceleration: float = 25.0  # metres per second squared of a landmark
    landmark_deviation: float = 0.02  # metres between where a detector and the rig see the same landmark

    def __post_init__(self) -> None:
        expect(self, "positive", "iterations", "learning_rate", "pixel_deviation", "angle_deviation", "twist_deviation")
        expect(self, "positive", "angular_acceleration", "linear_acceleration", "landmark_deviation")


@dataclass(frozen=True)
class MaskSettings:
    """Background plates and foreground masks."""

    plate_frames: int = 60  # evenly spaced frames whose median is the plate
    margin: float = 0.045  # of the person's height: how far outside the projected body the person may still be
    certain: float = 0.022  # of the person's height: how far inside it the person certainly is
    rounds: int = 1  # of segmenting and refining: the refined body starts better masks

    def __post_init__(self) -> None:
        expect(self, "positive", "plate_frames", "margin", "certain", "rounds")


@dataclass(frozen=True)
class RefinementSettings:
    """Differentiable rendering of silhouettes."""

    passes: int = 8  # over all frames: root, pose and shape
    offset_passes: int = 6  # over all frames: smooth offsets of the vertices, shared ones and a frame's own
    frames_per_step: int = 8
    learning_rate: float = 0.006  # of angles
    offset_learning_rate: float = 0.004
    silhouette_weight: float = 3.0  # of the share of the person's pixels that are wrong, beside the energy of keypoints
    smoothness: float = 30.0  # of offsets: rings of vertices over which a single pull spreads, squared
    offset_deviation: float = 0.015  # metres of an offset that all frames share
    frame_offset_deviation: float = 0.006  # metres of a frame's own offset
    uses_held_out_cameras: bool = False  # false: silhouettes of held-out cameras judge the registration and take no part in it
    least_overlap: float = 0.6  # frames whose silhouettes overlap less (mean IoU) are dropped
    largest_keypoint_error: float = 30.0  # frames whose median keypoint error is larger are dropped

    def __post_init__(self) -> None:
        expect(self, "positive", "passes", "frames_per_step", "learning_rate", "offset_learning_rate", "silhouette_weight")
        expect(self, "zero or more", "offset_passes")
        expect(self, "positive", "smoothness", "offset_deviation", "frame_offset_deviation", "largest_keypoint_error")
        expect(self, "between 0 and 1", "least_overlap")


@dataclass(frozen=True)
class RegistrationSettings:
    """All sections of a registration."""

    calibration: CalibrationSettings = field(default_factory=CalibrationSettings)
    output: OutputSettings = field(default_factory=OutputSettings)
    keypoints: KeypointSettings = field(default_factory=KeypointSettings)
    body: BodySettings = field(default_factory=BodySettings)
    pose: PoseSettings = field(default_factory=PoseSettings)
    masks: MaskSettings = field(default_factory=MaskSettings)
    refinement: RefinementSettings = field(default_factory=RefinementSettings)
