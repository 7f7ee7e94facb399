"""The decoder as a file of its own: what a player needs to turn driving signals into a mesh and a texture, without this package.

`export_decoder` writes it with torch.export; `torch.export.load(FILE).module()` runs it anywhere torch runs, one pose (or another number
that was fixed on writing) a call.
Rendering and ambient occlusion stay outside: the caller bakes the occlusion of the posed template, or gives ones.

Symbols: P poses, V vertices, D pose angles, F face signal, Z latent size, S shadow_size, T texture_size.
"""

import json
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mitsuba_avatar.body.rig import Rig
from mitsuba_avatar.files import atomic_path
from mitsuba_avatar.model.avatar import Avatar

FACTS = "mitsuba_avatar.json"  # inside the exported file


class DrivenDecoder(nn.Module):
    """`Avatar.decode` for one camera a pose, tensors in, tensors out.

    Args:
        avatar: to be exported, in evaluation mode.
    """

    def __init__(self, avatar: Avatar):
        super().__init__()
        self.avatar = avatar

    def forward(
        self,
        theta: Float[Tensor, "P D"],
        root: Float[Tensor, "P 4 4"],
        face: Float[Tensor, "P F"],
        z: Float[Tensor, "P Z"],
        camera_center: Float[Tensor, "P 3"],
        ambient_occlusion: Float[Tensor, "P 1 S S"],
    ) -> tuple[Float[Tensor, "P V 3"], Float[Tensor, "P 3 T T"]]:
        """Vertices in the world, metres, and linear radiance towards the camera; z of no entries where the avatar has no latent code."""
        latent = z if self.avatar.settings.use_latent else None
        output = self.avatar.decode(theta, root, face, latent, camera_center[:, None], ambient_occlusion)
        return output.vertices, output.textures[:, 0]


def example_inputs(avatar: Avatar, poses: int, seed: int = 0) -> tuple[Tensor, ...]:
    """Random but legal arguments of `DrivenDecoder.forward`, in its order, on the avatar's device."""
    generator = torch.Generator().manual_seed(seed)
    settings, device = avatar.settings, avatar.mean_texture.device

    def noise(*shape: int) -> Tensor:
        return torch.randn(poses, *shape, generator=generator)

    theta = avatar.standardize_theta.mean.cpu() + 0.1 * noise(len(avatar.standardize_theta.mean))
    root = torch.eye(4).repeat(poses, 1, 1)
    root[:, :3, 3] = 0.2 * noise(3)
    face = avatar.standardize_face.mean.cpu() + 0.01 * noise(len(avatar.standardize_face.mean))
    z = noise(settings.latent_size if settings.use_latent else 0)
    camera = torch.tensor([0.0, -3.0, 1.0]) + 0.3 * noise(3)
    occlusion = torch.rand(poses, 1, settings.shadow_size, settings.shadow_size, generator=generator)
    return tuple(value.to(device) for value in (theta, root, face, z, camera, occlusion))


def export_decoder(avatar: Avatar, rig: Rig, path: Path, poses: int = 1) -> None:
    """Write the decoder, whole or not at all.

    The file holds the names of the pose angles and the sizes of all arguments under `FACTS`, as JSON:
    `torch.export.load(path, extra_files=(files := {"mitsuba_avatar.json": ""}))`.

    Args:
        avatar: in evaluation mode.
        rig: that it is driven by.
        path: ending in .pt2.
        poses: P of every call.

    Raises:
        ValueError: another ending.
    """
    if path.suffix != ".pt2":
        raise ValueError(f"export_decoder(): expected a path that ends in .pt2, torch.export's own ending; got {path}. Rename it.")
    inputs = example_inputs(avatar, poses)
    names = ("theta", "root", "face", "z", "camera_center", "ambient_occlusion")
    with torch.no_grad():
        program = torch.export.export(DrivenDecoder(avatar).eval(), inputs, strict=False)
    facts = {
        "arguments": {name: list(value.shape) for name, value in zip(names, inputs, strict=True)},
        "results": {"vertices": [poses, rig.topology.num_vertices, 3], "texture": [poses, *avatar.mean_texture.shape]},
        "pose_angles": rig.dofs.names,
        "rig_fingerprint": rig.fingerprint,
    }
    with atomic_path(path) as temporary:
        torch.export.save(program, temporary, extra_files={FACTS: json.dumps(facts)})
