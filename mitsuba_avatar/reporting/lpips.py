"""LPIPS, the learned perceptual distance, with weights from a file that the user names: the package ships none and downloads none.

Features of AlexNet's five rectified convolutions are scaled to unit length at every location; their squared differences, weighed by the
published heads, are averaged over the picture and summed over the layers. Symbols: H, W pixels, C channels of a layer.

Source: Zhang et al., The Unreasonable Effectiveness of Deep Features as a Perceptual Metric, 2018, equation 1; version 0.1 of its weights.
"""

import pickle
import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor
from torch.nn import functional

# Of the convolutions, under their numbers among AlexNet's layers: channels in, channels out, kernel, stride, padding.
LAYERS = {0: (3, 64, 11, 4, 2), 3: (64, 192, 5, 1, 2), 6: (192, 384, 3, 1, 1), 8: (384, 256, 3, 1, 1), 10: (256, 256, 3, 1, 1)}
POOLED_BEFORE = (3, 6)  # convolutions that read a map of half the size
SMALLEST = 31  # pixels a side, below which the second pooling finds nothing
MEAN, DEVIATION = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)  # of the channels that AlexNet was trained on, in -1..1
NONZERO = 1e-10  # keeps the length of a vanishing feature from dividing by zero; the published value


class Lpips:
    """The distance with one set of weights.

    Args:
        weights: `features.<n>.weight` and `.bias` of AlexNet's convolutions, as torchvision names them, and `lin<k>.model.1.weight` of the
            five heads, as the `lpips` package does; what else is there is ignored.

    Raises:
        ValueError: a weight is missing or of another shape.
    """

    def __init__(self, weights: Mapping[str, Tensor]):
        shapes = {}
        for order, (number, (inner, outer, kernel, _, _)) in enumerate(LAYERS.items()):
            shapes[f"features.{number}.weight"] = (outer, inner, kernel, kernel)
            shapes[f"features.{number}.bias"] = (outer,)
            shapes[f"lin{order}.model.1.weight"] = (1, outer, 1, 1)
        for name, shape in shapes.items():
            found = tuple(weights[name].shape) if name in weights else None
            if found != shape:
                raise ValueError(f"Lpips(): expected weights {name} of {shape}; got {found}. docs/reports.md says how to make the file.")
        self.weights = {name: weights[name].detach().float() for name in shapes}

    @staticmethod
    def load(path: Path | str) -> "Lpips":
        """Read a safetensors file, or a state dictionary that torch saved.

        Raises:
            FileNotFoundError: no such file.
            ValueError: not such a file, or weights of another network.
        """
        path = Path(path)
        if not path.is_file():
            raise FileNotFoundError(f"Lpips.load(): expected a file of weights at {path}; got none. docs/reports.md says how to make one.")
        try:
            state = load_file(path) if path.suffix == ".safetensors" else torch.load(path, map_location="cpu", weights_only=True)
        except (SafetensorError, pickle.UnpicklingError, RuntimeError, EOFError) as error:
            reason = str(error).splitlines()[0]
            raise ValueError(f"Lpips.load(): expected a state dictionary in {path}; got {reason}. See docs/reports.md.") from error
        if not isinstance(state, Mapping) or not all(isinstance(value, Tensor) for value in state.values()):
            raise ValueError(f"Lpips.load(): expected a state dictionary in {path}; got {type(state).__name__}. Save network.state_dict().")
        # The lpips package cuts AlexNet into slices, whose layers keep their numbers.
        return Lpips({re.sub(r"^net\.slice\d\.", "features.", name): value for name, value in state.items()})

    @torch.no_grad()
    def compare(self, image: Float[np.ndarray, "H W 3"], reference: Float[np.ndarray, "H W 3"]) -> tuple[float, Float[np.ndarray, "H W"]]:
        """Distance of two display-encoded pictures in 0..1: 0 equal.

        Returns:
            The published distance, a mean over each layer's own grid, and its map: every layer resized bilinearly to the picture.

        Raises:
            ValueError: sizes that differ, or pictures that are too small.
        """
        if image.shape != reference.shape or min(image.shape[:2]) < SMALLEST:
            raise ValueError(
                f"Lpips.compare(): expected two images of one size, at least {SMALLEST} pixels a side; got {image.shape} and "
                f"{reference.shape}. Render at the capture's size."
            )
        pair = torch.from_numpy(np.stack([image, reference]).astype(np.float32)).permute(0, 3, 1, 2)  # [2, 3, H, W]
        distance, total = 0.0, torch.zeros(1, 1, *image.shape[:2])
        for order, features in enumerate(self._features(pair.clamp(0, 1))):
            unit = features / (features.square().sum(1, keepdim=True).sqrt() + NONZERO)  # [2, C, h, w]
            error = functional.conv2d((unit[:1] - unit[1:]).square(), self.weights[f"lin{order}.model.1.weight"])  # [1, 1, h, w]
            distance += float(error.mean())
            total += functional.interpolate(error, size=image.shape[:2], mode="bilinear", align_corners=False)
        return distance, total[0, 0].numpy()

    def _features(self, pictures: Float[Tensor, "2 3 H W"]) -> list[Tensor]:
        """Of every convolution, rectified."""
        mean, deviation = (torch.tensor(values)[:, None, None] for values in (MEAN, DEVIATION))
        values, features = (2 * pictures - 1 - mean) / deviation, []
        for number, (_, _, _, stride, padding) in LAYERS.items():
            if number in POOLED_BEFORE:
                values = functional.max_pool2d(values, kernel_size=3, stride=2)
            weight, bias = self.weights[f"features.{number}.weight"], self.weights[f"features.{number}.bias"]
            values = functional.conv2d(values, weight, bias, stride, padding).relu()
            features.append(values)
        return features
