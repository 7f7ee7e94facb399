"""A folder of synchronized videos, their calibration and their 2D keypoints, found and checked before any work.

```
cameras.json, Calib.qca.txt, ...             the calibration (calibration.py); its names of cameras are those of videos and folders
<camera>.mp4                                 or mov, avi, mkv, webm; also in videos/
keypoints_2d/<camera>/*.json                 a file a frame, as OpenPose writes them, in order of their names
masks/<camera>/*.png                         optional: a file a frame, white is the person, at the video's size
chart/chart.json  chart/<camera>.png         optional: pictures of a colour chart (captures/colour_calibration.py)
```
"""

from dataclasses import dataclass, replace
from pathlib import Path

from mitsuba_avatar.captures.cameras import Camera
from mitsuba_avatar.registration.calibration import find_calibration
from mitsuba_avatar.registration.settings import CalibrationSettings
from mitsuba_avatar.registration.video import VideoInfo, probe_video

VIDEO_ENDINGS = (".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v")
KEYPOINTS_FOLDER = "keypoints_2d"
MASKS_FOLDER = "masks"
LARGEST_CUT = 0.02  # of the calibrated width or height: encoders cut that much to reach multiples of 8 or 16


@dataclass(frozen=True, eq=False)
class RecordedView:
    """What one camera gave.

    Attributes:
        camera: at the size of the video, with its distortion.
        video: file.
        keypoints: a file a frame.
        masks: a file a frame, or empty.
    """

    camera: Camera
    video: Path
    keypoints: tuple[Path, ...]
    masks: tuple[Path, ...]


@dataclass(frozen=True, eq=False)
class Recording:
    """Views by camera name, all of the same number of frames. `open_recording` makes one."""

    path: Path
    views: dict[str, RecordedView]
    num_frames: int
    fps: float

    @property
    def has_masks(self) -> bool:
        """Whether masks came with the videos."""
        return all(view.masks for view in self.views.values())


def open_recording(path: Path | str, settings: CalibrationSettings = CalibrationSettings()) -> Recording:  # noqa: B008 - frozen
    """Find and check the parts of a recording; decodes no image.

    Args:
        path: its folder.
        settings: what the calibration's files do not say.

    Raises:
        FileNotFoundError: no folder, calibration, videos or keypoints.
        ValueError: a video without calibration, videos of different length or rate, another number of keypoint or mask files than
            frames, or a video of another shape than was calibrated. The message names camera and remedy.
    """
    path = Path(path)
    if not path.is_dir():
        raise FileNotFoundError(f"open_recording(): expected a folder of videos at {path}; got none. Check the path.")
    calibration = find_calibration(path)
    videos = {file.stem: file for folder in (path, path / "videos") for file in sorted(folder.glob("*")) if file.suffix in VIDEO_ENDINGS}
    if len(videos) < 2:
        raise FileNotFoundError(
            f"open_recording(): expected at least two videos in {path}; got {sorted(videos)}. Depth needs two views: put "
            f"<camera>{VIDEO_ENDINGS[0]} there."
        )
    probed = {name: probe_video(file) for name, file in videos.items()}
    cameras = calibration.cameras({name: (info.width, info.height) for name, info in probed.items()}, settings)
    uncalibrated = sorted(set(videos) - set(cameras))
    if uncalibrated:
        raise ValueError(
            f"open_recording(): expected every video's camera in the calibration of {path}; got none for {uncalibrated}. "
            f"It has {sorted(cameras)}. Rename the videos, calibrate those cameras, or take the videos away."
        )
    infos = {name: probed[name] for name in cameras if name in probed}
    num_frames = _common_length(path, infos)
    views = {}
    for name, info in infos.items():
        views[name] = RecordedView(
            camera=_at_video_size(cameras[name], info),
            video=videos[name],
            keypoints=_files(path, KEYPOINTS_FOLDER, name, "json", num_frames),
            masks=_files(path, MASKS_FOLDER, name, "png", num_frames) if (path / MASKS_FOLDER).is_dir() else (),
        )
    return Recording(path, views, num_frames, next(iter(infos.values())).fps)


def _common_length(path: Path, infos: dict[str, VideoInfo]) -> int:
    """Frames of every video, which must be as many in each."""
    counts = {name: info.num_frames for name, info in infos.items()}
    rates = {name: round(info.fps, 2) for name, info in infos.items()}
    if len(set(counts.values())) > 1:
        shortest = min(counts, key=lambda name: counts[name])
        raise ValueError(
            f"open_recording(): expected synchronized videos of one length in {path}; got {counts} frames, {shortest} is the shortest. "
            "Cut them so that frame n is the same moment in all."
        )
    if len(set(rates.values())) > 1:
        raise ValueError(
            f"open_recording(): expected videos of one frame rate in {path}; got {rates} frames a second. Resample them to one rate."
        )
    return next(iter(counts.values()))


def _at_video_size(camera: Camera, info: VideoInfo) -> Camera:
    """The calibrated camera at the size of its video: cut at the right and the bottom as encoders do, or scaled."""
    cuts = (1 - info.width / camera.width, 1 - info.height / camera.height)
    if min(cuts) >= 0 and max(cuts) <= LARGEST_CUT:
        return replace(camera, width=info.width, height=info.height)
    scale = info.height / camera.height
    if abs(camera.width * scale - info.width) > 1:
        raise ValueError(
            f"open_recording(): expected {camera.width}x{camera.height} pixels of {camera.name}, as calibrated, or that shape scaled; got "
            f"{info.width}x{info.height}. Use the video that was calibrated, not a cropped or turned one."
        )
    return replace(camera.resized(scale), width=info.width, height=info.height)


def _files(path: Path, folder: str, name: str, ending: str, num_frames: int) -> tuple[Path, ...]:
    """A camera's files, one a frame."""
    files = tuple(sorted((path / folder / name).glob(f"*.{ending}")))
    if not files:
        raise FileNotFoundError(
            f"open_recording(): expected {ending} files in {path / folder / name}; got none. Detect keypoints of this camera's video first."
            if ending == "json"
            else f"open_recording(): expected {ending} files in {path / folder / name}; got none. Give masks of all cameras or of none."
        )
    if len(files) != num_frames:
        raise ValueError(
            f"open_recording(): expected a file for each of the {num_frames} frames in {path / folder / name}; got {len(files)}. "
            "Detect again on this very video: frames and files belong together by their order."
        )
    return files
