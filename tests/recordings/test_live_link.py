from pathlib import Path

import numpy as np
import pytest

from mitsuba_avatar.recordings.live_link import read_live_link

NAMES = ("jawOpen", "eyeBlinkLeft", "eyeLookOutRight")
HEADER = "Timecode,BlendshapeCount,EyeBlinkLeft,EyeLookOutRight,JawOpen,HeadYaw"


def write(folder: Path, *rows: str, header: str = HEADER) -> Path:
    path = folder / "take_3.csv"
    path.write_bytes(("\ufeff" + "\r\n".join((header, *rows)) + "\r\n").encode())
    return path


def test_columns_are_found_by_name_and_times_by_timecode(tmp_path: Path):
    """Frames 58 and 59 of one second are followed by frame 0 of the next: the recording is at 60 frames a second."""
    path = write(tmp_path, "23:59:59:58.500,61,0.1,0.2,0.3,9", "23:59:59:59.500,61,0.4,0,1.2,9", "", "00:00:00:01.000,61,0.1,-0.5,0,9")
    recording = read_live_link(path, NAMES)
    assert recording.name == "take_3" and recording.action_names == NAMES
    np.testing.assert_allclose(recording.times, np.array([0, 1, 2.5]) / 60, atol=1e-9)
    np.testing.assert_allclose(recording.strengths, [[0.3, 0.1, 0.2], [1, 0.4, 0], [0, 0.1, 0]])


def test_a_rate_of_thirty_shows_in_the_frame_numbers(tmp_path: Path):
    recording = read_live_link(write(tmp_path, "00:00:01:29,61,0,0,0,0", "00:00:02:14,61,0,0,1,0"), NAMES)
    np.testing.assert_allclose(recording.times, [0, 0.5])


def test_resampling_is_linear_and_a_short_recording_plays_back_and_forth(tmp_path: Path):
    recording = read_live_link(write(tmp_path, "00:00:01:00,61,0,0,0,0", "00:00:02:00,61,0,0,0.5,0", "00:00:03:00,61,0,1,1,0"), NAMES)
    np.testing.assert_allclose(recording.at(np.array([0.5, 2.0, 3.0, 4.25]))[:, 0], [0.25, 1.0, 0.5, 0.125])
    np.testing.assert_allclose(recording.at(np.array([1.5]))[0], [0.75, 0, 0.5])


def test_one_row_is_a_still_face(tmp_path: Path):
    recording = read_live_link(write(tmp_path, "00:00:01:00,61,0.5,0,0.25,0"), NAMES)
    np.testing.assert_allclose(recording.at(np.array([0.0, 7.0])), [[0.25, 0.5, 0], [0.25, 0.5, 0]])


def test_missing_columns_are_named(tmp_path: Path):
    path = write(tmp_path, "00:00:01:00,61,0,0", header="Timecode,BlendshapeCount,EyeBlinkLeft,HeadYaw")
    with pytest.raises(ValueError, match=r"take_3.csv; missing: jawOpen, eyeLookOutRight\."):
        read_live_link(path, NAMES)
    with pytest.raises(ValueError, match="missing: Timecode"):
        read_live_link(write(tmp_path, "1", header="EyeBlinkLeft,EyeLookOutRight,JawOpen"), NAMES)


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ((), "at least one row"),
        (("00:00:01:00,61,0,0,0,0", "00:00:01:10,61,0,0,0"), "line 3 .*00:00:01:10,61,0,0,0"),
        (("00:00:01:00,61,0,x,0,0",), "line 2 "),
        (("00:00:01:00,61,0,nan,0,0",), "line 2 "),
        (("noon,61,0,0,0,0",), "line 2 .*noon"),
        (("00:00:01:75,61,0,0,0,0",), "at most 60 frames a second .*frame 75"),
        (("00:00:01:10,61,0,0,0,0", "00:00:01:09,61,0,0,0,0"), "row 2 is not later than row 1"),
    ],
)
def test_rows_that_cannot_be_used_are_refused_with_their_line(tmp_path: Path, rows: tuple[str, ...], message: str):
    with pytest.raises(ValueError, match=message):
        read_live_link(write(tmp_path, *rows), NAMES)


def test_a_missing_file_and_a_file_of_bytes_are_refused(tmp_path: Path):
    with pytest.raises(FileNotFoundError, match=r"motion.face_recording"):
        read_live_link(tmp_path / "none.csv", NAMES)
    (tmp_path / "photo.csv").write_bytes(bytes(range(128, 256)))
    with pytest.raises(ValueError, match=r"photo.csv cannot be read"):
        read_live_link(tmp_path / "photo.csv", NAMES)
