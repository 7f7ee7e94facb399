"""The decoder: from standardised driving signals and latent code to maps over the texture atlas.

    z -> deconvolutions -> [S x S] --+
    theta, f -> localized maps ------+-> trunk -> geometry branch -> displacement of the template
                                            +---> texture branch  -> view-independent texture
                                                        +----------> view branch -> what the camera's direction adds

z starts at a tiny map and so reaches the whole output; theta and f enter late, at the conditioning map, and reach only the
receptive field of what follows. Charts that are neighbours in the atlas may lie far apart on the body: a trunk of 1x1 kernels
(`decoder_kernel`) leaves only the doublings to carry a signal across their border. Everything runs once per pose except the view
branch, which runs once per pose and camera on smaller maps. Every layer has untied biases, and all three outputs are exactly zero
before training.

Source: arXiv:2105.10441, sections 3.2 to 3.4. The paper publishes no layer sizes; branches and widths are ours.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from mitsuba_avatar.model.conditioning import LocalizedSignal
from mitsuba_avatar.model.layers import NEGATIVE_SLOPE, biased_in_full_precision, channels_last, convolution, doubling, start_at_zero
from mitsuba_avatar.settings import ModelSettings

VIEW_COORDINATES = 4  # direction to the camera in rest space, and its cosine with the rest surface's normal


@dataclass(frozen=True)
class DecodedMaps:
    """What the decoder says, before any scale is applied; G, T, W are geometry_size, texture_size and view_size.

    Attributes:
        displacement: [P, 3, G, G] in units of `displacement_scale`.
        texture: [P, 3, T, T] in units of `texture_scale`.
        view_texture: [P, N, 3, W, W] in units of `texture_scale`.
    """

    displacement: Float[Tensor, "P 3 G G"]
    texture: Float[Tensor, "P 3 T T"]
    view_texture: Float[Tensor, "P N 3 W W"]


class LatentMaps(nn.Module):
    """From the latent vector to features at the conditioning map: a linear layer, then doublings."""

    def __init__(self, settings: ModelSettings):
        super().__init__()
        widths = settings.latent_channels
        self.size = settings.conditioning_size >> (len(widths) - 1)
        self.linear = nn.Linear(settings.latent_size, widths[0] * self.size**2)
        layers: list[nn.Module] = []
        for level, (before, after) in enumerate(zip(widths, widths[1:], strict=False), start=1):
            layers += [nn.LeakyReLU(NEGATIVE_SLOPE), doubling(before, after, self.size << level)]
        self.doublings = nn.Sequential(*layers)

    def forward(self, z: Float[Tensor, "P Z"]) -> Float[Tensor, "P C S S"]:
        """Features with support over the whole map."""
        features = self.linear(z).reshape(len(z), -1, self.size, self.size)
        return self.doublings(channels_last(features))


class Branch(nn.Module):
    """Doublings from the trunk to a map of 3 channels; keeps the features on the way for who wants them.

    Args:
        in_channels, in_size: of the trunk's features.
        widths: hidden features at each doubling; the last is repeated if there are more doublings.
        out_size: texels of the output, in_size or more.
    """

    def __init__(self, in_channels: int, in_size: int, widths: tuple[int, ...], out_size: int):
        super().__init__()
        self.widths = [in_channels]  # at in_size, 2 in_size, ...
        self.hidden = nn.ModuleList()
        size = in_size
        while 2 * size < out_size:
            size *= 2
            width = widths[min(len(self.hidden), len(widths) - 1)]
            self.hidden.append(doubling(self.widths[-1], width, size))
            self.widths.append(width)
        last = convolution if out_size == in_size else doubling
        self.last = start_at_zero(last(self.widths[-1], 3, out_size))

    def forward(self, trunk: Float[Tensor, "P C S S"]) -> tuple[Float[Tensor, "P 3 _ _"], list[Tensor]]:
        """Output map, and the features at S, 2 S, 4 S, ... that led to it."""
        features = [trunk]
        for layer in self.hidden:
            features.append(functional.leaky_relu(layer(features[-1]), NEGATIVE_SLOPE))
        return biased_in_full_precision(self.last, features[-1]), features


class ViewBranch(nn.Module):
    """What the texture gains from the direction of the camera: convolutions at `view_size`, once per pose and camera."""

    def __init__(self, in_channels: int, settings: ModelSettings):
        super().__init__()
        widths, size = settings.view_channels, settings.view_size
        # The first layer sees features and view coordinates side by side. It is split in two, because the part that reads the
        # features is the same for all cameras of a pose.
        self.from_features = convolution(in_channels, widths[0], size)
        self.from_view = nn.Conv2d(VIEW_COORDINATES, widths[0], kernel_size=3, padding=1, bias=False)
        layers: list[nn.Module] = []
        for before, after in zip(widths, widths[1:], strict=False):
            layers += [nn.LeakyReLU(NEGATIVE_SLOPE), convolution(before, after, size)]
        self.hidden = nn.Sequential(*layers, nn.LeakyReLU(NEGATIVE_SLOPE))
        self.last = start_at_zero(convolution(widths[-1], 3, size))

    def forward(self, features: Float[Tensor, "P C W W"], view: Float[Tensor, "P N K W W"]) -> Float[Tensor, "P N 3 W W"]:
        """View-dependent addition to the texture of every pose, one per camera.

        Args:
            features: [P, C, W, W] of the texture branch.
            view: [P, N, VIEW_COORDINATES, W, W] per texel, see `model.viewing`.
        """
        poses, cameras = view.shape[:2]
        shared = self.from_features(features).repeat_interleave(cameras, dim=0)  # [P * N, C, W, W], cameras fastest
        own = self.from_view(channels_last(view.flatten(0, 1)))
        return biased_in_full_precision(self.last, self.hidden(shared + own)).unflatten(0, (poses, cameras))


class Decoder(nn.Module):
    """Driving signals, latent code and view to displacement and texture maps.

    Args:
        settings: sizes and switches.
        pose_masks: [D, S, S] where each joint angle may act.
        face_masks: [F, S, S] where each entry of the face signal may act.
    """

    def __init__(self, settings: ModelSettings, pose_masks: Float[Tensor, "D S S"], face_masks: Float[Tensor, "F S S"]):
        super().__init__()
        size = settings.conditioning_size
        compressed = settings.use_compression
        self.pose_signal = LocalizedSignal(pose_masks, settings.pose_embedding_channels if compressed else None)
        self.face_signal = LocalizedSignal(face_masks, settings.face_embedding_channels if compressed else None)
        self.latent_maps = LatentMaps(settings) if settings.use_latent else None
        previous = self.pose_signal.channels + self.face_signal.channels + (settings.latent_channels[-1] if settings.use_latent else 0)
        layers: list[nn.Module] = []
        for width in settings.decoder_channels:
            layers += [convolution(previous, width, size, settings.decoder_kernel), nn.LeakyReLU(NEGATIVE_SLOPE)]
            previous = width
        self.trunk = nn.Sequential(*layers)
        self.geometry = Branch(previous, size, settings.geometry_channels, settings.geometry_size)
        self.texture = Branch(previous, size, settings.texture_channels, settings.texture_size)
        self.view_level = (settings.view_size // size).bit_length() - 1  # doublings from the trunk to the view branch
        self.view = ViewBranch(self.texture.widths[self.view_level], settings)

    def forward(
        self, theta: Float[Tensor, "P D"], face: Float[Tensor, "P F"], z: Float[Tensor, "P Z"] | None, view: Float[Tensor, "P N K W W"]
    ) -> DecodedMaps:
        """Maps of every pose, and of every camera of it.

        Args:
            theta, face: [P, D], [P, F] standardised driving signals.
            z: [P, Z] latent code; None where the model has none.
            view: [P, N, VIEW_COORDINATES, W, W] see `model.viewing`.

        Gradients: to every argument and parameter.
        """
        trunk = self._trunk(theta, face, z)
        displacement, _ = self.geometry(trunk)
        texture, features = self.texture(trunk)
        return DecodedMaps(displacement, texture, self.view(features[self.view_level], view))

    def displacement(
        self, theta: Float[Tensor, "P D"], face: Float[Tensor, "P F"], z: Float[Tensor, "P Z"] | None
    ) -> Float[Tensor, "P 3 G G"]:
        """The displacement of `forward` alone, at a fraction of its cost."""
        return self.geometry(self._trunk(theta, face, z))[0]

    def _trunk(self, theta: Tensor, face: Tensor, z: Tensor | None) -> Float[Tensor, "P C S S"]:
        """Features that geometry and texture share."""
        maps = [self.pose_signal(theta), self.face_signal(face)]
        if self.latent_maps is not None:
            maps.append(functional.leaky_relu(self.latent_maps(z), NEGATIVE_SLOPE))
        return self.trunk(torch.cat(maps, dim=1))
