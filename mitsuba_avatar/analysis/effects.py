"""Where on the surface a control acts, and where the avatar is unsure: fields over vertices, from small experiments on the decoder.

A control is a pose angle, or the face signal's main direction. It is moved by two standard deviations of the training frames while all
else stays, with z = 0, ambient occlusion included; what moves in rest space, and what changes its colour, is its effect. Under localization
nothing outside its region can: the share of the effect that does is the measure of chance correlations that a decoder has learnt
(arXiv:2105.10441, section 3.3 and the figure on localized effects). Uncertainty is the spread of what the decoder makes of one driving
signal under codes drawn from the prior.

Symbols: V vertices, N frames, D pose angles, F entries of the face signal.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mitsuba_avatar.analysis.measures import AT_ONCE, Study
from mitsuba_avatar.analysis.regions import with_surroundings
from mitsuba_avatar.body.driving import driving_regions
from mitsuba_avatar.body.uv import UvAtlas
from mitsuba_avatar.driving.principal_directions import PrincipalDirections
from mitsuba_avatar.driving.uncertainty import prior_codes, shape_spread, texture_spread
from mitsuba_avatar.rendering.ambient_occlusion import FrameOcclusion
from mitsuba_avatar.rendering.cameras import CameraBatch
from mitsuba_avatar.reporting.disentanglement import MILLIMETRES
from mitsuba_avatar.training.statistics import evenly_spaced

FACE = "face"
DEVIATIONS = 2.0  # of the training frames, that a control is moved by
FEWEST_VERTICES = 0.02  # share of all vertices that a control must govern to be worth a picture
FRAMES = 16  # of training, that effects are averaged over
SAMPLES = 16  # codes of the prior


@dataclass(frozen=True)
class Effect:
    """What one control moves.

    Attributes:
        name: of the pose angle, or FACE.
        moved_mm: [V] mean distance that each vertex moves in rest space, millimetres.
        recoloured: [V] mean change of linear radiance at each vertex, mean of the channels, towards one camera.
        region: [V] skin that the control governs, and what lies near.
    """

    name: str
    moved_mm: Float[np.ndarray, "V"]  # noqa: F821
    recoloured: Float[np.ndarray, "V"]  # noqa: F821
    region: Bool[np.ndarray, "V"]  # noqa: F821

    @property
    def share_outside(self) -> float:
        """Part of all movement that is outside the region; 0 where nothing moves."""
        return self._outside(self.moved_mm)

    @property
    def share_recoloured_outside(self) -> float:
        """Part of all change of colour that is outside the region; 0 where nothing changes."""
        return self._outside(self.recoloured)

    def _outside(self, effect: Float[np.ndarray, "V"]) -> float:  # noqa: F821
        total = float(effect.sum())
        return float(effect[~self.region].sum()) / total if total > 0 else 0.0


def liveliest_controls(study: Study, count: int = 5) -> list[str]:
    """The pose angles that vary most over the training frames, one for each joint that governs a good part of the surface, and the face."""
    std = study.drive.theta[study.frames("train")].std(0).numpy()
    std = np.where(driving_regions(study.rig).theta.mean(1) >= FEWEST_VERTICES, std, -1.0)  # fingers would crowd out limbs
    chosen: dict[int, int] = {}
    for angle in np.argsort(-std, kind="stable"):
        chosen.setdefault(int(study.rig.dofs.joints[angle]), int(angle))
    return [*(study.rig.dofs.names[angle] for angle in list(chosen.values())[:count]), FACE]


@torch.no_grad()
def control_effects(study: Study, names: Sequence[str], occlusion: FrameOcclusion | None) -> list[Effect]:
    """The effect of each control.

    Args:
        study: whose training frames are changed.
        names: of pose angles, or FACE.
        occlusion: of the capture's frames; None without the shadow branch.

    Raises:
        ValueError: a name that is no pose angle and not FACE.
    """
    known = list(study.rig.dofs.names)
    unknown = [name for name in names if name not in known and name != FACE]
    if unknown:
        raise ValueError(
            f"control_effects(): expected names of pose angles or {FACE!r}; got {unknown}. Name some of {', '.join(known[:6])}, ..."
        )
    train = study.frames("train")
    frames = evenly_spaced(train, FRAMES)
    theta, face = study.drive.theta[frames], study.drive.face[frames]
    regions, atlas = driving_regions(study.rig), UvAtlas(study.rig.topology, study.avatar.settings.texture_size)
    rest, colours = _decoded(study, theta, face), _coloured(study, frames, theta, face, occlusion, atlas)
    effects = []
    for name in names:
        moved_theta, moved_face, region = theta.clone(), face, regions.face
        if name == FACE:
            moved_face = face + DEVIATIONS * _main_direction(study.drive.face[train])
        else:
            angle = known.index(name)
            moved_theta[:, angle] += DEVIATIONS * study.drive.theta[train][:, angle].std()
            region = regions.theta[angle]
        distance = (_decoded(study, moved_theta, moved_face) - rest).norm(dim=-1).mean(0)
        change = (_coloured(study, frames, moved_theta, moved_face, occlusion, atlas) - colours).abs().mean(dim=(0, 2))
        moved, recoloured = (values.double().numpy() for values in (distance, change))
        effects.append(Effect(name, MILLIMETRES * moved, recoloured, with_surroundings(study.rig, region)))
    return effects


def shape_uncertainty(study: Study, frame: int, samples: int = SAMPLES) -> Float[np.ndarray, "V"]:  # noqa: F821
    """Spread of each vertex for a frame's driving signal, millimetres (`driving.uncertainty`)."""
    theta, _, face = study.row(frame)
    return MILLIMETRES * shape_spread(study.avatar, theta, face, prior_codes(study.avatar, samples)).numpy()


def texture_uncertainty(
    study: Study, frame: int, centers: Float[Tensor, "N 3"], occlusion: Tensor | None, samples: int = SAMPLES
) -> Float[np.ndarray, "T T"]:
    """Spread of each texel for a frame's driving signal, seen from cameras at `centers` (`driving.uncertainty`)."""
    return texture_spread(study.avatar, study.row(frame), centers, occlusion, prior_codes(study.avatar, samples)).numpy()


def _decoded(study: Study, theta: Tensor, face: Tensor) -> Float[Tensor, "N V 3"]:
    """Rest surfaces with z = 0."""
    portions = [slice(start, start + AT_ONCE) for start in range(0, len(theta), AT_ONCE)]
    return torch.cat([study.avatar.decode_rest_vertices(theta[rows], face[rows], None) for rows in portions])


def _coloured(
    study: Study, frames: list[int], theta: Tensor, face: Tensor, occlusion: FrameOcclusion | None, atlas: UvAtlas
) -> Float[Tensor, "n V 3"]:
    """Linear radiance at every vertex towards the capture's first camera, with z = 0 and the occlusion of the frames as they were.

    Of every other frame: textures take longer than surfaces.
    """
    camera = study.capture.cameras[study.capture.camera_names()[0]]
    center = CameraBatch.from_cameras([camera]).centers[None].to(theta.device)  # [1, 1, 3]
    colours = []
    for row in range(0, len(frames), 2):
        maps = None if occlusion is None else occlusion.maps([frames[row]]).to(theta.device)
        drive = theta[[row]], study.drive.root[[frames[row]]], face[[row]]
        colours.append(atlas.vertices_from_texels(study.avatar.decode(*drive, None, center, maps).textures[0]))
    return torch.cat(colours)


def _main_direction(face: Float[Tensor, "N F"]) -> Float[Tensor, "F"]:  # noqa: F821
    """First principal component, as long as the deviation along it."""
    steps = PrincipalDirections.of(face.numpy(), 1).steps  # none where the face does not move
    return torch.from_numpy(steps.sum(axis=0)).to(face)
