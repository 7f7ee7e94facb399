"""Values that must be refused before any long work, each with file, frame and remedy."""

import os

import numpy as np
import pytest
from PIL import Image

from mitsuba_avatar.captures import checks
from mitsuba_avatar.captures.checks import check_arrays, check_values
from mitsuba_avatar.captures.folder import Capture
from tests.small_rig import make_small_rig


def test_a_good_capture_passes(small_capture):
    check_values(small_capture, make_small_rig())


def damage(folder, name, change):
    """Apply `change` to an array of the capture in place, through its file."""
    values = np.load(folder / name)
    change(values)
    np.save(folder / name, values)
    return Capture.open(folder)


def put(index, value):
    """A change that writes one value."""

    def change(values):
        values[index] = value

    return change


def multiply(index, factor):
    """A change that scales some values."""

    def change(values):
        values[index] *= factor

    return change


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("pose.npy", put((2, 3), np.nan), r"pose.npy: expected finite joint angles; got NaN or infinity in frame index 2 \(number 105\)"),
        (
            "pose.npy",
            multiply((3, 2), 57.3),
            r"pose.npy: expected radians; got an angle of 8[56]\.\d, which looks like degrees in frame index 3",
        ),
        ("root.npy", put((1, 0, 3), np.inf), r"root.npy: expected finite root poses; got NaN or infinity in frame index 1"),
        (
            "root.npy",
            multiply((1, slice(3), slice(3)), 1.1),
            r"root.npy: expected rigid root poses.*in frame index 1.*Divide out the scale",
        ),
        ("root.npy", lambda values: values.__setitem__(0, values[0].T.copy()), r"rigid root poses.*frame index 0.*stored transposed"),
        ("root.npy", multiply((slice(None), slice(3), 3), 1000), r"translations in metres; got 5\d\d, which looks like millimetres"),
        ("face.npy", put((3, 1), np.nan), r"face.npy: expected a finite face signal; got NaN or infinity in frame index 3"),
        ("keypoints.npy", put((2, 1, 0), np.nan), r"keypoints.npy: expected finite keypoints where the confidence is positive"),
        ("keypoints.npy", multiply((slice(None), slice(None), slice(3)), 1000), r"expected keypoints in metres; got a coordinate of \d+"),
        ("vertices.npy", put((1, 77, 2), np.nan), r"vertices.npy: expected finite vertices; got NaN or infinity in frame index 1"),
        ("vertices.npy", multiply(slice(None), 3000), r"a person in metres; got one 1\d\d\d m tall, which looks like millimetres.*by 1000"),
        ("vertices.npy", multiply(slice(None), 100), r"a person in metres; got one \d\d m tall, which looks like centimetres.*by 100"),
        ("vertices.npy", multiply(slice(None), 0.01), r"got one 0.00\d+ m tall, which looks normalized"),
    ],
)
def test_bad_values_are_named(capture_copy, name, change, message):
    capture = damage(capture_copy, name, change)
    with pytest.raises(ValueError, match=message):
        check_arrays(capture)


def test_lost_keypoints_may_be_nan(capture_copy):
    def lose(values):
        values[1, 2] = [np.nan, np.nan, np.nan, 0.0]

    check_arrays(damage(capture_copy, "keypoints.npy", lose))


def test_arrays_are_read_in_blocks(capture_copy, monkeypatch):
    """The frame is named right whatever the block size is."""
    monkeypatch.setattr(checks, "BLOCK_BYTES", 5000)  # one frame of vertices a block
    with pytest.raises(ValueError, match="in frame index 3"):
        check_arrays(damage(capture_copy, "vertices.npy", put((3, 0, 0), np.nan)))


def test_arrays_of_another_rig_are_refused(capture_copy):
    rig = make_small_rig()
    np.save(capture_copy / "vertices.npy", np.zeros((4, 300, 3), np.float32))
    with pytest.raises(ValueError, match=r"258 vertices of the topology of .*rig.npz in .*vertices.npy; got 300.*same source"):
        check_arrays(Capture.open(capture_copy), rig)
    (capture_copy / "vertices.npy").unlink()
    np.save(capture_copy / "pose.npy", np.zeros((4, 104), np.float32))
    with pytest.raises(ValueError, match=r"5 joint angles of the dof table of .*rig.npz in .*pose.npy; got 104"):
        check_arrays(Capture.open(capture_copy), rig)


def truncate(path):
    """Cut the last 30 bytes."""
    path.write_bytes(path.read_bytes()[:-30])


@pytest.mark.parametrize(
    ("file", "damage_file", "error", "message"),
    [
        ("images/left/000105.png", os.remove, FileNotFoundError, r"expected an image at .*images/left/000105.png; got none"),
        ("images/left/000105.png", truncate, ValueError, r"a whole image in .*images/left/000105.png; got a truncated one"),
        ("masks/high/000100.png", os.remove, FileNotFoundError, r"expected an image at .*masks/high/000100.png; got none"),
        ("masks/high/000100.png", truncate, ValueError, r"a whole image in .*masks/high/000100.png"),
        ("masks/high/000100.png", Image.new("L", (32, 24)).save, ValueError, r"expected 64x48 pixels.*masks/high/000100.png; got 32x24"),
        (
            "masks/high/000100.png",
            Image.new("L", (64, 48), 1).save,
            ValueError,
            r"a mask from 0 to 255 in .*; got labels 0 and 1. Multiply",
        ),
        ("images/left/000105.png", Image.new("RGB", (128, 96)).save, ValueError, r"64x48 pixels, the size of left.*; got 128x96"),
    ],
)
def test_damaged_images_are_named(capture_copy, file, damage_file, error, message):
    damage_file(capture_copy / file)
    with pytest.raises(error, match=message):
        check_values(Capture.open(capture_copy))
