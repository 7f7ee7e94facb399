"""Slow float64 twins of the body's kernels, written one joint, vertex and texel at a time."""

import numpy as np

from mitsuba_avatar.body.rig import Rig, Topology


def rotation(axis: np.ndarray, angle: float) -> np.ndarray:
    """Rotation matrix as the limit of the exponential series of the cross-product matrix."""
    x, y, z = axis.astype(np.float64) * angle
    generator = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    term, total = np.eye(3), np.eye(3)
    for order in range(1, 40):
        term = term @ generator / order
        total = total + term
    return total


def posed_from_rest(rig: Rig, theta: np.ndarray, root: np.ndarray) -> np.ndarray:
    """[J, 4, 4] by recursion M_j = M_parent T(p_j) R_j T(-p_j)."""
    transforms = []
    for joint, parent in enumerate(rig.joint_parents):
        turn = np.eye(3)
        for dof in np.flatnonzero(rig.dofs.joints == joint):
            turn = turn @ rotation(rig.dofs.axes[dof], theta[dof])
        position = rig.joint_positions[joint].astype(np.float64)
        local = np.eye(4)
        local[:3, :3], local[:3, 3] = turn, position - turn @ position
        transforms.append((root if parent < 0 else transforms[parent]) @ local)
    return np.stack(transforms)


def pose_vertices(rest_vertices: np.ndarray, transforms: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """[V, 3]: every joint carries the vertex, the results are averaged."""
    homogeneous = np.concatenate([rest_vertices.astype(np.float64), np.ones((len(rest_vertices), 1))], axis=1)
    carried = np.einsum("jab,vb->vja", transforms, homogeneous)[..., :3]
    return (weights[:, :, None].astype(np.float64) * carried).sum(axis=1)


def texel_value(topology: Topology, values: np.ndarray, row: int, column: int, size: int) -> np.ndarray | None:
    """Barycentric value under one texel's centre by solving a 2x2 system per triangle; None where no chart is."""
    centre = np.array([(column + 0.5) / size, 1 - (row + 0.5) / size])
    for face, uv_face in zip(topology.faces, topology.uv_faces, strict=True):
        origin, first, second = topology.uv[uv_face].astype(np.float64)
        along, across = np.linalg.solve(np.stack([first - origin, second - origin], axis=1), centre - origin)
        if min(along, across, 1 - along - across) >= 0:
            return (1 - along - across) * values[face[0]] + along * values[face[1]] + across * values[face[2]]
    return None
