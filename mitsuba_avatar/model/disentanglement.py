"""The statistics network of mutual information neural estimation (MINE), and the bound that it climbs.

For any function f, I(z; c) >= E_joint[f] - log E_product[exp f], where the product pairs every z with the driving signal of another
frame; the best f is the logarithm of the density ratio, up to a constant. Training f makes the bound tight; training the encoder
against it drives what the driving signal tells out of z.

Symbols: N rows (frames, or draws of them), Z latent size, D entries of the driving signal c = (theta, face). Mutual information in nats.

Source: arXiv:2105.10441, section 3.5.2; MINE: arXiv:1801.04062.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mitsuba_avatar.model.layers import NEGATIVE_SLOPE

# Bound of |f|, in nats. The exponential of an unbounded f runs away as soon as one pair of the product is told apart with certainty;
# with this one the estimate stays below 2 * LARGEST_SCORE whatever the weights, far above what frames of a capture can show.
LARGEST_SCORE = 10.0
# Of an entry's deviation, relative to the largest one of its signal: what moves less is noise and must not be blown up to unit size.
SMALLEST_DEVIATION = 0.05


class StatisticsNetwork(nn.Module):
    """f(z, c): a scalar that is high where z and c belong together. Zero before training.

    A two-layer perceptron on both, plus an inner product of a linear embedding of each: the product alone expresses the density ratio of
    jointly Gaussian variables up to terms of each variable on its own, and finds it in a fraction of the steps.

    Args:
        latent_size: Z.
        driving_size: D.
        width: hidden features.
    """

    def __init__(self, latent_size: int, driving_size: int, width: int):
        super().__init__()
        self.from_latent, self.from_driving = nn.Linear(latent_size, width), nn.Linear(driving_size, width, bias=False)
        self.hidden, self.score = nn.Linear(width, width), nn.Linear(width, 1)
        self.latent_embedding, self.driving_embedding = nn.Linear(latent_size, width), nn.Linear(driving_size, width)
        for layer in (self.score, self.driving_embedding):
            nn.init.zeros_(layer.weight)
            nn.init.zeros_(layer.bias)
        self.activation = nn.LeakyReLU(NEGATIVE_SLOPE)
        for name, size in (("latent", latent_size), ("driving", driving_size)):
            self.register_buffer(f"{name}_mean", torch.zeros(size))
            self.register_buffer(f"{name}_std", torch.ones(size))

    def standardize_by(self, z: Float[Tensor, "N Z"], driving: Float[Tensor, "N D"]) -> None:
        """Measure inputs in the deviations of these rows from now on.

        Mutual information does not change with the scale of its variables, and neither may the estimate: an encoder could hide a leak
        by making it small.
        """
        for name, rows in (("latent", z), ("driving", driving)):
            std = rows.std(0, correction=0)
            largest = std.max()
            floor = torch.where(largest > 0, SMALLEST_DEVIATION * largest, torch.ones_like(largest))
            getattr(self, f"{name}_mean").copy_(rows.mean(0))
            getattr(self, f"{name}_std").copy_(torch.maximum(std, floor))

    def forward(self, z: Float[Tensor, "*#rows Z"], driving: Float[Tensor, "*#rows D"]) -> Float[Tensor, "*rows"]:
        """Scores of pairs, within +-LARGEST_SCORE; leading sizes are broadcast. Gradients: to everything."""
        return self.score_pairs(self.read_latent(z), self.read_driving(driving))

    def read_latent(self, z: Float[Tensor, "*rows Z"]) -> Float[Tensor, "*rows features"]:
        """What a score needs of latent codes: hidden features, then embedding. Made once a row, however many pairs the row is in."""
        z = (z - self.latent_mean) / self.latent_std
        return torch.cat([self.from_latent(z), self.latent_embedding(z)], dim=-1)

    def read_driving(self, driving: Float[Tensor, "*rows D"]) -> Float[Tensor, "*rows features"]:
        """What a score needs of driving signals: hidden features, then embedding."""
        driving = (driving - self.driving_mean) / self.driving_std
        return torch.cat([self.from_driving(driving), self.driving_embedding(driving)], dim=-1)

    def score_pairs(self, latent: Float[Tensor, "*#rows features"], driving: Float[Tensor, "*#rows features"]) -> Float[Tensor, "*rows"]:
        """Scores of what was read, as `forward`."""
        from_latent, latent_embedding = latent.chunk(2, dim=-1)
        from_driving, driving_embedding = driving.chunk(2, dim=-1)
        features = self.activation(from_latent + from_driving)
        score = self.score(self.activation(self.hidden(features)))[..., 0]
        score = score + (latent_embedding * driving_embedding).sum(-1) / math.sqrt(self.score.in_features)
        return LARGEST_SCORE * torch.tanh(score / LARGEST_SCORE)


def without_common_shift(z: Float[Tensor, "P Z"]) -> Float[Tensor, "P Z"]:
    """The same codes, whose gradient does not shift all rows alike.

    Mutual information does not change with a shift, but a network that learns from the last few hundred steps' codes does: an encoder
    outruns it by moving all its codes away, pays for that in the KL term, and leaves z = 0 far from every code that the decoder has met.

    Args:
        z: [P, Z]; of a single row nothing would be left of the gradient, so that it stays as it is.
    """
    if len(z) < 2 or not z.requires_grad:
        return z
    passed = z.view_as(z)
    passed.register_hook(lambda gradient: gradient - gradient.mean(0))
    return passed


def log_mean_exp(scores: Float[Tensor, "*rows"]) -> Float[Tensor, ""]:
    """log of the mean of exp(scores), without overflow."""
    return torch.logsumexp(scores.flatten(), 0) - math.log(scores.numel())


def mismatched(driving: Float[Tensor, "N D"], count: int, generator: torch.Generator) -> Float[Tensor, "S N D"]:
    """Driving signals of other rows: `count` copies, each shifted along the rows by a random number of places that is not zero.

    Args:
        driving: [N, D], two rows or more.
        count: S.
        generator: on the CPU.
    """
    shifts = torch.randint(1, len(driving), (count,), generator=generator)
    return torch.stack([driving.roll(-shift, 0) for shift in shifts.tolist()])


def mutual_information_bound(joint: Float[Tensor, "*rows"], product: Float[Tensor, "*pairs"]) -> Float[Tensor, ""]:
    """Donsker and Varadhan's lower bound, nats: mean score of matching pairs minus log mean exp of the mismatched ones'."""
    return joint.mean() - log_mean_exp(product)


def corrected_objective(joint: Float[Tensor, "*rows"], product: Float[Tensor, "*pairs"], denominator: float) -> Float[Tensor, ""]:
    """A number whose gradient is that of the bound, with the expectation under the logarithm taken from `denominator`.

    The gradient of log mean exp is a ratio of two means. A mini-batch's own mean below the line makes the ratio biased, hence MINE's
    correction: a moving average of mean(exp f) over many batches stands there instead. The number itself is no estimate.

    Source: arXiv:1801.04062, section 3.2.
    """
    return joint.mean() - product.exp().mean() / denominator
