"""The bench on a small rig and small films: its rows, its table, its figure."""

import json

import numpy as np
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


def test_noise_table(small, monkeypatch, capsys):
    from mitsuba_avatar.benchmarking import noise

    monkeypatch.setattr(noise, "SETTINGS", ((1, 1), (1, 8)))
    for name, value in (("WIDTH", 40), ("HEIGHT", 30), ("VIEWS", 2), ("CALLS", (1, 2, 4)), ("ORIENTATIONS", 2)):
        monkeypatch.setattr(noise, name, value)
    assert bench.main([*small, "--noise"]) == 0
    first, second = capsys.readouterr().out.split("\n\n")
    rows = {line[:24].strip(): [float(word) for word in line[24:].split()] for line in first.splitlines()[2:]}
    assert list(rows) == ["1, 1", "1, 8", "1, 18", "direct_projective"]
    for milliseconds, radiance, mask, *at_equal_time in rows.values():  # rounded where printed
        assert at_equal_time[0] == pytest.approx(radiance * milliseconds**0.5, rel=0.05, abs=0.1)
        assert np.isnan(mask) or at_equal_time[1] == pytest.approx(mask * milliseconds**0.5, rel=0.05, abs=0.1)
    assert rows["1, 8"][2] < 0.5 * rows["1, 1"][2], "samples on edges quiet the mask"
    lines = second.splitlines()[2:]
    assert [line[:20].split() for line in lines] == [
        ["1,", "2", "radiance"],
        ["1,", "2", "mask"],
        ["4,", "4", "radiance"],
        ["4,", "4", "mask"],
    ]
    for line in lines:
        one, independent_one, *others = (float(word.strip("()")) for word in line[20:].replace("(", " ").split())
        assert one == independent_one and all(value >= 0 for value in others)
        assert others[1::2] == pytest.approx([one / 2**0.5, one / 2], rel=0.05, abs=0.01)


def test_bias_is_a_share_of_the_largest_derivative():
    from mitsuba_avatar.benchmarking.bias import Estimate

    reference = Estimate(np.array([[2.0, -10.0], [1.0, 0.5]]), np.array([[0.3, 0.0], [0.0, 0.0]]))
    estimate = Estimate.of([np.array([[3.0, -10.0], [1.0, 0.4]]), np.array([[4.0, -10.0], [1.0, 0.8]])])
    bias = estimate.bias(reference)
    np.testing.assert_allclose(bias.mean, [[0.15, 0.0], [0.0, 0.1]])
    np.testing.assert_allclose(bias.error, [[np.hypot(0.5, 0.3) / 10, 0.0], [0.0, 0.2]])


@pytest.mark.slow
def test_bias_table(small, monkeypatch, capsys):
    """On a small film, where half a pixel is far, a gradient without its silhouettes would be off by a multiple of this."""
    from mitsuba_avatar.benchmarking import bias, noise

    for name, value in (("WIDTH", 40), ("HEIGHT", 30), ("VIEWS", 2)):
        monkeypatch.setattr(noise, name, value)
    monkeypatch.setattr(bias, "SAMPLES", 64)
    assert bench.main([*small[:2], "--rounds", "2", "--bias"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[1].split() == ["sideways", "up", "turn", "bend"]
    assert [line[:28].strip() for line in lines[2:]] == ["ours, radiance", "ours, mask", "direct_projective, radiance"]
    means = [float(word) for word in lines[3][28:].replace("+-", " ").split()][::2]
    assert max(map(abs, means)) < 15


def test_the_peers_gradient_is_that_of_the_welded_mesh(small):
    """Copies of a vertex along seams, which Mitsuba needs, give their gradients to the one vertex."""
    from mitsuba_avatar.benchmarking.contenders import DirectProjective

    workload = bench.make_workload(make_small_rig(), 40, 30, 4, 2)
    peer = DirectProjective(workload)
    peer.seed = 5
    split = [np.array(gradient).reshape(-1, 3) for gradient in peer._draw(with_gradients=True)]
    peer.seed = 5
    welded = peer.vertex_gradients().numpy()
    source = peer.source.numpy()
    copied = np.flatnonzero(np.bincount(source) > 1)
    assert len(copied) > 5 and welded.shape == workload.vertices.shape
    for mesh in range(2):
        scale = np.abs(split[mesh]).max()
        for vertex in copied[:5]:
            np.testing.assert_allclose(welded[mesh, vertex], split[mesh][source == vertex].sum(axis=0), atol=1e-3 * scale)
        np.testing.assert_allclose(welded[mesh].sum(axis=0), split[mesh].sum(axis=0), atol=1e-2 * scale)


def test_an_unknown_variant_is_refused(capsys):
    assert bench.main(["--variant", "scalar_rgb"]) == 2
    assert "expected 'auto', 'llvm_ad_rgb' or 'cuda_ad_rgb'" in capsys.readouterr().err


def test_contenders_draw_the_same_picture(small):
    """The peer's mesh, texture orientation and cameras are those of the renderer that it is timed against."""
    import drjit as dr
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
