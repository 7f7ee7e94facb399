"""LPIPS against what the `lpips` package says of the same weights and pictures, and against what a distance must be."""

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from mitsuba_avatar.reporting.lpips import LAYERS, Lpips
from mitsuba_avatar.reporting.protocols import protocol_metrics

# lpips 0.1.4: network.load_state_dict(package_names(weights)), network(image, reference, normalize=True); the map with spatial=True.
PUBLISHED_DISTANCE, PUBLISHED_MAP_MEAN, PUBLISHED_MAP_CORNER = 0.0024173781, 0.0024177197, 0.0028804636


def random_weights() -> dict[str, torch.Tensor]:
    """Random features, heads that are nowhere negative as the published ones are."""
    random = np.random.default_rng(8)
    result = {}
    for order, (number, (inner, outer, kernel, _, _)) in enumerate(LAYERS.items()):
        deviation = np.sqrt(2 / (inner * kernel**2))
        result[f"features.{number}.weight"] = deviation * random.standard_normal((outer, inner, kernel, kernel), np.float32)
        result[f"features.{number}.bias"] = 0.1 * random.standard_normal(outer, np.float32)
        result[f"lin{order}.model.1.weight"] = random.random((1, outer, 1, 1), np.float32) / outer
    return {name: torch.from_numpy(value.astype(np.float32)) for name, value in result.items()}


@pytest.fixture(scope="module")
def weights() -> dict[str, torch.Tensor]:
    return random_weights()


@pytest.fixture(scope="module")
def pair() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Two pictures of 47x66, and a mask of the half that differs more."""
    random = np.random.default_rng(5)
    reference = random.random((47, 66, 3), dtype=np.float32)
    noise = np.where(np.arange(66) < 33, 0.05, 0.3)[None, :, None]
    image = np.clip(reference + noise * random.standard_normal(reference.shape), 0, 1).astype(np.float32)
    return image, reference, np.broadcast_to(np.arange(66) >= 33, (47, 66)).astype(np.float32)


def package_names(weights: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """As `lpips.LPIPS(net="alex").state_dict()` has them, with what else it holds."""
    named = dict(weights)
    for order, number in enumerate(LAYERS):
        for kind in ("weight", "bias"):
            named[f"net.slice{order + 1}.{number}.{kind}"] = named.pop(f"features.{number}.{kind}")
    heads = {name.replace("lin", "lins."): value for name, value in weights.items() if name.startswith("lin")}
    return named | heads | {"scaling_layer.shift": torch.zeros(1, 3, 1, 1), "scaling_layer.scale": torch.ones(1, 3, 1, 1)}


def test_distance_and_map_are_those_of_the_published_package(weights, pair):
    distance, error = Lpips(weights).compare(*pair[:2])
    assert distance == pytest.approx(PUBLISHED_DISTANCE, rel=1e-4)
    assert error.shape == (47, 66) and error.mean() == pytest.approx(PUBLISHED_MAP_MEAN, rel=1e-4)
    assert error[2, 64] == pytest.approx(PUBLISHED_MAP_CORNER, rel=1e-3)


def test_it_is_zero_for_equal_pictures_symmetric_and_larger_where_more_differs(weights, pair):
    image, reference, mask = pair
    network = Lpips(weights)
    assert network.compare(reference, reference)[0] == 0
    distance, error = network.compare(image, reference)
    assert network.compare(reference, image)[0] == pytest.approx(distance, rel=1e-5)
    assert error[mask == 1].mean() > 2 * error[mask == 0].mean()


def test_the_image_protocol_gives_the_published_distance_and_the_others_means_of_the_map(weights, pair):
    network = Lpips(weights)
    values = protocol_metrics(*pair, has_flip=False, lpips=network)
    distance, error = network.compare(*pair[:2])
    assert values["image_lpips"] == pytest.approx(distance) and values["lpips"] == pytest.approx(error[:, 33:].mean(), rel=1e-5)
    assert values["box_lpips"] == pytest.approx(values["lpips"]) and "lpips" not in protocol_metrics(*pair, has_flip=False)


def test_both_kinds_of_file_and_both_ways_of_naming_are_read(weights, pair, tmp_path):
    save_file(weights, tmp_path / "alex.safetensors")
    torch.save(package_names(weights), tmp_path / "alex.pt")
    expected = Lpips(weights).compare(*pair[:2])[0]
    for name in ("alex.safetensors", "alex.pt"):
        assert Lpips.load(tmp_path / name).compare(*pair[:2])[0] == pytest.approx(expected, rel=1e-6)


def test_other_files_are_refused(weights, pair, tmp_path):
    with pytest.raises(FileNotFoundError, match="expected a file of weights at"):
        Lpips.load(tmp_path / "none.pt")
    for name in ("text.pt", "text.safetensors"):
        (tmp_path / name).write_text("not weights")
        with pytest.raises(ValueError, match="expected a state dictionary in"):
            Lpips.load(tmp_path / name)
    torch.save([torch.ones(2)], tmp_path / "list.pt")
    with pytest.raises(ValueError, match="got list"):
        Lpips.load(tmp_path / "list.pt")
    with pytest.raises(ValueError, match=r"expected weights lin2.model.1.weight of \(1, 384, 1, 1\); got None"):
        Lpips({name: value for name, value in weights.items() if not name.startswith("lin2")})
    with pytest.raises(ValueError, match="at least 31 pixels a side"):
        Lpips(weights).compare(pair[0][:20], pair[1][:20])
