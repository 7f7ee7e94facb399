"""A momentum model of 36 bones and 104 pose values on the small rig's mesh, and its posing written down again, slowly.

Y is up, as in the models that people release; nothing is aligned: pre-rotations, offsets of the transform and couplings are random.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from mitsuba_avatar.captures.formats.momentum import MomentumModel
from tests.small_rig import make_small_rig

JOINTS = 36
LOCAL = 98
Y_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # model axes from the small rig's, whose Z is up


def make_momentum_model(with_scales: bool = True) -> MomentumModel:
    """The same model on every call: a world bone, a root that six parameters move, 34 bones in a branching chain."""
    random = np.random.default_rng(11)
    rig = make_small_rig()
    vertices = 100.0 * rig.rest_vertices @ Y_UP.T
    parents = np.array([-1, 0, *(max(1, joint - 1 - joint % 3) for joint in range(2, JOINTS))])
    rows, names = [], [f"root_{channel}" for channel in ("tx", "ty", "tz", "rx", "ry", "rz")]
    rows += [(7 + channel, channel, 1.0) for channel in range(6)]
    for local in range(LOCAL):
        joint, channel = 2 + local // 3, 3 + local % 3
        names.append(f"b{joint}_{'xyz'[local % 3]}")
        rows.append((7 * joint + channel, 6 + local, 1.0))
    rows.append((7 * 35 + 3, 6 + 97, 0.5))  # one parameter turns two joints
    rows.append((7 * 20 + 4, 6 + 3, -0.25))
    scales = ["scale_all", "scale_arm"] if with_scales else []
    transform = np.zeros((7 * JOINTS, len(names) + len(scales)))
    for row, column, factor in rows:
        transform[row, column] = factor
    if with_scales:
        transform[7 + 6, -2] = 1.0
        transform[7 * 30 + 6, -1] = 1.0
    offsets = np.zeros((JOINTS, 7))
    offsets[2:, 3:6] = 0.2 * random.standard_normal((JOINTS - 2, 3))
    weights = random.random((len(vertices), JOINTS)) ** 8
    weights[:, :2] = 0
    weights[weights < np.sort(weights, axis=1)[:, -4:-3]] = 0
    face = (rig.face_region > 0.5).astype(np.float32)
    return MomentumModel(
        joint_names=("body_world", "b_root", *(f"b{joint}" for joint in range(2, JOINTS))),
        joint_parents=parents,
        pre_rotations=Rotation.random(JOINTS, rng=np.random.default_rng(3)).as_quat(),
        translation_offsets=6 * random.standard_normal((JOINTS, 3)),
        parameter_names=(*names, *scales),
        num_scales=len(scales),
        transform=transform,
        transform_offsets=offsets.ravel(),
        rest_vertices=vertices.astype(np.float32),
        skinning_weights=(weights / weights.sum(axis=1, keepdims=True)).astype(np.float32),
        faces=rig.topology.faces,
        uv=rig.topology.uv,
        uv_faces=rig.topology.uv_faces,
        global_scaling=np.full(3, 10.0),
        face_weights=face,
        limits={"b2_x": (-1.0, 2.0), "b5_z": (-0.5, 0.5)},
    )


def random_poses(count: int) -> np.ndarray:
    """[count, 104]: the root walks and turns about the vertical, joints bend a little."""
    random = np.random.default_rng(5)
    poses = 0.3 * random.standard_normal((count, 6 + LOCAL))
    poses[:, :3] = [30.0, 90.0, -20.0] + 10 * random.standard_normal((count, 3))
    poses[:, 3:6] = 0.1 * random.standard_normal((count, 3)) + np.array([0.0, 0.7, 0.0])
    return poses


def multiply(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Hamilton product of quaternions x, y, z, w."""
    x1, y1, z1, w1 = p
    x2, y2, z2, w2 = q
    return np.array(
        [
            w1 * x2 + x1 * w2 + y1 * z2 - z1 * y2,
            w1 * y2 - x1 * z2 + y1 * w2 + z1 * x2,
            w1 * z2 + x1 * y2 - y1 * x2 + z1 * w2,
            w1 * w2 - x1 * x2 - y1 * y2 - z1 * z2,
        ]
    )


def turn(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """q v q*."""
    conjugate = q * np.array([-1, -1, -1, 1])
    return multiply(multiply(q, np.array([*v, 0.0])), conjugate)[:3]


def reference_states(model: MomentumModel, values: np.ndarray) -> list[tuple[np.ndarray, np.ndarray, float]]:
    """Quaternion, translation and scale of every joint, one after the other."""
    channels = model.transform @ values + model.transform_offsets
    states = []
    for joint, parent in enumerate(model.joint_parents):
        tx, ty, tz, rx, ry, rz, sc = channels[7 * joint : 7 * joint + 7]
        halves = [np.array([np.sin(rx / 2), 0, 0, np.cos(rx / 2)]), np.array([0, np.sin(ry / 2), 0, np.cos(ry / 2)])]
        halves.append(np.array([0, 0, np.sin(rz / 2), np.cos(rz / 2)]))
        q = multiply(model.pre_rotations[joint], multiply(halves[2], multiply(halves[1], halves[0])))
        t, s = np.array([tx, ty, tz]) + model.translation_offsets[joint], 2.0**sc
        if parent >= 0:
            q_parent, t_parent, s_parent = states[parent]
            q, t, s = multiply(q_parent, q), turn(q_parent, s_parent * t) + t_parent, s_parent * s
        states.append((q, t, s))
    return states


def reference_vertices(model: MomentumModel, template: np.ndarray, values: np.ndarray) -> np.ndarray:
    """[V, 3] millimetres, vertex by vertex and joint by joint."""
    posed, bind = reference_states(model, values), reference_states(model, np.zeros(len(values)))
    result = np.zeros((len(template), 3))
    for vertex, point in enumerate(template.astype(np.float64)):
        for joint in np.flatnonzero(model.skinning_weights[vertex]):
            (q, t, s), (q0, t0, s0) = posed[joint], bind[joint]
            local = turn(q0 * np.array([-1, -1, -1, 1]), point - t0) / s0
            result[vertex] += model.skinning_weights[vertex, joint] * (turn(q, s * local) + t)
    return result * model.global_scaling
