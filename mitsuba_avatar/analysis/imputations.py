"""What each imputation of the latent code does to a driven avatar, in the matched setting and in unmatched ones (other attire, headset).

Nobody knows the right code of a frame that was captured in other clothes, so only the avatar's own capture is compared with a truth. An
imputation is faithful if the keypoints that the driving signal fixes stay where the signal asks for them, and plausible if clothes
neither flicker nor stand still. Distances in millimetres. Symbols: N frames, Z latent size. Source: arXiv:2105.10441, section 4.2.2.
"""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import get_args

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mitsuba_avatar.analysis.measures import Study
from mitsuba_avatar.body.skinning import pose_vertices
from mitsuba_avatar.driving.assembly import AssembledDrive, assemble, trained_face
from mitsuba_avatar.driving.imputation import ImputationName, make_imputation
from mitsuba_avatar.driving.signals import DrivingSignals
from mitsuba_avatar.driving.sources import load_body, load_face
from mitsuba_avatar.driving.temporal_model import TemporalModel
from mitsuba_avatar.driving.training_latents import TrainingLatents
from mitsuba_avatar.model.avatar import Avatar
from mitsuba_avatar.model.keypoints import DrivenKeypoints
from mitsuba_avatar.reporting.disentanglement import MILLIMETRES
from mitsuba_avatar.training.run_folder import RunFolder

AT_ONCE = 8  # frames


@dataclass(frozen=True)
class ImputationFigures:
    """What one imputation does, mean over frames.

    Attributes:
        body_keypoints_mm: distance of the joints that the surface shows from those that the driving signal gives.
        face_landmarks_mm: the same of the face's landmarks; None where the face signal does not list them.
        moved_mm: how far the clothes are from where the most likely code puts them, in rest space; of all vertices where none are known.
        step_mm: how far they move from one frame to the next in rest space, within clips; None where no two frames follow each other.
        from_truth_mm: distance of the clothes from the true surface; None where that is not known.
    """

    body_keypoints_mm: float
    face_landmarks_mm: float | None
    moved_mm: float
    step_mm: float | None
    from_truth_mm: float | None


def drive_of_capture(run: RunFolder, avatar: Avatar, path: Path | str, training: TrainingLatents, split: str = "test") -> AssembledDrive:
    """Body and face of a capture's frames as signals of this avatar, whatever the capture calls its face.

    Raises:
        FileNotFoundError, ValueError: as `load_body`, `load_face`, `assemble`.
    """
    body = load_body(path, run.rig, split=split)
    return assemble(run, avatar, body, load_face(path, trained_face(run), body.fps, split), lambda: training.signals)


def imputation_figures(
    study: Study, training: TrainingLatents, signals: DrivingSignals, seed: int = 0, exact: Float[np.ndarray, "N V 3"] | None = None
) -> dict[str, dict]:
    """Name of every imputation -> its `ImputationFigures` as a dictionary.

    Args:
        study: of the avatar; its capture says which vertices are clothes.
        training: codes of the training frames.
        signals: N frames that drive.
        seed: of imputations that draw.
        exact: true surface of these frames in the world, metres, where it is known.

    Returns:
        an avatar without a latent code has `zero` alone.

    Raises:
        ValueError: no two training frames follow each other, as the temporal model needs.
    """
    avatar, keypoints = study.avatar, study.keypoints()
    names = get_args(ImputationName) if avatar.settings.use_latent else ("zero",)
    temporal = TemporalModel.fit(training) if avatar.settings.use_latent else None
    watched = study.groups().get("garment", np.ones(study.rig.topology.num_vertices, dtype=bool))
    figures = {}
    for name in names:
        z = make_imputation(name, training.mu.shape[1], training, temporal, seed).latents(signals)
        figures[name] = asdict(_figures(avatar, keypoints, signals, z, watched, exact))
    return figures


@torch.no_grad()
def _figures(
    avatar: Avatar,
    keypoints: DrivenKeypoints,
    signals: DrivingSignals,
    z: Float[Tensor, "N Z"],
    watched: Bool[np.ndarray, "V"],  # noqa: F821
    exact: Float[np.ndarray, "N V 3"] | None,
) -> ImputationFigures:
    """Decode all frames with given codes and compare."""
    mask = torch.from_numpy(watched)
    astray, moved, shapes, wrong = [], [], [], []
    for start in range(0, len(signals), AT_ONCE):
        rows = slice(start, start + AT_ONCE)
        theta, root, face = signals.theta[rows], signals.root[rows], signals.face[rows]
        rest = avatar.decode_rest_vertices(theta, face, z[rows] if avatar.settings.use_latent else None)
        likely = avatar.decode_rest_vertices(theta, face, None)
        asked, shown = keypoints.from_driving(theta, root, face), keypoints.from_surface(rest, theta, root)
        astray.append((shown - asked).norm(dim=-1))  # [P, K]
        moved.append((rest - likely).norm(dim=-1)[:, mask].mean(1))
        shapes.append(rest[:, mask])
        if exact is not None:
            surface = pose_vertices(rest, avatar.skeleton(theta, root), avatar.skinning_weights)
            wrong.append((surface - torch.from_numpy(np.array(exact[rows], np.float32))).norm(dim=-1)[:, mask].mean(1))
    distances, shape = torch.cat(astray), torch.cat(shapes)
    steps = [(shape[clip][1:] - shape[clip][:-1]).norm(dim=-1).mean(1) for clip in signals.clips if clip.stop - clip.start > 1]
    return ImputationFigures(
        body_keypoints_mm=MILLIMETRES * float(distances[:, : keypoints.num_body].mean()),
        face_landmarks_mm=MILLIMETRES * float(distances[:, keypoints.num_body :].mean()) if keypoints.with_face else None,
        moved_mm=MILLIMETRES * float(torch.cat(moved).mean()),
        step_mm=MILLIMETRES * float(torch.cat(steps).mean()) if steps else None,
        from_truth_mm=MILLIMETRES * float(torch.cat(wrong).mean()) if wrong else None,
    )
