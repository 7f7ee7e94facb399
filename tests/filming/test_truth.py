import json
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

import mitsuba_avatar.filming.path_integrator  # noqa: F401 - registers what the scene names
from mitsuba_avatar.captures.images import read_image, read_mask
from mitsuba_avatar.filming.appearance import Appearance
from mitsuba_avatar.filming.grids import grid_topology
from mitsuba_avatar.filming.sensor import Sensor
from mitsuba_avatar.filming.settings import CameraSettings, LightSettings, StudioSettings
from mitsuba_avatar.filming.stage import Layer
from mitsuba_avatar.filming.truth import GARMENT, OcclusionTruth, copy_scene, write_truth
from tests.filming.posed_body import PosedBody, posed_body


@pytest.fixture(scope="module")
def posed() -> PosedBody:
    return posed_body()


def test_paint_sensors_and_light_are_kept(tmp_path: Path):
    settings = StudioSettings(cameras=CameraSettings(train=2, held_out=1, colour_spread=0.1), light=LightSettings(scene="half_lit"))
    rng = np.random.default_rng(0)
    paint = Appearance(rng.uniform(0.1, 0.7, (8, 8, 3)).astype(np.float32), rng.uniform(0.2, 1, (8, 8)).astype(np.float32))
    write_truth(tmp_path, [Layer("shirt", grid_topology(2, 2), paint)], np.array([4, 9]), ["a", "b", "c"], settings)
    assert np.load(tmp_path / "truth" / GARMENT).tolist() == [4, 9]
    np.testing.assert_array_equal(read_image(tmp_path / "truth" / "shirt" / "albedo.exr"), paint.base_colour)
    np.testing.assert_array_equal(read_image(tmp_path / "truth" / "shirt" / "roughness.exr")[..., 1], paint.roughness)
    kept = json.loads((tmp_path / "truth" / "sensors.json").read_text())
    np.testing.assert_array_equal(kept["responses"]["c"], Sensor.of(settings).responses[2])
    scene = mi.load_file(str(tmp_path / "truth" / "light" / "half_lit.xml"))
    assert scene.environment() is not None


def test_a_scene_with_files_out_of_reach_is_refused(tmp_path: Path):
    scene = tmp_path / "scenes" / "lost.xml"
    scene.parent.mkdir()
    text = '<scene version="3.0.0"><emitter type="envmap"><string name="filename" value="{}"/></emitter></scene>'
    scene.write_text(text.format("gone.exr"))
    with pytest.raises(FileNotFoundError, match=r"copy_scene\(\): expected .*gone.exr"):
        copy_scene(scene, tmp_path / "copy")
    (tmp_path / "outside.exr").write_bytes(b"")
    scene.write_text(text.format("../outside.exr"))
    with pytest.raises(ValueError, match=r"copy_scene\(\): expected the files of"):
        copy_scene(scene, tmp_path / "copy")


def test_occlusion_of_a_frame_is_a_map_in_the_bodys_atlas(posed: PosedBody, tmp_path: Path):
    truth = OcclusionTruth(tmp_path, posed.rig.topology, 64)
    truth.write(3, posed.vertices[3])
    path = tmp_path / "truth" / "ambient_occlusion" / "000003.png"
    occlusion = read_mask(path)
    assert occlusion.shape == (64, 64) and 0.4 < occlusion.mean() / 255 < 0.98 and np.ptp(occlusion) > 100
    stamp = path.stat().st_mtime_ns
    truth.write(3, posed.vertices[5])
    assert path.stat().st_mtime_ns == stamp
