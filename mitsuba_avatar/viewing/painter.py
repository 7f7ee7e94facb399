"""From a view state and a camera to a picture: decodes the avatar, dresses its surface in what should be seen, renders it.

Whatever the surface shows, a texture of display-encoded colours is made of it and drawn by the surface renderer, so that every kind of
picture has the same silhouette and pixels. Symbols: S texels of the shading maps, T of the avatar's texture.
"""

import time
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn import functional

from mitsuba_avatar.body.mesh import vertex_normals
from mitsuba_avatar.body.rig import Rig
from mitsuba_avatar.body.uv import UvAtlas
from mitsuba_avatar.captures.cameras import Camera
from mitsuba_avatar.captures.colour import decode, encode
from mitsuba_avatar.driving.animation import posed_occlusion
from mitsuba_avatar.driving.uncertainty import prior_codes, shape_spread
from mitsuba_avatar.model.avatar import Avatar, AvatarOutput
from mitsuba_avatar.rendering.ambient_occlusion import AmbientOcclusion
from mitsuba_avatar.rendering.cameras import CameraBatch
from mitsuba_avatar.rendering.surface import SurfaceRenderer
from mitsuba_avatar.reporting.figures import heat_map
from mitsuba_avatar.viewing.state import Surface, ViewState
from mitsuba_avatar.viewing.wireframe import draw_wireframe

SHADING_SIZE = 256  # texels of maps made from the mesh
BACKDROP = 0.05  # linear radiance behind the avatar: dark grey, the same for all pictures
UNCERTAINTY_SAMPLES = 8  # latent codes drawn from the prior
UNCERTAINTY_MAXIMUM_MM = 10.0  # spread that is drawn brightest
TONE_LEVELS = 4096  # of the table that display-encodes pixels
PARTS = ("occlusion", "decoding", "rendering", "encoding")


@dataclass(frozen=True)
class Quality:
    """How finely a picture is drawn: coarse while something moves, fine when all is still.

    Attributes:
        samples_per_pixel: of the renderer.
        occlusion_lag: pictures by which the ambient occlusion may lag behind the pose. Tracing it costs as much as decoding, and
            shadows change more slowly than what casts them.
    """

    samples_per_pixel: int
    occlusion_lag: int


MOVING, STILL = Quality(1, 3), Quality(8, 0)


@dataclass
class Timings:
    """Seconds that the last picture's parts took, under the names of PARTS; a part that was not needed takes none."""

    seconds: dict[str, float] = field(default_factory=dict)

    def lap(self, part: str, started: float) -> float:
        """Count the time since `started` under a part; returns the time now."""
        now = time.perf_counter()
        self.seconds[part] = self.seconds.get(part, 0.0) + now - started
        return now


class Painter:
    """Draws view states. Not for several threads at once.

    Args:
        avatar: to be shown.
        rig: of the avatar.
        occlusion: baker at the size that the avatar reads.
    """

    def __init__(self, avatar: Avatar, rig: Rig, occlusion: AmbientOcclusion):
        self.avatar, self.rig, self.occlusion = avatar, rig, occlusion
        self.atlas = UvAtlas(rig.topology, SHADING_SIZE)
        self.faces = torch.from_numpy(rig.topology.faces)
        self.timings = Timings()
        self._renderers: dict[tuple[int, int, int], SurfaceRenderer] = {}
        self._share: tuple[bytes, Tensor] | None = None  # of which pose
        self._lag = 0  # pictures since then
        self._spread: tuple[bytes, Tensor] | None = None
        levels = encode(torch.linspace(0, 1, TONE_LEVELS), "srgb")
        self._tones = (255 * levels + 0.5).to(torch.uint8)

    @torch.no_grad()
    def draw(
        self,
        state: ViewState,
        face: Float[np.ndarray, "F"],  # noqa: F821
        z: Float[Tensor, "1 Z"] | None,
        camera: Camera,
        quality: Quality = STILL,
    ) -> UInt8[np.ndarray, "H W 3"]:
        """The avatar over a grey backdrop, display-encoded.

        Args:
            state: pose, root, surface, switches.
            face: [F] the state's face signal with everything added.
            z: latent code; None for an avatar that has none.
            camera: decides the picture's size.
            quality: how finely.
        """
        self.timings = Timings()
        device = self.avatar.mean_texture.device
        theta, root = (torch.from_numpy(np.asarray(values, np.float32))[None].to(device) for values in (state.theta, state.root))
        signal = torch.from_numpy(np.asarray(face, np.float32))[None].to(device)
        batch = CameraBatch.from_cameras([camera])
        now = time.perf_counter()
        share = self._occlusion_share(state, theta, quality)
        now = self.timings.lap("occlusion", now)
        output = self.avatar.decode(theta, root, signal, z, batch.centers[None].to(device), share)
        textures = self._surface(state, output, share, batch, (theta, signal))
        now = self.timings.lap("decoding", now)
        renderer = self._renderer(camera.width, camera.height, quality.samples_per_pixel)
        if state.has_wireframe:
            layers = renderer.render_layers(output.vertices, textures, batch)
            radiance, mask, depth = layers.radiance, layers.mask, layers.depth
        else:
            (radiance, mask), depth = renderer.render(output.vertices, textures, batch), None
        picture = self._toned(radiance + (1 - mask) * BACKDROP)
        if depth is not None:
            points = output.vertices[0].cpu().numpy().astype(np.float64)
            picture = draw_wireframe(picture, depth[0, 0].cpu().numpy(), points, self.rig.topology.faces, camera)
        self.timings.lap("rendering", now)
        return picture

    def _occlusion_share(self, state: ViewState, theta: Tensor, quality: Quality) -> Float[Tensor, "1 1 S S"] | None:
        """Ambient occlusion of the posed template; the last pose's is kept, since cameras and faces do not change it."""
        if not self.avatar.settings.use_shadow and state.surface != "ambient occlusion":
            return None
        key = np.asarray(state.theta, np.float32).tobytes()
        self._lag += 1
        if self._share is None or (key != self._share[0] and self._lag > quality.occlusion_lag):
            self._share, self._lag = (key, posed_occlusion(self.avatar, self.occlusion, theta)), 0
        return self._share[1]

    def _surface(
        self, state: ViewState, output: AvatarOutput, share: Tensor | None, batch: CameraBatch, drive: tuple[Tensor, Tensor]
    ) -> Float[Tensor, "1 3 _ _"]:
        """The texture to draw: linear radiance that is encoded to the colours meant."""
        surface: Surface = state.surface
        if surface == "texture":
            textures = output.textures[0]
            if not state.has_shadow:
                size = textures.shape[-2:]
                textures = textures / functional.interpolate(output.gain, size=size, mode="bilinear", align_corners=False)
            return textures
        if surface == "uncertainty":
            shown = self._spread_colours(state, *drive)
        elif surface == "ambient occlusion":
            shown = share.expand(-1, 3, -1, -1)
        elif surface == "shadow gain":
            shown = (output.gain / 2).clamp(0, 1).expand(-1, 3, -1, -1)  # 1, which changes nothing, is mid-grey
        else:
            shown = self._shape(output.vertices.cpu(), batch.centers, is_lit=surface == "shape")
        return decode(shown.contiguous(), "srgb").to(output.textures.device)

    def _shape(self, vertices: Float[Tensor, "1 V 3"], centers: Float[Tensor, "1 3"], is_lit: bool) -> Float[Tensor, "1 3 S S"]:
        """Grey lit from the camera, or normals in world axes as colours."""
        normals = vertex_normals(vertices, self.faces)
        maps = self.atlas.texels_from_vertices(torch.cat([vertices, normals], dim=2))
        normals = functional.normalize(maps[:, 3:], dim=1)
        if not is_lit:
            return 0.5 + 0.5 * normals
        to_camera = functional.normalize(centers[:, :, None, None] - maps[:, :3], dim=1)
        return (0.15 + 0.7 * (to_camera * normals).sum(1, keepdim=True).clamp(min=0)).expand(-1, 3, -1, -1)

    def _spread_colours(self, state: ViewState, theta: Tensor, face: Tensor) -> Float[Tensor, "1 3 S S"]:
        """Spread of the surface over latent codes drawn from the prior, as a heat map; none for an avatar without a latent code."""
        key = np.concatenate([state.theta, face[0].cpu().numpy()]).tobytes()
        if self._spread is None or self._spread[0] != key:
            spread = torch.zeros(self.rig.topology.num_vertices)
            if self.avatar.settings.use_latent:
                spread = shape_spread(self.avatar, theta, face, prior_codes(self.avatar, UNCERTAINTY_SAMPLES)).cpu()
            self._spread = (key, self.atlas.texels_from_vertices(spread[None, :, None]))
        colours = heat_map(1000 * self._spread[1][0, 0].numpy(), UNCERTAINTY_MAXIMUM_MM)
        return torch.from_numpy(colours).permute(2, 0, 1)[None]

    def _toned(self, radiance: Float[Tensor, "1 3 H W"]) -> UInt8[np.ndarray, "H W 3"]:
        """Display-encoded bytes by table: a fifth of what the power function costs."""
        level = (radiance[0].permute(1, 2, 0).clamp(0, 1) * (TONE_LEVELS - 1) + 0.5).to(torch.int32).cpu()
        return self._tones[level.flatten().long()].view(level.shape).numpy()

    def _renderer(self, width: int, height: int, samples_per_pixel: int) -> SurfaceRenderer:
        key = (width, height, samples_per_pixel)
        if key not in self._renderers:
            self._renderers[key] = SurfaceRenderer(self.rig.topology, width, height, samples_per_pixel)
        return self._renderers[key]
