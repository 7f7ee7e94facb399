"""The one interface of all readers: cameras, frames, and per camera and frame an image and a mask, read when asked for.

A `Source` speaks our conventions whatever its files say: metres, world Z up, OpenCV axes, world to camera, pixel origin at the image's
corner, intrinsics of the images that it returns. Only lens distortion stays in the images: `SourceInfo.lenses` describes it and
the conversion removes it.
"""

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32, Float64, UInt8

from mitsuba_avatar.captures.cameras import Camera, UpAxis
from mitsuba_avatar.captures.colour import ColourCurve
from mitsuba_avatar.captures.description import Distortion
from mitsuba_avatar.captures.formats.decoding import decode_image
from mitsuba_avatar.captures.frames import Frame
from mitsuba_avatar.captures.images import ImageExtension
from mitsuba_avatar.captures.undistortion import Lens

LEAST_UPRIGHT = 0.4  # length of the cameras' mean up direction; below it they are rolled, or look from below as much as from above
LEAST_SPREAD = 0.1  # mean square of the cameras' horizontal axes along their second direction; below it they all look the same way
SNAP_ANGLE_DEG = 35.0  # the world's up is one of its axes if the cameras stand as near to it as this: hands, and heads, roll a little
SURE_ANGLE_DEG = 5.0  # as far off, nobody need be told
TEST_SHARE = 0.1  # of the frames, where neither the data set nor the user says which are for testing


@dataclass(frozen=True)
class SourceOptions:
    """What a user may say about a data set that its files do not.

    Attributes:
        cameras: read only these; all of them must be there. Empty reads all that have calibration and images.
        fps: frames per second; 0 takes what the format or its documentation says.
        test_frames: so many of the last frames are for testing; -1 takes the data set's own split, or else a tenth.
        up: axis of the data set's world that points up; "auto" takes that along which the cameras stand, "cameras" as they stand.
        distortion: "apply" the stored lens coefficients, "ignore" them, or do as the data set's own tools do ("auto").
        assets: file of the body model, for formats that keep it elsewhere.
        images_only: leave out what takes long to list and has nothing to do with images (names of keypoints).
    """

    cameras: tuple[str, ...] = ()
    fps: float = 0.0
    test_frames: int = -1
    up: UpAxis = "auto"
    distortion: Distortion = "auto"
    assets: Path | None = None
    images_only: bool = False


@dataclass(frozen=True)
class MissingFrame:
    """A frame that the data set lists and that cannot be used, and why."""

    number: int
    reason: str


@dataclass(frozen=True, eq=False)
class SourceInfo:
    """What a source is, known before any image is decoded.

    Attributes:
        name: of the capture.
        fps: frames per second.
        cameras: name -> Camera without distortion, at the images' size.
        lenses: name -> Lens, for cameras whose images are bent.
        frames: those that every camera has, by index.
        missing: listed frames that are left out.
        colour_curve: of the images' values.
        image_extension: of the image files.
        has_masks: whether `mask` gives any.
        lacks: what a fit needs and the data set does not have.
        notes: what a user should know about what was read.
        keypoint_names: of `keypoints`.
        licence, source: of the data set.
    """

    name: str
    fps: float
    cameras: Mapping[str, Camera]
    frames: tuple[Frame, ...]
    lenses: Mapping[str, Lens] = field(default_factory=dict)
    missing: tuple[MissingFrame, ...] = ()
    colour_curve: ColourCurve = "srgb"
    image_extension: ImageExtension = "jpg"
    has_masks: bool = True
    lacks: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    keypoint_names: tuple[str, ...] = ()
    licence: str = ""
    source: str = ""

    def missing_reasons(self) -> dict[str, int]:
        """How many frames are left out for each reason, most frequent first."""
        return dict(Counter(frame.reason for frame in self.missing).most_common())


class Source(ABC):
    """A capture in another format, read in place. Opening reads lists and headers; images are decoded when asked for and not kept."""

    info: SourceInfo

    @abstractmethod
    def encoded_image(self, camera_name: str, frame_index: int) -> bytes:
        """The image file's bytes.

        Raises:
            FileNotFoundError, ValueError: the file is missing or damaged.
        """

    @abstractmethod
    def where(self, camera_name: str, frame_index: int) -> str:
        """The image file, as messages name it."""

    def image(self, camera_name: str, frame_index: int) -> UInt8[np.ndarray, "H W 3"]:
        """Decode an image [H, W, 3] as stored: bent, if the camera has a lens, and in the source's colour curve.

        Raises:
            FileNotFoundError: if the file is missing.
            ValueError: for a truncated file, more than 8 bits a channel, CMYK, or another size than the camera's.
        """
        where = self.where(camera_name, frame_index)
        pixels = decode_image(self.encoded_image(camera_name, frame_index), where)
        self._check_size(pixels, camera_name, where)
        return pixels

    def mask(self, camera_name: str, frame_index: int) -> UInt8[np.ndarray, "H W"] | None:
        """Coverage of the person [H, W], 0 to 255, bent as the image; None if the data set has no masks. Raises as `image`."""
        return None

    def background(self, camera_name: str) -> UInt8[np.ndarray, "H W 3"] | None:
        """What a camera sees without the person; None if unknown. Raises as `image`."""
        return None

    def vertices(self, frame_index: int) -> Float32[np.ndarray, "V 3"] | None:
        """Registered mesh of a frame, metres, world axes; None if the data set has none."""
        return None

    def keypoints(self, frame_index: int) -> Float32[np.ndarray, "K 4"] | None:
        """3D keypoints of a frame, x, y, z in metres and confidence; None if the data set has none."""
        return None

    def _check_size(self, pixels: np.ndarray, camera_name: str, where: str) -> None:
        """Refuse an image whose size is not its camera's."""
        camera = self.info.cameras[camera_name]
        if pixels.shape[:2] != (camera.height, camera.width):
            raise ValueError(
                f"Source: expected {camera.width}x{camera.height} pixels, the size of {camera_name}, in {where}; got "
                f"{pixels.shape[1]}x{pixels.shape[0]}. Take images and calibration of one release and resolution."
            )


def chosen_cameras(calibrated: Sequence[str], recorded: Iterable[str], wanted: Sequence[str], where: Path) -> tuple[list[str], list[str]]:
    """Cameras to read, in the calibration's order, and notes about those left out.

    Raises:
        ValueError: if a camera with images has no calibration, a wanted camera lacks either, or none is left.
    """
    recorded = set(recorded)
    unknown = sorted(set(wanted or recorded) - set(calibrated))
    if unknown:
        raise ValueError(
            f"chosen_cameras(): expected calibration of every camera with images in {where}; got none for {unknown[:5]}"
            f"{' and others' if len(unknown) > 5 else ''}. Calibrate them, or name the cameras to read."
        )
    without_images = [name for name in calibrated if name not in recorded and (not wanted or name in wanted)]
    names = [name for name in calibrated if name in recorded and (not wanted or name in wanted)]
    if not names or (wanted and without_images):
        raise ValueError(
            f"chosen_cameras(): expected images of {list(wanted) or 'at least one calibrated camera'} in {where}; got none for "
            f"{without_images[:5]}. Copy the images, or name other cameras."
        )
    return names, [f"cameras without images: {', '.join(without_images)}"] if without_images else []


def common_frames(
    listed: Sequence[int] | None, available: Mapping[str, Iterable[int]], where: Path, known_missing: Mapping[int, str] | None = None
) -> tuple[list[int], tuple[MissingFrame, ...]]:
    """Frame numbers that everything has, and the others with the reason.

    Args:
        listed: numbers in the data set's own list; None takes all that occur anywhere.
        available: what is needed ("image of 400870") -> the numbers that it has.
        where: for messages.
        known_missing: numbers that the data set itself reports missing, with the reason.

    Raises:
        ValueError: if no frame is left; says what lacks most.
    """
    known_missing = known_missing or {}
    sets = {what: set(numbers) for what, numbers in available.items()}
    numbers = sorted(set().union(*sets.values()) if listed is None else set(listed))
    kept, missing = [], []
    for number in numbers:
        absent = [what for what, has in sets.items() if number not in has]
        reason = known_missing.get(number) or (f"no {absent[0]}" if absent else "")
        if reason:
            missing.append(MissingFrame(number, reason))
        else:
            kept.append(number)
    if not kept:
        counts = Counter(frame.reason for frame in missing).most_common(3)
        raise ValueError(
            f"common_frames(): expected frames that every camera has in {where}; got none of {len(numbers)}: "
            f"{'; '.join(f'{reason} ({count} frames)' for reason, count in counts) or 'no images'}. Copy the rest, or name other cameras."
        )
    return kept, tuple(missing)


def timed_frames(
    numbers: Sequence[int],
    fps: float,
    test_frames: int,
    splits: Mapping[int, str] | None = None,
    segments: Mapping[int, str] | None = None,
) -> tuple[Frame, ...]:
    """Frames with times, splits and segments.

    Args:
        numbers: kept frame numbers, in order.
        fps: numbers count at this rate.
        test_frames: so many of the last are for testing; -1 takes `splits`, or else a tenth.
        splits: number -> "train" or "test", if the data set says.
        segments: number -> name of the take.

    Raises:
        ValueError: if no frame is left to learn from.
    """
    if test_frames >= len(numbers):
        raise ValueError(f"timed_frames(): expected fewer test frames than the {len(numbers)} there are; got {test_frames}. Lower it.")
    if test_frames < 0 and splits is None:
        test_frames = int(TEST_SHARE * len(numbers))
    first_test = len(numbers) - max(test_frames, 0)
    frames = []
    for index, number in enumerate(numbers):
        split = splits.get(number, "train") if splits is not None and test_frames < 0 else ("test" if index >= first_test else "train")
        segment = segments.get(number, "sequence") if segments else "sequence"
        frames.append(Frame(number, (number - numbers[0]) / fps, split, segment))
    return tuple(frames)


def upright_world(cameras: Iterable[Camera], up: UpAxis, where: Path, has_axes: bool = True) -> Float64[np.ndarray, "4 4"]:
    """Rotation [4, 4] that carries a data set's world to one whose Z points up.

    Args:
        cameras: in that world.
        up: "auto" takes the world's axis that is nearest to up as the cameras stand, or that direction itself where no axis is near.
        where: for messages.
        has_axes: whether the world's axes mean anything; where not, "auto" is as "cameras".

    Raises:
        ValueError: if the cameras do not tell which way is up.
    """
    if up in ("auto", "cameras"):
        direction = cameras_up(cameras, where)
        axis = int(np.abs(direction).argmax())
        if up == "auto" and has_axes and abs(direction[axis]) > np.cos(np.deg2rad(SNAP_ANGLE_DEG)):
            direction = np.sign(direction[axis]) * np.eye(3)[axis]
    else:
        direction = np.zeros(3)
        direction["xyz".index(up[-1])] = -1.0 if up.startswith("-") else 1.0
    return _rotation_to_z(direction)


def cameras_up(cameras: Iterable[Camera], where: Path) -> Float64[np.ndarray, "3"]:
    """Unit vector that points up as the cameras stand: upright to their horizontal axes, however far they look down.

    Where all look the same way, and their horizontal axes leave it open, the mean of their own up directions.

    Raises:
        ValueError: if the cameras do not tell which way is up.
    """
    rotations = np.stack([camera.camera_from_world[:3, :3] for camera in cameras])
    mean = -rotations[:, 1].mean(axis=0)
    length = float(np.linalg.norm(mean))
    if length < LEAST_UPRIGHT:
        raise ValueError(
            f"upright_world(): expected cameras that stand upright, to tell which way is up in {where}; got a mean up direction of "
            f"length {length:.2f}. Say which axis points up (--up z, say; calibration.up=z for register)."
        )
    horizontal = rotations[:, 0]
    values, vectors = np.linalg.eigh(horizontal.T @ horizontal / len(horizontal))
    if values[1] < LEAST_SPREAD:
        return mean / length
    return vectors[:, 0] * np.sign(vectors[:, 0] @ mean)


def degrees_off(cameras: Iterable[Camera], world_from_native: Float64[np.ndarray, "4 4"], where: Path) -> float:
    """Degrees between the turned world's up and up as the cameras stand in the world that it is turned from."""
    return float(np.rad2deg(np.arccos(np.clip(world_from_native[2, :3] @ cameras_up(cameras, where), -1.0, 1.0))))


def up_notes(
    native: Iterable[Camera], world_from_native: Float64[np.ndarray, "4 4"], options: SourceOptions, where: Path
) -> tuple[str, ...]:
    """What a user should know about the axis that was taken for up: nothing where the cameras stand along it."""
    off = degrees_off(native, world_from_native, where) if options.up == "auto" else 0.0
    if off <= SURE_ANGLE_DEG:
        return ()
    up = world_from_native[2, :3]
    axis = ("-" if up.min() < -0.5 else "") + "xyz"[int(np.abs(up).argmax())]
    return (f"{axis} was taken for up, though the cameras stand {off:.0f} degrees off it (--up names an axis, --up cameras takes theirs)",)


def turned_camera(camera: Camera, world_from_native: Float[np.ndarray, "4 4"]) -> Camera:
    """The same camera in the turned world."""
    rotation = world_from_native[:3, :3]
    native_from_world = np.eye(4)
    native_from_world[:3, :3], native_from_world[:3, 3] = rotation.T, -rotation.T @ world_from_native[:3, 3]
    return replace(camera, camera_from_world=camera.camera_from_world @ native_from_world)


def turned_points(points: Float[np.ndarray, "N 3"], world_from_native: Float[np.ndarray, "4 4"]) -> Float32[np.ndarray, "N 3"]:
    """Points [N, 3] in the turned world."""
    return (points.astype(np.float64) @ world_from_native[:3, :3].T + world_from_native[:3, 3]).astype(np.float32)


def _rotation_to_z(direction: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "4 4"]:
    """The shortest rotation that carries a unit vector to +Z; upside down turns about X."""
    matrix = np.eye(4)
    if direction[2] < -1 + 1e-9:
        matrix[1, 1] = matrix[2, 2] = -1.0
        return matrix
    x, y, z = direction
    axis = np.array([[0, 0, -x], [0, 0, -y], [x, y, 0]])  # cross matrix of direction x Z
    matrix[:3, :3] = np.eye(3) + axis + axis @ axis / (1 + z)
    return matrix
