"""What a run is measured by: image error driven with z = 0, geometry against the truth, disentanglement.

Image errors are means over pictures of the mean squared difference inside the captured mask, in 0..255 values, as in the paper's table.
Truth is read where the capture is the studio's own (its folder `truth/`), and left out where it is not.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from mitsuba_avatar.analysis.regions import with_surroundings
from mitsuba_avatar.body.driving import driving_regions
from mitsuba_avatar.body.rig import Rig
from mitsuba_avatar.captures.arrays import open_frame_array
from mitsuba_avatar.captures.folder import Capture
from mitsuba_avatar.driving.signals import DrivingSignals
from mitsuba_avatar.driving.training_latents import encode_frames
from mitsuba_avatar.filming.truth import GARMENT, TRUTH_FOLDER
from mitsuba_avatar.model.avatar import Avatar
from mitsuba_avatar.model.encoder import Posterior
from mitsuba_avatar.model.keypoints import DrivenKeypoints, lists_face_landmarks
from mitsuba_avatar.reporting.disentanglement import (
    MILLIMETRES,
    drive_swap,
    fresh_mutual_information,
    latent_swap,
    latent_use,
    linear_probe,
    other_frames,
)
from mitsuba_avatar.reporting.evaluation import Evaluator
from mitsuba_avatar.reporting.metrics import l1_in_mask, mse_in_mask, psnr_from_mse, silhouette_iou
from mitsuba_avatar.ridge import ridge_prediction
from mitsuba_avatar.training.statistics import evenly_spaced

AT_ONCE = 8  # frames
PRINCIPAL = 64  # directions of the garment's shape that the hidden state is told in
STEADY = 1e-4  # radians: an angle that varies less tells nothing
FEWEST_FRAMES = 64  # of training that an estimate of mutual information is worth making on
Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Splits:
    """Frames that are measured, by what they are: "train", "validation", "test", "stress"; empty ones are left out."""

    frames: dict[str, list[int]]

    @classmethod
    def of(cls, capture: Capture, most: int) -> "Splits":
        """At most `most` evenly spaced frames of each."""
        groups: dict[str, list[int]] = {"train": [], "validation": [], "test": [], "stress": []}
        for index, frame in enumerate(capture.frames):
            groups[frame.purpose].append(index)
        return cls({name: evenly_spaced(frames, most) for name, frames in groups.items() if frames})


def image_errors(
    evaluator: Evaluator, splits: Splits, progress: Progress = lambda done, total: None, z: Float[Tensor, "1 Z"] | None = None
) -> dict[str, dict[str, Any]]:
    """Split -> errors of the driven avatar, over all cameras and over held-out cameras alone.

    Args:
        evaluator: of the avatar.
        splits: frames that are drawn.
        progress: called as progress(done, total), in frames.
        z: latent code of all frames; None for z = 0.

    Returns:
        for each split `mse`, `l1` (0..255), `psnr` (of the mean error, dB), `iou`, `held_out_mse`, `pictures`, how many were counted, and
        `takes`: segment -> `mse` of its frames.
    """
    capture = evaluator.capture
    names, held_out = capture.camera_names(), set(capture.camera_names(held_out=True))
    total, done = sum(map(len, splits.frames.values())), 0
    errors = {}
    for split, frames in splits.frames.items():
        rows, takes = [], []
        for frame in frames:
            batch = evaluator.reader.read([frame], [names])
            drawn = evaluator.draw("avatar", batch, z)
            images, masks = (batch.pictures(values) for values in (drawn.images, batch.images)), (drawn.masks, batch.masks)
            pictures = zip(names, *images, *(batch.coverage(values) for values in masks), strict=True)
            for name, image, captured, mask, inside in pictures:
                if inside.any():
                    iou = silhouette_iou(mask, inside)
                    rows.append((mse_in_mask(image, captured, inside), l1_in_mask(image, captured, inside), iou, name in held_out))
                    takes.append(capture.frames[frame].segment)
            done += 1
            progress(done, total)
        mse, l1, iou, is_held_out = np.array(rows, dtype=np.float64).T
        errors[split] = {
            "mse": float(mse.mean()),
            "l1": float(l1.mean()),
            "psnr": psnr_from_mse(float(mse.mean())),
            "iou": float(iou.mean()),
            "pictures": len(rows),
            "takes": {take: float(mse[np.array(takes) == take].mean()) for take in dict.fromkeys(takes)},
        }
        if is_held_out.any():
            errors[split]["held_out_mse"] = float(mse[is_held_out > 0].mean())
    return errors


@dataclass(frozen=True)
class Study:
    """A trained avatar and the frames of the capture that judge it, encoded.

    Attributes:
        avatar, rig, capture: of the run.
        drive: of all N frames.
        posterior: of all frames; None for an avatar without a latent code.
        exact: [N, V, 3] true registered surface, world, metres; the capture's own mesh where there is no truth.
        garment: vertices that are clothes; None where nothing says which.
    """

    avatar: Avatar
    rig: Rig
    capture: Capture
    drive: DrivingSignals
    posterior: Posterior | None
    exact: np.ndarray
    garment: Int[np.ndarray, "G"] | None

    @classmethod
    def of(cls, avatar: Avatar, rig: Rig, capture: Capture) -> "Study":
        """Encode every frame of a capture with a registered mesh."""
        truth, count = capture.path / TRUTH_FOLDER, len(capture.frames)
        exact = open_frame_array(truth, "vertices", count) if truth.is_dir() else None
        garment = np.load(truth / GARMENT) if (truth / GARMENT).is_file() else None
        drive = DrivingSignals.of_capture(capture)
        posterior = None
        if avatar.settings.use_latent and capture.vertices is not None:
            posterior = encode_frames(avatar, capture, list(range(count)), drive)
        return cls(avatar, rig, capture, drive, posterior, capture.vertices if exact is None else exact, garment)

    def frames(self, *splits: str) -> list[int]:
        """Frames of some splits, in order of time, without stress segments."""
        return [i for i, frame in enumerate(self.capture.frames) if frame.purpose in splits]

    def groups(self) -> dict[str, np.ndarray]:
        """Masks over vertices to report distances for, apart from all."""
        if self.garment is None:
            return {}
        mask = np.zeros(self.rig.topology.num_vertices, dtype=bool)
        mask[self.garment] = True
        return {"garment": mask}

    @torch.no_grad()
    def surface(self, frame: int, z: Float[Tensor, "1 Z"] | None) -> Float[np.ndarray, "V 3"]:
        """Surface decoded for a frame's driving signal in the world, metres; None is the most likely code."""
        return self.avatar.decode_vertices(*self.row(frame), z)[0].numpy()

    def row(self, frame: int) -> tuple[Float[Tensor, "1 D"], Float[Tensor, "1 4 4"], Float[Tensor, "1 F"]]:
        """Theta, root and face of a frame."""
        rows = slice(frame, frame + 1)
        return self.drive.theta[rows], self.drive.root[rows], self.drive.face[rows]

    def mean_code(self) -> Float[Tensor, "1 Z"] | None:
        """Mean of the training frames' posterior means, the code of the imputation `mean` (driving/imputation.py); None for an avatar
        without a latent code."""
        return None if self.posterior is None else self.posterior.mu[self.frames("train")].mean(0, keepdim=True)

    def keypoints(self) -> DrivenKeypoints:
        """What the driving signal fixes."""
        with_face = lists_face_landmarks(self.rig, self.capture.description.face_signal, self.drive.face.shape[1])
        return DrivenKeypoints(self.rig, self.avatar.template_vertices, with_face)


@torch.no_grad()
def geometry_errors(study: Study, most: int) -> dict[str, dict[str, float]]:
    """Split -> mean distances in millimetres from the true surface: of the registered mesh that the avatar was trained on, of the surface
    driven with z = 0, and of the surface decoded from the frame's own latent code; each over all vertices and over the garment's alone.

    With tracking noise on the registered mesh, "decoded" below "registered" on training frames is what training gained. Errors of tracking
    average out over frames without any image: what images add is the difference to the same training without them (a rehearsal).
    """
    masks = {"": np.ones(study.rig.topology.num_vertices, dtype=bool)} | {f"_{name}": mask for name, mask in study.groups().items()}
    errors: dict[str, dict[str, float]] = {}
    for split, frames in Splits.of(study.capture, most).frames.items():
        sums: dict[str, list[float]] = {}
        for frame in frames:
            registered, decoded = surface_distances(study, frame)
            distances = {"registered": registered, "driven": _distance(study, frame, study.surface(frame, None))}
            for name, distance in (distances | ({} if study.posterior is None else {"decoded": decoded})).items():
                for suffix, mask in masks.items():
                    sums.setdefault(f"{name}{suffix}_mm", []).append(float(distance[mask].mean()))
        errors[split] = {name: float(np.mean(values)) for name, values in sums.items()}
    return errors


@torch.no_grad()
def surface_distances(study: Study, frame: int) -> tuple[Float[np.ndarray, "V"], Float[np.ndarray, "V"]]:  # noqa: F821
    """Distance of each vertex from the true surface's, millimetres: of the registered mesh, and of the mesh decoded from the frame's own
    latent code (z = 0 for an avatar without one)."""
    z = None if study.posterior is None else study.posterior.mu[frame : frame + 1]
    registered = np.asarray(study.capture.vertices[frame])
    return _distance(study, frame, registered), _distance(study, frame, study.surface(frame, z))


def disentanglement(study: Study, seed: int = 0) -> dict:
    """How far latent code and driving signal are apart; an avatar without a latent code has nothing to tell but `spurious`.

    Returns:
        `spurious` (see `spurious_effects`); `LatentUse` over training frames; `mutual_information_nats` by a fresh estimator;
        `latent_swap` and `drive_swap` on test frames; `hidden_state_r2`, what a linear probe reads off z of the garment's state that
        a linear probe of the pose does not tell (partial R^2), on validation and test frames (where the truth is known).
    """
    result: dict = {"spurious": spurious_effects(study, seed)}
    if study.posterior is None:
        return result
    train, judged = study.frames("train"), study.frames("test") or study.frames("train")
    posterior = Posterior(study.posterior.mu[train], study.posterior.logvar[train])
    driving = study.avatar.standardized_driving(study.drive.theta, study.drive.face)
    result |= asdict(latent_use(posterior, seed))
    if len(train) >= FEWEST_FRAMES:
        result["mutual_information_nats"] = fresh_mutual_information(posterior, driving[train], seed=seed)
    rows = torch.tensor(judged)
    drive, z = study.drive.chosen(judged), study.posterior.mu[rows]
    others = other_frames(driving[rows], seed)
    keypoints, groups = study.keypoints(), study.groups()
    result["latent_swap"] = asdict(latent_swap(study.avatar, keypoints, drive, z, z[others], groups))
    result["drive_swap"] = asdict(drive_swap(study.avatar, keypoints, drive.chosen(others.tolist()), z, groups))
    if study.garment is not None:
        hidden = _hidden_state(study, train)
        mu = study.posterior.mu.double().numpy()
        result["hidden_state_r2"] = {
            split: linear_probe(mu[train], hidden[train], mu[rows], hidden[rows])
            for split in ("validation", "test")
            if (rows := study.frames(split))
        }
    return result


@torch.no_grad()
def spurious_effects(study: Study, seed: int = 0) -> dict[str, float]:
    """Chance correlations, seen directly: the face of one frame with the pose of another, z = 0, on training frames.

    Returns:
        mean distances in millimetres: `face_moves_body_mm`, how far another face moves the surface away from the face,
        and `pose_moves_face_mm`, how far another pose moves the face's landmarks in the head's frame (0 where the face signal lists none).
    """
    frames = evenly_spaced(study.frames("train"), 64)
    drive = study.drive.chosen(frames)
    others = other_frames(study.avatar.standardized_driving(drive.theta, drive.face), seed)
    outside = ~with_surroundings(study.rig, driving_regions(study.rig).face)
    landmarks = torch.from_numpy(study.rig.face_keypoint_vertices)
    body, face = [], []
    for start in range(0, len(frames), AT_ONCE):
        rows = slice(start, start + AT_ONCE)
        theta, expression = drive.theta[rows], drive.face[rows]
        rest, other_face, other_pose = (
            study.avatar.decode_rest_vertices(angles, signal, None)
            for angles, signal in ((theta, expression), (theta, drive.face[others][rows]), (drive.theta[others][rows], expression))
        )
        body.append((other_face - rest).norm(dim=-1)[:, torch.from_numpy(outside)])
        face.append((other_pose - rest).norm(dim=-1)[:, landmarks])
    return {
        "face_moves_body_mm": MILLIMETRES * float(torch.cat(body).mean()),
        "pose_moves_face_mm": MILLIMETRES * float(torch.cat(face).mean()) if len(landmarks) else 0.0,
    }


def _hidden_state(study: Study, train: list[int]) -> Float[np.ndarray, "N K"]:
    """The garment's true shape in rest space, main directions, less what ridge regression on the pose angles tells of it, metres."""
    avatar, count = study.avatar, len(study.capture.frames)
    garment = []
    for start in range(0, count, AT_ONCE):
        rows = slice(start, start + AT_ONCE)
        exact = torch.from_numpy(np.array(study.exact[rows], np.float32))
        garment.append(
            avatar.unpose(exact, study.drive.theta[rows], study.drive.root[rows])[:, torch.from_numpy(study.garment)].flatten(1).numpy()
        )
    shape = np.concatenate(garment).astype(np.float64)
    shape -= shape[train].mean(0)
    _, _, directions = np.linalg.svd(shape[train], full_matrices=False)
    state = shape @ directions[:PRINCIPAL].T
    angles = study.drive.theta.double().numpy()
    mean, spread = angles[train].mean(0), angles[train].std(0)
    moving = spread > STEADY
    angles = (angles - mean)[:, moving] / spread[moving]
    return state - ridge_prediction(angles[train], state[train], angles)


def _distance(study: Study, frame: int, surface: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "V"]:  # noqa: F821
    """Of each vertex from where it truly is, millimetres."""
    return MILLIMETRES * np.linalg.norm(surface.astype(np.float64) - study.exact[frame], axis=-1)
