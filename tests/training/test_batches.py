"""Batches: what an iteration sees follows from seed and iteration alone, and holds what the capture's files say."""

import json
import shutil
import threading

import numpy as np
import pytest
import torch

from mitsuba_avatar.captures.colour import encode
from mitsuba_avatar.captures.folder import Capture
from mitsuba_avatar.presets import resolve
from mitsuba_avatar.training.batches import AHEAD, BatchSampler, FrameReader, batches, check_readable, training_sampler
from mitsuba_avatar.training.distributed import Process
from tests.drawn_capture import BACKGROUND, HEIGHT, HELD_OUT, TRAIN_FRAMES, WIDTH

CAMERAS = ["a", "b", "c", "d", "e"]


def make_sampler(frames=7, poses=2, views=3, seed=0, rank=0, num_ranks=1):
    return BatchSampler([10 + i for i in range(frames)], CAMERAS, poses, views, seed, rank, num_ranks)


def test_an_iteration_draws_the_same_whenever_it_is_asked():
    sampler = make_sampler()
    later = [sampler.draw(i) for i in range(5, 0, -1)][::-1]
    assert [make_sampler().draw(i) for i in range(1, 6)] == later
    assert make_sampler(seed=1).draw(1) != sampler.draw(1)


def test_every_epoch_shows_every_frame_once_in_another_order():
    """14 slots of 7 frames: two epochs, the second of which begins in the middle of a batch."""
    sampler = make_sampler()
    drawn = [frame for i in range(7) for frame in sampler.draw(i)[0]]
    assert sorted(drawn[:7]) == sorted(drawn[7:]) == list(range(10, 17))
    assert drawn[:7] != drawn[7:]


def test_coming_frames_are_those_of_the_next_batches_for_one_pass_at_most():
    sampler = make_sampler(frames=7, poses=4, rank=1, num_ranks=2)
    drawn = [frame for i in (5, 6) for frame in sampler.draw(i)[0]]
    assert list(sampler.coming_frames(5, 100)) == drawn  # two batches of four hold seven frames
    assert list(sampler.coming_frames(5, 6)) == drawn[:2]


def test_cameras_of_a_pose_are_all_different_and_all_get_their_turn():
    names = [group for i in range(20) for group in make_sampler().draw(i)[1]]
    assert all(len(set(group)) == 3 for group in names)
    assert {name for group in names for name in group} == set(CAMERAS)
    assert len({tuple(group) for group in names}) > 20, "poses of one iteration draw their cameras apart"


@pytest.mark.parametrize("num_ranks", [2, 4])
def test_ranks_share_the_batch_of_a_single_process(num_ranks):
    whole = make_sampler(frames=9, poses=4)
    for iteration in (0, 3, 11):
        shares = [make_sampler(frames=9, poses=4, rank=rank, num_ranks=num_ranks).draw(iteration) for rank in range(num_ranks)]
        assert [frame for frames, _ in shares for frame in frames] == whole.draw(iteration)[0]
        assert [group for _, names in shares for group in names] == whole.draw(iteration)[1]


def test_batches_that_cannot_be_filled_are_refused():
    with pytest.raises(ValueError, match=r"3 poses a batch cannot be shared by 2 processes\. Make training\.poses_per_batch a multiple"):
        make_sampler(poses=3, num_ranks=2)
    with pytest.raises(ValueError, match=r"views_per_pose is 6, but the capture has 5 training cameras\. Lower it"):
        make_sampler(views=6)


def test_training_draws_neither_test_frames_nor_held_out_cameras(drawn_capture):
    sampler = training_sampler(drawn_capture, resolve("tiny").training, Process())
    assert sampler.frames == list(range(TRAIN_FRAMES))
    assert sampler.camera_names == [name for name in drawn_capture.cameras if name != HELD_OUT]


def test_a_batch_holds_what_the_files_say(reader, drawn_capture):
    frames, names = [5, 2], [["left", "front", HELD_OUT], ["back", "left", "right"]]
    batch = reader.read(frames, names)
    assert batch.images.shape == batch.backgrounds.shape == (6, 3, HEIGHT, WIDTH) and batch.masks.shape == (6, 1, HEIGHT, WIDTH)
    pairs = [(frame, name) for frame, group in zip(frames, names, strict=True) for name in group]
    for row, (frame, name) in enumerate(pairs):
        np.testing.assert_array_equal(batch.images[row].permute(1, 2, 0), drawn_capture.encoded_image(name, frame) / np.float32(255))
        np.testing.assert_array_equal(batch.masks[row, 0], drawn_capture.mask(name, frame))
        camera = drawn_capture.cameras[name]
        np.testing.assert_allclose(batch.cameras.intrinsics[row], [camera.fx, camera.fy, camera.cx, camera.cy], rtol=1e-6)
        np.testing.assert_allclose(batch.camera_centers.flatten(0, 1)[row], camera.center_world, atol=1e-5)
    for name in ("theta", "root", "face", "vertices"):
        np.testing.assert_array_equal(getattr(batch, name), getattr(drawn_capture, name)[frames])
    np.testing.assert_allclose(batch.backgrounds[4, :, 7, 9], BACKGROUND, rtol=1e-6)
    assert torch.equal(batch.ambient_occlusion, reader.occlusion.maps(frames)) and batch.ambient_occlusion.std() > 0.01


def test_surfaces_are_read_without_images_and_occlusion(reader, monkeypatch):
    frames, names = [5, 2], [["left", "front"], ["back", "left"]]
    whole = reader.read(frames, names)
    monkeypatch.setattr(Capture, "mask", None)
    monkeypatch.setattr(reader, "occlusion", None)
    batch = reader.read_surfaces(frames, names).to(torch.device("cpu"))
    assert (batch.frames, batch.camera_names) == (frames, names)
    assert all(torch.equal(getattr(batch, name), getattr(whole, name)) for name in ("theta", "root", "face", "vertices"))
    assert all(getattr(batch, name) is None for name in ("images", "masks", "backgrounds", "cameras", "ambient_occlusion", "sizes"))


def test_images_of_another_size_lie_in_the_corner_of_one_film(reader, two_sizes_reader):
    names = [["left", "front"], ["back", "left"]]
    batch, whole = two_sizes_reader.read([5, 2], names), reader.read([5, 2], names)
    assert batch.sizes == [(25, 39), (WIDTH, HEIGHT), (WIDTH, HEIGHT), (25, 39)]
    for part in ("images", "masks", "backgrounds"):
        values, expected = getattr(batch, part), getattr(whole, part)
        assert values.shape == expected.shape and torch.equal(values[1:3], expected[1:3])
        for row in (0, 3):
            assert torch.equal(values[row, :, :39, :25], expected[row, :, :39, :25]) and expected[row, :, 39:].any()
            assert not values[row, :, 39:].any() and not values[row, :, :, 25:].any()
        assert torch.equal(batch.within_views(expected), values)
    assert torch.equal(batch.cameras.intrinsics, whole.cameras.intrinsics), "the corner stays where it was"
    pictures, coverage = batch.pictures(whole.images), batch.coverage(whole.masks)
    assert [picture.shape for picture in pictures] == [(39, 25, 3), (HEIGHT, WIDTH, 3), (HEIGHT, WIDTH, 3), (39, 25, 3)]
    np.testing.assert_array_equal(coverage[3], whole.masks[3, 0, :39, :25])
    assert whole.within_views(whole.images) is whole.images, "nothing to do where all have one size"


def test_images_over_an_unknown_background_are_put_on_black(reader, drawn_capture, tmp_path):
    shutil.copytree(drawn_capture.path, tmp_path / "copy")
    description = (tmp_path / "copy/capture.yaml").read_text().splitlines()
    start = next(i for i, line in enumerate(description) if line.startswith("background:"))
    stop = start + 1 + sum(line.startswith("- 0.") for line in description)
    (tmp_path / "copy/capture.yaml").write_text("\n".join(description[:start] + description[stop:]))
    capture = Capture.open(tmp_path / "copy")
    batch = FrameReader(capture, reader.occlusion).read([1], [["front", "back"]])
    expected = encode(capture.image("back", 1) * capture.mask("back", 1)[..., None], "srgb")
    np.testing.assert_array_equal(batch.images[1].permute(1, 2, 0), expected)
    assert not batch.backgrounds.any() and (batch.images[1] * (batch.masks[1] == 0)).abs().max() == 0


class RecordingReader(FrameReader):
    """Notes what is read, and fails at a chosen read."""

    def __init__(self, reader, fail_at=None):
        super().__init__(reader.capture, reader.occlusion)
        self.reads, self.fail_at = [], fail_at

    def read(self, frames, camera_names):
        self.reads.append((frames, camera_names))
        if len(self.reads) - 1 == self.fail_at:
            raise ValueError("damaged image")
        return super().read(frames, camera_names)


def threads():
    return [thread for thread in threading.enumerate() if thread.name.startswith("batches")]


def test_batches_come_in_order_and_only_a_few_ahead(reader):
    recording, sampler = RecordingReader(reader), training_sampler(reader.capture, resolve("tiny").training, Process())
    stream = batches(recording.read, sampler, 3, 9)
    for iteration in range(3, 9):
        batch = next(stream)
        assert (batch.frames, batch.camera_names) == sampler.draw(iteration)
        assert len(recording.reads) <= iteration - 3 + 1 + AHEAD
    assert next(stream, None) is None and not threads()
    assert recording.reads == [sampler.draw(i) for i in range(3, 9)], "each is decoded once"


def test_a_stream_that_is_closed_early_leaves_no_thread(reader):
    recording, sampler = RecordingReader(reader), training_sampler(reader.capture, resolve("tiny").training, Process())
    stream = batches(recording.read, sampler, 0, 1000)
    next(stream)
    assert threads()
    stream.close()
    assert not threads() and len(recording.reads) <= 1 + AHEAD


def test_an_image_that_cannot_be_read_stops_at_its_own_iteration(reader):
    stream = batches(RecordingReader(reader, fail_at=1).read, training_sampler(reader.capture, resolve("tiny").training, Process()), 0, 5)
    next(stream)
    with pytest.raises(ValueError, match="damaged image"):
        next(stream)
    assert not threads()


@pytest.fixture
def copy(drawn_capture, tmp_path):
    """Folder of a fresh copy without its images."""
    return shutil.copytree(drawn_capture.path, tmp_path / "copy", ignore=shutil.ignore_patterns("images", "*.png"))


def edit_camera(folder, **changes):
    document = json.loads((folder / "cameras.json").read_text())
    document["cameras"][1].update(changes)
    (folder / "cameras.json").write_text(json.dumps(document))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"distortion": [0.1, 0, 0, 0]}, r"expected pinhole cameras in .*cameras\.json; got distortion for \['right'\]\. Undistort"),
    ],
)
def test_cameras_that_cannot_be_rendered_are_refused(copy, changes, message):
    edit_camera(copy, **changes)
    with pytest.raises(ValueError, match=message):
        check_readable(Capture.open(copy))


@pytest.mark.parametrize(
    ("missing", "message"),
    [
        (["pose.npy"], r"expected pose\.npy in .*copy; got none"),
        (["face.npy", "root.npy"], r"expected root\.npy, face\.npy in .*copy; got none"),
        (["masks"], r"expected masks in .*copy/masks; got none\. Segment"),
    ],
)
def test_a_capture_without_what_drives_an_avatar_is_refused(copy, missing, message):
    for name in missing:
        shutil.rmtree(copy / name) if name == "masks" else (copy / name).unlink()
    with pytest.raises(FileNotFoundError, match=message):
        check_readable(Capture.open(copy))
