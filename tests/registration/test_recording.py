"""Folders of videos: what is found, and what is refused before any work."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mitsuba_avatar.captures.cameras import save_cameras
from mitsuba_avatar.registration.recording import open_recording
from mitsuba_avatar.registration.video import probe_video, read_video
from mitsuba_avatar.reporting.video import write_video
from tests.registration.people_in_cameras import make_cameras

WIDTH, HEIGHT, FRAMES = 48, 80, 5


def write_recording(folder: Path, num_frames: dict[str, int] | None = None, fps: float = 25.0) -> None:
    """Grey videos of cameras a, b and c, each frame a little brighter; keypoints of nobody."""
    cameras = {name: camera for name, camera in make_cameras(WIDTH, HEIGHT).items() if name != "d"}
    save_cameras(folder / "cameras.json", cameras)
    for index, name in enumerate(cameras):
        count = (num_frames or {}).get(name, FRAMES)
        frames = (np.full((HEIGHT, WIDTH, 3), 40 + 20 * frame + 5 * index, np.uint8) for frame in range(count))
        write_video(folder / f"{name}.mp4", frames, fps)
        (folder / "keypoints_2d" / name).mkdir(parents=True)
        for frame in range(FRAMES):
            (folder / "keypoints_2d" / name / f"{name}.{frame:04d}.json").write_text('{"people": []}')


def test_a_recording_is_found(tmp_path):
    write_recording(tmp_path)
    recording = open_recording(tmp_path)
    assert list(recording.views) == ["a", "b", "c"] and recording.num_frames == FRAMES and recording.fps == 25.0
    assert not recording.has_masks and len(recording.views["b"].keypoints) == FRAMES
    levels = [frame.mean() for frame in read_video(recording.views["b"].video)]
    np.testing.assert_allclose(levels, 45 + 20 * np.arange(FRAMES), atol=2)


def test_videos_that_encoders_cut_keep_their_calibration(tmp_path):
    write_recording(tmp_path)
    cameras = {name: replace(camera, height=HEIGHT + 1) for name, camera in make_cameras(WIDTH, HEIGHT).items()}
    save_cameras(tmp_path / "cameras.json", cameras)
    camera = open_recording(tmp_path).views["a"].camera
    assert (camera.width, camera.height) == (WIDTH, HEIGHT) and camera.fx == cameras["a"].fx and camera.cy == cameras["a"].cy


def test_half_size_videos_scale_the_calibration(tmp_path):
    write_recording(tmp_path)
    cameras = {name: camera.resized(2.0) for name, camera in make_cameras(WIDTH, HEIGHT).items()}
    save_cameras(tmp_path / "cameras.json", cameras)
    camera = open_recording(tmp_path).views["c"].camera
    assert (camera.width, camera.height) == (WIDTH, HEIGHT) and camera.fx == pytest.approx(cameras["c"].fx / 2)


def test_a_shorter_video_is_named(tmp_path):
    write_recording(tmp_path, {"b": 3})
    with pytest.raises(ValueError, match="'b': 3.*b is the shortest"):
        open_recording(tmp_path)


def test_videos_of_different_rates_are_refused(tmp_path):
    write_recording(tmp_path)
    frames = (np.zeros((HEIGHT, WIDTH, 3), np.uint8) for _ in range(FRAMES))
    write_video(tmp_path / "c.mp4", frames, 30.0)
    with pytest.raises(ValueError, match="one frame rate.*'c': 30"):
        open_recording(tmp_path)


def test_a_camera_missing_from_the_calibration_is_named(tmp_path):
    write_recording(tmp_path)
    cameras = make_cameras(WIDTH, HEIGHT)
    del cameras["b"]
    save_cameras(tmp_path / "cameras.json", cameras)
    with pytest.raises(ValueError, match=r"got none for \['b'\]"):
        open_recording(tmp_path)


def test_a_turned_video_is_refused(tmp_path):
    write_recording(tmp_path)
    save_cameras(tmp_path / "cameras.json", make_cameras(HEIGHT, WIDTH))
    with pytest.raises(ValueError, match="of a, as calibrated.*48x80"):
        open_recording(tmp_path)


def test_missing_keypoints_are_named(tmp_path):
    write_recording(tmp_path)
    (tmp_path / "keypoints_2d/c/c.0002.json").unlink()
    with pytest.raises(ValueError, match="keypoints_2d/c; got 4"):
        open_recording(tmp_path)
    for path in (tmp_path / "keypoints_2d/c").iterdir():
        path.unlink()
    with pytest.raises(FileNotFoundError, match="keypoints_2d/c; got none"):
        open_recording(tmp_path)


def test_what_is_no_recording_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="nowhere; got none"):
        open_recording(tmp_path / "nowhere")
    with pytest.raises(FileNotFoundError, match=r"cameras\.json, \*\.qca\.txt"):
        open_recording(tmp_path)
    save_cameras(tmp_path / "cameras.json", make_cameras())
    with pytest.raises(FileNotFoundError, match="at least two videos"):
        open_recording(tmp_path)


def test_a_file_that_is_no_video_is_named(tmp_path):
    (tmp_path / "a.mp4").write_text(json.dumps({}))
    with pytest.raises(ValueError, match=r"expected a video in .*a\.mp4"):
        probe_video(tmp_path / "a.mp4")
    with pytest.raises(FileNotFoundError, match=r"b\.mp4; got none"):
        probe_video(tmp_path / "b.mp4")
