"""Cameras that record one surface in different colours are brought to agree, and held-out ones have no say in it."""

import numpy as np
import pytest
import torch

from mitsuba_avatar.captures.cameras import Camera, look_at
from mitsuba_avatar.captures.colour import encode_bytes
from mitsuba_avatar.registration.colour_agreement import agree, corrected, read_agreement, solve_corrections, stored_agreement
from mitsuba_avatar.registration.colour_correction import corrected_image, keep_corrections, load_corrections, undoing
from mitsuba_avatar.registration.colour_samples import ColourSampler, SharedColours, shared_colours
from mitsuba_avatar.rendering.cameras import CameraBatch
from mitsuba_avatar.rendering.surface import SurfaceRenderer
from tests.registration.drawn_recording import acted

NAMES = ("a", "b", "c", "d")
GAINS = np.array([[1.0, 1.0, 1.0], [0.7, 0.8, 1.2], [1.3, 0.9, 0.6], [0.8, 1.1, 1.4]])  # by which cameras record too much
NEIGHBOURS = ((0, 1), (1, 2), (2, 3))


def recorded(recording: np.ndarray, pairs=NEIGHBOURS, noise: float = 0.05, outliers: float = 0.1, seed: int = 0) -> SharedColours:
    """300 points a pair of neighbours, recorded through [C, 3, 4] with errors of both views; some are of something else entirely."""
    rng = np.random.default_rng(seed)
    pair = np.repeat(np.array(pairs), 300, axis=0)
    truth = rng.uniform(0.05, 0.45, (len(pair), 1, 3)) * np.exp(noise * rng.normal(size=(len(pair), 2, 3)))
    wrong = rng.random((len(pair), 2)) < outliers
    truth[wrong] = rng.uniform(0.02, 0.6, (int(wrong.sum()), 3))
    colours = np.einsum("spij,spj->spi", recording[pair][..., :3], truth) + recording[pair][..., 3]
    typical = np.einsum("cij,j->ci", recording[..., :3], np.full(3, 0.25)) + recording[..., 3]
    return SharedColours(NAMES, pair, colours, rng.uniform(0.5, 2.0, len(pair)), rng.integers(0, 5, len(pair)), typical)


def diagonal(gains: np.ndarray) -> np.ndarray:
    return np.einsum("ci,ij->cij", gains, np.eye(3, 4))


def gains_of(matrices: np.ndarray) -> np.ndarray:
    return np.diagonal(matrices[:, :, :3], axis1=1, axis2=2)


def held(*names: str) -> np.ndarray:
    return np.isin(NAMES, names)


def test_gains_are_recovered_through_noise_and_outliers():
    agreement = agree(recorded(diagonal(GAINS)), [], reference="a")
    assert agreement.correction == "gains" and agreement.reference == "a"
    np.testing.assert_allclose(gains_of(np.stack(list(agreement.matrices.values()))), 1 / GAINS, rtol=0.03)
    assert all(agreement.after[name] < 0.7 * agreement.before[name] for name in NAMES)
    assert agreement.candidates["gains"] < 0.7 * agreement.candidates["none"] and agreement.samples == {
        "a": 300,
        "b": 600,
        "c": 600,
        "d": 300,
    }


def test_cameras_that_agree_stay_as_they_are():
    agreement = agree(recorded(diagonal(np.ones((4, 3)))), ["d"])
    assert agreement.correction == "none"
    assert all(np.array_equal(matrix, np.eye(3, 4)) for matrix in agreement.matrices.values())
    gains = gains_of(solve_corrections(recorded(diagonal(np.ones((4, 3)))), "gains", 1, held("d")))
    np.testing.assert_allclose(gains, 1, atol=0.02)


@pytest.mark.parametrize("kind", ["gains", "affine"])
def test_the_reference_is_not_touched(kind):
    matrices = solve_corrections(recorded(diagonal(GAINS)), kind, 2, held())
    np.testing.assert_array_equal(matrices[2], np.eye(3, 4))
    np.testing.assert_allclose(gains_of(matrices), GAINS[2] / GAINS, rtol=0.06)


def test_crosstalk_and_offsets_are_recovered_and_chosen():
    recording = diagonal(GAINS)
    recording[1:, 0, 1], recording[1:, 1, 2], recording[1:, :, 3] = 0.2, -0.15, 0.015
    shared = recorded(recording, noise=0.01, outliers=0.0)
    agreement = agree(shared, [], reference="a")
    assert agreement.correction == "affine"
    gains = agree(shared, [], "gains", "a")
    assert agreement.after["b"] < 0.8 * gains.after["b"]
    colours = np.array([[0.1, 0.3, 0.2], [0.4, 0.2, 0.1], [0.2, 0.2, 0.35]])
    seen = colours @ recording[1, :, :3].T + recording[1, :, 3]
    errors = [np.abs(seen @ one.matrices["b"][:, :3].T + one.matrices["b"][:, 3] - colours).mean() for one in (agreement, gains)]
    assert errors[0] < 0.7 * errors[1]


def test_flattening_both_views_is_no_agreement():
    """Two cameras that nothing ties to the reference agree no better for being corrected to a third of their contrast."""
    shared = recorded(diagonal(np.ones((4, 3))), pairs=((0, 1), (2, 3)), outliers=0.0)
    flat = np.tile(np.concatenate([np.eye(3) / 3, np.full((3, 1), 0.15)], axis=1), (4, 1, 1))
    chart = dict(zip(NAMES, flat, strict=True))
    agreement = agree(shared, [], chart=chart)
    assert agreement.after["c"] > 0.8 * agreement.before["c"]


@pytest.mark.parametrize("kind", ["gains", "affine"])
def test_a_held_out_camera_is_corrected_and_moves_no_other(kind):
    pairs = (*NEIGHBOURS, (0, 3), (0, 2))
    shared = recorded(diagonal(GAINS), pairs)
    spoilt = recorded(diagonal(GAINS), pairs)
    spoilt.colours[(spoilt.pair == 2).any(axis=1)] *= 3.0
    spoilt.typical[2] *= 3.0
    first, second = (solve_corrections(one, kind, 0, held("c")) for one in (shared, spoilt))
    np.testing.assert_array_equal(first[[0, 1, 3]], second[[0, 1, 3]])
    np.testing.assert_allclose(gains_of(first), 1 / GAINS, rtol=0.06)
    chosen = [agree(one, ["c"]) for one in (shared, spoilt)]
    assert chosen[0].reference == chosen[1].reference != "c" and chosen[0].candidates == chosen[1].candidates


def test_cameras_without_common_points_get_the_hue_and_keep_their_brightness():
    matrices = solve_corrections(recorded(diagonal(GAINS), pairs=((0, 1), (2, 3))), "gains", 0, held())
    gains = gains_of(matrices)
    balanced = gains * GAINS
    np.testing.assert_allclose(balanced[1:] / balanced[1:].mean(axis=1, keepdims=True), 1, atol=0.03)
    np.testing.assert_allclose(gains[2] / gains[3], GAINS[3] / GAINS[2], rtol=0.04)
    np.testing.assert_allclose(np.log(gains[2:]).mean(), 0, atol=0.02)


def test_disagreement_is_measured_on_frames_that_were_left_out():
    """What a block of frames says of itself does not lower its own disagreement."""
    shared = recorded(diagonal(np.ones((4, 3))), noise=0.0, outliers=0.0)
    shared.colours[(shared.block == 3), 1] *= 1.6
    agreement = agree(shared, [], "affine", "a")
    assert agreement.after["b"] > 0.9 * agreement.before["b"]


def test_a_chart_is_taken_and_measured():
    shared = recorded(diagonal(GAINS))
    chart = dict(zip(NAMES, diagonal(1 / GAINS), strict=True))
    agreement = agree(shared, ["d"], chart=chart)
    assert agreement.correction == "chart" and agreement.reference == ""
    assert agreement.matrices["c"] is not None and np.array_equal(agreement.matrices["c"], chart["c"])
    assert agreement.after["c"] < 0.7 * agreement.before["c"]


def test_an_agreement_comes_back_from_its_stage():
    agreement = agree(recorded(diagonal(GAINS), pairs=((0, 1), (1, 2))), ["c"])
    again = read_agreement(stored_agreement(agreement))
    assert (again.correction, again.reference, again.candidates, again.samples) == (
        agreement.correction,
        agreement.reference,
        agreement.candidates,
        agreement.samples,
    )
    np.testing.assert_equal(again.after, agreement.after)
    np.testing.assert_array_equal(again.matrices["b"], agreement.matrices["b"])


def test_a_correction_is_applied_kept_and_taken_back(tmp_path):
    agreement = agree(recorded(diagonal(GAINS)), [], reference="a")
    image = np.random.default_rng(1).integers(5, 150, (6, 9, 3), np.uint8)
    keep_corrections(tmp_path, agreement)
    matrix = load_corrections(tmp_path)["c"]
    np.testing.assert_allclose(matrix, agreement.matrices["c"], atol=1e-6)
    changed = corrected_image(image, matrix)
    assert np.abs(changed.astype(int) - image).max() > 10
    assert np.abs(corrected_image(changed, undoing(matrix)).astype(int) - image).max() <= 2
    assert corrected_image(image, load_corrections(tmp_path)["a"]) is image


def test_images_with_other_corrections_are_not_resumed(tmp_path):
    (tmp_path / "images").mkdir()
    none = agree(recorded(diagonal(GAINS)), [], "none")
    keep_corrections(tmp_path, none)
    assert (tmp_path / "images").is_dir() and load_corrections(tmp_path) == {}
    gains = agree(recorded(diagonal(GAINS)), [], "gains")
    keep_corrections(tmp_path, gains)
    assert not (tmp_path / "images").exists()
    (tmp_path / "images").mkdir()
    keep_corrections(tmp_path, gains)
    assert (tmp_path / "images").is_dir()
    keep_corrections(tmp_path, none)
    assert not (tmp_path / "images").exists() and load_corrections(tmp_path) == {}


def test_a_damaged_file_of_corrections_is_named(tmp_path):
    (tmp_path / "colour_correction.json").write_text('{"format_version": 1, "cameras": {"a": [1, 2]}}')
    with pytest.raises(ValueError, match=r"load_corrections\(\).*colour_correction\.json"):
        load_corrections(tmp_path)


@pytest.mark.usefixtures("one_thread", "private_cache")
def test_gains_of_drawn_cameras_are_recovered_from_their_images():
    """The whole way: a textured person drawn by three cameras with gains, clipped and encoded, before a magenta room."""
    angles = {"a": -0.7, "b": 0.1, "c": 0.8}
    cameras = {
        name: Camera(
            name, 100, 180, 210.0, 205.0, 52.0, 88.0, look_at(np.array([2.9 * np.cos(t), 2.9 * np.sin(t), 1.4]), np.array([0.0, 0, 0.9]))
        )
        for name, t in angles.items()
    }
    truth = acted(3, cameras)
    texture = torch.nn.functional.interpolate(
        0.08 + 0.4 * torch.rand(1, 3, 9, 7, generator=torch.Generator().manual_seed(0)), size=(64, 64)
    )
    renderer = SurfaceRenderer(truth.rig.topology, 100, 180, samples_per_pixel=9)
    sampler = ColourSampler(truth.rig, cameras)

    def look(frame: int) -> tuple[np.ndarray, np.ndarray]:
        vertices = torch.from_numpy(truth.vertices[frame])
        with torch.no_grad():
            radiance, mask = renderer.render(
                vertices[None], texture.expand(3, -1, -1, -1), CameraBatch.from_cameras(list(cameras.values()))
            )
        room = torch.tensor([0.9, 0.02, 0.8]).view(1, 3, 1, 1) * (1 - mask)
        recording = (radiance + room).permute(0, 2, 3, 1).numpy() * GAINS[:3, None, None].astype(np.float32)
        return sampler.look(vertices, encode_bytes(recording, "srgb"), mask[:, 0].numpy())

    shared = shared_colours(NAMES[:3], [0, 1, 2], look, lambda done, total: None)
    assert len(np.unique(shared.block)) == 3 and {tuple(pair) for pair in shared.pair.tolist()} >= {(0, 1), (1, 2)}
    agreement = agree(shared, ["c"], "gains", "a")
    matrices = np.stack(list(agreement.matrices.values()))
    np.testing.assert_allclose(gains_of(matrices), 1 / GAINS[:3], rtol=0.04)
    colours = corrected(shared, matrices)
    assert np.median(np.abs(colours[:, 0] - colours[:, 1])) < 0.02
