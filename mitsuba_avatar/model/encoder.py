"""The encoder: from the registered mesh of a frame to a Gaussian over the latent code z. Used in training only.

Its last layer begins small, so that the posterior begins near the prior, and is scaled by the root of its inputs ("equalized learning
rate", arXiv:1710.10196). Adam moves every one of its thousand weights by the learning rate at each step; unscaled, `logvar` jumps by
several units at once, exp(logvar) explodes, and at a low KL weight training ends there. The layer's inputs are divided by
sqrt(1 + their mean square): a frame whose clothes are far from where they usually are then has a code in its own direction, but no
farther out. Undivided, single frames reached 700 nats where the rest had 12, enough to skip the step.

It sees what the driving signal cannot tell: the registered vertices, unposed, minus the template, drawn as a map over the texture
atlas. Convention of the whole project: `logvar` is the logarithm of the variance, so std = exp(0.5 * logvar).

Source: arXiv:2105.10441, section 3.2.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mitsuba_avatar.model.layers import NEGATIVE_SLOPE, channels_last, in_full_precision
from mitsuba_avatar.settings import ModelSettings

# In units of `displacement_scale`. Unposing sends the vertices of a folded joint far away (see body.skinning.unpose_vertices), and one
# such texel would drown all others; real clothing stays within this.
LARGEST_OFFSET = 10.0
HEAD_DEVIATION = 0.1  # of the last layer's weights at first; outputs then deviate by about as much from the prior's mu = logvar = 0


@dataclass(frozen=True)
class Posterior:
    """Diagonal Gaussian over the latent code, one row a pose.

    Attributes:
        mu: [P, Z] mean.
        logvar: [P, Z] logarithm of the variance.
    """

    mu: Float[Tensor, "P Z"]
    logvar: Float[Tensor, "P Z"]

    def sample(self, noise: Float[Tensor, "P Z"]) -> Float[Tensor, "P Z"]:
        """Reparameterised draw z = mu + std * noise; noise is drawn by the caller, who owns the seeds. Gradients: to mu and logvar."""
        return self.mu + torch.exp(0.5 * self.logvar) * noise

    def divergence(self) -> Float[Tensor, "P"]:  # noqa: F821
        """[P] Kullback-Leibler divergence from N(0, I) of each row, nats. Gradients: to mu and logvar."""
        return 0.5 * (self.mu.square() + self.logvar.exp() - 1 - self.logvar).sum(-1)


class Encoder(nn.Module):
    """Strided convolutions over the map of offsets, halving it once per entry of `encoder_channels`, then one scaled linear layer."""

    def __init__(self, settings: ModelSettings):
        super().__init__()
        layers: list[nn.Module] = []
        previous = 3
        for channels in settings.encoder_channels:
            layers += [nn.Conv2d(previous, channels, kernel_size=4, stride=2, padding=1), nn.LeakyReLU(NEGATIVE_SLOPE)]
            previous = channels
        self.convolutions = nn.Sequential(*layers)
        smallest = settings.encoder_size >> len(settings.encoder_channels)
        self.head = nn.Linear(previous * smallest**2, 2 * settings.latent_size)
        self.head_scale = self.head.in_features**-0.5
        nn.init.normal_(self.head.weight, std=HEAD_DEVIATION)
        nn.init.zeros_(self.head.bias)

    def forward(self, offsets: Float[Tensor, "P 3 S S"]) -> Posterior:
        """Posterior of each pose.

        Args:
            offsets: [P, 3, S, S] unposed registered surface minus template, in units of `displacement_scale`, S = encoder_size.
        """
        features = self.convolutions(channels_last(offsets.clamp(-LARGEST_OFFSET, LARGEST_OFFSET)))
        features = features.flatten(1).to(self.head.weight.dtype)
        features = features / (1 + features.square().mean(1, keepdim=True)).sqrt()  # root mean square below one
        mu, logvar = in_full_precision(self.head, self.head_scale * features).chunk(2, dim=1)  # [P, Z] each
        return Posterior(mu, logvar)
