"""Shape and motion of the rig from keypoints: the most probable body under what detectors saw and how bodies move.

Energy, in units of standard deviations squared: robust reprojection error of every landmark in every camera; pose angles near rest;
small accelerations of angles and landmarks; small offsets of landmarks; a phenotype near its start. Angles are brought back within the
limits of their joints after each step.

Symbols: N frames, C cameras, K landmarks. Pixels of the full cameras; metres, radians, seconds.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64
from torch import Tensor

from mitsuba_avatar.body.anny_rig import AnnyPhenotype, build_anny_rig
from mitsuba_avatar.body.rig import Rig
from mitsuba_avatar.captures.cameras import Camera
from mitsuba_avatar.recordings.angle_solver import AngleSolver, BoneTargets, PositionTargets
from mitsuba_avatar.registration.body_sequence import BodySequence
from mitsuba_avatar.registration.body_shape import PARAMETERS, AnnyShapes
from mitsuba_avatar.registration.keypoints_2d import LANDMARKS
from mitsuba_avatar.registration.keypoints_3d import REFERENCE_HEIGHT, PersonKeypoints
from mitsuba_avatar.registration.landmarks import rig_landmarks
from mitsuba_avatar.registration.settings import BodySettings, PoseSettings

TRUNK = ("left_hip", "right_hip", "left_shoulder", "right_shoulder", "neck", "upper_neck", "mid_hip")
ROBUSTNESS = 3.0  # standard deviations from which an observation is taken for an outlier
FIRST_ROBUSTNESS = 20.0  # the same at the start, when the model is wrong rather than the observation
HANDS_FEET_AND_EYES = ("finger", "wrist", "toe", "eye", "foot")  # joints that landmarks at joints do not tell how to turn
ROUNDS = 2  # of fitting and rebuilding the rig at the phenotype that was found
NEAREST_DEPTH = 0.1  # metres; points behind a camera would flip sides


@dataclass(frozen=True, eq=False)
class FittedBody:
    """A body fitted to a sequence.

    Attributes:
        phenotype: of the rig (`build_anny_rig` makes it).
        theta: [N, D]. root: [N, 4, 4].
        landmark_offsets: [K, 3] metres at rest.
    """

    phenotype: AnnyPhenotype
    theta: Float32[np.ndarray, "N D"]
    root: Float32[np.ndarray, "N 4 4"]
    landmark_offsets: Float32[np.ndarray, "K 3"]


class KeypointEnergy:
    """What keypoints and priors say about a `BodySequence`.

    Args:
        cameras: C full cameras.
        observations: [N, C, K, 3] x, y, confidence; NaN where missing.
        fps: frames a second.
        settings: deviations.
        body: freedom of the shape.
    """

    def __init__(
        self,
        cameras: Sequence[Camera],
        observations: Float64[np.ndarray, "N C K 3"],
        fps: float,
        settings: PoseSettings,
        body: BodySettings,
    ):
        self.settings, self.body, self.fps = settings, body, fps
        self.scale = REFERENCE_HEIGHT / cameras[0].height  # to the pixels that settings count
        rows = [[camera.fx, camera.fy, camera.cx, camera.cy] for camera in cameras]
        self.intrinsics = torch.tensor(rows, dtype=torch.float32)
        self.camera_from_world = torch.from_numpy(np.stack([camera.camera_from_world for camera in cameras])).float()
        self.pixels = torch.from_numpy(np.nan_to_num(observations[..., :2])).float()
        self.confidence = torch.from_numpy(np.nan_to_num(observations[..., 2])).float()
        self.total = float(self.confidence.sum().clamp(min=1.0))

    def errors(self, landmarks: Float[Tensor, "N K 3"]) -> Float[Tensor, "N C K"]:
        """Reprojection errors in reference pixels, where there is an observation or not."""
        points = torch.einsum("cij,nkj->ncki", self.camera_from_world[:, :3, :3], landmarks) + self.camera_from_world[:, None, :3, 3]
        plane = points[..., :2] / points[..., 2:].clamp(min=NEAREST_DEPTH)
        projected = plane * self.intrinsics[:, None, :2] + self.intrinsics[:, None, 2:]
        return self.scale * ((projected - self.pixels) ** 2).sum(-1).clamp(min=1e-8).sqrt()

    def known_errors(self, landmarks: Float[Tensor, "N K 3"]) -> Float32[np.ndarray, "N C K"]:
        """The same, NaN where nothing was observed."""
        errors = torch.where(self.confidence > 0, self.errors(landmarks), torch.nan)
        return errors.detach().numpy()

    def data(self, landmarks: Float[Tensor, "N K 3"], robustness: float = ROBUSTNESS) -> Tensor:
        """Mean robust error (Geman-McClure) per unit of confidence."""
        squared = (self.errors(landmarks) / self.settings.pixel_deviation).square()
        return (self.confidence * squared / (1 + squared / robustness**2)).sum() / self.total

    def priors(self, sequence: BodySequence, landmarks: Float[Tensor, "N K 3"]) -> Tensor:
        """Everything that does not look at images, in the unit of `data`."""
        settings, step = self.settings, 1 / self.fps**2
        deviations = torch.tensor(
            [settings.twist_deviation if name.endswith("_twist") else settings.angle_deviation for name in sequence.dof_names]
        )
        energy = (sequence.theta / deviations).square().sum()
        if len(sequence.theta) > 2:
            bends = sequence.theta[2:] - 2 * sequence.theta[1:-1] + sequence.theta[:-2]
            energy = energy + (bends / (settings.angular_acceleration * step)).square().sum()
            leaps = landmarks[2:] - 2 * landmarks[1:-1] + landmarks[:-2]
            energy = energy + (leaps / (settings.linear_acceleration * step)).square().sum()
        frames = len(sequence.theta)
        energy = energy + frames * (sequence.landmark_offsets / settings.landmark_deviation).square().sum()
        start = torch.tensor([getattr(self.body, name) for name in PARAMETERS])
        energy = energy + frames * ((sequence.tangent.phenotype + sequence.shape - start) / self.body.freedom).square().sum()
        return energy / self.total


def fit_keypoints(
    cameras: Sequence[Camera],
    keypoints: PersonKeypoints,
    fps: float,
    pose: PoseSettings,
    body: BodySettings,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> FittedBody:
    """Fit shape, motion and landmark offsets to a sequence of keypoints.

    Args:
        cameras: C full cameras.
        keypoints: of the followed person.
        fps: frames a second.
        pose, body: settings.
        progress: called as progress(done, total).
    """
    energy = KeypointEnergy(cameras, keypoints.observations, fps, pose, body)
    shapes = AnnyShapes()
    phenotype = AnnyPhenotype(**{name: getattr(body, name) for name in PARAMETERS})
    rig = build_anny_rig(phenotype)
    positions = filled_in_time(keypoints.positions)
    theta, root = warm_start(rig, positions)
    fitted = FittedBody(phenotype, theta, root, np.zeros((len(LANDMARKS), 3), np.float32))
    for index in range(ROUNDS):
        rig = build_anny_rig(fitted.phenotype)
        sequence = BodySequence(rig, shapes.tangent(fitted.phenotype), fitted.theta, fitted.root)
        sequence.landmark_offsets.data.copy_(torch.from_numpy(fitted.landmark_offsets))
        done = index * pose.iterations
        optimise(sequence, energy, pose, body, lambda step, done=done: progress(done + step, ROUNDS * pose.iterations))
        fitted = fitted_body(sequence)
    return fitted


def optimise(
    sequence: BodySequence, energy: KeypointEnergy, pose: PoseSettings, body: BodySettings, progress: Callable[[int], None]
) -> None:
    """Minimise the energy by Adam with a decaying step, in place."""
    groups = [
        {"params": [sequence.theta, sequence.turn], "lr": pose.learning_rate},
        {"params": [sequence.place], "lr": 0.3 * pose.learning_rate},
        {"params": [sequence.shape], "lr": 0.3 * pose.learning_rate},
        {"params": [sequence.landmark_offsets], "lr": 0.1 * pose.learning_rate},
    ]
    optimizer = torch.optim.Adam(groups)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, pose.iterations, eta_min=0.0)
    is_fixed = torch.tensor([name in body.fixed for name in PARAMETERS])
    for step in range(pose.iterations):
        optimizer.zero_grad()
        vertices, joints = sequence.rest()
        landmarks = sequence.landmarks(vertices, joints, sequence.transforms(joints))
        done = step / pose.iterations
        robustness = max(ROBUSTNESS, FIRST_ROBUSTNESS * (ROBUSTNESS / FIRST_ROBUSTNESS) ** (2 * done))
        (energy.data(landmarks, robustness) + energy.priors(sequence, landmarks)).backward()
        sequence.shape.grad[is_fixed] = 0
        optimizer.step()
        schedule.step()
        sequence.project_to_limits()
        progress(step + 1)


def fitted_body(sequence: BodySequence) -> FittedBody:
    """What a sequence has arrived at; the root is kept rigid about its own joint when the rig is rebuilt at the new phenotype."""
    with torch.no_grad():
        phenotype = sequence.tangent.moved(sequence.shape)
        joint = build_anny_rig(phenotype).joint_positions
        root = sequence.root(torch.from_numpy(joint))
        return FittedBody(phenotype, sequence.theta.numpy().copy(), root.numpy().copy(), sequence.landmark_offsets.numpy().copy())


def warm_start(rig: Rig, positions: Float64[np.ndarray, "N K 4"]) -> tuple[Float32[np.ndarray, "N D"], Float32[np.ndarray, "N 4 4"]]:
    """Pose angles and roots that bring the rig's joints near to the landmarks: trunk first, then limbs by least squares.

    Args:
        rig: of a shape that need not be right.
        positions: [N, K, 4] landmarks without gaps (`filled_in_time`).
    """
    root = trunk_roots(rig, positions)
    landmarks = rig_landmarks(rig)
    at_one_joint = [
        index for index in range(len(LANDMARKS)) if (landmarks.from_joints[index] == 1).any() and (positions[:, index, 3] > 0).all()
    ]
    joints = landmarks.from_joints[at_one_joint].argmax(axis=1)
    names = np.array(rig.joint_names)[rig.dofs.joints]
    free = np.array([index for index, name in enumerate(names) if not name.startswith(HANDS_FEET_AND_EYES)], dtype=np.int64)
    no_bones = BoneTargets(np.zeros(0, np.int64), np.zeros((len(positions), 0, 3, 3)), np.zeros((0, 3)), np.zeros((0, 2)))
    places = PositionTargets(joints.astype(np.int64), positions[:, at_one_joint, :3])
    theta = np.zeros((len(positions), len(rig.dofs.names)))
    theta, roots = AngleSolver(rig, free).solve(theta, root.astype(np.float64), no_bones, places)
    return theta.astype(np.float32), roots.astype(np.float32)


def trunk_roots(rig: Rig, positions: Float64[np.ndarray, "N K 4"]) -> Float32[np.ndarray, "N 4 4"]:
    """Roots that bring the rig's trunk at rest onto the landmarks, rigidly (Kabsch), frame by frame."""
    landmarks = rig_landmarks(rig)
    rest = landmarks.from_joints @ rig.joint_positions
    roots = np.tile(np.eye(4, dtype=np.float32), (len(positions), 1, 1))
    chosen = [LANDMARKS.index(name) for name in TRUNK]
    for frame, points in enumerate(positions):
        known = [index for index in chosen if points[index, 3] > 0]
        if len(known) < 3:
            raise ValueError(
                f"trunk_roots(): expected hips and shoulders in some frame; got {[LANDMARKS[index] for index in known]} only. "
                "Use a detector of whole bodies, and cameras that see one."
            )
        here, there = rest[known], points[known, :3]
        left, _, right = np.linalg.svd((here - here.mean(0)).T @ (there - there.mean(0)))
        flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
        rotation = (left @ flip @ right).T
        roots[frame, :3, :3], roots[frame, :3, 3] = rotation, there.mean(0) - rotation @ here.mean(0)
    return roots


def filled_in_time(positions: Float64[np.ndarray, "N K 4"]) -> Float64[np.ndarray, "N K 4"]:
    """Missing places interpolated from the frames before and after; a landmark that is never seen stays at confidence 0."""
    filled = positions.copy()
    times = np.arange(len(positions))
    for index in range(positions.shape[1]):
        known = positions[:, index, 3] > 0
        if known.any():
            for column in range(4):
                filled[:, index, column] = np.interp(times, times[known], positions[known, index, column])
    return filled
