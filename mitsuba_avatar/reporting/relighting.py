"""The reflectance behind an avatar's radiance: what is left of its texture when the light it was captured in is divided out.

A diffuse surface shows L = albedo * E / pi, with E the irradiance that reaches it in its pose. E is ray-traced on the avatar's own
surface, under the captured light where a capture names it (`lighting.scene` in capture.yaml), else under uniform light of radiance one:
then E / pi is ambient occlusion, and albedo is right up to a factor. Over several training frames and all views,

    albedo = (sum L E' + p sum L M) / (sum E'^2 + p sum M^2),    E' = E / pi,

per texel and channel: well-lit moments count most. M is the mean of E' over the surface; the terms with it let a texel which hardly
any light reaches look like its radiance under average light, instead of dividing by nothing.

What is not diffuse reflection of direct light is counted as albedo all the same: gloss (about 0.04 of the light, whatever the colour),
light that parts of the body throw at each other, wrinkles that texture shows and geometry lacks.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mitsuba_avatar.body.mesh import vertex_normals
from mitsuba_avatar.body.rig import Topology
from mitsuba_avatar.body.uv import UvAtlas
from mitsuba_avatar.captures.folder import Capture
from mitsuba_avatar.rendering.ambient_occlusion import AmbientOcclusion
from mitsuba_avatar.rendering.environment_map import EnvironmentMap
from mitsuba_avatar.rendering.lit_scene import far_radiance
from mitsuba_avatar.reporting.playback import Playback, PosedAvatar
from mitsuba_avatar.resources import find_resource

FRAMES = 8  # training frames that an estimate looks at
CAMERAS = 8
RAYS = 128  # per texel and frame
REACH = 4.0  # metres; a body throws its shadow on itself no farther
GRAZING = 0.02  # weight of a view that does not face a texel: only where no other view does it count
BRIGHTEST = 0.95  # albedo; nothing that people wear is whiter
PRIOR = 0.1  # p above


@dataclass(frozen=True, eq=False)
class CapturedLight:
    """The light of a capture.

    Attributes:
        name: of the scene, or "uniform".
        environment: light from far away.
    """

    name: str
    environment: EnvironmentMap

    @staticmethod
    def of(capture: Capture, choice: str = "auto") -> "CapturedLight":
        """The captured light by choice: "uniform", a scene's name or file, or "auto" (the scene that the capture names, else uniform).

        Raises:
            FileNotFoundError: if there is no such scene.
            ValueError: if the scene's light does not all come from far away.
        """
        name = str(capture.description.lighting.get("scene", "uniform")) if choice == "auto" else choice
        if name == "uniform":
            return CapturedLight(name, EnvironmentMap(torch.ones(3, 2, 4)))
        try:
            return CapturedLight(name, EnvironmentMap(far_radiance(scene_file(name))))
        except FileNotFoundError as error:
            raise FileNotFoundError(f"CapturedLight.of(): {error} Or say --captured-light uniform.") from error


class SurfaceRadiance:
    """What the surface of an avatar shows on average: training frames and cameras of a capture, evenly spread.

    Args:
        playback: avatar, and the capture whose training frames and cameras are looked at.
        topology: of the avatar's rig.
    """

    def __init__(self, playback: Playback, topology: Topology):
        capture = playback.capture
        self.playback, self.topology = playback, topology
        self.atlas = UvAtlas(topology, playback.avatar.settings.texture_size)
        names = _spread(capture.camera_names(held_out=False) or capture.camera_names(), CAMERAS)
        self.centers = torch.from_numpy(np.stack([capture.cameras[name].center_world for name in names]).astype(np.float32))
        self.frames = _spread(capture.frame_indices("train") or list(range(len(capture.frames))), FRAMES)

    def at(self, frame: int) -> tuple[PosedAvatar, Float[Tensor, "3 T T"]]:
        """The posed avatar, and its linear radiance as the mean over views that face each texel, [3, T, T]."""
        posed = self.playback.pose(frame, self.centers)
        normals = vertex_normals(posed.vertices[None], torch.from_numpy(self.topology.faces))
        surface = self.atlas.texels_from_vertices(torch.cat([posed.vertices[None], normals], dim=2))[0]  # [6, T, T]
        to_camera = torch.nn.functional.normalize(self.centers[:, :, None, None] - surface[None, :3], dim=1)
        facing = (to_camera * torch.nn.functional.normalize(surface[None, 3:], dim=1)).sum(1, keepdim=True).clamp(min=GRAZING)
        return posed, (posed.textures.clamp(min=0) * facing).sum(0) / facing.sum(0)

    def mean(self) -> Float[Tensor, "3 T T"]:
        """Over the frames: the light of the capture baked into one texture, [3, T, T]."""
        return torch.stack([self.at(frame)[1] for frame in self.frames]).mean(dim=0)


def estimate_albedo(
    shown: SurfaceRadiance, light: CapturedLight, progress: Callable[[int, int], None] = lambda done, total: None
) -> Float[Tensor, "3 T T"]:
    """Diffuse albedo of an avatar, [3, T, T] in 0..1, defined at every texel; the same on every call.

    Args:
        shown: by the avatar, in frames of the capture that it was *trained* on.
        light: of that capture.
        progress: called as `progress(done, total)` after every frame.
    """
    size = shown.atlas.size
    baker = AmbientOcclusion(shown.topology, size, RAYS, REACH)
    product, squares = torch.zeros(3, size, size), torch.zeros(3, size, size)
    for done, frame in enumerate(shown.frames):
        posed, radiance = shown.at(frame)
        irradiance = baker.bake_lighting(posed.vertices, light.environment, seed=frame).irradiance / np.pi
        mean = irradiance[:, shown.atlas.covered].mean(dim=1)[:, None, None]
        product += radiance * (irradiance + PRIOR * mean)
        squares += irradiance**2 + PRIOR * mean**2
        progress(done + 1, len(shown.frames))
    return (product / (squares * shown.playback.capture.description.exposure)).clamp(0, BRIGHTEST)


def scene_file(name: str) -> Path:
    """The XML file of a scene, by path or by its name in scenes/."""
    return find_resource("scenes", name, ".xml")


def _spread(items: list, count: int) -> list:
    """At most `count` items, evenly spread."""
    return [items[i * len(items) // min(count, len(items))] for i in range(min(count, len(items)))]
