"""What each training camera adds to the pictures of the person, learnt beside the avatar so that the avatar need not learn it.

Blur: optics and demosaicking spread light over neighbouring pixels, each camera its own way. It is a diffusion, the same few taps several
times, by a variance in square pixels: zero is no blur at all and has a gradient there. Bias: stray light and what is left of colour
differences, a few cells of linear radiance a camera, stretched over its image. Both act on the person's light in linear radiance, before
the background is put behind it, for plates of a camera have its blur already.

One camera, the identity, keeps neither: otherwise the avatar could grow sharper or brighter and every camera undo it. Validation,
evaluation and novel views leave the response out: they show the avatar as the identity camera sees it.

Symbols: C cameras, B images, h and w cells.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mitsuba_avatar.captures.cameras import Camera
from mitsuba_avatar.captures.folder import Capture
from mitsuba_avatar.files import atomic_path
from mitsuba_avatar.settings import CameraResponseSettings, Settings
from mitsuba_avatar.training.batches import FrameBatch
from mitsuba_avatar.training.collectives import average_gradients
from mitsuba_avatar.training.distributed import Process

PASSES = 4  # of the taps (s, 1 - 2 s, s) along each axis; a pass adds a variance of 2 s
LARGEST_SHARE = 1 / 3  # s of a box over three pixels; more would make edges ring
LARGEST_VARIANCE = 2 * PASSES * LARGEST_SHARE  # square pixels


class CameraResponse(nn.Module):
    """Blur and bias of every training camera; an identity where it begins.

    Args:
        cameras: the training cameras, at the size of the images.
        settings: what is learnt, and which camera is the identity.

    Attributes:
        variance: [C] square pixels of blur. bias: [C, 3, h, w] linear radiance.

    Raises:
        ValueError: the identity camera is no training camera.
    """

    def __init__(self, cameras: Mapping[str, Camera], settings: CameraResponseSettings):
        super().__init__()
        self.names, self.settings = tuple(cameras), settings
        identity = settings.identity_camera or self.names[0]
        if identity not in self.names:
            raise ValueError(
                f"CameraResponse(): expected camera_response.identity_camera to be a training camera, one of {list(self.names)}; got "
                f"{identity!r}. Correct the name, or leave it out to take the first."
            )
        width, height = next(iter(cameras.values())).width, next(iter(cameras.values())).height
        cells = settings.bias_cells
        grid = (cells, max(1, round(cells * width / height))) if height >= width else (max(1, round(cells * height / width)), cells)
        self.variance = nn.Parameter(torch.zeros(len(self.names)), requires_grad=settings.blur)
        self.bias = nn.Parameter(torch.zeros(len(self.names), 3, *grid), requires_grad=settings.bias)
        self.register_buffer("is_free", torch.tensor([float(name != identity) for name in self.names]), persistent=False)
        # Its own optimizer: another rate than the avatar's, and a bias that decays where nothing speaks for it.
        groups = [{"params": [self.variance], "weight_decay": 0.0}, {"params": [self.bias], "weight_decay": settings.bias_decay}]
        self.optimizer = torch.optim.AdamW(groups, lr=settings.learning_rate)

    @staticmethod
    def of(capture: Capture, settings: Settings) -> "CameraResponse | None":
        """The response of a capture's training cameras; None where the settings do not ask for it, or look at no pictures."""
        if not (settings.camera_response.is_learnt and settings.loss.looks_at_images):
            return None
        names = capture.camera_names(held_out=False)
        return CameraResponse({name: capture.cameras[name] for name in names}, settings.camera_response)

    def forward(self, image: Float[Tensor, "B 3 H W"], mask: Float[Tensor, "B 1 H W"], batch: FrameBatch) -> Float[Tensor, "B 3 H W"]:
        """Rendered radiance as the cameras of a batch would have recorded it.

        Args:
            image: [B, 3, H, W] linear radiance over the batch's backgrounds.
            mask: [B, 1, H, W] rendered coverage.
            batch: whose cameras, sizes and backgrounds are used.

        Gradients: to image, mask (by the blur alone), variance and bias.
        """
        views = [self.names.index(name) for names in batch.camera_names for name in names]
        free = self.is_free[views]
        light = torch.cat([image - (1 - mask) * batch.backgrounds, mask], dim=1)  # premultiplied radiance, coverage
        if self.settings.blur:
            light = diffused(light, self.variance[views] * free)
        radiance, coverage = light[:, :3], light[:, 3:]
        if self.settings.bias:
            # Where the person is, however the background came in; silhouettes are not this map's business.
            cells = self.bias[views] * free[:, None, None, None]
            radiance = radiance + stretched(cells, batch.sizes, image.shape[2], image.shape[3]) * coverage.detach()
        return radiance + (1 - coverage) * batch.backgrounds

    def step(self, falling: float, process: Process) -> None:
        """Follow the gradients, then back to the legal range: no camera sharpens, none blurs more than its taps can.

        Args:
            falling: factor on the learning rate, as the avatar's falls.
            process: ranks whose gradients are averaged.
        """
        average_gradients(self.parameters(), process)
        for group in self.optimizer.param_groups:
            group["lr"] = falling * self.settings.learning_rate
        self.optimizer.step()
        with torch.no_grad():
            self.variance.clamp_(0.0, LARGEST_VARIANCE)

    def facts(self) -> dict[str, Any]:
        """Name of each camera -> pixels of blur (standard deviation), and mean bias of red, green and blue, for people to read."""
        free = self.is_free.cpu()
        deviations = (self.variance.detach().cpu() * free).sqrt().tolist()
        means = (self.bias.detach().cpu().mean(dim=(2, 3)) * free[:, None]).tolist()
        return {
            name: {"blur_pixels": round(deviation, 3), "mean_bias": [round(value, 5) for value in mean]}
            for name, deviation, mean in zip(self.names, deviations, means, strict=True)
        }

    def write_facts(self, path: Path) -> None:
        """Write `facts` as JSON."""
        with atomic_path(path) as temporary:
            temporary.write_text(json.dumps(self.facts(), indent=1) + "\n", encoding="utf-8")

    def saved(self) -> dict[str, Any]:
        """What a checkpoint keeps."""
        return {"cameras": list(self.names), "parameters": self.state_dict(), "optimizer": self.optimizer.state_dict()}

    def restore(self, saved: Mapping[str, Any]) -> None:
        """Continue from `saved`.

        Raises:
            ValueError: it is of other cameras, or of another grid.
        """
        shapes = [{name: list(value.shape) for name, value in state.items()} for state in (saved["parameters"], self.state_dict())]
        if tuple(saved["cameras"]) != self.names or shapes[0] != shapes[1]:
            raise ValueError(
                f"CameraResponse: expected a checkpoint with the response of {list(self.names)}, {shapes[1]}; got {saved['cameras']}, "
                f"{shapes[0]}. Resume with the cameras and the camera_response.bias_cells that the run began with."
            )
        self.load_state_dict(saved["parameters"])
        self.optimizer.load_state_dict(saved["optimizer"])


def diffused(values: Float[Tensor, "B C H W"], variance: Float[Tensor, "B"]) -> Float[Tensor, "B C H W"]:  # noqa: F821
    """Blur each image by its variance in square pixels along both axes, 0 to `LARGEST_VARIANCE`; borders repeat. Sums stay, at borders too.

    Gradients: to values and variance, at zero variance too.
    """
    share = (variance / (2 * PASSES))[:, None, None, None]
    for _ in range(PASSES):
        for axis in (2, 3):
            size = values.shape[axis]
            before = torch.cat([values.narrow(axis, 0, 1), values.narrow(axis, 0, size - 1)], dim=axis)
            after = torch.cat([values.narrow(axis, 1, size - 1), values.narrow(axis, size - 1, 1)], dim=axis)
            values = values + share * (before - 2 * values + after)
    return values


def stretched(cells: Float[Tensor, "B C h w"], sizes: Sequence[tuple[int, int]], height: int, width: int) -> Float[Tensor, "B C H W"]:
    """Each map of cells over its own image of (width, height) pixels, bilinearly, in the upper left corner of a film; zero beyond."""
    if all(size == (width, height) for size in sizes):
        return nn.functional.interpolate(cells, (height, width), mode="bilinear", align_corners=False)
    film = []
    for row, (own_width, own_height) in enumerate(sizes):
        own = nn.functional.interpolate(cells[row : row + 1], (own_height, own_width), mode="bilinear", align_corners=False)
        film.append(nn.functional.pad(own, (0, width - own_width, 0, height - own_height)))
    return torch.cat(film)
