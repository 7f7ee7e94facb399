"""Pose angles that bring bones to given rotations and joints to given places, within the rig's limits: damped least squares per frame.

All frames are solved at once. Derivatives are exact: a pose angle turns everything below its joint about one world axis.

Symbols: N frames, S bones with a target rotation, P joints with a target position, D pose angles, A of them free. Metres, radians, float64.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64
from scipy.spatial.transform import Rotation

from mitsuba_avatar.body.rig import Rig
from mitsuba_avatar.body.skeleton import Skeleton

ITERATIONS = 40
LARGEST_STEP = 0.4  # radians in one iteration: linearisation is good for no more
REST_WEIGHT = 0.03  # pull of every angle to zero: shares a turn among the joints of a chain that could all do it
TWIST_WEIGHT = 0.15  # the same for twists along a limb, which joints above do as well
CONVERGED = 1e-3  # radians


@dataclass(frozen=True, eq=False)  # arrays have no truth value to compare by
class BoneTargets:
    """Rotations that bones should have.

    Attributes:
        joints: [S] joint whose rotation is meant.
        rotations: [N, S, 3, 3] world rotation since rest.
        directions: [S, 3] unit, of the bone at rest.
        weights: [S, 2] how much the bone's direction counts, and its turn about itself.
    """

    joints: Int64[np.ndarray, "S"]  # noqa: F821
    rotations: Float64[np.ndarray, "N S 3 3"]
    directions: Float64[np.ndarray, "S 3"]
    weights: Float64[np.ndarray, "S 2"]


@dataclass(frozen=True, eq=False)  # arrays have no truth value to compare by
class PositionTargets:
    """Places where joints should be; the root may move for them.

    Attributes:
        joints: [P].
        positions: [N, P, 3] metres.
        weight: residual per metre, beside residuals of directions, which are radians.
        root_weight: the same for the root's shift from where it is given.
    """

    joints: Int64[np.ndarray, "P"]  # noqa: F821
    positions: Float64[np.ndarray, "N P 3"]
    weight: float = 12.0
    root_weight: float = 1.5


class AngleSolver:
    """Solves for the pose angles `free` of a rig."""

    def __init__(self, rig: Rig, free: Int64[np.ndarray, "A"]):  # noqa: F821
        self.skeleton = Skeleton(rig).double()
        self.rig, self.free = rig, free
        self.joints = rig.dofs.joints[free]
        self.lower, self.upper = rig.dofs.lower[free].astype(np.float64), rig.dofs.upper[free].astype(np.float64)
        self.pull = np.array([TWIST_WEIGHT if rig.dofs.names[index].endswith("_twist") else REST_WEIGHT for index in free])
        carries = np.eye(len(rig.joint_parents), dtype=bool)  # [a, j]: joint a is j or above it
        for joint, parent in enumerate(rig.joint_parents):
            if parent >= 0:
                carries[:, joint] |= carries[:, parent]
        self.moves: Bool[np.ndarray, "A J"] = carries[self.joints]

    def solve(
        self,
        theta: Float64[np.ndarray, "N D"],
        root: Float64[np.ndarray, "N 4 4"],
        bones: BoneTargets,
        places: PositionTargets | None = None,
    ) -> tuple[Float64[np.ndarray, "N D"], Float64[np.ndarray, "N 4 4"]]:
        """Angles, and root, that come nearest to the targets; Levenberg-Marquardt with angles held at their limits.

        Args:
            theta: start; angles that are not free stay.
            root: world_from_root; only its translation changes, and only for `places`.

        Returns:
            theta and root, new.
        """
        theta, root = theta.copy(), root.copy()
        theta[:, self.free] = np.clip(theta[:, self.free], self.lower, self.upper)
        given = root[:, :3, 3].copy()
        damping = np.full(len(theta), 1e-2)
        residuals, jacobian = self._linearise(theta, root, given, bones, places)
        for _ in range(ITERATIONS):
            step = self._step(theta[:, self.free], residuals, jacobian, damping)
            moved_theta, moved_root = theta.copy(), root.copy()
            moved_theta[:, self.free] = np.clip(theta[:, self.free] + step[:, : len(self.free)], self.lower, self.upper)
            if places is not None:
                moved_root[:, :3, 3] += step[:, len(self.free) :]
            new_residuals, new_jacobian = self._linearise(moved_theta, moved_root, given, bones, places)
            better = (new_residuals**2).sum(axis=1) <= (residuals**2).sum(axis=1)
            damping = np.clip(np.where(better, damping / 4, damping * 6), 1e-6, 1e4)
            theta[better], root[better] = moved_theta[better], moved_root[better]
            residuals[better], jacobian[better] = new_residuals[better], new_jacobian[better]
            if np.abs(step).max() < CONVERGED:
                break
        return theta, root

    def pose(
        self, theta: Float64[np.ndarray, "N D"], root: Float64[np.ndarray, "N 4 4"]
    ) -> tuple[Float64[np.ndarray, "N J 3 3"], Float64[np.ndarray, "N J 3"]]:
        """World rotations since rest, and positions, of all joints."""
        with torch.no_grad():
            transforms = self.skeleton(torch.from_numpy(theta), torch.from_numpy(root))
            return transforms[..., :3, :3].numpy(), self.skeleton.posed_joints(transforms).numpy()

    def _step(
        self,
        angles: Float64[np.ndarray, "N A"],
        residuals: Float64[np.ndarray, "N R"],
        jacobian: Float64[np.ndarray, "N R U"],
        damping: Float64[np.ndarray, "N"],  # noqa: F821
    ) -> Float64[np.ndarray, "N U"]:
        """One damped step, with angles frozen that lie on a limit and would go beyond it."""
        gradient = np.einsum("nru,nr->nu", jacobian, residuals)
        hessian = np.matmul(jacobian.transpose(0, 2, 1), jacobian)
        frozen = np.zeros_like(gradient, dtype=bool)
        count = angles.shape[1]
        frozen[:, :count] = (angles <= self.lower) & (gradient[:, :count] > 0) | (angles >= self.upper) & (gradient[:, :count] < 0)
        hessian[frozen] = 0
        hessian.transpose(0, 2, 1)[frozen] = 0
        diagonal = np.arange(hessian.shape[-1])
        hessian[:, diagonal, diagonal] += np.where(frozen, 1.0, damping[:, None])
        step = np.linalg.solve(hessian, -np.where(frozen, 0, gradient)[..., None])[..., 0]
        return step * np.minimum(1, LARGEST_STEP / np.maximum(np.abs(step).max(axis=1, keepdims=True), 1e-12))

    def _linearise(
        self,
        theta: Float64[np.ndarray, "N D"],
        root: Float64[np.ndarray, "N 4 4"],
        given: Float64[np.ndarray, "N 3"],
        bones: BoneTargets,
        places: PositionTargets | None,
    ) -> tuple[Float64[np.ndarray, "N R"], Float64[np.ndarray, "N R U"]]:
        """Residuals and their derivatives by the free angles and, with `places`, the root's translation."""
        rotations, positions = self.pose(theta, root)
        axes = self._world_axes(theta, rotations)  # [N, A, 3]
        count, free = len(theta), len(self.free)
        unknowns = free + (3 if places is not None else 0)
        residuals, jacobians = [], []

        def add(residual: np.ndarray, by_angle: np.ndarray, by_root: float) -> None:  # [N, K, 3], [N, K, A, 3]
            rows = residual.shape[1] * 3
            block = np.zeros((count, residual.shape[1], 3, unknowns))
            block[..., :free] = by_angle.transpose(0, 1, 3, 2)
            if places is not None:
                block[..., free:] = by_root * np.eye(3)
            residuals.append(residual.reshape(count, rows))
            jacobians.append(block.reshape(count, rows, unknowns))

        for rest, weight in _rest_vectors(bones):
            vectors = (rotations[:, bones.joints] @ rest[..., None])[..., 0]  # [N, S, 3]
            wanted = (bones.rotations @ rest[..., None])[..., 0]
            turning = np.cross(axes[:, None], vectors[:, :, None]) * self.moves[:, bones.joints].T[None, :, :, None]
            add(weight[:, None] * (vectors - wanted), weight[:, None, None] * turning, 0.0)
        if places is not None:
            arms = positions[:, places.joints, None] - positions[:, None, self.joints]  # [N, P, A, 3]
            turning = np.cross(axes[:, None], arms) * self.moves[:, places.joints].T[None, :, :, None]
            add(places.weight * (positions[:, places.joints] - places.positions), places.weight * turning, places.weight)
            shift = places.root_weight * (root[:, None, :3, 3] - given[:, None])
            add(shift, np.zeros((count, 1, free, 3)), places.root_weight)
        pull = np.zeros((count, free, unknowns))
        pull[:, np.arange(free), np.arange(free)] = self.pull
        residuals.append(self.pull * theta[:, self.free])
        jacobians.append(pull)
        return np.concatenate(residuals, axis=1), np.concatenate(jacobians, axis=1)

    def _world_axes(self, theta: Float64[np.ndarray, "N D"], rotations: Float64[np.ndarray, "N J 3 3"]) -> Float64[np.ndarray, "N A 3"]:
        """World axis of each free angle: its joint's angles multiply in table order, so those after it have turned its axis back."""
        axes = np.empty((len(theta), len(self.free), 3))
        for place, (index, joint) in enumerate(zip(self.free, self.joints, strict=True)):
            axis = np.tile(self.rig.dofs.axes[index].astype(np.float64), (len(theta), 1))
            for later in np.flatnonzero(self.rig.dofs.joints == joint):
                if later > index:
                    axis = Rotation.from_rotvec(-theta[:, later, None] * self.rig.dofs.axes[later]).apply(axis)
            axes[:, place] = (rotations[:, joint] @ axis[..., None])[..., 0]
        return axes


def _rest_vectors(bones: BoneTargets) -> list[tuple[Float64[np.ndarray, "S 3"], Float64[np.ndarray, "S"]]]:  # noqa: F821
    """Vectors carried by each bone, with weights: along it, and two across it, which feel its turn about itself."""
    helper = np.eye(3)[np.abs(bones.directions).argmin(axis=1)]
    across = np.cross(bones.directions, helper)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    return [
        (bones.directions, bones.weights[:, 0]),
        (across, bones.weights[:, 1]),
        (np.cross(bones.directions, across), bones.weights[:, 1]),
    ]
