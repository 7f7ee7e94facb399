"""A viewing session: which avatar, which timeline, which state, and what happens to the state when a control is used.

A browser, or anything else, sits on top of it: it calls the methods that its controls stand for and asks for pictures. Nothing here knows
about sockets or widgets, so that everything can be tested without them.
"""

import io
import math
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from mitsuba_avatar.body.rig import Rig
from mitsuba_avatar.captures.cameras import Camera, look_at
from mitsuba_avatar.driving.imputation import FROM_TRAINING, make_imputation
from mitsuba_avatar.driving.principal_directions import PrincipalDirections
from mitsuba_avatar.driving.signals import DrivingSignals
from mitsuba_avatar.driving.training_latents import TrainingLatents
from mitsuba_avatar.model.avatar import Avatar
from mitsuba_avatar.rendering.ambient_occlusion import AmbientOcclusion
from mitsuba_avatar.viewing.painter import MOVING, STILL, UNCERTAINTY_MAXIMUM_MM, UNCERTAINTY_SAMPLES, Painter, Quality
from mitsuba_avatar.viewing.pose_map import PoseMap
from mitsuba_avatar.viewing.state import ViewState, limb_groups
from mitsuba_avatar.viewing.window import camera_of_view

FACE_DIRECTIONS, LATENT_DIRECTIONS = 8, 8
LARGEST_SHIFT = 3.0  # standard deviations that a slider reaches
MOST_NAMED_FACE_ENTRIES = 70  # a face signal of named actions gets a slider for each; longer ones are turned by directions alone
MAP_SHARE = 0.34  # of the picture's shorter side that the map takes
FIRST_FIELD = 0.6  # radians between the upper and lower edge of the first view: a portrait lens
JPEG_QUALITY = 80
_LEGENDS = {
    "uncertainty": f"spread of the surface over {UNCERTAINTY_SAMPLES} codes of the prior: black 0, yellow {UNCERTAINTY_MAXIMUM_MM:g} mm",
    "shadow gain": "gain of the quasi-shadow: black 0, mid-grey 1, white 2",
    "ambient occlusion": "share of the sky that is open: black 0, white 1",
    "normals": "surface normal in world axes: red x, green y, blue z",
}


@dataclass(frozen=True, eq=False)  # tensors have no truth value to compare by
class ViewedAvatar:
    """What a session has to show.

    Attributes:
        avatar, rig: the person.
        timeline: what the time slider runs along.
        training: poses that the avatar was trained on, for map and directions.
        latents: what the encoder says about the training frames; None where nothing can be encoded.
        others: further groups of poses on the map, by name.
        face_names: of the entries of the face signal that may be turned one by one; empty for landmarks.
        occlusion: baker at the size that the avatar reads.
    """

    avatar: Avatar
    rig: Rig
    timeline: DrivingSignals
    training: DrivingSignals
    latents: TrainingLatents | None
    others: Mapping[str, DrivingSignals]
    face_names: tuple[str, ...]
    occlusion: AmbientOcclusion


class ViewerSession:
    """State and pictures. Methods may be called from any thread, `picture` from one alone.

    Attributes:
        limbs: group -> pose angles. angle_limits: [D, 2] radians, the rig's, widened where the recorded poses exceed them.
        imputations: names to choose from.
        face_directions, latent_directions: handles; None where the signal has none.
        pose_map: None where there are too few poses.
        version: grows with every change of the state.
    """

    def __init__(self, viewed: ViewedAvatar):
        self.viewed, self.painter = viewed, Painter(viewed.avatar, viewed.rig, viewed.occlusion)
        self.limbs = limb_groups(viewed.rig.dofs.names)
        recorded = torch.cat([viewed.training.theta, viewed.timeline.theta]).numpy()
        self.angle_limits: Float[np.ndarray, "D 2"] = np.stack(
            [np.minimum(viewed.rig.dofs.lower, recorded.min(axis=0)), np.maximum(viewed.rig.dofs.upper, recorded.max(axis=0))], axis=1
        )
        self.face_directions = PrincipalDirections.of(viewed.training.face.numpy(), FACE_DIRECTIONS)
        has_codes = viewed.latents is not None and viewed.latents.mu.shape[1] > 0
        self.latent_directions = PrincipalDirections.of(viewed.latents.mu.numpy(), LATENT_DIRECTIONS) if has_codes else None
        self.imputations = ("zero",)
        if viewed.avatar.settings.use_latent:
            self.imputations = ("zero", "prior", "clip", *(FROM_TRAINING if has_codes else ()))
        self.groups = {"training": viewed.training, **viewed.others}
        self.pose_map = PoseMap({name: signals.theta.numpy() for name, signals in self.groups.items()}) if len(recorded) > 3 else None
        self._imputed: dict[str, Tensor] = {}
        self._lock, self.version = threading.Lock(), 0
        shifts = len(self.face_directions.steps), 0 if self.latent_directions is None else len(self.latent_directions.steps)
        self.state = replace(
            self._taken(viewed.timeline, 0, 0),
            face_shift=(0.0,) * shifts[0],
            latent_shift=(0.0,) * shifts[1],
        )

    def change(self, how: Callable[[ViewState], ViewState]) -> None:
        """Replace the state by what a function makes of it."""
        with self._lock:
            self.state = how(self.state)
            self.version += 1

    def set_frame(self, frame: int) -> None:
        """Take pose, root and face of a row of the timeline; rows beyond its end begin anew. Shifts and switches stay."""
        frame %= len(self.viewed.timeline)
        taken = self._taken(self.viewed.timeline, frame, frame)
        self.change(lambda state: replace(state, theta=taken.theta, root=taken.root, face=taken.face, frame=frame))

    def load_pose(self, group: str, row: int) -> None:
        """Take pose, root and face of a point of the map."""
        taken = self._taken(self.groups[group], row, 0)
        self.change(lambda state: replace(state, theta=taken.theta, root=taken.root, face=taken.face))

    def reset_shifts(self) -> None:
        """Back to the unshifted face signal and latent code."""
        self.change(lambda state: replace(state, face_shift=(0.0,) * len(state.face_shift), latent_shift=(0.0,) * len(state.latent_shift)))

    def click(self, x: float, y: float, width: int, height: int) -> tuple[str, int] | None:
        """A click on the picture, x to the right and y downwards in 0..1; on a point of the map it loads the pose and returns the point."""
        if self.pose_map is None or not self.state.has_map:
            return None
        side = _map_side(width, height)
        column, row = x * width, y * height - (height - side)
        if not (0 <= column < side and 0 <= row < side):
            return None
        point = self.pose_map.nearest(column / side, row / side)
        if point is not None:
            self.load_pose(*point)
        return point

    def face_signal(self, state: ViewState) -> Float[np.ndarray, "F"]:  # noqa: F821
        """[F] of a state, shifts added; facial actions stay in 0..1."""
        face = state.face + self.face_directions.offset(np.array(state.face_shift))
        return np.clip(face, 0, 1) if self.viewed.face_names else face

    def latent(self, state: ViewState) -> Float[Tensor, "1 Z"] | None:
        """Latent code of a state: imputed, shifts added; None for an avatar that has none.

        `nearest` looks at the state's own pose and face; the others were imputed along the timeline and are read at the state's frame.
        """
        settings = self.viewed.avatar.settings
        if not settings.use_latent:
            return None
        if state.imputation == "nearest":
            drive = DrivingSignals(
                torch.from_numpy(state.theta)[None].float(),
                torch.from_numpy(state.root)[None].float(),
                torch.from_numpy(self.face_signal(state))[None].float(),
                self.viewed.timeline.fps,
            )
            z = self._imputation("nearest").latents(drive)
        else:
            if state.imputation not in self._imputed:
                self._imputed[state.imputation] = self._imputation(state.imputation).latents(self.viewed.timeline)
            z = self._imputed[state.imputation][state.frame][None]
        if self.latent_directions is not None:
            z = z + torch.from_numpy(self.latent_directions.offset(np.array(state.latent_shift)))[None]
        return z.float().to(self.viewed.avatar.mean_texture.device)

    def picture(self, camera: Camera, quality: Quality = STILL) -> UInt8[np.ndarray, "H W 3"]:
        """What the state looks like from a camera, with map and legend."""
        with self._lock:
            state = self.state
        shown = replace(state, root=self.viewed.timeline.root[0].numpy()) if state.is_in_place else state
        image = self.painter.draw(shown, self.face_signal(state), self.latent(state), camera, quality)
        legend = _LEGENDS.get(state.surface)
        if legend:
            image = _with_text(image, legend)
        if state.has_map and self.pose_map is not None:
            side = _map_side(camera.width, camera.height)
            image[camera.height - side :, :side] = self.pose_map.draw(side, state.theta)
        return image

    def first_view(self) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
        """Where a camera should begin: its centre, before the person's front, and what it looks at; metres."""
        state = self.state
        with torch.no_grad():
            rows = (torch.from_numpy(np.asarray(values, np.float32))[None] for values in (state.theta, state.root))
            device = self.viewed.avatar.mean_texture.device
            points = self.viewed.avatar.pose_template(*(row.to(device) for row in rows))[0].cpu().numpy().astype(np.float64)
        target = 0.5 * (points.min(axis=0) + points.max(axis=0))
        radius = float(np.linalg.norm(points - target, axis=1).max())
        front = np.asarray(state.root, np.float64)[:3, :3] @ np.array([0.0, -1.0, 0.12])
        front[2] = 0.12
        return target + radius / math.sin(0.46 * FIRST_FIELD) * front / np.linalg.norm(front), target

    def measure(self, seconds: float, width: int, height: int) -> dict[str, float]:
        """Play the timeline before an orbiting camera as fast as it goes, and time it.

        Returns:
            `frames_per_second` of decoding, rendering and JPEG encoding together, and mean milliseconds of each part (`decoding_ms`, ...).
        """
        centre, target = self.first_view()
        sums: dict[str, float] = {}
        frames, started = -2, 0.0  # the first two compile kernels
        while frames < 1 or time.perf_counter() - started < seconds:
            if frames == 0:
                started, sums = time.perf_counter(), {}
            angle = 0.02 * frames
            turn = np.array([[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]])
            self.set_frame(self.state.frame + 1)
            pose = look_at(target + turn @ (centre - target), target)
            image = self.picture(camera_of_view(pose, FIRST_FIELD, width / height, width, height), MOVING)
            now = time.perf_counter()
            encode_jpeg(image)
            self.painter.timings.lap("encoding", now)
            for part, value in self.painter.timings.seconds.items():
                sums[part] = sums.get(part, 0.0) + value
            frames += 1
        rate = frames / (time.perf_counter() - started)
        return {"frames_per_second": rate} | {f"{part}_ms": 1000 * value / frames for part, value in sums.items()}

    def _imputation(self, name: str):
        settings = self.viewed.avatar.settings
        return make_imputation(name, settings.latent_size if settings.use_latent else 0, self.viewed.latents)

    def _taken(self, signals: DrivingSignals, row: int, frame: int) -> ViewState:
        return ViewState(signals.theta[row].numpy().copy(), signals.root[row].numpy().copy(), signals.face[row].numpy().copy(), frame)


def encode_jpeg(image: UInt8[np.ndarray, "H W 3"]) -> bytes:
    """The picture as a JPEG file."""
    stream = io.BytesIO()
    Image.fromarray(image).save(stream, "JPEG", quality=JPEG_QUALITY)
    return stream.getvalue()


def _map_side(width: int, height: int) -> int:
    return round(MAP_SHARE * min(width, height))


def _with_text(image: UInt8[np.ndarray, "H W 3"], text: str) -> UInt8[np.ndarray, "H W 3"]:
    picture = Image.fromarray(image)
    font = ImageFont.load_default(max(10, len(image) // 34))
    ImageDraw.Draw(picture).text((10, 8), text, fill=(235, 235, 235), font=font)
    return np.array(picture)
