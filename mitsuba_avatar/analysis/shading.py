"""Whether pictures darken where the pose hides light, and brighten where it opens: what the shadow branch is for.

The change of a pixel's occlusion is r = log(o / mean o): its surface point's ambient occlusion in this pose against the mean over
training frames. Brightness is linear radiance, mean of the channels. A brightness error that goes with r is shading that the avatar does
not know of; errors of stripes, folds and outlines do not go with it, and make up most of an image error.

Symbols: n pixels.

Source: arXiv:2105.10441, section 3.4.2.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from mitsuba_avatar.captures.colour import decode
from mitsuba_avatar.reporting.evaluation import Drawn, Evaluator
from mitsuba_avatar.training.batches import FrameBatch
from mitsuba_avatar.training.statistics import evenly_spaced

FRAMES = 8  # of a split that are looked at, every camera's picture of each
MEAN_FRAMES = 64  # of training that the mean occlusion is taken over
CHANGED = 0.1  # |log| from which occlusion counts as changed
LARGEST_CHANGE = 0.7  # |log| that the slope reads changes as at most: a factor of two
LEAST_OCCLUSION = 0.05  # below it a texel lies inside the body, and its logarithm means nothing
COVERED = 0.99  # of a pixel, by the person, in captured and drawn picture


@dataclass(frozen=True)
class ShadingError:
    """Brightness errors by change of occlusion.

    Attributes:
        slope: s of truth = drawn * (1 + s r), least squares: 0 where pictures darken as they should, 1 where they do not at all and
            radiance is proportional to occlusion.
        changed_share: share of pixels with |r| of CHANGED or more.
        darker, lighter: log(truth / drawn) of the summed brightness of pixels whose occlusion fell, rose, by as much; 0 without any.
        changed_mse, unchanged_mse: squared error, 0..255 display-encoded values, of these pixels and of the others.
    """

    slope: float
    changed_share: float
    darker: float
    lighter: float
    changed_mse: float
    unchanged_mse: float

    @classmethod
    def of(
        cls,
        change: Float[np.ndarray, "n"],  # noqa: F821
        truth: Float[np.ndarray, "n"],  # noqa: F821
        drawn: Float[np.ndarray, "n"],  # noqa: F821
        squared_error: Float[np.ndarray, "n"],  # noqa: F821
    ) -> "ShadingError":
        """From each pixel's change of occlusion, linear brightness in the captured and the drawn picture, and squared error."""
        read = np.clip(change, -LARGEST_CHANGE, LARGEST_CHANGE)
        weight = float(np.square(drawn * read).sum())
        changed = np.abs(change) >= CHANGED

        def ratio(chosen: np.ndarray) -> float:
            sums = truth[chosen].sum(), drawn[chosen].sum()
            return float(np.log(sums[0] / sums[1])) if min(sums) > 0 else 0.0

        return cls(
            slope=float((drawn * read * (truth - drawn)).sum()) / weight if weight > 0 else 0.0,
            changed_share=float(changed.mean()),
            darker=ratio(change <= -CHANGED),
            lighter=ratio(change >= CHANGED),
            changed_mse=float(squared_error[changed].mean()) if changed.any() else 0.0,
            unchanged_mse=float(squared_error[~changed].mean()) if not changed.all() else 0.0,
        )


def shading_errors(
    evaluator: Evaluator, splits: dict[str, list[int]], progress: Callable[[int, int], None] = lambda done, total: None
) -> dict[str, dict[str, float]]:
    """Split -> `ShadingError` of at most FRAMES of its frames, driven with z = 0, over all cameras.

    Splits in which no pixel is covered are left out.
    """
    names = [evaluator.capture.camera_names()]
    mean = evaluator.reader.occlusion.maps(evenly_spaced(evaluator.train_frames, MEAN_FRAMES)).mean(dim=0, keepdim=True)
    chosen = {split: evenly_spaced(frames, FRAMES) for split, frames in splits.items()}
    total, done, errors = sum(map(len, chosen.values())), 0, {}
    for split, frames in chosen.items():
        pixels = []
        for frame in frames:
            batch = evaluator.reader.read([frame], names)
            pixels.append(_pixels(evaluator, batch, evaluator.draw("avatar", batch), mean))
            done += 1
            progress(done, total)
        columns = np.concatenate([np.empty((4, 0)), *pixels], axis=1)
        if columns.size:
            errors[split] = asdict(ShadingError.of(*columns))
    return errors


@torch.no_grad()
def _pixels(evaluator: Evaluator, batch: FrameBatch, drawn: Drawn, mean: Float[Tensor, "1 1 S S"]) -> Float[np.ndarray, "4 n"]:
    """Change of occlusion, captured and drawn brightness, and squared error of the pixels that the person covers."""
    size = evaluator.avatar.settings.texture_size  # the renderer's kernels are made for it
    maps = torch.cat([batch.ambient_occlusion, mean, torch.ones_like(mean)], dim=1)
    textures = functional.interpolate(maps, size=(size, size), mode="bilinear", align_corners=False)
    textures = textures.to(evaluator.avatar.mean_texture.device).expand(len(batch.cameras), -1, -1, -1)
    vertices = drawn.vertices[None].to(textures.device)
    occlusion = evaluator.renderer.render(vertices, textures, batch.cameras, seed=batch.frames[0])[0].cpu()
    inside = (torch.minimum(batch.masks, drawn.masks) > COVERED)[:, 0] & (occlusion[:, :2].amin(dim=1) > LEAST_OCCLUSION)
    change = torch.log(occlusion[:, 0].clamp(min=LEAST_OCCLUSION) / occlusion[:, 1].clamp(min=LEAST_OCCLUSION))
    truth, picture = (decode(images, "srgb").mean(dim=1) for images in (batch.images, drawn.images))
    squared_error = (255 * (drawn.images - batch.images)).square().mean(dim=1)
    return torch.stack([values[inside] for values in (change, truth, picture, squared_error)]).double().numpy()
