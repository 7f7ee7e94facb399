"""The avatar as a whole: a conditional VAE whose decoder is driven by joint angles, face signal, latent code and cameras.

    vertices = LBS(theta, root, template + displacement_scale * D_G)
    texture  = soft_clamp(mean_texture + texture_scale * (D_T + D_view)) * gain(ambient occlusion)

The template is the rig's rest surface plus the mean offset of the registered meshes, and every network output starts at zero: an
untrained avatar *is* the posed template with the mean texture. The root pose moves the surface and conditions nothing.

Symbols: P poses, N cameras a pose, V vertices, D pose angles, F entries of the face signal, Z latent size, S shadow_size,
T texture_size. Metres, radians, linear radiance.

Source: arXiv:2105.10441, sections 3.2 to 3.4.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from mitsuba_avatar.body.driving import driving_masks
from mitsuba_avatar.body.mesh import vertex_normals
from mitsuba_avatar.body.rig import Rig
from mitsuba_avatar.body.skeleton import Skeleton
from mitsuba_avatar.body.skinning import pose_vertices, unpose_vertices
from mitsuba_avatar.body.uv import UvAtlas
from mitsuba_avatar.model.conditioning import Standardization
from mitsuba_avatar.model.decoder import Decoder
from mitsuba_avatar.model.encoder import Encoder, Posterior
from mitsuba_avatar.model.shadow import ShadowUNet
from mitsuba_avatar.model.viewing import ViewMaps
from mitsuba_avatar.settings import ModelSettings

# Radiance is not negative, but a hard clamp at zero would leave a texel that an early step drove below it without a gradient for ever.
# Below zero the texture keeps this slope: what remains negative is invisible, and it can find its way back.
NEGATIVE_RADIANCE_SLOPE = 0.01


@dataclass(frozen=True)
class DrivingStatistics:
    """What the training frames look like on average: the origin and the units of everything the networks say.

    Attributes:
        theta_mean, theta_std: [D] joint angles, radians.
        face_mean, face_std: [F] face signal, in its own unit.
        mean_texture: [3, T, T] linear radiance, defined at every texel (inpainted between charts).
        mean_displacement: [V, 3] mean offset of the unposed registered meshes from the rig's rest vertices, metres.
    """

    theta_mean: Float[Tensor, "D"]
    theta_std: Float[Tensor, "D"]
    face_mean: Float[Tensor, "F"]
    face_std: Float[Tensor, "F"]
    mean_texture: Float[Tensor, "3 T T"]
    mean_displacement: Float[Tensor, "V 3"]

    @classmethod
    def neutral(cls, rig: Rig, face_size: int, texture_size: int) -> "DrivingStatistics":
        """Zero means, unit deviations, a grey texture: for an avatar whose state is about to be loaded, and for tests."""
        dofs = len(rig.dofs.names)
        return cls(
            theta_mean=torch.zeros(dofs),
            theta_std=torch.ones(dofs),
            face_mean=torch.zeros(face_size),
            face_std=torch.ones(face_size),
            mean_texture=torch.full((3, texture_size, texture_size), 0.5),
            mean_displacement=torch.zeros(rig.topology.num_vertices, 3),
        )


@dataclass(frozen=True)
class AvatarOutput:
    """Surface and appearance of P poses, seen by N cameras each.

    Attributes:
        rest_vertices: [P, V, 3] template plus displacement, rest space, metres.
        vertices: [P, V, 3] the same, posed in the world.
        textures: [P, N, 3, T, T] linear radiance towards each camera, shadow included.
        gain: [P, 1, S, S] quasi-shadow that `textures` was multiplied by, 1 where it changes nothing.
    """

    rest_vertices: Float[Tensor, "P V 3"]
    vertices: Float[Tensor, "P V 3"]
    textures: Float[Tensor, "P N 3 T T"]
    gain: Float[Tensor, "P 1 S S"]


class Avatar(nn.Module):
    """A drivable person.

    Drive it, without encoder and with the most likely latent code:

        avatar = Avatar(rig, settings, DrivingStatistics.neutral(rig, face_size, settings.texture_size))
        avatar.load_state_dict(state)
        output = avatar.decode(theta, root, face, None, camera_centers, ambient_occlusion)

    Networks compute in float32, except in training (`train()`) after `mixed_precision` was set: then hidden layers compute in bfloat16.

    The state holds weights and training statistics; everything that follows from rig and settings is rebuilt from them.

    Args:
        rig: topology, skeleton, skinning weights, driving regions.
        settings: sizes and switches.
        statistics: of the training frames.

    Raises:
        ValueError: if the statistics do not fit rig or settings.
    """

    def __init__(self, rig: Rig, settings: ModelSettings, statistics: DrivingStatistics):
        super().__init__()
        _check_statistics(rig, settings, statistics)
        self.settings = settings
        self.mixed_precision = False
        self.standardize_theta = Standardization(statistics.theta_mean, statistics.theta_std)
        self.standardize_face = Standardization(statistics.face_mean, statistics.face_std)
        self.register_buffer("mean_texture", statistics.mean_texture.clone())
        self.register_buffer("mean_displacement", statistics.mean_displacement.clone())
        self.register_buffer("rig_vertices", torch.from_numpy(rig.rest_vertices), persistent=False)
        self.register_buffer("skinning_weights", torch.from_numpy(rig.skinning_weights), persistent=False)
        self.skeleton = Skeleton(rig)

        self.atlas = UvAtlas(rig.topology, settings.view_size)
        normals = vertex_normals(self.rig_vertices[None], torch.from_numpy(rig.topology.faces))[0]
        self.view_maps = ViewMaps(self.atlas, self.rig_vertices, normals, self.skinning_weights)
        pose_masks, face_masks = _conditioning_masks(rig, settings, len(statistics.face_mean))
        self.decoder = Decoder(settings, pose_masks, face_masks)
        self.shadow = ShadowUNet(settings) if settings.use_shadow else None
        self.encoder_atlas = UvAtlas(rig.topology, settings.encoder_size) if settings.use_latent else None
        self.encoder = Encoder(settings) if settings.use_latent else None

    @property
    def template_vertices(self) -> Float[Tensor, "V 3"]:
        """Rest surface that displacements start from, metres."""
        return self.rig_vertices + self.mean_displacement

    def pose_template(self, theta: Float[Tensor, "P D"], root: Float[Tensor, "P 4 4"]) -> Float[Tensor, "P V 3"]:
        """LBS(theta, template) in the world, metres: what ambient occlusion is computed on. Gradients: to theta and root."""
        return pose_vertices(self.template_vertices.expand(len(theta), -1, -1), self.skeleton(theta, root), self.skinning_weights)

    def unpose(self, vertices: Float[Tensor, "P V 3"], theta: Float[Tensor, "P D"], root: Float[Tensor, "P 4 4"]) -> Float[Tensor, "P V 3"]:
        """Registered vertices carried back to rest space, metres: what `encode` reads."""
        return unpose_vertices(vertices, self.skeleton(theta, root), self.skinning_weights)

    def offset_maps(self, unposed_vertices: Float[Tensor, "P V 3"]) -> Float[Tensor, "P 3 E E"]:
        """What the encoder reads: offsets from the template over the atlas, in units of `displacement_scale`; E = encoder_size.

        It follows from a frame and the rig alone, so that training keeps it (training/offset_maps.py). Gradients: to the vertices.

        Raises:
            ValueError: if the avatar has no latent code.
        """
        if self.encoder_atlas is None:
            raise ValueError("offset_maps(): expected an avatar with an encoder; model.use_latent is false. Decode with z = None.")
        return self.encoder_atlas.texels_from_vertices((unposed_vertices - self.template_vertices) / self.settings.displacement_scale)

    def encode(self, unposed_vertices: Float[Tensor, "P V 3"]) -> Posterior:
        """Gaussian over the latent code of each pose.

        Args:
            unposed_vertices: [P, V, 3] registered mesh in rest space, metres.

        Gradients: flow to the encoder and to the vertices.

        Raises:
            ValueError: if the avatar has no latent code.

        Source: arXiv:2105.10441, section 3.2.
        """
        return self._posterior(self.offset_maps(unposed_vertices))

    def decode(
        self,
        theta: Float[Tensor, "P D"],
        root: Float[Tensor, "P 4 4"],
        face: Float[Tensor, "P F"],
        z: Float[Tensor, "P Z"] | None,
        camera_centers: Float[Tensor, "P N 3"],
        ambient_occlusion: Float[Tensor, "P 1 S S"] | None,
    ) -> AvatarOutput:
        """Surface of every pose and its texture towards every camera.

        Args:
            theta: [P, D] joint angles, radians.
            root: [P, 4, 4] rigid world_from_root; moves the surface, conditions nothing.
            face: [P, F] face signal.
            z: [P, Z] latent code; None means zero, the most likely one.
            camera_centers: [P, N, 3] metres, world axes.
            ambient_occlusion: [P, 1, S, S] of `pose_template`, 1 where open; may be None without the shadow branch.

        Gradients: flow to all arguments and parameters.

        Raises:
            ValueError: if a latent code is given to an avatar that has none, or ambient occlusion is missing or of another size.
        """
        posed_from_rest = self.skeleton(theta, root)
        signals = self.standardize_theta(theta), self.standardize_face(face), self._latent(z, len(theta))
        view = self.view_maps(posed_from_rest, camera_centers)
        with self._networks():
            maps = self.decoder(*signals, view)
        rest_vertices = self._displaced(maps.displacement)
        vertices = pose_vertices(rest_vertices, posed_from_rest, self.skinning_weights)
        gain = self._gain(ambient_occlusion, len(theta))
        return AvatarOutput(rest_vertices, vertices, self._textures(maps.texture, maps.view_texture, gain), gain)

    def decode_rest_vertices(
        self, theta: Float[Tensor, "P D"], face: Float[Tensor, "P F"], z: Float[Tensor, "P Z"] | None
    ) -> Float[Tensor, "P V 3"]:
        """The `rest_vertices` of `decode` alone, without cameras, occlusion or texture; arguments, gradients and errors as there."""
        signals = self.standardize_theta(theta), self.standardize_face(face), self._latent(z, len(theta))
        with self._networks():
            displacement = self.decoder.displacement(*signals)
        return self._displaced(displacement)

    def decode_vertices(
        self, theta: Float[Tensor, "P D"], root: Float[Tensor, "P 4 4"], face: Float[Tensor, "P F"], z: Float[Tensor, "P Z"] | None
    ) -> Float[Tensor, "P V 3"]:
        """The `vertices` of `decode` alone: posed in the world, metres; arguments, gradients and errors as there."""
        return pose_vertices(self.decode_rest_vertices(theta, face, z), self.skeleton(theta, root), self.skinning_weights)

    def standardized_driving(self, theta: Float[Tensor, "P D"], face: Float[Tensor, "P F"]) -> Float[Tensor, "P DF"]:
        """The driving signal as one vector c = (theta, face), each in its own unit of deviation."""
        return torch.cat([self.standardize_theta(theta), self.standardize_face(face)], dim=1)

    def forward(
        self,
        offset_maps: Float[Tensor, "P 3 E E"] | None,
        theta: Float[Tensor, "P D"],
        root: Float[Tensor, "P 4 4"],
        face: Float[Tensor, "P F"],
        camera_centers: Float[Tensor, "P N 3"],
        ambient_occlusion: Float[Tensor, "P 1 S S"] | None,
        noise: Float[Tensor, "P Z"] | None,
    ) -> tuple[AvatarOutput, Posterior | None]:
        """One training pass: encode the registered mesh, draw z = mu + std * noise, decode.

        Args:
            offset_maps: [P, 3, E, E] of the unposed registered mesh, see there; not read without a latent code.
            noise: [P, Z] standard normal numbers; None takes z = mu.
            theta, root, face, camera_centers, ambient_occlusion: as in `decode`.

        Returns:
            What `decode` returns, and the posterior (None for an avatar without a latent code).

        Raises:
            ValueError: as `decode`; also if an avatar with a latent code gets no offset maps.
        """
        z, posterior = self._draw_latent(offset_maps, noise)
        return self.decode(theta, root, face, z, camera_centers, ambient_occlusion), posterior

    def reconstruct_surface(
        self,
        offset_maps: Float[Tensor, "P 3 E E"] | None,
        theta: Float[Tensor, "P D"],
        root: Float[Tensor, "P 4 4"],
        face: Float[Tensor, "P F"],
        noise: Float[Tensor, "P Z"] | None,
    ) -> tuple[Float[Tensor, "P V 3"], Posterior | None]:
        """The posed surface and the posterior of `forward` alone, without cameras, occlusion or texture; arguments and errors as there."""
        z, posterior = self._draw_latent(offset_maps, noise)
        return self.decode_vertices(theta, root, face, z), posterior

    @contextmanager
    def _networks(self) -> Iterator[None]:
        """The precision in which encoder, decoder and shadow branch compute; what skins and textures the surface stays outside."""
        if not (self.mixed_precision and self.training):
            yield
            return
        with torch.autocast(self.mean_texture.device.type, torch.bfloat16):
            yield

    def _posterior(self, offset_maps: Tensor) -> Posterior:
        """What the encoder says."""
        with self._networks():
            return self.encoder(offset_maps)

    def _draw_latent(self, offset_maps: Tensor | None, noise: Tensor | None) -> tuple[Tensor | None, Posterior | None]:
        """Latent code of a training pass, and the posterior that it is from; nothing for an avatar without."""
        if not self.settings.use_latent:
            return None, None
        if offset_maps is None:
            raise ValueError(
                "Avatar(): expected offset maps of registered vertices to encode; got None. Train on a capture with vertices.npy, "
                "or set model.use_latent false."
            )
        posterior = self._posterior(offset_maps)
        return posterior.mu if noise is None else posterior.sample(noise), posterior

    def _displaced(self, displacement: Float[Tensor, "P 3 G G"]) -> Float[Tensor, "P V 3"]:
        """Template plus decoded displacement, rest space."""
        # Every texel of the map is the decoder's own, so lookups across a chart's border need no inpainting.
        return self.template_vertices + self.settings.displacement_scale * self.atlas.vertices_from_texels(displacement)

    def _latent(self, z: Tensor | None, poses: int) -> Tensor | None:
        """The latent code that the decoder reads."""
        if not self.settings.use_latent:
            if z is not None:
                raise ValueError("decode(): expected z = None, because model.use_latent is false; got a latent code. Leave it out.")
            return None
        return self.mean_texture.new_zeros(poses, self.settings.latent_size) if z is None else z

    def _gain(self, ambient_occlusion: Tensor | None, poses: int) -> Tensor:
        """Gain map of every pose; ones without the shadow branch."""
        size = self.settings.shadow_size
        if self.shadow is None:
            return self.mean_texture.new_ones(poses, 1, size, size)
        if ambient_occlusion is None or ambient_occlusion.shape != (poses, 1, size, size):
            got = "None" if ambient_occlusion is None else list(ambient_occlusion.shape)
            raise ValueError(
                f"decode(): ambient_occlusion must be [{poses}, 1, {size}, {size}] for this avatar; got {got}. "
                "Bake it at model.texture_size / model.shadow_downscale, on pose_template()."
            )
        with self._networks():
            return self.shadow(ambient_occlusion)

    def _textures(
        self, texture: Float[Tensor, "P 3 T T"], view_texture: Float[Tensor, "P N 3 W W"], gain: Float[Tensor, "P 1 S S"]
    ) -> Float[Tensor, "P N 3 T T"]:
        """Radiance towards each camera: mean plus what the branches add, softly kept from below zero, times the gain."""
        size, scale = self.settings.texture_size, self.settings.texture_scale
        gain = _resized(gain, size)[:, None]  # [P, 1, 1, T, T]
        # The gain is positive, so it may be applied before the soft clamp: cheaper, since this product is made once per pose.
        common = (self.mean_texture + scale * texture)[:, None] * gain  # [P, 1, 3, T, T]
        from_view = _resized((scale * view_texture).flatten(0, 1), size).unflatten(0, view_texture.shape[:2])
        return functional.leaky_relu(torch.addcmul(common, from_view, gain), NEGATIVE_RADIANCE_SLOPE)


def _resized(maps: Float[Tensor, "B C H H"], size: int) -> Float[Tensor, "B C T T"]:
    """Bilinear upsampling that keeps texel centres in place. It runs on contiguous maps: with three channels, channels-last is slower."""
    return functional.interpolate(maps.contiguous(), size=(size, size), mode="bilinear", align_corners=False)


def _conditioning_masks(rig: Rig, settings: ModelSettings, face_size: int) -> tuple[Float[Tensor, "D S S"], Float[Tensor, "F S S"]]:
    """Regions in which each entry of theta and of the face signal may act; all ones without localization."""
    size = settings.conditioning_size
    if not settings.use_localization:
        return torch.ones(len(rig.dofs.names), size, size), torch.ones(face_size, size, size)
    masks = driving_masks(rig, size)
    return masks.theta, masks.face.expand(face_size, size, size)


def _check_statistics(rig: Rig, settings: ModelSettings, statistics: DrivingStatistics) -> None:
    dofs, vertices, size = len(rig.dofs.names), rig.topology.num_vertices, settings.texture_size
    for name, shape in (
        ("theta_mean", (dofs,)),
        ("theta_std", (dofs,)),
        ("mean_texture", (3, size, size)),
        ("mean_displacement", (vertices, 3)),
    ):
        value = getattr(statistics, name)
        if value.shape != shape:
            raise ValueError(
                f"Avatar(): statistics.{name} must be {list(shape)} for this rig and model; got {list(value.shape)}. "
                "Compute the statistics with the same rig and texture_size."
            )
        if not torch.isfinite(value).all():
            raise ValueError(f"Avatar(): expected finite statistics.{name}; got NaN or infinity. Check pose and images of the capture.")
