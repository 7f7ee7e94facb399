from pathlib import Path

import numpy as np
import pytest

from mitsuba_avatar.recordings.bvh import joint_transforms, read_bvh
from tests.recordings.written import NAMES, Z_UP_FACING_X, Encoding, bvh_text, movement, positions

SMALL = """HIERARCHY
ROOT Big Hips
{ OFFSET 0 0 0
  CHANNELS 6 Yposition Xposition Zposition Yrotation Zrotation Xrotation
  JOINT arm {
    OFFSET 0 1.5 0
    CHANNELS 1 Xrotation
    End Site { OFFSET 0.25 0 0 } } }
MOTION
Frames: 2
Frame Time: 0.05
1 2 3 0 0 0 0
1 2 3 90 0 0 90
"""


def write(folder: Path, text: str) -> Path:
    path = folder / "walk.bvh"
    path.write_text(text, encoding="utf-8")
    return path


def test_channels_in_any_order_and_number_turn_and_move_the_right_joints(tmp_path: Path):
    recording = read_bvh(write(tmp_path, SMALL), unit="metres")
    assert recording.joint_names == ("Big Hips", "arm", "arm_end") and list(recording.parents) == [-1, 0, 1]
    assert recording.frame_time == 0.05 and recording.duration == 0.05
    _, places = joint_transforms(recording.parents, recording.rotations, recording.translations)
    np.testing.assert_allclose(places[0], [[2, 1, 3], [2, 2.5, 3], [2.25, 2.5, 3]], atol=1e-9)
    np.testing.assert_allclose(places[1, 2], [2, 2.5, 2.75], atol=1e-9)  # x to -z by the root; the arm turns about its own length


@pytest.mark.parametrize(
    "encoding",
    [Encoding(), Encoding(unit=0.0254, order="XYZ"), Encoding(unit=1.0, axes=Z_UP_FACING_X, order="YXZ"), Encoding(arms_down=0.7)],
    ids=["centimetres", "inches", "metres, Z up", "arms down at rest"],
)
def test_joints_are_where_they_were_however_the_file_is_written(tmp_path: Path, encoding: Encoding):
    turns, hips = movement(5)
    recording = read_bvh(write(tmp_path, bvh_text(turns, hips, encoding)))
    assert recording.unit_is_assumed and recording.unit == {0.01: "centimetres", 0.0254: "inches", 1.0: "metres"}[encoding.unit]
    _, places = joint_transforms(recording.parents, recording.rotations, recording.translations)
    named = [recording.joint_names.index(name) for name in NAMES]
    np.testing.assert_allclose(places[:, named] @ encoding.axes, positions(turns, hips), atol=1e-5)


def test_cmu_units_are_recognised(tmp_path: Path):
    text = bvh_text(*movement(2), Encoding(unit=0.0254 / 0.45))
    assert read_bvh(write(tmp_path, text)).unit == "cmu"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("HIERARCHY", "HIERACHY", "line 1 .*'HIERACHY'"),
        ("OFFSET 0 1.5 0", "OFFSET 0 1.5", "three numbers of an offset in line 7 .*'CHANNELS'"),
        ("OFFSET 0 1.5 0", "OFFSET 0 nan 0", "three numbers of an offset in line 6 .*'nan'"),
        ("1 Xrotation", "1 Wrotation", "each once a joint in line 7 .*'Wrotation'"),
        ("JOINT arm", "JOINT Big Hips", "a new name of a joint .*'Big Hips'"),
        ("} } }", "} }", "'}' in line 9 .*'MOTION'"),
        ("Frames: 2", "Frames: 0", "at least one frame .*Frames: 0"),
        ("Frames: 2", "Frames: 3", "3 frames x 7 channels = 21 .*got 14"),
        ("Time: 0.05", "Time: 0", "frame time above 0 s"),
        ("90 0 0 90", "90 0 0 ninety", "expected numbers after the frame time .*ninety"),
        ("90 0 0 90", "90 0 0 inf", "1 of them not finite"),
        (SMALL[SMALL.index("MOTION") :], "", "'MOTION' .*the end of the file"),
    ],
)
def test_malformed_files_are_refused_with_the_place(tmp_path: Path, old: str, new: str, message: str):
    assert old in SMALL
    with pytest.raises(ValueError, match=message):
        read_bvh(write(tmp_path, SMALL.replace(old, new)), unit="metres")


def test_a_size_that_no_unit_explains_is_refused_and_an_explicit_unit_is_checked(tmp_path: Path):
    path = write(tmp_path, bvh_text(*movement(2), Encoding(unit=0.0001)))
    with pytest.raises(ValueError, match=r"got \S+ units in .*motion.bvh_unit to one of metres"):
        read_bvh(path)
    path = write(tmp_path, bvh_text(*movement(2), Encoding(unit=0.01)))
    assert not read_bvh(path, unit="centimetres").unit_is_assumed
    with pytest.raises(ValueError, match=r"if its unit is metres. Set motion.bvh_unit to centimetres"):
        read_bvh(path, unit="metres")
    path = write(tmp_path, bvh_text(*movement(2), Encoding(unit=0.0254)))
    with pytest.raises(ValueError, match=r"got one of 0\.\d+ m if its unit is centimetres. Set motion.bvh_unit to inches"):
        read_bvh(path, unit="centimetres")
    toddler = write(tmp_path, bvh_text(*movement(2), Encoding(unit=2.0)))
    assert read_bvh(toddler, unit="metres").unit == "metres", "no other unit makes a person of it"


def test_a_missing_file_is_named(tmp_path: Path):
    with pytest.raises(FileNotFoundError, match=r"nothing.bvh"):
        read_bvh(tmp_path / "nothing.bvh")
