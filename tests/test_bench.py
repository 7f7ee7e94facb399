"""The bench on a small rig and small films: its rows, its table, its figure."""

import json

import pytest
from PIL import Image

from mitsuba_avatar import bench
from mitsuba_avatar.body import anny_rig
from tests.small_rig import make_small_rig


@pytest.fixture
def small(monkeypatch, request):
    monkeypatch.setattr(anny_rig, "build_anny_rig", make_small_rig)
    monkeypatch.setattr(bench, "SIZES", ((40, 30),))
    monkeypatch.setattr(bench, "BATCHES", ((1, 1), (4, 2)))
    monkeypatch.setattr(bench, "OCCLUSION_SIZE", 32)
    return ["--variant", request.config.getoption("variant"), "--rounds", "1"]


def test_rows_and_table(small, tmp_path, capsys):
    assert bench.main([*small, "--json", str(tmp_path / "rows.json")]) == 0
    rows = json.loads((tmp_path / "rows.json").read_text())
    assert [(row["width"], row["height"], row["views"], row["meshes"]) for row in rows] == [(40, 30, 1, 1), (40, 30, 4, 2)]
    for row in rows:
        assert all(row[name] > 0 for name in ("ours_forward_ms", "ours_ms", "direct_projective_ms", "primary_ms"))
    printed = capsys.readouterr().out
    assert "30 x 40" in printed
    assert "ambient occlusion, 32^2 texels" in printed


def test_figure(small, tmp_path, monkeypatch):
    from mitsuba_avatar.benchmarking import derivative_figure

    monkeypatch.setattr(derivative_figure, "PASSES", 1)
    monkeypatch.setattr(derivative_figure, "SAMPLES", 4)
    assert bench.main([*small, "--figure", str(tmp_path / "figure.png")]) == 0
    with Image.open(tmp_path / "figure.png") as picture:
        assert picture.width > 800


def test_an_unknown_variant_is_refused(capsys):
    assert bench.main(["--variant", "scalar_rgb"]) == 2
    assert "expected 'auto', 'llvm_ad_rgb' or 'cuda_ad_rgb'" in capsys.readouterr().err


def test_contenders_draw_the_same_picture(small):
    """The peer's mesh, texture orientation and cameras are those of the renderer that it is timed against."""
    import drjit as dr
    import numpy as np
    import torch

    from mitsuba_avatar.benchmarking.contenders import DirectProjective
    from mitsuba_avatar.rendering.backend import loaded_mitsuba
    from mitsuba_avatar.rendering.surface import SurfaceRenderer

    mi = loaded_mitsuba()
    workload = bench.make_workload(make_small_rig(), 40, 30, 2, 1)
    peer = DirectProjective(workload)
    with torch.no_grad():
        radiance, _ = SurfaceRenderer(workload.rig.topology, 40, 30, samples_per_pixel=64).render(
            workload.vertices, workload.textures, workload.cameras
        )
    for view in range(2):
        peer.parameters[peer.texture_key] = peer.textures[view]
        peer.parameters.update()
        image = mi.render(peer.scene, sensor=peer.sensors[view], integrator=peer.integrator, seed=1, spp=64)
        dr.eval(image)
        np.testing.assert_allclose(np.array(image)[..., :3].transpose(2, 0, 1).mean(), radiance[view].mean(), rtol=0.03)
        assert np.abs(np.array(image)[..., :3].transpose(2, 0, 1) - radiance[view].numpy()).mean() < 0.15 * float(radiance[view].mean())
