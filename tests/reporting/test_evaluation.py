"""Measuring an avatar: the baselines are what they say, and every number is filed where it belongs."""

import dataclasses

import numpy as np
import pytest
import torch

from mitsuba_avatar.captures.colour import encode
from mitsuba_avatar.reporting.evaluation import EVERY_MEASURE, METHODS, as_images
from mitsuba_avatar.reporting.metrics import image_metrics, load_pictures, silhouette_iou, temporal_flicker
from mitsuba_avatar.reporting.protocols import protocol_metrics
from mitsuba_avatar.reporting.seams import SeamSampler
from tests.drawn_capture import BACKGROUND, HEIGHT, HELD_OUT, TRAIN_FRAMES, WIDTH, with_small_camera

VIEWS = ["left", HELD_OUT, "front"]


def test_all_methods_draw_display_values(evaluator):
    batch = evaluator.reader.read([8], [VIEWS])
    for method in METHODS:
        drawn = evaluator.draw(method, batch)
        assert drawn.images.shape == (3, 3, HEIGHT, WIDTH) and drawn.masks.shape == (3, 1, HEIGHT, WIDTH)
        assert drawn.images.min() >= 0 and drawn.images.max() <= 1 and not drawn.images.requires_grad
        corner = encode(torch.tensor(BACKGROUND), "srgb")
        torch.testing.assert_close(drawn.images[1, :, 0, 0], corner, atol=3e-3, rtol=0, msg="composited on the capture's background")


def test_the_template_is_the_avatar_before_training(evaluator, loaded):
    batch = evaluator.reader.read([3], [VIEWS])
    drawn = evaluator.draw("template_mean_texture", batch)
    torch.testing.assert_close(drawn.vertices, loaded.avatar.pose_template(batch.theta, batch.root)[0].detach())
    assert (drawn.images - evaluator.draw("avatar", batch).images).abs().max() > 0.02


def test_the_nearest_frame_is_the_nearest_other_training_frame(evaluator, drawn_capture):
    for index in (0, 4, 9):
        batch = evaluator.reader.read([index], [VIEWS])
        drawn = evaluator.draw("nearest_frame", batch)
        distance = np.linalg.norm(drawn_capture.theta[:TRAIN_FRAMES] - drawn_capture.theta[index], axis=1)
        distance[distance == 0] = np.inf
        nearest = int(distance.argmin())
        assert nearest != index
        for view, name in enumerate(VIEWS):
            expected = encode(drawn_capture.image(name, nearest), "srgb")
            np.testing.assert_allclose(as_images(drawn.images)[view], expected, atol=1e-6)
            np.testing.assert_array_equal(drawn.masks[view, 0], drawn_capture.mask(name, nearest))


def test_numbers_are_those_of_the_single_pictures(evaluator, drawn_capture):
    """Two frames and two cameras, averaged by hand."""
    frames, names = [2, 5], ["right", "back"]
    means = evaluator.measure({"train": frames}, ["avatar"], names).means()["avatar"]["train"]
    expected = {"psnr": [], "l1": [], "iou": []}
    for index in frames:
        batch = evaluator.reader.read([index], [names])
        drawn = evaluator.draw("avatar", batch)
        for view, name in enumerate(names):
            mask = drawn_capture.mask(name, index)
            values = image_metrics(as_images(drawn.images)[view], encode(drawn_capture.image(name, index), "srgb"), mask)
            expected["psnr"].append(values["psnr"])
            expected["l1"].append(values["l1"])
            expected["iou"].append(silhouette_iou(drawn.masks[view, 0].numpy(), mask))
    assert list(means) == ["seen"] and means["seen"]["images"] == 4
    for name, values in expected.items():
        assert means["seen"][name] == pytest.approx(np.mean(values), rel=1e-5), name


def test_a_smaller_camera_is_measured_on_its_own_pixels(loaded, evaluator, drawn_capture, tmp_path):
    """Another size changes nothing for the other cameras; for itself, errors are those of the cut pictures."""
    capture = with_small_camera(drawn_capture, tmp_path / "copy", "right", 31, 44)
    cut = dataclasses.replace(loaded, capture=capture).evaluator()
    names, batch = ["right", "back"], evaluator.reader.read([2], [["right", "back"]])
    drawn = evaluator.draw("avatar", batch)
    images, references, masks = (values.numpy()[:, :, :44, :31] for values in (drawn.images, batch.images, batch.masks))
    rows = {
        name: cut.measure({"train": [2]}, ["avatar"], [name], measures=EVERY_MEASURE).means()["avatar"]["train"]["seen"] for name in names
    }
    expected = protocol_metrics(images[0].transpose(1, 2, 0), references[0].transpose(1, 2, 0), masks[0, 0])
    for metric, value in expected.items():
        assert rows["right"][metric] == pytest.approx(value, rel=0.05), metric
    whole = evaluator.measure({"train": [2]}, ["avatar"], ["back"]).means()["avatar"]["train"]["seen"]
    assert rows["back"]["psnr"] == pytest.approx(whole["psnr"], rel=1e-5)
    flicker = cut.measure_flicker({"train": [2]}, ["nearest_frame"], names).means()["nearest_frame"]["train"]["seen"]
    assert flicker["images"] == 2 and np.isfinite(flicker["flicker"])


def test_cameras_and_splits_are_told_apart(evaluator):
    calls = []
    means = evaluator.measure(
        {"train": [0], "test": [8, 9]}, ["template_mean_texture"], progress=lambda done, total: calls.append((done, total))
    ).means()["template_mean_texture"]
    images = {(split, cameras): values["images"] for split, group in means.items() for cameras, values in group.items()}
    assert images == {("train", "seen"): 4, ("train", "held_out"): 1, ("test", "seen"): 8, ("test", "held_out"): 2}
    assert calls == [(1, 3), (2, 3), (3, 3)]


def test_cameras_that_see_nobody_are_left_out(evaluator, monkeypatch):
    read = evaluator.reader.read

    def without_person(frames, camera_names):
        batch = read(frames, camera_names)
        batch.masks[1] = 0
        return batch

    monkeypatch.setattr(evaluator.reader, "read", without_person)
    means = evaluator.measure({"test": [8]}, ["avatar"], VIEWS).means()
    assert list(means["avatar"]["test"]) == ["seen"] and means["avatar"]["test"]["seen"]["images"] == 2


def test_frames_of_a_split_are_spread_evenly(evaluator):
    assert evaluator.split_frames(3) == {"train": [0, 4, 7], "test": [8, 9]}


def test_every_measure_has_its_name_and_the_pictures_add_up(evaluator, tmp_path):
    metrics = evaluator.measure({"test": [8, 9]}, ["avatar", "nearest_frame"], VIEWS, measures=EVERY_MEASURE)
    means = metrics.means()
    names = {f"{protocol}{name}" for protocol in ("", "image_", "box_") for name in ("psnr", "ssim", "l1", "mse", "flip")}
    assert set(means["avatar"]["test"]["seen"]) == names | {"iou", "vertex_mm", "seam", "images"}
    assert set(means["nearest_frame"]["test"]["seen"]) == names | {"iou", "vertex_mm", "images"}
    batch = evaluator.reader.read([8], [VIEWS])
    metrics.save_pictures(tmp_path / "metrics.csv")
    rows = [row for row in load_pictures(tmp_path / "metrics.csv") if row["method"] == "avatar" and row["camera"] != HELD_OUT]
    assert [(row["camera"], row["frame"]) for row in rows] == [("left", 28), ("front", 28), ("left", 29), ("front", 29)]
    assert np.mean([row["box_flip"] for row in rows]) == pytest.approx(means["avatar"]["test"]["seen"]["box_flip"], rel=1e-4)
    texture = evaluator.draw("avatar", batch).texture
    assert rows[0]["seam"] == pytest.approx(SeamSampler(evaluator.renderer.topology).difference(texture), rel=1e-4)


def test_flicker_compares_neighbours_of_one_segment(evaluator):
    """Frame 8 looks forwards, frame 9 is the segment's last and looks back: both are the same pair."""
    metrics = evaluator.measure_flicker({"test": [8, 9], "train": [2]}, ["avatar", "nearest_frame"], ["left"])
    means = metrics.means()["avatar"]
    pictures, references, masks = [], [], []
    for index in (8, 9):
        batch = evaluator.reader.read([index], [["left"]])
        pictures.append(as_images(evaluator.draw("avatar", batch).images)[0])
        references.append(as_images(batch.images)[0])
        masks.append(batch.masks[0, 0].numpy())
    assert means["test"]["seen"]["flicker"] == pytest.approx(temporal_flicker(*map(np.stack, (pictures, references, masks))), rel=1e-5)
    assert means["test"]["seen"]["images"] == 2 and means["train"]["seen"]["images"] == 1
