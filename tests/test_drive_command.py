"""`python -m mitsuba_avatar.drive`: video, pictures and report of a driven run, and what it says about bad input."""

import json
import shutil

import av
import numpy as np
import pytest
import torch

from mitsuba_avatar.captures.images import read_image
from mitsuba_avatar.drive import main
from tests.drawn_capture import HEIGHT, WIDTH, copy_with_a_wider_held_out_camera

pytestmark = pytest.mark.usefixtures("one_thread")

SMALL = ("--width", "30", "--height", "44")


def frames_of(path) -> list[np.ndarray]:
    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


def test_the_test_split_drives_as_a_video_with_a_report(fitted_run, private_cache, tmp_path, capsys):
    out = tmp_path / "out"
    assert main([str(fitted_run), *SMALL, "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "setting: matched" in printed and "all 5 angles of 2 frames were in range" in printed
    assert "decoding" in printed and "rendering" in printed and printed.strip().endswith(str(out))
    frames = frames_of(out / "drive.mp4")
    assert len(frames) == 2 and frames[0].shape == (44, 30, 3)
    assert sorted(path.name for path in out.iterdir()) == ["drive.json", "drive.mp4", "overview.png"]
    facts = json.loads((out / "drive.json").read_text())
    assert facts["frames"] == 2 and facts["setting"] == "matched" and facts["range"]["changed_frames"] == 0
    assert facts["frames_per_second"]["decoding"] > 0 and facts["frames_per_second"]["rendering"] > 0


def test_held_out_cameras_see_the_driven_person_where_the_capture_has_it(fitted_run, drawn_capture, private_cache, tmp_path):
    words = ("--path", "held_out", "--format", "png", "--split", "test")
    assert main([str(fitted_run), *words, "--out", str(tmp_path / "out")]) == 0
    (name,) = drawn_capture.camera_names(held_out=True)
    for row, index in enumerate((8, 9)):
        picture = read_image(tmp_path / f"out/{row:06d}.png").astype(np.float32) / 255
        mask = drawn_capture.mask(name, index)
        assert picture.shape == (HEIGHT, WIDTH, 3)
        assert np.abs(picture - drawn_capture.display_image(name, index))[mask == 1].mean() < 0.06


def test_held_out_cameras_of_several_sizes_make_one_video_and_pictures_of_their_own(fitted_run, drawn_capture, private_cache, tmp_path):
    copy_with_a_wider_held_out_camera(drawn_capture, tmp_path / "copy")
    words = ("--pose", str(tmp_path / "copy"), "--path", "held_out", "--format", "png", "mp4", "--split", "test")
    assert main([str(fitted_run), *words, "--out", str(tmp_path / "out")]) == 0
    assert [read_image(tmp_path / f"out/{row:06d}.png").shape for row in (0, 1)] == [(HEIGHT, 64, 3), (HEIGHT, WIDTH, 3)]
    assert [frame.shape for frame in frames_of(tmp_path / "out/drive.mp4")] == 2 * [(HEIGHT, 64, 3)]


def test_what_has_no_cameras_is_seen_by_the_held_out_ones_of_the_run_s_capture(fitted_run, drawn_capture, private_cache, tmp_path):
    np.save(tmp_path / "theta.npy", np.array(drawn_capture.theta[:1]))
    words = ("--pose", str(tmp_path / "theta.npy"), "--path", "held_out", "--format", "png")
    assert main([str(fitted_run), *words, "--out", str(tmp_path / "out")]) == 0
    assert read_image(tmp_path / "out/000000.png").shape == (HEIGHT, WIDTH, 3)


def test_arrays_out_of_range_are_held_or_projected_and_reported(fitted_run, drawn_capture, private_cache, tmp_path, capsys):
    theta = np.array(drawn_capture.theta[:3])
    theta[1, 2] = 2.2 + 0.5  # the elbow bends no farther than 2.2
    np.save(tmp_path / "theta.npy", theta)
    shutil.copytree(fitted_run, tmp_path / "run")
    words = (str(tmp_path / "run"), "--pose", str(tmp_path / "theta.npy"), *SMALL, "--format", "png")
    pictures = {}
    for name in ("none", "clamp", "project"):
        assert main([*words, "--range", name, "--out", str(tmp_path / name)]) == 0
        printed = capsys.readouterr().out
        pictures[name] = read_image(tmp_path / name / "000001.png").astype(float)
        assert "setting: unmatched" in printed and "no root.npy beside theta.npy" in printed and "mean of the training frames" in printed
        assert ("clamped to the rig's limits: changed 1 of 5 angles in 1 of 3 frames, by 28.6 degrees" in printed) == (name == "clamp")
        assert ("projected onto the training poses: changed" in printed) == (name == "project")
    assert np.abs(pictures["none"] - pictures["clamp"]).mean() > 0.2
    assert (tmp_path / "run/latents").is_dir(), "what the projection needed is kept with the run"


def test_imputations_change_the_picture_and_the_temporal_model_is_kept(fitted_run, private_cache, tmp_path, capsys):
    shutil.copytree(fitted_run, tmp_path / "run")
    words = (str(tmp_path / "run"), *SMALL, "--format", "png")
    pictures = {}
    for name in ("zero", "prior", "nearest", "temporal"):
        assert main([*words, "--imputation", name, "--out", str(tmp_path / name)]) == 0
        pictures[name] = read_image(tmp_path / name / "000001.png").astype(float)
    assert "temporal model: " in capsys.readouterr().out
    assert np.abs(pictures["zero"] - pictures["prior"]).max() > 2
    names = sorted(path.name for path in (tmp_path / "run/latents").iterdir())
    assert names == ["temporal_000040.npz", "training_000040.npz"]
    np.save(tmp_path / "z.npy", np.zeros((2, 3), np.float32))
    assert main([*words, "--latents", str(tmp_path / "z.npy"), "--out", str(tmp_path / "given")]) == 2
    assert "drive: expected latent codes [N, " in capsys.readouterr().err


@pytest.mark.parametrize("path", ["orbit", "turntable", "spiral"])
def test_cameras_go_around(fitted_run, private_cache, tmp_path, path):
    words = ("--path", path, *SMALL, "--format", "png", "--split", "train", "--seconds", "0.3")
    assert main([str(fitted_run), *words, "--out", str(tmp_path / "out")]) == 0
    first, second = (read_image(tmp_path / f"out/00000{row}.png").astype(float) for row in (0, 1))
    assert np.abs(first - second).mean() > 2
    for picture in (first, second):
        edge = np.concatenate([picture[0], picture[-1], picture[:, 0], picture[:, -1]])
        assert np.ptp(edge, axis=0).max() < 12, "the whole body is in view"


def test_the_decoder_alone_is_exported(fitted_run, private_cache, tmp_path, capsys):
    path = tmp_path / "decoder.pt2"
    assert main([str(fitted_run), "--export-decoder", str(path)]) == 0
    assert capsys.readouterr().out.strip() == str(path)
    from mitsuba_avatar.driving.decoder_export import example_inputs
    from mitsuba_avatar.training.run_folder import RunFolder

    avatar = RunFolder.open(fitted_run).load_avatar("last")
    theta, root, face, z, center, share = example_inputs(avatar, 1, seed=3)
    with torch.no_grad():
        vertices, texture = torch.export.load(path).module()(theta, root, face, z, center, share)
        ours = avatar.decode(theta, root, face, z, center[:, None], share)
    torch.testing.assert_close(vertices, ours.vertices, atol=1e-6, rtol=0)
    torch.testing.assert_close(texture, ours.textures[:, 0], atol=1e-6, rtol=0)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--pose", "/gone.bvh"], "expected a BVH file at /gone.bvh; there is none"),
        (["--face", "/gone.csv"], "expected a CSV file at /gone.csv; there is none"),
        (["--latents", "/gone.npy"], "/gone.npy"),
        (["--checkpoint", "newest"], "expected --checkpoint best or last; got 'newest'"),
        (["--width", "0"], "0x540"),
        (["--export-decoder", "decoder.onnx"], "ends in .pt2"),
        (["--out", "/dev/null/out"], "got /dev/null, which is a file"),
    ],
)
def test_bad_input_is_one_line(fitted_run, private_cache, tmp_path, capsys, words, message):
    assert main([str(fitted_run), "--out", str(tmp_path / "out"), *words]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("drive: ") and message in line


def test_action_codes_cannot_drive_an_avatar_whose_rig_has_no_facial_actions(fitted_run, private_cache, tmp_path, capsys):
    (tmp_path / "codes.csv").write_text("jawOpen\n0.5\n0.1\n")
    assert main([str(fitted_run), "--face", str(tmp_path / "codes.csv"), *SMALL, "--out", str(tmp_path / "out")]) == 2
    assert "'small' has no facial actions that tie the two" in capsys.readouterr().err
