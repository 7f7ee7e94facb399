"""The loss terms, one function each, and how they are weighted and summed.

Every term is a mean with a unit that does not change with image size, number of vertices or batch size, so that weights carry over:

    image      absolute colour difference, summed over all pixels, per foreground pixel and channel
    mask       squared difference of coverage, summed over all pixels, per foreground pixel
    geometry   squared distance of a vertex to the tracked one, cm^2, mean over vertices
    laplacian  squared difference of mesh Laplacians, cm^2, mean over vertices
    kl         nats per pose, summed over the latent code
    mutual_information  nats that the latent code tells about the driving signal, as estimated
    perturbation        squared distance of driven keypoints under a random latent code, cm^2, mean over keypoints

Image terms count *every* pixel, because a silhouette is learnt from both of its sides, but divide by the foreground alone: the weight
of a person then does not fall with the amount of background that a camera happens to see. Colours are compared as they are given; the
caller chooses the curve (linear radiance, or encoded for display).

Symbols: B images, P poses, V vertices, K keypoints, Z latent size. Source: arXiv:2105.10441, sections 3.5 and 3.6.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from mitsuba_avatar.body.mesh import Laplacian
from mitsuba_avatar.model.encoder import Posterior
from mitsuba_avatar.settings import LossSettings

CENTIMETRES = 100.0  # in a metre
TERMS = ("image", "mask", "geometry", "laplacian", "kl", "mutual_information", "perturbation")
LATENT_TERMS = ("kl", "mutual_information", "perturbation")  # of an avatar with a latent code alone


def image_loss(image: Float[Tensor, "B 3 H W"], target: Float[Tensor, "B 3 H W"], target_mask: Float[Tensor, "B 1 H W"]) -> Tensor:
    """Absolute colour difference, over all pixels, per foreground pixel and channel (L_I).

    Args:
        image, target: [B, 3, H, W] colours on the same curve.
        target_mask: [B, 1, H, W] in 0..1, true foreground; only its sum counts.

    Returns:
        Scalar >= 0. Gradients: to `image`.
    """
    return (image - target).abs().sum() / (3 * _foreground_pixels(target_mask))


def mask_loss(mask: Float[Tensor, "B 1 H W"], target_mask: Float[Tensor, "B 1 H W"]) -> Tensor:
    """Squared difference of coverage, over all pixels, per foreground pixel (L_M); both masks in 0..1. Gradients: to `mask`."""
    return (mask - target_mask).square().sum() / _foreground_pixels(target_mask)


def geometry_loss(vertices: Float[Tensor, "P V 3"], tracked_vertices: Float[Tensor, "P V 3"]) -> Tensor:
    """Mean squared distance to the tracked mesh, cm^2 (L_G); both in metres. Gradients: to `vertices`."""
    return (CENTIMETRES * (vertices - tracked_vertices)).square().sum(-1).mean()


def laplacian_loss(vertices: Float[Tensor, "P V 3"], tracked_vertices: Float[Tensor, "P V 3"], laplacian: Laplacian) -> Tensor:
    """Mean squared difference of mesh Laplacians, cm^2 (L_lap): smooth where the tracked mesh is, rough where it is.

    Args:
        vertices, tracked_vertices: [P, V, 3] metres.
        laplacian: of the meshes' topology.

    Returns:
        Scalar >= 0, zero for any common translation. Gradients: to `vertices`.
    """
    offsets = CENTIMETRES * (vertices - tracked_vertices)  # the Laplacian is linear: L(a) - L(b) = L(a - b), one product for both
    return laplacian(offsets).square().sum(-1).mean()


def kl_loss(posterior: Posterior) -> Tensor:
    """Kullback-Leibler divergence of the posterior from N(0, I), nats per pose (L_KL). Gradients: to mu and logvar."""
    return posterior.divergence().mean()


def perturbation_loss(keypoints: Float[Tensor, "P K 3"], driven_keypoints: Float[Tensor, "P K 3"]) -> Tensor:
    """Mean squared distance of keypoints from where the driving signal puts them, cm^2 (L_pc); both in metres.

    The paper sums over the keypoints; the mean keeps the weight independent of how many a rig has. Gradients: to both.
    """
    return (CENTIMETRES * (keypoints - driven_keypoints)).square().sum(-1).mean()


@dataclass(frozen=True)
class LossInputs:
    """What one step made, and what it should have been. A part that is None must not be asked for.

    Attributes:
        image, mask: [B, 3, H, W], [B, 1, H, W] rendered.
        target_image, target_mask: the same, captured.
        vertices: [P, V, 3] posed in the world, metres.
        tracked_vertices: [P, V, 3] registered mesh.
        posterior: of the encoder.
        laplacian: of the meshes' topology.
        mutual_information: estimate of the statistics network, nats; a loss as it stands.
        keypoints: [P, K, 3] of the surface decoded under a latent code drawn from the prior, metres.
        driven_keypoints: [P, K, 3] the same as the driving signal gives them.
    """

    image: Float[Tensor, "B 3 H W"] | None = None
    mask: Float[Tensor, "B 1 H W"] | None = None
    target_image: Float[Tensor, "B 3 H W"] | None = None
    target_mask: Float[Tensor, "B 1 H W"] | None = None
    vertices: Float[Tensor, "P V 3"] | None = None
    tracked_vertices: Float[Tensor, "P V 3"] | None = None
    posterior: Posterior | None = None
    laplacian: Laplacian | None = None
    mutual_information: Float[Tensor, ""] | None = None
    keypoints: Float[Tensor, "P K 3"] | None = None
    driven_keypoints: Float[Tensor, "P K 3"] | None = None


def loss_weights(settings: LossSettings, iteration: int) -> dict[str, float]:
    """Weight of every term that counts at this iteration (0 is the first); a term of weight zero is left out.

    Mesh supervision leads the way, then steps back for the images (section 3.6): `geometry` is multiplied by `geometry_after` from
    iteration `geometry_iterations` on. `kl` rises in equal steps, and has its full weight in iteration `kl_warm_up` - 1 and later.
    """
    weights = {name: getattr(settings, name) for name in TERMS}
    if iteration < settings.kl_warm_up:
        weights["kl"] *= (iteration + 1) / settings.kl_warm_up
    if iteration >= settings.geometry_iterations:
        weights["geometry"] *= settings.geometry_after
    return {name: weight for name, weight in weights.items() if weight > 0}


def evaluate_losses(inputs: LossInputs, weights: dict[str, float]) -> dict[str, Tensor]:
    """Value of every term that has a weight, not yet multiplied by it.

    Args:
        inputs: predictions and targets.
        weights: of `loss_weights`; only its keys are evaluated.

    Raises:
        ValueError: if a term has a weight but a part that it needs is None.
    """
    terms = {
        "image": (image_loss, ("image", "target_image", "target_mask")),
        "mask": (mask_loss, ("mask", "target_mask")),
        "geometry": (geometry_loss, ("vertices", "tracked_vertices")),
        "laplacian": (laplacian_loss, ("vertices", "tracked_vertices", "laplacian")),
        "kl": (kl_loss, ("posterior",)),
        "mutual_information": (lambda estimate: estimate, ("mutual_information",)),
        "perturbation": (perturbation_loss, ("keypoints", "driven_keypoints")),
    }
    values = {}
    for name in weights:
        function, needed = terms[name]
        missing = [part for part in needed if getattr(inputs, part) is None]
        if missing:
            raise ValueError(
                f"evaluate_losses(): the term {name!r} needs {missing}; got None. Give the capture what it lacks, or set loss.{name} to 0."
            )
        values[name] = function(*(getattr(inputs, part) for part in needed))
    return values


def weighted_sum(terms: dict[str, Tensor], weights: dict[str, float]) -> Tensor:
    """The loss: sum of weight times term. Gradients: to the terms."""
    return torch.stack([weights[name] * value for name, value in terms.items()]).sum()


def _foreground_pixels(target_mask: Float[Tensor, "B 1 H W"]) -> Tensor:
    """Foreground pixels of the batch; at least one, so that cameras that miss the person give no division by zero."""
    return target_mask.sum().clamp(min=1)
