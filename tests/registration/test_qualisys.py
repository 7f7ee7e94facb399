"""Qualisys calibrations: a hand-made camera read back, and files that are none."""

import numpy as np
import pytest

from mitsuba_avatar.registration.qualisys import load_qualisys

CAMERA = """
 <camera serial="{name}" viewrotation="0">
  <fov_video bottom="1919" left="0" right="1087" top="0"/>
  <transform r11="1" r12="0" r13="0" r21="0" r22="0" r23="1" r31="0" r32="-1" r33="0" x="250.0" y="-3000.0" z="1500.0"/>
  <intrinsic centerPointU="34752" centerPointV="60800" focalLengthU="96000" focalLengthV="97280" radialDistortion1="-0.05"
   radialDistortion2="0.1" radialDistortion3="0" tangentalDistortion1="0.001" tangentalDistortion2="-0.002"/>
 </camera>"""


def text_of(*names: str) -> str:
    cameras = "".join(CAMERA.format(name=name) for name in names)
    return f"<?xml version='1.0' encoding='ASCII'?><calibration><cameras>{cameras}</cameras></calibration>"


def test_a_camera_looks_where_the_file_says(tmp_path):
    """Rows of the file's rotation are right, up and backwards: this camera stands at y = -3 m and looks along +Y."""
    (tmp_path / "Calib.qca.txt").write_text(text_of("cam01", "cam02"))
    cameras = load_qualisys(tmp_path / "Calib.qca.txt")
    assert list(cameras) == ["cam01", "cam02"]
    camera = cameras["cam01"]
    assert (camera.width, camera.height) == (1088, 1920)
    np.testing.assert_allclose([camera.fx, camera.fy, camera.cx, camera.cy], [1500, 1520, 543.5, 950.5])
    np.testing.assert_allclose(camera.center_world, [0.25, -3, 1.5], atol=1e-12)
    assert camera.distortion == (-0.05, 0.1, 0.001, -0.002)
    pixels, depth = camera.project(np.array([[0.25, 0.0, 1.5], [0.35, 0.0, 1.5], [0.25, 0.0, 1.6]]))
    np.testing.assert_allclose(depth, 3)
    np.testing.assert_allclose(pixels[0], [543.5, 950.5], atol=1e-9)
    assert pixels[1, 0] > pixels[0, 0] + 40 and pixels[2, 1] < pixels[0, 1] - 40, "x to the right, up is up"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("not xml", "expected XML"),
        ("<calibration><cameras/></calibration>", "expected cameras"),
        (text_of("a", "a"), "got 'a' twice"),
        (text_of("a").replace("<intrinsic", "<lens"), "of camera 'a'.*no intrinsic"),
        (text_of("a").replace('focalLengthU="96000"', ""), "focalLengthU"),
        (text_of("a").replace('r11="1"', 'r11="2"'), "no rotation"),
    ],
)
def test_files_that_are_no_calibration_are_refused(text, message, tmp_path):
    (tmp_path / "Calib.qca.txt").write_text(text)
    with pytest.raises(ValueError, match=message):
        load_qualisys(tmp_path / "Calib.qca.txt")


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"Calib\.qca\.txt; got none"):
        load_qualisys(tmp_path / "Calib.qca.txt")
