"""`python -m mitsuba_avatar.export`: a finished run in formats of other programs, and what it says about bad input."""

import json

import numpy as np
import pytest
import trimesh
from PIL import Image

from mitsuba_avatar.captures.colour import encode
from mitsuba_avatar.export import main
from mitsuba_avatar.reporting.exr import read_exr

pytestmark = pytest.mark.usefixtures("one_thread")


def test_everything_at_once(fitted_run, private_cache, tmp_path, capsys):
    words = ("--format", "glb", "obj", "ply", "textures", "--split", "train", "--frames", "3", "--texture", "albedo")
    assert main([str(fitted_run), *words, "--out", str(tmp_path / "out")]) == 0
    out = capsys.readouterr().out
    assert "skinning with 4 joints a vertex: 0.00 mm" in out and out.rstrip().endswith(str(tmp_path / "out"))
    names = {str(path.relative_to(tmp_path / "out")) for path in (tmp_path / "out").rglob("*") if path.is_file()}
    frames = {f"{kind}/{number:06d}.{kind}" for kind in ("obj", "ply") for number in (20, 21, 22)}
    textures = {f"textures/{name}.{kind}" for name in ("radiance", "albedo") for kind in ("png", "exr")}
    assert names == frames | textures | {"avatar.glb", "avatar.json", "obj/avatar.mtl", "obj/avatar.png"}
    facts = json.loads((tmp_path / "out/avatar.json").read_text())
    assert facts["frames"] == 3 and len(facts["costs_mm"]) == 3
    linear = read_exr(tmp_path / "out/textures/albedo.exr")["colour"]
    with Image.open(tmp_path / "out/textures/albedo.png") as picture:
        np.testing.assert_allclose(np.asarray(picture) / 255, encode(linear, "srgb"), atol=0.5 / 255 + 1e-4)
    (mesh,) = trimesh.load(str(tmp_path / "out/avatar.glb"), process=False).geometry.values()
    with Image.open(tmp_path / "out/obj/avatar.png") as picture:
        np.testing.assert_array_equal(np.asarray(mesh.visual.material.baseColorTexture.convert("RGB")), np.asarray(picture.convert("RGB")))


def test_meshes_alone_need_no_texture(fitted_run, private_cache, tmp_path):
    assert main([str(fitted_run), "--format", "ply", "--frames", "1", "--out", str(tmp_path / "out")]) == 0
    assert [path.name for path in (tmp_path / "out").rglob("*.*")] == ["000028.ply"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--frames", "-1"], "expected --frames of at least 1"),
        (["--capture", "/nowhere"], "/nowhere; got none"),
        (["--face-shapes", "actions", "--format", "glb", "--frames", "1"], "'small' has none"),
        (["--pose-shapes", "-1"], "pose_shapes >= 0"),
        (["--texture", "albedo", "--captured-light", "moon"], "got 'moon'"),
        (["--out", "/dev/null/out"], "got /dev/null, which is a file"),
    ],
)
def test_bad_input_is_one_line(fitted_run, private_cache, tmp_path, capsys, words, message):
    output = () if "--out" in words else ("--out", str(tmp_path / "out"))
    assert main([str(fitted_run), *words, *output]) == 2
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("export: ")]
    assert message in line
