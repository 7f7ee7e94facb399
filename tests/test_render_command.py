"""`python -m mitsuba_avatar.render`: pictures, EXR layers and video of a finished run."""

import json
import os
import shutil
import signal

import av
import numpy as np
import pytest
import trimesh
from PIL import Image

from mitsuba_avatar.captures.colour import encode
from mitsuba_avatar.captures.images import read_image
from mitsuba_avatar.render import main
from mitsuba_avatar.reporting.exr import read_exr
from tests.drawn_capture import HEIGHT, HELD_OUT, WIDTH, copy_with_a_wider_held_out_camera

pytestmark = pytest.mark.usefixtures("one_thread")


def test_held_out_cameras_as_pictures(fitted_run, private_cache, drawn_capture, tmp_path, capsys):
    assert main([str(fitted_run), "--path", "held_out", "--frames", "2", "--out", str(tmp_path / "out")]) == 0
    assert capsys.readouterr().out.strip() == str(tmp_path / "out")
    assert sorted(path.name for path in (tmp_path / "out").glob("*.png")) == [f"{HELD_OUT}_000028.png", f"{HELD_OUT}_000029.png"]
    for index in (8, 9):
        picture = read_image(tmp_path / f"out/{HELD_OUT}_0000{20 + index}.png").astype(np.float32) / 255
        mask = drawn_capture.mask(HELD_OUT, index)
        assert picture.shape == (HEIGHT, WIDTH, 3)
        reference = encode(drawn_capture.image(HELD_OUT, index), "srgb")
        assert np.abs(picture - reference)[mask == 1].mean() < 0.06, "the avatar stands where the person stood"
        assert np.ptp(picture[mask == 0], axis=1).mean() < 0.05, "the backdrop is grey"


def test_an_orbit_as_layers(fitted_run, private_cache, tmp_path):
    words = ("--format", "exr", "--frames", "3", "--width", "30", "--height", "44", "--split", "train")
    assert main([str(fitted_run), *words, "--out", str(tmp_path / "out")]) == 0
    paths = sorted((tmp_path / "out").glob("*.exr"))
    assert [path.name for path in paths] == ["orbit_0000_000020.exr", "orbit_0001_000022.exr", "orbit_0002_000025.exr"]
    layers = read_exr(paths[1])
    assert set(layers) == {"colour", "depth", "normal", "position", "uv", "albedo", "ambient_occlusion", "mask"}
    mask = layers["mask"]
    np.testing.assert_array_equal(mask, layers["colour"][..., 3])
    inside = mask == 1
    assert 0.5 < layers["ambient_occlusion"][inside].mean() <= 1 and layers["depth"][inside].min() > 0.5
    colour = layers["colour"][inside][:, :3]
    assert np.abs(layers["albedo"][inside] - colour).mean() < 0.3 * colour.mean(), "uniform light: albedo is radiance, but for occlusion"
    assert mask.shape == (44, 30) and 0.02 < mask.mean() < 0.6 and mask.max() == pytest.approx(1, abs=1e-3)
    edge = np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]])
    assert edge.max() == 0, "the whole body is in view"


def test_posed_meshes(fitted_run, private_cache, tmp_path):
    words = ("--format", "ply", "--frames", "2", "--width", "30", "--height", "44", "--split", "train")
    assert main([str(fitted_run), *words, "--out", str(tmp_path / "out")]) == 0
    first, second = (trimesh.load(path, process=False) for path in sorted((tmp_path / "out").glob("*.ply")))
    assert first.vertices.shape == second.vertices.shape == (258, 3) and len(first.faces) > 400
    assert np.abs(first.vertices - second.vertices).max() > 1e-3


def test_an_orbit_as_video(fitted_run, private_cache, tmp_path, capsys):
    shutil.copytree(fitted_run, tmp_path / "run")
    assert main([str(tmp_path / "run"), "--format", "mp4", "--frames", "4", "--width", "30", "--height", "44"]) == 0
    assert capsys.readouterr().out.strip() == str(tmp_path / "run/renders/orbit.mp4")
    with av.open(str(tmp_path / "run/renders/orbit.mp4")) as container:
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert len(frames) == 4 and frames[0].shape == (44, 30, 3)
    assert np.abs(frames[0].astype(float) - frames[2]).mean() > 1, "the camera moves"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--frames", "0"], "expected --frames of at least 1; got 0"),
        (["--scene", "moonbase"], "got 'moonbase'"),
        (["--path", "keyframes"], "expected --file with --path keyframes or cameras"),
        (["--path", "cameras", "--file", "/none.json"], "expected a camera file at /none.json"),
        (["--noise", "0.1"], "--noise and --seconds are for path tracing"),
        (["--scene", "dome", "--noise", "0.1", "--seconds", "1"], "not both"),
        (["--hold", "7"], "expected a frame number 20..29"),
        (["--play", "25"], "expected 24 frames from number 25 on"),
        (["--only", "24"], "expected pictures 0..23"),
        (["--shard", "2/2"], "--shard i/n"),
        (["--format", "mp4", "--backdrop", "None"], "a video has no transparency"),
        (["--capture", "/nowhere"], "/nowhere; got none"),
        (["--width", "0"], "0x540"),
        (["--checkpoint", "first"], "'best' or 'last'"),
    ],
)
def test_bad_input_is_one_line(fitted_run, private_cache, capsys, words, message):
    assert main([str(fitted_run), *words]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("render: ") and message in line


def test_a_capture_without_held_out_cameras_has_none_to_render(fitted_run, drawn_capture, private_cache, tmp_path, capsys):
    shutil.copytree(drawn_capture.path, tmp_path / "copy")
    description = tmp_path / "copy/capture.yaml"
    description.write_text(description.read_text().replace(f"held_out_cameras:\n- {HELD_OUT}", "held_out_cameras: []"))
    assert main([str(fitted_run), "--path", "held_out", "--capture", str(tmp_path / "copy")]) == 2
    assert "has no held-out cameras. Use --path orbit" in capsys.readouterr().err


def test_held_out_cameras_of_several_sizes_keep_them_and_meet_in_the_video(fitted_run, drawn_capture, private_cache, tmp_path):
    """The smaller camera sees what it sees alone; in the video it is centred on the backdrop."""
    copy_with_a_wider_held_out_camera(drawn_capture, tmp_path / "copy")
    words = ("--capture", str(tmp_path / "copy"), "--path", "held_out", "--frames", "2", "--hold", "29", "--format", "mp4", "exr")
    assert main([str(fitted_run), *words, "--out", str(tmp_path / "out")]) == 0
    names = ("front_000029", f"{HELD_OUT}_000029")
    pictures = [read_image(tmp_path / f"out/{name}.png") for name in names]
    assert [picture.shape for picture in pictures] == [(HEIGHT, 64, 3), (HEIGHT, WIDTH, 3)] and WIDTH != 64
    assert [len(np.unique(picture)) > 20 for picture in pictures] == [True, True], "both see somebody"
    assert [read_exr(tmp_path / f"out/{name}.exr")["depth"].shape for name in names] == [picture.shape[:2] for picture in pictures]
    with av.open(str(tmp_path / "out.mp4")) as container:
        frames = [frame.to_ndarray(format="rgb24").astype(int) for frame in container.decode(video=0)]
    assert [frame.shape for frame in frames] == 2 * [(HEIGHT, 64, 3)]
    margin = (64 - WIDTH) // 2
    assert np.abs(frames[1][:, margin : margin + WIDTH] - pictures[1]).mean() < 4, "the smaller picture is in the middle"
    assert np.abs(frames[1][:, : margin - 2] - pictures[1][0, 0]).max() < 8, "on the backdrop"


def test_a_place_that_cannot_be_written_is_one_line(fitted_run, private_cache, tmp_path, capsys):
    (tmp_path / "file").write_text("not a folder")
    assert main([str(fitted_run), "--frames", "1", "--out", str(tmp_path / "file/out")]) == 2
    assert f"expected a folder at {tmp_path}/file/out; got {tmp_path}/file, which is a file" in capsys.readouterr().err


SMALL = ("--frames", "4", "--width", "30", "--height", "44")
IN_A_SCENE = ("--scene", "half_lit", "--samples", "16", "--captured-light", "uniform")


@pytest.mark.parametrize("scene", [(), IN_A_SCENE], ids=["surface", "path_traced"])
def test_a_picture_drawn_alone_has_the_same_bytes(fitted_run, private_cache, tmp_path, scene):
    """Also in another order: the last one first."""
    words = (str(fitted_run), "--path", "spiral", "--format", "exr", "png", "--frames", "3", *SMALL[2:], *scene)
    for part in ((), ("--only", "2"), ("--shard", "0/1")):
        assert main([*words, *part, "--out", str(tmp_path / ("all" if not part else "parts"))]) == 0
    names = sorted(path.name for path in (tmp_path / "all").iterdir())
    assert len(names) == 7 and names == sorted(path.name for path in (tmp_path / "parts").iterdir())
    for name in names:
        assert (tmp_path / "all" / name).read_bytes() == (tmp_path / "parts" / name).read_bytes(), name


def test_what_exists_is_kept_and_other_settings_are_refused(fitted_run, private_cache, tmp_path, capsys):
    words = (str(fitted_run), *SMALL, "--out", str(tmp_path / "out"))
    assert main([*words]) == 0
    paths = sorted((tmp_path / "out").glob("*.png"))
    paths[1].unlink()
    paths[2].write_bytes(b"somebody's own")
    assert main([*words]) == 0 and paths[1].exists() and paths[2].read_bytes() == b"somebody's own"
    assert main([*words, "--exposure", "1"]) == 2
    assert "expected pictures with exposure = 0.0" in capsys.readouterr().err
    assert main([*words, "--exposure", "1", "--overwrite"]) == 0 and paths[2].read_bytes() != b"somebody's own"


def test_relit_from_the_side_the_lamps_are_on(fitted_run, private_cache, tmp_path):
    """half_lit shines from +x: orbit pictures 1 (from +x) and 3 (from -x) differ; baked light and a turntable do not."""
    means = {}
    for path, light in (("orbit", "relit"), ("orbit", "baked"), ("turntable", "relit")):
        out = tmp_path / path / light
        words = ("--path", path, "--light", light, "--hold", "24", "--format", "exr", *IN_A_SCENE, *SMALL, "--out", str(out))
        assert main([str(fitted_run), *words]) == 0
        colours = [read_exr(file)["colour"] for file in sorted(out.glob("*.exr"))]
        means[path, light] = [float(colour[colour[..., 3] == 1][:, :3].mean()) for colour in colours]
    assert means["orbit", "relit"][1] > 3 * means["orbit", "relit"][3]
    assert means["orbit", "baked"][1] < 2 * means["orbit", "baked"][3]
    assert means["turntable", "relit"][1] < 2 * means["turntable", "relit"][3], "the camera and the lamps stand still"


def test_a_time_budget_is_settled_once(fitted_run, private_cache, tmp_path):
    words = (str(fitted_run), *SMALL, "--scene", "dome", "--light", "baked", "--seconds", "0.05", "--out", str(tmp_path / "out"))
    assert main([*words, "--only", "0"]) == 0
    settled = json.loads((tmp_path / "out/render.json").read_text())["settled"]
    assert settled["samples"] % 16 == 0 and settled["samples"] > 0
    assert main([*words]) == 0 and json.loads((tmp_path / "out/render.json").read_text())["settled"] == settled
    assert len(list((tmp_path / "out").glob("*.png"))) == 4


def test_cameras_and_key_frames_of_files(fitted_run, private_cache, drawn_capture, tmp_path):
    cameras = ("--path", "cameras", "--file", str(drawn_capture.path / "cameras.json"), "--frames", "2", "--play", "22")
    assert main([str(fitted_run), *cameras, "--out", str(tmp_path / "cameras")]) == 0
    assert sorted(path.name for path in (tmp_path / "cameras").glob("*.png")) == ["front_000022.png", "right_000023.png"]
    key = "{time: 0, position: [0, -2, 0.5], target: [0, 0, 0.3], field_of_view: 30}"
    (tmp_path / "keys.yaml").write_text(f"keyframes: [{key}]")
    keys = ("--path", "keyframes", "--file", str(tmp_path / "keys.yaml"), "--backdrop", "None", "--frames", "1", *SMALL[2:])
    assert main([str(fitted_run), *keys, "--out", str(tmp_path / "keys")]) == 0
    with Image.open(tmp_path / "keys/keyed_0000_000028.png") as picture:
        alpha = np.asarray(picture)[..., 3]
    assert alpha.shape == (44, 30) and alpha.max() == 255 and alpha.min() == 0


def test_a_video_waits_for_the_other_shard(fitted_run, private_cache, tmp_path, capsys):
    words = (str(fitted_run), "--format", "mp4", *SMALL, "--out", str(tmp_path / "out"))
    assert main([*words, "--shard", "1/2"]) == 0
    assert "waits for 2 pictures" in capsys.readouterr().err and not (tmp_path / "out.mp4").exists()
    assert main([*words, "--shard", "0/2"]) == 0 and (tmp_path / "out.mp4").exists()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_killed_render_leaves_whole_files_and_goes_on(fitted_run, private_cache, tmp_path, capsys, monkeypatch, number):
    """The signal comes while the third picture's bytes are written."""
    out, save, saved = tmp_path / "out", Image.Image.save, []

    def killed_in_the_third(picture, target, *arguments, **options):
        saved.append(target)
        save(picture, target, *arguments, **options)
        if len(saved) == 3:
            os.truncate(target, os.path.getsize(target) // 2)
            os.kill(os.getpid(), number)

    words = [str(fitted_run), *SMALL, "--out", str(out)]
    with monkeypatch.context() as patch:
        patch.setattr(Image.Image, "save", killed_in_the_third)
        assert main(words) == 130
    assert "render: interrupted; finished pictures are kept. Give the same command again to go on." in capsys.readouterr().err
    left = {path.name: path.read_bytes() for path in out.iterdir()}
    times = {name: (out / name).stat().st_mtime_ns for name in left}
    assert len([name for name in left if name.endswith(".png")]) == 2 and not [name for name in left if name.startswith(".")]
    assert main(words) == 0
    pictures = sorted(out.glob("*.png"))
    assert len(pictures) == 4 and {read_image(path).shape for path in pictures} == {(44, 30, 3)}
    assert all((out / name).stat().st_mtime_ns == times[name] for name in left if name.endswith(".png")), "they are not drawn again"


def test_a_missing_codec_is_one_line_and_the_pictures_stay(fitted_run, private_cache, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("mitsuba_avatar.reporting.video._CODEC", "h000")
    assert main([str(fitted_run), "--format", "mp4", *SMALL, "--out", str(tmp_path / "out")]) == 2
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("render: ")]
    assert "h000" in line and len(list((tmp_path / "out").glob("*.png"))) == 4 and not (tmp_path / "out.mp4").exists()
