"""Momentum body models as rigs of ours, and the other way round.

A momentum parameter may move several channels of several joints; a pose angle of ours turns one joint about one axis. So the angles
are the rotation channels that parameters move, Rz Ry Rx of each joint in this order: exact. Six parameters that move the root become
the root pose: exact. Scale parameters are constants of a person and go into the rest surface, which is exact where the joints around a
vertex share one scale. Translations of joints below the root have no counterpart and are reported.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64
from scipy.spatial.transform import Rotation

from mitsuba_avatar.body.rig import DofTable, Rig, Topology
from mitsuba_avatar.body.skeleton import Skeleton
from mitsuba_avatar.body.skinning import unpose_vertices
from mitsuba_avatar.captures.formats.goliath import MomentumTracking
from mitsuba_avatar.captures.formats.momentum import CHANNELS, JointStates, MomentumModel
from mitsuba_avatar.captures.rigid import inverse_rigid

METRES = 1e-3  # of a millimetre
UNIT = 100.0  # model units (centimetres) of a metre, in models that are made here
LEAST_WEIGHT = 0.1  # a pose angle that moves no vertex with more weight is left out
NUM_LANDMARKS = 24  # of the face
SAME_PLACE = 1e-6  # metres
FRAMES_AT_ONCE = 64
ROOT_CHANNELS = ("tx", "ty", "tz", "rx", "ry", "rz")


@dataclass(frozen=True, eq=False)
class TrackedRig:
    """A rig and its poses.

    Attributes:
        rig: ours.
        theta: [N, D] radians.
        root: [N, 4, 4] world_from_root.
        notes: what of the model could not be carried over.
    """

    rig: Rig
    theta: Float32[np.ndarray, "N D"]
    root: Float32[np.ndarray, "N 4 4"]
    notes: tuple[str, ...]


def rig_from_momentum(tracking: MomentumTracking) -> TrackedRig:
    """A rig, pose angles and root poses from a tracked momentum model.

    Raises:
        ValueError: for a model with several roots, or with another scaling along each axis.
    """
    model, poses = tracking.model, tracking.poses
    metres = float(model.global_scaling[0]) * METRES
    if np.count_nonzero(model.joint_parents < 0) != 1 or not np.allclose(model.global_scaling, model.global_scaling[0]):
        raise ValueError(
            f"rig_from_momentum(): expected one root and one scale; got {np.count_nonzero(model.joint_parents < 0)} roots and "
            f"{model.global_scaling.tolist()}. Take the body's model, not a hand's or a scene's."
        )
    rest = model.joint_states(np.zeros(model.num_pose), tracking.scales)
    root_joint = _root_joint(model)
    root = _root_poses(model.joint_states(poses, tracking.scales), rest, root_joint, metres)
    root = tracking.world_from_model @ root
    turn = _rest_axes(root)
    vertices = METRES * model.pose_vertices(tracking.template, np.zeros(model.num_pose), tracking.scales) @ turn[:3, :3].T
    turn[2, 3] = -vertices[:, 2].min()
    vertices[:, 2] += turn[2, 3]
    positions = metres * rest.translations @ turn[:3, :3].T + turn[:3, 3]
    final = _merged_joints(model, positions)
    rows = _in_parameter_order(model, _turning_rows(model, root_joint), final)
    kept = np.flatnonzero(final == np.arange(len(final)))
    weights = model.skinning_weights.astype(np.float64)[:, kept]
    weights /= weights.sum(axis=1, keepdims=True)
    face_region = _face_region(model, vertices)
    landmarks = _spread_vertices(vertices, np.flatnonzero(face_region > 0.5), NUM_LANDMARKS)
    names = tuple(model.joint_names[joint] for joint in kept)
    has_skin = weights.max(axis=0) > LEAST_WEIGHT
    rig = Rig(
        name="momentum",
        topology=Topology(len(vertices), model.faces, model.uv.clip(0, 1), model.uv_faces),
        rest_vertices=vertices.astype(np.float32),
        joint_names=names,
        joint_parents=_merged_parents(model, final, kept),
        joint_positions=positions[kept].astype(np.float32),
        skinning_weights=weights.astype(np.float32),
        dofs=_dof_table(model, rows, rest, tracking.scales, turn, np.searchsorted(kept, final)),
        face_region=face_region,
        face_keypoint_names=tuple(f"face_{index:02d}" for index in range(len(landmarks))),
        face_keypoint_vertices=landmarks,
        keypoint_names=tuple(name for name, is_skinned in zip(names, has_skin, strict=True) if is_skinned),
    )
    channels = model.channels(poses, tracking.scales).reshape(len(poses), -1)
    at_rest = model.channels(np.zeros(model.num_pose), tracking.scales).ravel()
    theta = (channels - at_rest)[:, rows]
    root = root @ inverse_rigid(turn)
    return TrackedRig(rig, theta.astype(np.float32), root.astype(np.float32), _losses(model, channels - at_rest, root_joint, metres))


def face_signal(
    rig: Rig, theta: Float32[np.ndarray, "N D"], root: Float32[np.ndarray, "N 4 4"], vertices: Float32[np.ndarray, "N V 3"]
) -> Float32[np.ndarray, "N K3"]:
    """The face signal of registered meshes: their landmarks unposed and seen from the head, as `driving.face_keypoints` has it.

    Args:
        rig: theirs.
        theta, root: poses.
        vertices: [N, V, 3] metres, world axes; may be memory-mapped, only the landmarks are read.

    Returns:
        [N, K * 3] metres.
    """
    landmarks, skeleton = rig.face_keypoint_vertices, Skeleton(rig)
    weights = torch.from_numpy(rig.skinning_weights[landmarks])
    origin = rig.joint_positions[int(weights.sum(dim=0).argmax())]
    signals = []
    with torch.no_grad():
        for start in range(0, len(theta), FRAMES_AT_ONCE):
            part = slice(start, start + FRAMES_AT_ONCE)
            transforms = skeleton(torch.from_numpy(np.array(theta[part])), torch.from_numpy(np.array(root[part])))
            posed = torch.from_numpy(np.array(vertices[part][:, landmarks]))
            signals.append((unpose_vertices(posed, transforms, weights).numpy() - origin).reshape(len(posed), -1))
    return np.concatenate(signals).astype(np.float32)


def momentum_from_rig(rig: Rig) -> MomentumModel:
    """A momentum model that poses as a rig of ours does: a bone for each pose angle, turned so that rx is the angle.

    Parameters are six of the root (centimetres and radians), then the rig's pose angles under their own names.
    """
    names, parents, quaternions, offsets, rows = ["root"], [-1], [np.array([0.0, 0.0, 0.0, 1.0])], [np.zeros(3)], []
    turns, last_bone = [np.eye(3)], np.zeros(len(rig.joint_names), dtype=np.int64)
    for joint, name in enumerate(rig.joint_names):
        parent = int(last_bone[rig.joint_parents[joint]]) if rig.joint_parents[joint] >= 0 else 0
        above = rig.joint_positions[rig.joint_parents[joint]].astype(np.float64) if rig.joint_parents[joint] >= 0 else np.zeros(3)
        offset = UNIT * (turns[parent].T @ (rig.joint_positions[joint].astype(np.float64) - above))
        angles = np.flatnonzero(rig.dofs.joints == joint)
        for place, angle in enumerate(angles if len(angles) else [-1]):
            turn = _turn_to_axis(rig.dofs.axes[angle].astype(np.float64)) if angle >= 0 else turns[parent]
            names.append(name if place == max(len(angles), 1) - 1 else f"{name}_angle{place}")
            parents.append(parent)
            quaternions.append(Rotation.from_matrix(turns[parent].T @ turn).as_quat())
            offsets.append(offset if place == 0 else np.zeros(3))
            turns.append(turn)
            parent = len(names) - 1
            if angle >= 0:
                rows.append((7 * parent + CHANNELS.index("rx"), 6 + int(angle)))
        last_bone[joint] = parent
    transform = np.zeros((7 * len(names), 6 + len(rig.dofs.names)))
    for channel in range(6):
        transform[channel, channel] = 1.0
    for row, column in rows:
        transform[row, column] = 1.0
    weights = np.zeros((rig.topology.num_vertices, len(names)), np.float32)
    weights[:, last_bone] = rig.skinning_weights
    limits = {name: (float(low), float(high)) for name, low, high in zip(rig.dofs.names, rig.dofs.lower, rig.dofs.upper, strict=True)}
    return MomentumModel(
        joint_names=tuple(names),
        joint_parents=np.array(parents, dtype=np.int64),
        pre_rotations=np.array(quaternions),
        translation_offsets=np.array(offsets),
        parameter_names=(*(f"root_{channel}" for channel in ROOT_CHANNELS), *rig.dofs.names),
        num_scales=0,
        transform=transform,
        transform_offsets=np.zeros(7 * len(names)),
        limits=limits,
        rest_vertices=(UNIT * rig.rest_vertices).astype(np.float32),
        skinning_weights=weights,
        faces=rig.topology.faces,
        uv=rig.topology.uv,
        uv_faces=rig.topology.uv_faces,
        global_scaling=np.full(3, 1.0 / (METRES * UNIT)),
        face_weights=rig.face_region,
    )


def momentum_poses(theta: Float[np.ndarray, "N D"], root: Float[np.ndarray, "N 4 4"]) -> Float64[np.ndarray, "N P"]:
    """Parameters of `momentum_from_rig`'s model: translation in centimetres, angles of Rz Ry Rx, then theta."""
    angles = Rotation.from_matrix(root[:, :3, :3].astype(np.float64)).as_euler("xyz")
    return np.concatenate([UNIT * root[:, :3, 3].astype(np.float64), angles, theta.astype(np.float64)], axis=1)


def _root_joint(model: MomentumModel) -> int:
    """The joint whose place parameters move: the root of the body, whatever bones lie above it."""
    moves = model.transform.reshape(len(model.joint_names), 7, -1)[:, :3, : model.num_pose].any(axis=(1, 2))
    return int(np.argmax(moves)) if moves.any() else int(np.argmax(model.joint_parents < 0))


def _root_poses(states: JointStates, rest: JointStates, joint: int, metres: float) -> Float64[np.ndarray, "N 4 4"]:
    """Rigid transforms [N, 4, 4] in metres that carry the model at rest to where its root joint is."""
    root = np.zeros((len(states.rotations), 4, 4))
    root[:, :3, :3] = states.rotations[:, joint] @ rest.rotations[joint].T
    root[:, :3, 3] = metres * (states.translations[:, joint] - root[:, :3, :3] @ rest.translations[joint])
    root[:, 3, 3] = 1.0
    return root


def _rest_axes(root: Float64[np.ndarray, "N 4 4"]) -> Float64[np.ndarray, "4 4"]:
    """Rotation [4, 4] that makes the model's own up axis, which the poses hold up on average, the Z axis."""
    up = root[:, 2, :3].mean(axis=0)
    axis = int(np.abs(up).argmax())
    sign = 1.0 if up[axis] > 0 else -1.0
    turn = np.eye(4)
    first, second = np.roll(np.eye(3), -1 - axis, axis=0)[:2]  # the two axes that follow `axis` cyclically
    turn[:3, :3] = np.stack([first, sign * second, sign * np.eye(3)[axis]])
    return turn


def _below(model: MomentumModel, joint: int) -> set[int]:
    """The joint and all that hang on it."""
    below = {joint}
    for child, parent in enumerate(model.joint_parents.tolist()):
        if parent in below:
            below.add(child)
    return below


def _turning_rows(model: MomentumModel, root_joint: int) -> list[int]:
    """Rows of the transform that are pose angles: rotation channels below the root that move skin, rz ry rx of each joint."""
    rows = []
    for joint in sorted(_below(model, root_joint) - {root_joint}):
        if model.skinning_weights[:, sorted(_below(model, joint))].max() > LEAST_WEIGHT:
            rows += [row for row in (7 * joint + 5, 7 * joint + 4, 7 * joint + 3) if model.transform[row, : model.num_pose].any()]
    return rows


def _in_parameter_order(model: MomentumModel, rows: list[int], final: np.ndarray) -> list[int]:
    """Rows by the first parameter that moves them, but those of one joint in the order in which they act."""
    first = {row: int(np.flatnonzero(model.transform[row, : model.num_pose])[0]) for row in rows}
    waiting = {joint: [row for row in rows if final[row // 7] == joint] for joint in {int(final[row // 7]) for row in rows}}
    return [waiting[int(final[row // 7])].pop(0) for row in sorted(rows, key=lambda row: (first[row], row))]


def _dof_table(
    model: MomentumModel,
    rows: list[int],
    rest: JointStates,
    scales: Float64[np.ndarray, "S"],
    turn: Float64[np.ndarray, "4 4"],
    rig_joint: np.ndarray,
) -> DofTable:
    """Axes of the rotation channels at rest, in the rig's axes; each follows the turns of the channels before it."""
    offsets = model.channels(np.zeros(model.num_pose), scales)[:, 3:6]
    names, joints, axes, limits = [], [], [], []
    for row in rows:
        joint, channel = divmod(row, 7)
        parent = int(model.joint_parents[joint])
        x, y, z = (Rotation.from_euler(axis, angle).as_matrix() for axis, angle in zip("xyz", offsets[joint], strict=True))
        before = {5: np.eye(3), 4: z, 3: z @ y}[channel]
        base = rest.rotations[parent] @ Rotation.from_quat(model.pre_rotations[joint]).as_matrix() @ before
        axes.append(turn[:3, :3] @ base[:, channel - 3])
        columns = np.flatnonzero(model.transform[row, : model.num_pose])
        is_own = len(columns) == 1 and model.transform[row, columns[0]] == 1 and np.count_nonzero(model.transform[:, columns[0]]) == 1
        parameter = model.parameter_names[columns[0]]
        names.append(parameter if is_own else f"{model.joint_names[joint]}.{CHANNELS[channel]}")
        low, high = model.limits.get(parameter, (-np.pi, np.pi)) if is_own else (-np.pi, np.pi)
        limits.append((low, high) if low < high else (-np.pi, np.pi))
        joints.append(int(rig_joint[joint]))
    return DofTable(
        names=tuple(names),
        joints=np.array(joints, dtype=np.int64),
        axes=np.array(axes, dtype=np.float32).reshape(-1, 3),
        lower=np.array([low for low, _ in limits], dtype=np.float32),
        upper=np.array([high for _, high in limits], dtype=np.float32),
    )


def _merged_joints(model: MomentumModel, positions: Float64[np.ndarray, "J 3"]) -> np.ndarray:
    """[J] the joint that each one becomes: bare joints with one child at the same place are parts of that child."""
    children = [np.flatnonzero(model.joint_parents == joint) for joint in range(len(positions))]
    final = np.arange(len(positions))
    for joint in reversed(range(len(positions))):
        if len(children[joint]) == 1 and not model.skinning_weights[:, joint].any():
            child = int(children[joint][0])
            if np.linalg.norm(positions[joint] - positions[child]) < SAME_PLACE:
                final[joint] = final[child]
    return final


def _merged_parents(model: MomentumModel, final: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """Parents of the kept joints, counted among them."""
    parents = np.full(len(kept), -1, dtype=np.int64)
    for place, joint in enumerate(kept.tolist()):
        above = int(model.joint_parents[joint])
        while above >= 0 and final[above] == joint:
            above = int(model.joint_parents[above])
        if above >= 0:
            parents[place] = int(np.searchsorted(kept, above))
    return parents


def _face_region(model: MomentumModel, vertices: Float64[np.ndarray, "V 3"]) -> Float32[np.ndarray, "V"]:
    """The model's own face, else the skin of joints called head, else the highest tenth of the body."""
    if model.face_weights.max() > 0.5:
        return model.face_weights
    heads = [index for index, name in enumerate(model.joint_names) if "head" in name.lower()]
    region = model.skinning_weights[:, heads].sum(axis=1) if heads else np.zeros(len(vertices), np.float32)
    if not (region > 0.5).any():
        region = (vertices[:, 2] > np.quantile(vertices[:, 2], 0.9)).astype(np.float32)
    return region.astype(np.float32).clip(0, 1)


def _spread_vertices(vertices: Float64[np.ndarray, "V 3"], candidates: np.ndarray, count: int) -> np.ndarray:
    """Up to `count` of the candidates, each as far as possible from those before it."""
    points = vertices[candidates]
    chosen = [int(np.linalg.norm(points - points.mean(axis=0), axis=1).argmin())]
    distance = np.linalg.norm(points - points[chosen[0]], axis=1)
    while len(chosen) < min(count, len(points)) and distance.max() > 0:
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return candidates[chosen].astype(np.int64)


def _losses(model: MomentumModel, changes: Float64[np.ndarray, "N C"], root_joint: int, metres: float) -> tuple[str, ...]:
    """What the poses do that a rig of ours cannot."""
    by_channel = np.abs(changes).reshape(len(changes), -1, 7).max(axis=0)  # [J, 7]
    by_channel[root_joint] = 0.0
    notes = []
    if by_channel[:, :3].max() > 0:
        joint = int(by_channel[:, :3].max(axis=1).argmax())
        shift = 1000 * metres * by_channel[:, :3].max()
        notes.append(
            f"poses shift {np.count_nonzero(by_channel[:, :3].max(axis=1))} joints, at most {shift:.1f} mm "
            f"({model.joint_names[joint]}); the rig turns joints only"
        )
    if by_channel[:, 6].max() > 0:
        notes.append(f"poses scale joints by up to {2 ** by_channel[:, 6].max():.3f}; the rig does not")
    return tuple(notes)


def _turn_to_axis(axis: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3 3"]:
    """A rotation whose first column is the unit vector."""
    axis = axis / np.linalg.norm(axis)
    second = np.cross(axis, np.eye(3)[int(np.abs(axis).argmin())])
    second /= np.linalg.norm(second)
    return np.stack([axis, second, np.cross(axis, second)], axis=1)
