"""capture.yaml and frames.csv: round trips, tolerance towards spreadsheets, and every file that must be refused."""

import pytest

from mitsuba_avatar.captures.description import CaptureDescription, load_description, save_description
from mitsuba_avatar.captures.frames import Frame, load_frames, save_frames


def test_description_round_trip(tmp_path):
    description = CaptureDescription(
        "Größe",
        fps=29.97,
        colour_curve="linear",
        exposure=0.5,
        lighting={"emitters": [{"type": "area", "radiance": [1.0, 2.0, 3.0]}]},
        face_signal="action_codes",
        face_names=("jawOpen", "smile"),
        keypoint_names=("nose",),
        held_out_cameras=("12",),
        image_extension="exr",
        licence="CC0-1.0",
        source="a test",
    )
    save_description(tmp_path / "capture.yaml", description)
    assert load_description(tmp_path / "capture.yaml") == description


def test_description_defaults(tmp_path):
    (tmp_path / "capture.yaml").write_text("name: 2024\nfps: 10\n")
    assert load_description(tmp_path / "capture.yaml") == CaptureDescription("2024", fps=10.0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("name: a\n", r"expected the keys 'name' and 'fps' in .*capture.yaml"),
        ("just words", r"expected the keys 'name' and 'fps'"),
        ("name: [\n", r"expected YAML in .*capture.yaml"),
        ("name: a\nfps: 10\ncolor_curve: srgb\n", r"got 'color_curve'. Did you mean 'colour_curve'"),
        ("name: a\nfps: fast\n", r"capture.yaml is not usable. Expected fps to be a number; got 'fast'"),
        ("name: a\nfps: 10\ncolour_curve: rec709\n", r"Expected colour_curve to be one of srgb, linear; got 'rec709'. Encode the images"),
        ("name: a\nfps: 0\n", r"expected fps: > 0; got 0.0"),
        ("name: a\nfps: 10\nunits: millimetres\n", r"expected units: metres; got 'millimetres'. Convert cameras"),
        ("name: a\nfps: 10\nformat_version: 2\n", r"expected format_version: 1; got 2"),
        ("name: a\nfps: 10\nexposure: -1\n", r"expected exposure: > 0"),
        ("name: a\nfps: 10\nface_signal: smile\n", r"Expected face_signal to be one of keypoints, action_codes; got 'smile'"),
        ("name: a\nfps: 10\nimage_extension: tiff\n", r"Expected image_extension to be one of png, jpg, avif, exr; got 'tiff'"),
        ("name: a\nfps: 10\nimage_extension: exr\n", r"expected colour_curve: linear for exr images; got 'srgb'"),
        ("name: a\nfps: 10\nface_names: smile\n", r"Expected face_names to be a list of names; got 'smile'"),
        ("name: a\nfps: 10\nlighting: bright\n", r"Expected lighting to be a mapping"),
    ],
)
def test_unusable_descriptions_are_refused(tmp_path, text, message):
    (tmp_path / "capture.yaml").write_text(text)
    with pytest.raises(ValueError, match=message):
        load_description(tmp_path / "capture.yaml")


def test_frames_round_trip(tmp_path):
    frames = (
        Frame(7, 0.1, "train", "walk, slowly"),
        Frame(8, 0.2, "validation", "walk, slowly"),
        Frame(9, 0.30000000000000004, "test", "jump"),
    )
    save_frames(tmp_path / "frames.csv", frames)
    assert load_frames(tmp_path / "frames.csv") == frames


def test_frames_as_a_spreadsheet_writes_them(tmp_path):
    """Byte-order mark, CRLF, blanks after commas, a column of notes, a blank line."""
    text = "\ufeffframe, time, split, segment, notes\r\n000003, 0.5, train , walk, good\r\n\r\n4, 0.6, test, walk, \r\n"
    (tmp_path / "frames.csv").write_bytes(text.encode())
    assert load_frames(tmp_path / "frames.csv") == (Frame(3, 0.5, "train", "walk"), Frame(4, 0.6, "test", "walk"))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("frame;time;split;segment\n", r"columns frame,time,split,segment in .*frames.csv; got 'frame;time;split;segment'"),
        ("", r"columns frame,time,split,segment"),
        ("frame,time,split,segment\n", r"at least one frame in .*frames.csv"),
        ("frame,time,split,segment\n1,0,train,a\n1.5,0,train,a\n", r"in line 3 of .*frames.csv; got \['1.5'"),
        ("frame,time,split,segment\n1,0,training,a\n", r"'number,seconds,train\|validation\|test,segment' in line 2"),
        ("frame,time,split,segment\n1,0\n", r"in line 2 of"),
        ("frame,time,split,segment\n-1,0,train,a\n", r"in line 2 of"),
        ("frame,time,split,segment\n1,0,train,a\n01,1,train,a\n", r"frames.csv must list every frame once; got frame 1 twice"),
    ],
)
def test_unusable_frame_lists_are_refused(tmp_path, text, message):
    (tmp_path / "frames.csv").write_text(text)
    with pytest.raises(ValueError, match=message):
        load_frames(tmp_path / "frames.csv")


@pytest.mark.parametrize("load", [load_description, load_frames])
def test_missing_files_are_named(tmp_path, load):
    with pytest.raises(FileNotFoundError, match=r"expected .* at .*absent; got none"):
        load(tmp_path / "absent")
