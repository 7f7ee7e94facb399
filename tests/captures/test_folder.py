"""The lazy reader and the writer: round trip, memory, interruption, and captures that must be refused."""

import json
import pickle
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from mitsuba_avatar.captures.colour import decode_bytes
from mitsuba_avatar.captures.description import CaptureDescription
from mitsuba_avatar.captures.folder import Capture
from mitsuba_avatar.captures.frames import Frame
from mitsuba_avatar.captures.writer import CaptureWriter
from tests.small_capture import FRAMES, draw, make_cameras, make_poses
from tests.small_rig import make_small_rig


def test_round_trip(small_capture):
    capture = Capture.open(small_capture.path)
    theta, root = make_poses()
    np.testing.assert_array_equal(capture.theta, theta)
    np.testing.assert_array_equal(capture.root, root)
    assert capture.frames == FRAMES and capture.vertices.shape == (4, 258, 3) and capture.face.shape == (4, 2)
    assert capture.rig_path.is_file()
    image, mask = draw(capture.cameras["left"], np.array(capture.vertices[2]), make_small_rig().topology.faces)
    np.testing.assert_array_equal(capture.encoded_image("left", 2), image)
    np.testing.assert_array_equal(capture.image("left", 2), decode_bytes(image, "srgb"))
    np.testing.assert_array_equal(capture.mask("left", 2), mask.astype(np.float32))
    assert capture.images.image_path("left", capture.frames[2].number).name == "000105.png", "files carry the frame's number, not its index"


def test_selections(small_capture):
    assert small_capture.frame_indices() == [0, 1, 2, 3]
    assert small_capture.frame_indices(split="train") == [0, 1, 2]
    assert small_capture.frame_indices(split="train", segment="turn") == [2]
    assert small_capture.camera_names() == ["front", "left", "high"]
    assert small_capture.camera_names(held_out=True) == ["high"]
    assert small_capture.camera_names(held_out=False) == ["front", "left"]


def test_a_stress_segment_is_no_test_take(small_capture):
    capture = Capture.open(small_capture.path)
    capture.frames = tuple(replace(frame, split="test", segment="stress_wild") if i == 1 else frame for i, frame in enumerate(FRAMES))
    assert capture.frame_indices("stress") == [1] and capture.frame_indices("test") == [3]
    assert Frame(0, 0.0, "train", "stress_free").purpose == "train"


def test_wrong_names_and_indices_are_refused(small_capture):
    with pytest.raises(ValueError, match=r"got 'frnt'. Did you mean 'front'"):
        small_capture.image("frnt", 0)
    with pytest.raises(IndexError, match=r"frame index in 0..3 of .*frames.csv; got 105. Give the row, not the frame's number"):
        small_capture.image("front", 105)
    with pytest.raises(IndexError, match="got -1"):
        small_capture.mask("front", -1)
    with pytest.raises(ValueError, match=r"expected a segment of \['bend', 'turn'\] in .*; got 'walk'"):
        small_capture.frame_indices(segment="walk")
    with pytest.raises(ValueError, match="expected 0 < image_scale <= 1; got 2"):
        Capture.open(small_capture.path, image_scale=2.0)


def test_smaller_images_are_averages_in_linear_light(small_capture):
    half = Capture.open(small_capture.path, image_scale=0.5)
    assert (half.cameras["front"].width, half.cameras["front"].height) == (32, 24)
    full = small_capture.image("front", 0)
    np.testing.assert_allclose(half.image("front", 0), full.reshape(24, 2, 32, 2, 3).mean(axis=(1, 3)), atol=1e-6)
    assert half.mask("front", 0).shape == (24, 32) and np.count_nonzero(half.mask("front", 0) % 1) > 0


def test_workers_open_the_capture_again(small_capture):
    """A pickled capture is two paths long, not two arrays."""
    half = Capture.open(small_capture.path, image_scale=0.5)
    assert len(pickle.dumps(half)) < 1000
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(half)).image("left", 1), half.image("left", 1))


def test_memory_does_not_grow_with_frames(tmp_path):
    """800 frames of 17x11 images and 9.6 MB of vertices: reading all of it allocates less than a tenth of that."""
    frames = [Frame(index, index / 10, "train", "a") for index in range(800)]
    camera = {"only": replace(make_cameras(17, 11)["front"], name="only")}
    writer = CaptureWriter(tmp_path / "long", CaptureDescription("long", fps=10.0, image_extension="jpg"), camera, frames)
    pixels = np.arange(11 * 17 * 3, dtype=np.uint8).reshape(11, 17, 3)
    writer.write_image("only", 0, pixels)
    content = (tmp_path / "long/images/only/000000.jpg").read_bytes()
    for frame in frames:
        (tmp_path / f"long/images/only/{frame.number:06d}.jpg").write_bytes(content)
    writer.write_arrays(vertices=np.random.default_rng(0).random((800, 1000, 3), dtype=np.float32))
    writer.finish()
    tracemalloc.start()
    capture = Capture.open(tmp_path / "long")
    opened, _ = tracemalloc.get_traced_memory()
    total = sum(float(capture.image("only", index).sum()) + float(capture.vertices[index].sum()) for index in range(800))
    kept, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert total > 0
    assert kept - opened < 50_000, f"reading kept {kept - opened} bytes"
    assert peak < 1_000_000, f"peak {peak} bytes, the arrays and images are {800 * (1000 * 12 + 11 * 17 * 12)}"


# ---- Writer ----


def begin(path, **changes):
    """A writer of two cameras and two frames, with nothing written."""
    cameras = {name: camera for name, camera in make_cameras(17, 11).items() if name != "high"}
    return CaptureWriter(path, CaptureDescription("two", fps=10.0, **changes), cameras, FRAMES[:2])


def fill(writer, skip=()):
    """Write every image that is not there yet, except those to skip; returns what was written."""
    written = []
    for name, camera in writer.cameras.items():
        for index in range(len(writer.frames)):
            if (name, index) not in skip and not writer.has_image(name, index):
                writer.write_image(name, index, np.full((camera.height, camera.width, 3), 10 * index, np.uint8))
                written.append((name, index))
    return written


def test_interrupted_writer_is_refused_by_the_reader_and_resumes(tmp_path):
    writer = begin(tmp_path / "two")
    assert fill(writer, skip={("left", 1)}) == [("front", 0), ("front", 1), ("left", 0)]
    with pytest.raises(FileNotFoundError, match=r"got an unfinished one \(no capture.yaml\). Run the command .* again: it resumes"):
        Capture.open(tmp_path / "two")
    resumed = begin(tmp_path / "two")
    with pytest.raises(FileNotFoundError, match=r"expected 4 images in .*; got 3, the first missing is .*left/000101.png"):
        resumed.finish()
    assert fill(resumed) == [("left", 1)]
    for name, camera in resumed.cameras.items():
        assert not resumed.has_all(), "masks are missing"
        for index in range(len(resumed.frames)):
            resumed.write_mask(name, index, np.full((camera.height, camera.width), 0.5))
    assert resumed.has_all()
    assert resumed.finish().camera_names() == ["front", "left"]
    with pytest.raises(FileExistsError, match="got a finished capture"):
        begin(tmp_path / "two")


def test_resuming_with_other_settings_is_refused(tmp_path):
    begin(tmp_path / "two")
    with pytest.raises(FileExistsError, match=r"got an unfinished one whose capture.unfinished.yaml differ"):
        begin(tmp_path / "two", exposure=2.0)


def test_a_crash_before_the_marker_can_be_resumed_and_foreign_folders_cannot(tmp_path):
    begin(tmp_path / "two")
    (tmp_path / "two/capture.unfinished.yaml").unlink()
    fill(begin(tmp_path / "two"))
    (tmp_path / "other").mkdir()
    (tmp_path / "other/thesis.tex").write_text("important")
    with pytest.raises(FileExistsError, match=r"expected an empty folder at .*other; got \['thesis.tex'\]"):
        begin(tmp_path / "other")


def test_a_failed_write_leaves_nothing(tmp_path, monkeypatch):
    writer = begin(tmp_path / "two")

    def fail(self, path, **options):
        path.write_bytes(b"half an image")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Image.Image, "save", fail)
    with pytest.raises(OSError, match="No space left"):
        writer.write_image("front", 0, np.zeros((11, 17, 3), np.uint8))
    assert not writer.has_image("front", 0) and not list((tmp_path / "two/images/front").iterdir())


def test_masks_must_be_complete_if_there_is_one(tmp_path):
    writer = begin(tmp_path / "two")
    fill(writer)
    writer.write_mask("front", 0, np.linspace(0, 1, 187).reshape(11, 17))
    assert writer.has_mask("front", 0) and not writer.has_mask("front", 1)
    with pytest.raises(FileNotFoundError, match="expected 4 masks in .*; got 1"):
        writer.finish()


def test_masks_of_every_type_agree(tmp_path):
    writer = begin(tmp_path / "two")
    coverage = np.indices((11, 17)).sum(axis=0) % 2
    for name, index, mask in (("front", 0, coverage.astype(bool)), ("front", 1, coverage.astype(np.float32)), ("left", 0, coverage * 255)):
        writer.write_mask(name, index, mask if mask.dtype in (bool, np.float32) else mask.astype(np.uint8))
    stored = [np.array(Image.open(path)) for path in sorted((tmp_path / "two/masks").rglob("*.png"))]
    assert len(stored) == 3 and all(np.array_equal(mask, coverage * 255) for mask in stored)


def test_wrong_sizes_types_and_names_are_refused_on_writing(tmp_path):
    writer = begin(tmp_path / "two")
    with pytest.raises(ValueError, match=r"expected 11 rows of 17 pixels for front; got 17 of 11. Arrays are \[height, width\]"):
        writer.write_image("front", 0, np.zeros((17, 11, 3), np.uint8))
    with pytest.raises(ValueError, match=r"expected a camera of \['front', 'left'\]; got 'top'"):
        writer.write_mask("top", 0, np.zeros((11, 17), bool))
    with pytest.raises(ValueError, match=r"'theta': '\[2, any\]'.*got 'theta' with \[3, 5\]. Give a row for each frame"):
        writer.write_arrays(theta=np.zeros((3, 5)))
    with pytest.raises(ValueError, match="got 'poses'"):
        writer.write_arrays(poses=np.zeros((2, 5)))
    with pytest.raises(ValueError, match=r"unknown held-out \['top'\]"):
        begin(tmp_path / "three", held_out_cameras=("top",))


# ---- Captures that must not open ----


def test_missing_parts_are_none(capture_copy):
    for name in ("vertices.npy", "keypoints.npy", "rig.npz"):
        (capture_copy / name).unlink()
    capture = Capture.open(capture_copy)
    assert capture.vertices is None and capture.keypoints is None and capture.theta is not None and not capture.rig_path.exists()


def test_not_a_capture(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"expected a capture's folder at .*absent; got none"):
        Capture.open(tmp_path / "absent")
    with pytest.raises(FileNotFoundError, match=r"expected capture.yaml, cameras.json and frames.csv in .*; got no capture.yaml"):
        Capture.open(tmp_path)


def test_arrays_that_do_not_fit_are_refused(capture_copy):
    np.save(capture_copy / "root.npy", np.zeros((3, 4, 4), np.float32))
    with pytest.raises(ValueError, match=r"float32 \[4, 4, 4\] \(root, a row for each frame.*root.npy; got float32 \[3, 4, 4\]"):
        Capture.open(capture_copy)
    np.save(capture_copy / "root.npy", np.zeros((4, 4, 4)))
    with pytest.raises(ValueError, match=r"root.npy; got float64 \[4, 4, 4\]. Save it as float32"):
        Capture.open(capture_copy)
    content = (capture_copy / "vertices.npy").read_bytes()
    (capture_copy / "root.npy").unlink()
    (capture_copy / "vertices.npy").write_bytes(content[:-100])
    with pytest.raises(ValueError, match=r"a whole array in .*vertices.npy; got \d+ bytes"):
        Capture.open(capture_copy)


def test_names_that_do_not_fit_are_refused(capture_copy):
    text = (capture_copy / "capture.yaml").read_text()
    (capture_copy / "capture.yaml").write_text(text.replace("- high", "- top"))
    with pytest.raises(ValueError, match=r"held_out_cameras of .*capture.yaml in cameras.json; got unknown \['top'\]"):
        Capture.open(capture_copy)
    (capture_copy / "capture.yaml").write_text(text.replace("- a\n", "- a\n- c\n"))
    with pytest.raises(ValueError, match=r"each of the 2 columns of .*face.npy; got 3 face_names"):
        Capture.open(capture_copy)


def test_damaged_images_are_named_when_read(capture_copy):
    capture = Capture.open(capture_copy)
    path = capture_copy / "images/front/000101.png"
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(ValueError, match=r"a whole image in .*front/000101.png; got 200 bytes"):
        capture.image("front", 1)
    path.unlink()
    with pytest.raises(FileNotFoundError, match=r"expected an image at .*front/000101.png; got none"):
        capture.image("front", 1)
    Image.new("L", (48, 64)).save(capture_copy / "masks/front/000101.png")
    with pytest.raises(
        ValueError, match=r"expected 64x48 pixels, the size of front in cameras.json, in .*masks/front/000101.png; got 48x64"
    ):
        capture.mask("front", 1)


def test_non_rigid_camera_is_named(capture_copy):
    document = json.loads((capture_copy / "cameras.json").read_text())
    document["cameras"][1]["camera_from_world"][0][0] *= 1.1
    (capture_copy / "cameras.json").write_text(json.dumps(document))
    with pytest.raises(ValueError, match=r"camera 1 \(left\) of .*cameras.json is not usable.*must be a rigid 4x4"):
        Capture.open(capture_copy)
