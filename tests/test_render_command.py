"""`python -m mitsuba_avatar.render`: pictures, EXR layers and video of a finished run."""

import json
import shutil

import av
import numpy as np
import OpenEXR
import pytest
import trimesh

from mitsuba_avatar.captures.colour import encode
from mitsuba_avatar.captures.images import read_image
from mitsuba_avatar.render import main
from tests.drawn_capture import HEIGHT, HELD_OUT, WIDTH

pytestmark = pytest.mark.usefixtures("one_thread")


def test_held_out_cameras_as_pictures(fitted_run, private_cache, drawn_capture, tmp_path, capsys):
    assert main([str(fitted_run), "--path", "held_out", "--frames", "2", "--output", str(tmp_path / "out")]) == 0
    assert capsys.readouterr().out.strip() == str(tmp_path / "out")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [f"{HELD_OUT}_000028.png", f"{HELD_OUT}_000029.png"]
    for index in (8, 9):
        picture = read_image(tmp_path / f"out/{HELD_OUT}_0000{20 + index}.png").astype(np.float32) / 255
        mask = drawn_capture.mask(HELD_OUT, index)
        assert picture.shape == (HEIGHT, WIDTH, 3)
        reference = encode(drawn_capture.image(HELD_OUT, index), "srgb")
        assert np.abs(picture - reference)[mask == 1].mean() < 0.06, "the avatar stands where the person stood"
        assert np.ptp(picture[mask == 0], axis=1).mean() < 0.05, "the backdrop is grey"


def test_an_orbit_as_layers(fitted_run, private_cache, tmp_path):
    words = ("--format", "exr", "--frames", "3", "--width", "30", "--height", "44", "--split", "train")
    assert main([str(fitted_run), *words, "--output", str(tmp_path / "out")]) == 0
    paths = sorted((tmp_path / "out").iterdir())
    assert [path.name for path in paths] == ["orbit_0000_000020.exr", "orbit_0001_000022.exr", "orbit_0002_000025.exr"]
    channels = OpenEXR.File(str(paths[1]), separate_channels=True).channels()
    mask = next(np.asarray(channel.pixels, np.float32) for name, channel in channels.items() if "mask" in name.lower() or name == "A")
    assert mask.shape == (44, 30) and 0.02 < mask.mean() < 0.6 and mask.max() == pytest.approx(1, abs=1e-3)
    edge = np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]])
    assert edge.max() == 0, "the whole body is in view"


def test_posed_meshes(fitted_run, private_cache, tmp_path):
    words = ("--format", "ply", "--frames", "2", "--width", "30", "--height", "44", "--split", "train")
    assert main([str(fitted_run), *words, "--output", str(tmp_path / "out")]) == 0
    first, second = (trimesh.load(path, process=False) for path in sorted((tmp_path / "out").iterdir()))
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


def test_held_out_cameras_of_several_sizes_cannot_share_a_film(fitted_run, drawn_capture, private_cache, tmp_path, capsys):
    """A driving capture needs neither images nor masks, so only the cameras themselves tell."""
    shutil.copytree(drawn_capture.path, tmp_path / "copy", ignore=shutil.ignore_patterns("*.png"))
    document = json.loads((tmp_path / "copy/cameras.json").read_text())
    document["cameras"][0]["width"] = 64
    (tmp_path / "copy/cameras.json").write_text(json.dumps(document))
    description = tmp_path / "copy/capture.yaml"
    description.write_text(description.read_text().replace(f"- {HELD_OUT}", f"- {HELD_OUT}\n- front"))
    assert main([str(fitted_run), "--path", "held_out", "--capture", str(tmp_path / "copy")]) == 2
    assert "expected held-out cameras of one image size" in capsys.readouterr().err
    words = ("--frames", "1", "--width", "30", "--height", "44", "--output", str(tmp_path / "out"))
    assert main([str(fitted_run), "--capture", str(tmp_path / "copy"), *words]) == 0


def test_a_place_that_cannot_be_written_is_one_line(fitted_run, private_cache, tmp_path, capsys):
    (tmp_path / "file").write_text("not a folder")
    assert main([str(fitted_run), "--frames", "1", "--output", str(tmp_path / "file/out")]) == 2
    assert f"expected a folder at {tmp_path}/file/out; got {tmp_path}/file, which is a file" in capsys.readouterr().err
