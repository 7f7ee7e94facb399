"""What an avatar leaves open: the spread of what it decodes from one driving signal under latent codes drawn from the prior.

Spreads are root-mean-square distances from the mean, unbiased in the number of codes. Symbols: M codes, Z latent size, V vertices,
T texels. Metres, linear radiance.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from mitsuba_avatar.model.avatar import Avatar

AT_ONCE = 8  # codes


def prior_codes(avatar: Avatar, count: int, seed: int = 0) -> Float[Tensor, "M Z"]:
    """Latent codes drawn from the prior, on the avatar's device.

    Raises:
        ValueError: if the avatar has no latent code, or fewer than two codes are asked for.
    """
    if not avatar.settings.use_latent:
        raise ValueError("prior_codes(): expected an avatar with a latent code; model.use_latent is false. Use another run.")
    if count < 2:
        raise ValueError(f"prior_codes(): expected at least 2 codes; got {count}. A single one has no spread.")
    codes = torch.randn((count, avatar.settings.latent_size), generator=torch.Generator().manual_seed(seed))
    return codes.to(avatar.mean_texture.device)


@torch.no_grad()
def shape_spread(
    avatar: Avatar, theta: Float[Tensor, "1 D"], face: Float[Tensor, "1 F"], codes: Float[Tensor, "M Z"]
) -> Float[Tensor, "V"]:  # noqa: F821
    """Spread of each vertex in rest space, metres.

    Args:
        avatar: to be decoded.
        theta, face: the driving signal.
        codes: of `prior_codes`.
    """
    surfaces = [avatar.decode_rest_vertices(theta.expand(len(part), -1), face.expand(len(part), -1), part) for part in codes.split(AT_ONCE)]
    return torch.cat(surfaces).double().var(0, correction=1).sum(-1).sqrt().float()


@torch.no_grad()
def texture_spread(
    avatar: Avatar,
    drive: tuple[Float[Tensor, "1 D"], Float[Tensor, "1 4 4"], Float[Tensor, "1 F"]],
    centers: Float[Tensor, "N 3"],
    occlusion: Float[Tensor, "1 1 S S"] | None,
    codes: Float[Tensor, "M Z"],
) -> Float[Tensor, "T T"]:
    """Spread of each texel: standard deviation of radiance, root mean square over channels and cameras.

    Args:
        avatar: to be decoded.
        drive: theta, root, face.
        centers: [N, 3] of the cameras that it is seen from, metres.
        occlusion: [1, 1, S, S] of the pose; None without the shadow branch.
        codes: of `prior_codes`.
    """
    textures = [avatar.decode(*drive, z[None], centers[None], occlusion).textures[0] for z in codes]
    return torch.stack(textures).var(0, correction=1).mean(dim=(0, 1)).sqrt()
