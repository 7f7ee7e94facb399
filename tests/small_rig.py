"""A rig of 258 vertices for tests that need a body but not a person: a bent-able arm with a fist for a face.

An upright, slightly tapered tube of elliptic section (so that no axis is like another) with two caps, three joints (base, elbow,
wrist), five pose angles, a texture seam along the tube and one around each cap, and a "face" on the upper cap.
"""

import numpy as np

from mitsuba_avatar.body.rig import DofTable, Rig, Topology

SEGMENTS = 16
RINGS = 16
LENGTH = 0.6  # metres


def make_small_rig() -> Rig:
    """The same rig on every call."""
    vertices = _vertices()
    positions = np.array([[0, 0, 0], [0, 0, 0.45 * LENGTH], [0, 0, 0.8 * LENGTH]], dtype=np.float32)
    topology = _topology(len(vertices))
    weights = _weights(vertices[:, 2], positions[:, 2])
    face_region = np.clip((vertices[:, 2] - 0.88 * LENGTH) / (0.1 * LENGTH), 0, 1).astype(np.float32)
    dofs = DofTable(
        names=("base_flexion", "base_twist", "elbow_flexion", "wrist_flexion", "wrist_deviation"),
        joints=np.array([0, 0, 1, 2, 2]),
        axes=np.array([[1, 0, 0], [0, 0, 1], [0.8, 0.6, 0], [1, 0, 0], [0, 1, 0]], dtype=np.float32),
        lower=np.array([-1.0, -1.5, 0.0, -1.0, -0.5], dtype=np.float32),
        upper=np.array([1.0, 1.5, 2.2, 1.2, 0.5], dtype=np.float32),
    )
    landmarks = (RINGS - 1) * SEGMENTS + np.array([1, 5, 8, 14])
    return Rig(
        name="small",
        topology=topology,
        rest_vertices=vertices,
        joint_names=("base", "elbow", "wrist"),
        joint_parents=np.array([-1, 0, 1]),
        joint_positions=positions,
        skinning_weights=weights,
        dofs=dofs,
        face_region=face_region,
        face_keypoint_names=("rim_1", "rim_5", "rim_8", "rim_14"),
        face_keypoint_vertices=landmarks,
        keypoint_names=("base", "elbow", "wrist"),
    )


def _vertices() -> np.ndarray:
    """[258, 3]: rings from below upwards, then the lower and upper pole."""
    angle = 2 * np.pi * np.arange(SEGMENTS) / SEGMENTS
    height = LENGTH * np.arange(RINGS) / (RINGS - 1)
    taper = 1 - 0.3 * height / LENGTH
    ring = np.stack([0.09 * np.cos(angle), 0.06 * np.sin(angle)], axis=1)  # [S, 2]
    tube = np.concatenate([taper[:, None, None] * ring, np.broadcast_to(height[:, None, None], (RINGS, SEGMENTS, 1))], axis=2)
    poles = np.array([[0, 0, -0.02], [0.01, 0, LENGTH + 0.03]])
    return np.concatenate([tube.reshape(-1, 3), poles]).astype(np.float32)


def _topology(num_vertices: int) -> Topology:
    """Faces outwards; tube chart on the upper 60 % of the atlas, the caps as two discs below it."""
    ring, segment = np.meshgrid(np.arange(RINGS - 1), np.arange(SEGMENTS), indexing="ij")
    ring, segment = ring.reshape(-1), segment.reshape(-1)
    beside = (segment + 1) % SEGMENTS
    a, b = ring * SEGMENTS + segment, ring * SEGMENTS + beside
    c, d = b + SEGMENTS, a + SEGMENTS
    tube_faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    wide = SEGMENTS + 1  # texture columns of the tube: the seam's twice
    ua, ub = ring * wide + segment, ring * wide + segment + 1
    uc, ud = ub + wide, ua + wide
    tube_uv_faces = np.concatenate([np.stack([ua, ub, uc], 1), np.stack([ua, uc, ud], 1)])
    column, row = np.meshgrid(np.arange(wide) / SEGMENTS, np.arange(RINGS) / (RINGS - 1))
    tube_uv = np.stack([0.04 + 0.92 * column.reshape(-1), 0.44 + 0.52 * row.reshape(-1)], axis=1)

    start = np.arange(SEGMENTS)
    after = (start + 1) % SEGMENTS
    bottom = np.stack([np.full(SEGMENTS, num_vertices - 2), after, start], axis=1)
    top = np.stack([np.full(SEGMENTS, num_vertices - 1), (RINGS - 1) * SEGMENTS + start, (RINGS - 1) * SEGMENTS + after], axis=1)
    angle = 2 * np.pi * start / SEGMENTS
    circle = 0.17 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    discs, disc_faces = [], []
    for number, (centre, mirror) in enumerate((((0.24, 0.21), -1), ((0.72, 0.2), 1))):
        base = len(tube_uv) + number * (SEGMENTS + 1)
        discs.append(np.concatenate([[centre], centre + circle * [mirror, 1]]))
        corners = (after, start) if mirror < 0 else (start, after)
        disc_faces.append(np.stack([np.full(SEGMENTS, base), base + 1 + corners[0], base + 1 + corners[1]], axis=1))
    return Topology(
        num_vertices=num_vertices,
        faces=np.concatenate([tube_faces, bottom, top]),
        uv=np.concatenate([tube_uv, *discs]).astype(np.float32),
        uv_faces=np.concatenate([tube_uv_faces, *disc_faces]),
    )


def _weights(height: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """[V, 3]: each joint takes over within 8 cm around it."""
    above = [np.clip((height - joint) / 0.08 + 0.5, 0, 1) for joint in joints[1:]]
    weights = np.stack([1 - above[0], above[0] - above[1], above[1]], axis=1)
    return (weights / weights.sum(axis=1, keepdims=True)).astype(np.float32)
