"""An avatar played by the frames of a capture: surface, textures and occlusion of any frame, towards any cameras."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mitsuba_avatar.captures.folder import Capture
from mitsuba_avatar.driving.animation import posed_occlusion
from mitsuba_avatar.model.avatar import Avatar
from mitsuba_avatar.rendering.ambient_occlusion import AmbientOcclusion


@dataclass(frozen=True, eq=False)
class PosedAvatar:
    """An avatar in one frame, on the CPU.

    Attributes:
        rest_vertices, vertices: [V, 3] in rest space and in the world, metres.
        textures: [N, 3, T, T] linear radiance towards each camera.
        ambient_occlusion: [S, S] of the posed template, 1 where open.
    """

    rest_vertices: Float[Tensor, "V 3"]
    vertices: Float[Tensor, "V 3"]
    textures: Float[Tensor, "N 3 T T"]
    ambient_occlusion: Float[Tensor, "S S"]


@dataclass(frozen=True, eq=False)
class Playback:
    """An avatar with what plays it; the latent code is zero.

    Attributes:
        avatar: to be played.
        capture: whose theta, root and face play it; it may be another capture of the same rig.
        occlusion: baker at the avatar's shadow size.
    """

    avatar: Avatar
    capture: Capture
    occlusion: AmbientOcclusion

    @torch.no_grad()
    def pose(
        self, frame: int, centers: Float[np.ndarray, "N 3"] | Float[Tensor, "N 3"], turn: Float[np.ndarray, "4 4"] | None = None
    ) -> PosedAvatar:
        """One frame, the same whichever frames came before.

        Args:
            frame: index into the capture.
            centers: [N, 3] of cameras, metres, world axes.
            turn: [4, 4] rigid, moves the posed person in the world; None leaves it where the capture has it.
        """
        device = self.avatar.mean_texture.device
        theta, root, face = (
            torch.from_numpy(np.array(values[frame], np.float32))[None].to(device)
            for values in (self.capture.theta, self.capture.root, self.capture.face)
        )
        if turn is not None:
            root = torch.from_numpy(turn.astype(np.float32)).to(device)[None] @ root
        share = posed_occlusion(self.avatar, self.occlusion, theta, seed=frame)
        cameras = torch.as_tensor(centers, dtype=torch.float32, device=device)[None]
        output = self.avatar.decode(theta, root, face, None, cameras, share)
        return PosedAvatar(output.rest_vertices[0].cpu(), output.vertices[0].cpu(), output.textures[0].cpu(), share[0, 0].cpu())
