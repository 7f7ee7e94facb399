"""Where on the surface a control acts, and where the avatar is unsure: fields over vertices, from small experiments on the decoder.

A control is a pose angle, or the face signal's main direction. It is moved by two standard deviations of the training frames while all
else stays, with z = 0; what moves, in rest space, is its effect. Under localization nothing outside its region can move: the share of the
effect that does is the measure of chance correlations that a decoder has learnt (arXiv:2105.10441, section 3.3 and the figure on
localized effects). Uncertainty is the spread of what the decoder makes of one driving signal under codes drawn from the prior.

Symbols: V vertices, N frames, D pose angles, F entries of the face signal.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mitsuba_avatar.analysis.measures import AT_ONCE, MILLIMETRES, Study
from mitsuba_avatar.analysis.regions import with_surroundings
from mitsuba_avatar.body.driving import driving_regions
from mitsuba_avatar.driving.principal_directions import PrincipalDirections
from mitsuba_avatar.training.statistics import evenly_spaced

FACE = "face"
DEVIATIONS = 2.0  # of the training frames, that a control is moved by
FEWEST_VERTICES = 0.02  # share of all vertices that a control must govern to be worth a picture
FRAMES = 16  # of training, that effects are averaged over


@dataclass(frozen=True)
class Effect:
    """What one control moves.

    Attributes:
        name: of the pose angle, or FACE.
        moved_mm: [V] mean distance that each vertex moves in rest space, millimetres.
        region: [V] skin that the control governs, and what lies near.
    """

    name: str
    moved_mm: Float[np.ndarray, "V"]  # noqa: F821
    region: Bool[np.ndarray, "V"]  # noqa: F821

    @property
    def share_outside(self) -> float:
        """Part of all movement that is outside the region; 0 where nothing moves."""
        total = float(self.moved_mm.sum())
        return float(self.moved_mm[~self.region].sum()) / total if total > 0 else 0.0


def liveliest_controls(study: Study, count: int = 5) -> list[str]:
    """The pose angles that vary most over the training frames, one for each joint that governs a good part of the surface, and the face."""
    std = study.drive.theta[study.frames("train")].std(0).numpy()
    std = np.where(driving_regions(study.rig).theta.mean(1) >= FEWEST_VERTICES, std, -1.0)  # fingers would crowd out limbs
    chosen: dict[int, int] = {}
    for angle in np.argsort(-std, kind="stable"):
        chosen.setdefault(int(study.rig.dofs.joints[angle]), int(angle))
    return [*(study.rig.dofs.names[angle] for angle in list(chosen.values())[:count]), FACE]


@torch.no_grad()
def control_effects(study: Study, names: Sequence[str]) -> list[Effect]:
    """The effect of each control.

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
    rows = torch.tensor(evenly_spaced(train, FRAMES))
    theta, face = study.drive.theta[rows], study.drive.face[rows]
    regions = driving_regions(study.rig)
    rest = _decoded(study, theta, face)
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
        effects.append(Effect(name, MILLIMETRES * distance.double().numpy(), with_surroundings(study.rig, region)))
    return effects


@torch.no_grad()
def shape_uncertainty(study: Study, frame: int, samples: int = 16, seed: int = 0) -> Float[np.ndarray, "V"]:  # noqa: F821
    """Spread of each vertex over codes drawn from the prior, for a frame's driving signal: root mean square distance from the mean, mm.

    Raises:
        ValueError: if the avatar has no latent code.
    """
    row = study.drive.rows(slice(frame, frame + 1))
    surfaces = []
    for start in range(0, samples, AT_ONCE):
        z = prior_codes(study, samples, seed)[start : start + AT_ONCE]
        surfaces.append(study.avatar.decode_rest_vertices(row.theta.expand(len(z), -1), row.face.expand(len(z), -1), z))
    return MILLIMETRES * torch.cat(surfaces).double().var(0, correction=1).sum(-1).sqrt().numpy()


@torch.no_grad()
def texture_uncertainty(
    study: Study, frame: int, centers: Float[Tensor, "N 3"], occlusion: Tensor | None, samples: int = 16, seed: int = 0
) -> Float[np.ndarray, "T T"]:
    """The same of each texel: standard deviation of radiance, root mean square over channels and cameras.

    Args:
        centers: [N, 3] of the cameras that it is seen from, metres.
        occlusion: [1, 1, S, S] of the frame; None without the shadow branch.
    """
    row = study.drive.rows(slice(frame, frame + 1))
    textures = [
        study.avatar.decode(row.theta, row.root, row.face, z[None], centers[None], occlusion).textures[0]
        for z in prior_codes(study, samples, seed)
    ]
    return torch.stack(textures).var(0, correction=1).mean(dim=(0, 1)).sqrt().numpy()


def prior_codes(study: Study, samples: int, seed: int) -> Float[Tensor, "M Z"]:
    """Latent codes drawn from the prior.

    Raises:
        ValueError: if the avatar has no latent code.
    """
    if study.posterior is None:
        raise ValueError("prior_codes(): expected an avatar with a latent code; model.use_latent is false. Analyse another run.")
    size = study.avatar.settings.latent_size
    return torch.randn((samples, size), generator=torch.Generator().manual_seed(seed))


def _decoded(study: Study, theta: Tensor, face: Tensor) -> Float[Tensor, "N V 3"]:
    """Rest surfaces with z = 0."""
    portions = [slice(start, start + AT_ONCE) for start in range(0, len(theta), AT_ONCE)]
    return torch.cat([study.avatar.decode_rest_vertices(theta[rows], face[rows], None) for rows in portions])


def _main_direction(face: Float[Tensor, "N F"]) -> Float[Tensor, "F"]:  # noqa: F821
    """First principal component, as long as the deviation along it."""
    steps = PrincipalDirections.of(face.numpy(), 1).steps  # none where the face does not move
    return torch.from_numpy(steps.sum(axis=0)).to(face)
