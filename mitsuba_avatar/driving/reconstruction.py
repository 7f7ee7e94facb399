"""Reconstruction: root pose, joint angles, face signal and latent code of a frame, found by gradient descent through the renderer.

    minimise  w_I L_I + w_M L_M (+ w_G L_G) + KL weight * |z|^2 / 2 + pull towards the start

over the views of a frame that nobody held out, and the registered mesh if asked for. Frames of a sequence start from each other. The
avatar itself stays as it is. Joint angles are held within the rig's limits after every step.

Symbols: D pose angles, F entries of the face signal, Z latent size, N views. Metres, radians. Source: arXiv:2105.10441, section 4.2.1.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mitsuba_avatar.body.rig import Rig
from mitsuba_avatar.captures.colour import encode
from mitsuba_avatar.driving.animation import decoder_latent, posed_occlusion, posed_template
from mitsuba_avatar.model.avatar import Avatar
from mitsuba_avatar.rendering.ambient_occlusion import AmbientOcclusion
from mitsuba_avatar.rendering.cameras import CameraBatch
from mitsuba_avatar.rendering.surface import SurfaceRenderer
from mitsuba_avatar.settings import LossSettings
from mitsuba_avatar.training.batches import FrameBatch
from mitsuba_avatar.training.losses import geometry_loss, image_loss, mask_loss

OCCLUSION_EVERY = 10  # steps between bakes: occlusion follows the pose slowly and carries no gradient
FINAL_RATE = 0.1  # of the learning rates, reached along half a cosine
ANGLE_UNIT = 0.1  # radians; change of an angle that the pull counts as one


@dataclass(frozen=True)
class ReconstructionSettings:
    """How a frame is reconstructed.

    Raises:
        ValueError: a number that makes no sense.
    """

    steps: int = 60  # of the first frame and every later one
    views_per_step: int = 4  # drawn anew in each step
    root_rate: float = 2e-3  # Adam's learning rate: metres and radians
    angle_rate: float = 5e-3  # radians
    face_rate: float = 0.02  # in units of the face signal's largest training deviation
    latent_rate: float = 0.05
    pull: float = 1e-3  # towards the start, per angle moved by 0.1 radians and per entry of the face signal moved by its unit
    use_mesh: bool = False  # let the registered mesh count as well
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("steps", "views_per_step"):
            if getattr(self, name) < 1:
                raise ValueError(f"ReconstructionSettings(): expected {name} of at least 1; got {getattr(self, name)}. Raise it.")
        for name in ("root_rate", "angle_rate", "face_rate", "latent_rate", "pull"):
            if not 0 <= getattr(self, name) < float("inf"):
                raise ValueError(f"ReconstructionSettings(): expected {name} of 0 or more; got {getattr(self, name)}. Change it.")


@dataclass(frozen=True, eq=False)  # tensors have no truth value to compare by
class BodyState:
    """Everything that says how an avatar looks in one frame, in the host's memory.

    Attributes:
        theta: [1, D] radians. root: [1, 4, 4]. face: [1, F]. z: [1, Z].
    """

    theta: Float[Tensor, "1 D"]
    root: Float[Tensor, "1 4 4"]
    face: Float[Tensor, "1 F"]
    z: Float[Tensor, "1 Z"]

    def save_arrays(self) -> dict[str, np.ndarray]:
        """Plain arrays by name."""
        return {name: getattr(self, name)[0].numpy() for name in ("theta", "root", "face", "z")}

    @staticmethod
    def of_arrays(arrays: dict[str, np.ndarray]) -> "BodyState":
        """The inverse of `save_arrays`."""
        return BodyState(**{name: torch.from_numpy(arrays[name].astype(np.float32))[None] for name in ("theta", "root", "face", "z")})


@dataclass(frozen=True)
class DrawnState:
    """An avatar in one state, seen by N cameras.

    Attributes:
        images: [N, 3, H, W] display-encoded, over the batch's backgrounds. masks: [N, 1, H, W]. vertices: [1, V, 3] metres.
    """

    images: Float[Tensor, "N 3 H W"]
    masks: Float[Tensor, "N 1 H W"]
    vertices: Float[Tensor, "1 V 3"]


class Reconstructor:
    """Fits states of one avatar to frames of a capture.

    Args:
        avatar: its parameters are frozen.
        rig: limits of the angles.
        renderer: of the capture's film size, with the training's number of samples.
        occlusion: baker at the avatar's shadow size.
        loss: weights of image, mask, geometry and KL terms.
        settings: of the descent.
    """

    def __init__(
        self,
        avatar: Avatar,
        rig: Rig,
        renderer: SurfaceRenderer,
        occlusion: AmbientOcclusion,
        loss: LossSettings,
        settings: ReconstructionSettings,
    ):
        self.avatar = avatar.requires_grad_(False)
        self.renderer, self.occlusion, self.loss, self.settings = renderer, occlusion, loss, settings
        self.lower, self.upper = torch.from_numpy(rig.dofs.lower), torch.from_numpy(rig.dofs.upper)
        unit = avatar.standardize_face.std.max()
        self.face_unit = float(unit) if unit > 0 else 1.0

    @torch.no_grad()
    def draw(self, state: BodyState, batch: FrameBatch, renderer: SurfaceRenderer | None = None) -> DrawnState:
        """Draw a state as the cameras of a batch of one pose see it, with another renderer if one is given."""
        share = self._occlusion(state.theta, batch.frames[0])
        drawn = self._drawn(state, share, batch, renderer or self.renderer, batch.frames[0])
        return replace(drawn, images=drawn.images.clamp(0, 1).cpu(), masks=drawn.masks.cpu(), vertices=drawn.vertices.cpu())

    def fit(self, start: BodyState, batch: FrameBatch) -> tuple[BodyState, list[float]]:
        """Descend from a start.

        Args:
            start: where to begin; the pull draws towards it.
            batch: one pose, the views that count; registered vertices where the settings ask for them.

        Returns:
            The state after the last step, and the loss of every step.

        Raises:
            ValueError: the loss is not finite, or `use_mesh` finds no mesh.
        """
        settings = self.settings
        if settings.use_mesh and batch.vertices is None:
            raise ValueError("Reconstructor.fit(): expected a registered mesh; the capture has none. Leave use_mesh false.")
        motion, theta, face, z = (torch.zeros(1, 6), start.theta.clamp(self.lower, self.upper), torch.zeros_like(start.face), start.z)
        parameters = [value.clone().requires_grad_() for value in (motion, theta, face, z)]
        motion, theta, face, z = parameters
        rates = (settings.root_rate, settings.angle_rate, settings.face_rate, settings.latent_rate)
        optimizer = torch.optim.Adam([{"params": [value], "lr": rate} for value, rate in zip(parameters, rates, strict=True)])
        schedule = torch.optim.lr_scheduler.LambdaLR(
            optimizer, lambda step: FINAL_RATE + (1 - FINAL_RATE) * 0.5 * (1 + math.cos(math.pi * step / settings.steps))
        )
        pivot = _middle(posed_template(self.avatar, start.theta.to(self.avatar.mean_texture.device)), start.root)
        losses = []
        for step in range(settings.steps):
            if step % OCCLUSION_EVERY == 0:
                share = self._occlusion(theta.detach(), batch.frames[0])
            state = BodyState(theta, moved_root(start.root, motion, pivot), start.face + self.face_unit * face, z)
            views = _drawn_views(batch, settings, step)
            drawn = self._drawn(state, share, views, self.renderer, seed=settings.seed + step)
            loss = self._loss(drawn, views, start, parameters)
            if not bool(torch.isfinite(loss)):
                raise ValueError(
                    f"Reconstructor.fit(): expected a finite loss in step {step} of frame {batch.frames[0]}; got {float(loss.detach())}. "
                    "Lower the rates."
                )
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
            with torch.no_grad():
                theta.clamp_(self.lower, self.upper)
            losses.append(float(loss.detach()))
        root = moved_root(start.root, motion.detach(), pivot)
        return BodyState(theta.detach(), root, start.face + self.face_unit * face.detach(), z.detach()), losses

    def _loss(self, drawn: DrawnState, views: FrameBatch, start: BodyState, parameters: list[Tensor]) -> Tensor:
        """What one step minimises."""
        _, theta, face, z = parameters
        device = drawn.images.device
        target_masks = views.masks.to(device)
        total = self.loss.image * image_loss(drawn.images, views.images.to(device), target_masks)
        total = total + self.loss.mask * mask_loss(drawn.masks, target_masks)
        if self.settings.use_mesh and views.vertices is not None:
            total = total + self.loss.geometry * geometry_loss(drawn.vertices, views.vertices.to(device))
        pull = ((theta - start.theta) / ANGLE_UNIT).square().sum() + face.square().sum()
        return total.cpu() + self.settings.pull * pull + self.loss.kl * 0.5 * z.square().sum()

    def _drawn(self, state: BodyState, share: Tensor, batch: FrameBatch, renderer: SurfaceRenderer, seed: int) -> DrawnState:
        """Decode and render; gradients flow to the state."""
        device = self.avatar.mean_texture.device
        theta, root, face = (value.to(device) for value in (state.theta, state.root, state.face))
        output = self.avatar.decode(theta, root, face, decoder_latent(self.avatar, state.z), batch.camera_centers.to(device), share)
        radiance, masks = renderer.render(
            output.vertices, output.textures[0], batch.cameras, seed=seed, background=batch.backgrounds.to(device)
        )
        return DrawnState(batch.within_views(encode(radiance, "srgb")), batch.within_views(masks), output.vertices)

    def _occlusion(self, theta: Float[Tensor, "1 D"], seed: int) -> Float[Tensor, "1 1 S S"]:
        """Ambient occlusion of the posed template, without gradient."""
        device = self.avatar.mean_texture.device
        return posed_occlusion(self.avatar, self.occlusion, theta.to(device), seed)


def moved_root(root: Float[Tensor, "1 4 4"], motion: Float[Tensor, "1 6"], pivot: Float[Tensor, "3"]) -> Float[Tensor, "1 4 4"]:
    """A root turned about a point of the world and shifted.

    Args:
        root: [1, 4, 4] world_from_root.
        motion: [1, 6] rotation vector, radians, and shift, metres.
        pivot: [3] point that only the shift moves: turning about the world's origin would swing a far body away.

    Gradients: to root and motion.
    """
    x, y, z = motion[0, :3].unbind()
    zero = torch.zeros_like(x)
    cross = torch.stack([torch.stack([zero, -z, y]), torch.stack([z, zero, -x]), torch.stack([-y, x, zero])])
    rotation = torch.linalg.matrix_exp(cross)
    shift = motion[0, 3:] + pivot - rotation @ pivot
    bottom = root.new_tensor([[0.0, 0.0, 0.0, 1.0]])
    return (torch.cat([torch.cat([rotation, shift[:, None]], dim=1), bottom]) @ root[0])[None]


def _middle(template: Float[Tensor, "V 3"], root: Float[Tensor, "1 4 4"]) -> Float[Tensor, "3"]:
    """Middle of a posed template in the world."""
    return root[0, :3, :3] @ template.mean(0) + root[0, :3, 3]


def _drawn_views(batch: FrameBatch, settings: ReconstructionSettings, step: int) -> FrameBatch:
    """The views that a step looks at."""
    names = batch.camera_names[0]
    if len(names) <= settings.views_per_step:
        return batch
    order = np.random.default_rng([settings.seed, batch.frames[0], step]).permutation(len(names))[: settings.views_per_step]
    rows = torch.from_numpy(np.sort(order))
    cameras = CameraBatch(batch.cameras.intrinsics[rows], batch.cameras.camera_from_world[rows])
    return replace(
        batch,
        camera_names=[[names[row] for row in rows.tolist()]],
        images=batch.images[rows],
        masks=batch.masks[rows],
        backgrounds=batch.backgrounds[rows],
        cameras=cameras,
        sizes=[batch.sizes[row] for row in rows.tolist()],
    )
