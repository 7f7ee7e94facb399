"""An avatar in motion: decode and render frame after frame, with the time that each part takes.

Symbols: N frames, V vertices, Z latent size. Metres, world axes, linear radiance.
"""

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import ConvexHull
from torch import Tensor

from mitsuba_avatar.captures.cameras import Camera
from mitsuba_avatar.driving.signals import DrivingSignals
from mitsuba_avatar.model.avatar import Avatar
from mitsuba_avatar.rendering.ambient_occlusion import AmbientOcclusion
from mitsuba_avatar.rendering.cameras import CameraBatch
from mitsuba_avatar.rendering.surface import SurfaceRenderer
from mitsuba_avatar.training.statistics import evenly_spaced

PARTS = ("occlusion", "decoding", "rendering")


@dataclass
class FrameClock:
    """Seconds that each part of each frame took, in the order of PARTS."""

    seconds: dict[str, list[float]] = field(default_factory=lambda: {name: [] for name in PARTS})

    @contextmanager
    def timed(self, part: str) -> Iterator[None]:
        """Count what happens inside as one frame's share of a part; waits for the device."""
        started = time.perf_counter()
        yield
        if torch.cuda.is_available():
            torch.cuda.synchronize()
        self.seconds[part].append(time.perf_counter() - started)

    def frames_per_second(self) -> dict[str, float]:
        """Median rate of each part. The first frame, which compiles kernels, is left out where there are others."""
        return {name: 1 / float(np.median(seconds[1:] or seconds)) for name, seconds in self.seconds.items() if seconds}

    def summary(self) -> str:
        """One line for the user."""
        return ", ".join(f"{name} {rate:.1f}" for name, rate in self.frames_per_second().items()) + " frames per second"


@dataclass(frozen=True)
class AnimatedFrame:
    """One frame of a drive.

    Attributes:
        row: of the driving signals.
        vertices: [V, 3] metres, in the host's memory.
        radiance: [H, W, 3] linear, premultiplied by coverage.
        coverage: [H, W] of the avatar.
    """

    row: int
    vertices: Float[Tensor, "V 3"]
    radiance: Float[np.ndarray, "H W 3"]
    coverage: Float[np.ndarray, "H W"]


def decoder_latent(avatar: Avatar, z: Float[Tensor, "P Z"]) -> Float[Tensor, "P Z"] | None:
    """z as `Avatar.decode` wants it: on its device, None for an avatar without a latent code."""
    return z.to(avatar.mean_texture.device) if avatar.settings.use_latent else None


def animate(
    avatar: Avatar,
    signals: DrivingSignals,
    latents: Float[Tensor, "N Z"],
    shots: Sequence[tuple[int, Camera]],
    renderer: SurfaceRenderer,
    occlusion: AmbientOcclusion,
    clock: FrameClock,
) -> Iterator[AnimatedFrame]:
    """Drive an avatar and draw it.

    Args:
        avatar: to be driven.
        signals: N frames.
        latents: [N, Z] of an imputation.
        shots: (row of the signals, camera), one a picture; a picture has its camera's size.
        renderer: of a film that holds the largest of them (`captures.cameras.film_size`).
        occlusion: baker at the avatar's shadow size.
        clock: is told what each part took.
    """
    device = avatar.mean_texture.device
    for row, camera in shots:
        theta, root, face = (values[row : row + 1].to(device) for values in (signals.theta, signals.root, signals.face))
        batch = CameraBatch.from_cameras([camera])
        with torch.no_grad():  # left before the yield: the caller's own gradients are not this function's business
            with clock.timed("occlusion"):
                share = posed_occlusion(avatar, occlusion, theta, seed=row)
            with clock.timed("decoding"):
                z = decoder_latent(avatar, latents[row : row + 1])
                output = avatar.decode(theta, root, face, z, batch.centers[None].to(device), share)
            with clock.timed("rendering"):
                radiance, mask = renderer.render(output.vertices, output.textures.flatten(0, 1), batch, seed=row)
                seen = (slice(camera.height), slice(camera.width))
                picture, coverage = radiance[0].permute(1, 2, 0)[seen].cpu().numpy(), mask[0, 0][seen].cpu().numpy()
        yield AnimatedFrame(row, output.vertices[0].cpu(), np.ascontiguousarray(picture), np.ascontiguousarray(coverage))


@torch.no_grad()
def posed_template(avatar: Avatar, theta: Float[Tensor, "1 D"]) -> Float[Tensor, "V 3"]:
    """[V, 3] what ambient occlusion is baked on, in the host's memory: the root pose does not matter to it."""
    root = torch.eye(4, device=theta.device)[None]
    return avatar.pose_template(theta, root)[0].cpu()


def posed_occlusion(avatar: Avatar, occlusion: AmbientOcclusion, theta: Float[Tensor, "1 D"], seed: int = 0) -> Float[Tensor, "1 1 S S"]:
    """Ambient occlusion of one pose as `Avatar.decode` wants it, on the avatar's device."""
    return occlusion.bake(posed_template(avatar, theta), seed)[None, None].to(avatar.mean_texture.device)


@torch.no_grad()
def outline(avatar: Avatar, signals: DrivingSignals, most_frames: int = 200) -> Float[np.ndarray, "P 3"]:
    """Corners of the convex hull of the posed template over time: a camera that has them in view sees all of it, in every frame.

    Args:
        avatar: whose template is posed.
        signals: that pose it.
        most_frames: evenly spaced ones are looked at where there are more.

    Returns:
        [P, 3] metres, world axes.
    """
    device, corners = avatar.mean_texture.device, np.zeros((0, 3), np.float32)
    for row in evenly_spaced(list(range(len(signals))), most_frames):
        theta, root = (values[row : row + 1].to(device) for values in (signals.theta, signals.root))
        points = np.concatenate([corners, avatar.pose_template(theta, root)[0].cpu().numpy()])
        corners = points[ConvexHull(points).vertices]
    return corners
