"""Forward kinematics: from joint angles theta and a root pose to one rigid transform per joint.

M_j = M_parent(j) T(p_j) R_j T(-p_j), M_root = root T(p_0) R_0 T(-p_0), where p_j is the joint's rest position and R_j the product, in
table order, of the rotations of its pose angles about axes fixed in rest world axes. With theta = 0 and root = identity every M_j is
the identity. Radians, metres. It knows nothing of the surface.

Source: arXiv:2105.10441, section 3.4.1.
"""

import math

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from mitsuba_avatar.body.rig import Rig


class Skeleton(nn.Module):
    """The skeleton of a rig with constants as buffers, so that it follows the model to its device.

    All joints are treated at once: the chain product is taken by pointer doubling, M <- M[ancestor at distance 2^k] M, in
    ceil(log2 depth) batched products instead of one per joint.
    """

    def __init__(self, rig: Rig):
        super().__init__()
        joints, dofs = len(rig.joint_names), len(rig.dofs.names)
        self.num_joints, self.num_dofs = joints, dofs
        # Row `dofs` is an angle that is always zero: joints with fewer angles than the busiest one fill up with it.
        per_joint = [np.flatnonzero(rig.dofs.joints == joint) for joint in range(joints)]
        slots = np.full((joints, max(1, max(map(len, per_joint)))), dofs, dtype=np.int64)
        for joint, entries in enumerate(per_joint):
            slots[joint, : len(entries)] = entries
        axes = np.concatenate([rig.dofs.axes, np.array([[1, 0, 0]], dtype=np.float32)])
        # Joint `joints` is an identity transform: the parent of the root and its own parent.
        ancestors = [np.concatenate([np.where(rig.joint_parents < 0, joints, rig.joint_parents), [joints]])]
        for _ in range(max(0, math.ceil(math.log2(max(1, _depth(rig.joint_parents)))) - 1)):
            ancestors.append(ancestors[-1][ancestors[-1]])
        self.register_buffer("slots", torch.from_numpy(slots), persistent=False)
        self.register_buffer("ancestors", torch.from_numpy(np.stack(ancestors)), persistent=False)
        cross = _cross_matrices(torch.from_numpy(axes))
        self.register_buffer("cross", cross, persistent=False)
        self.register_buffer("cross_squared", cross @ cross, persistent=False)
        self.register_buffer("joint_positions", torch.from_numpy(rig.joint_positions), persistent=False)

    def joint_rotations(self, theta: Float[Tensor, "B D"]) -> Float[Tensor, "B J 3 3"]:
        """Local rotation R_j of every joint, in rest world axes."""
        angles = torch.cat([theta, theta.new_zeros(len(theta), 1)], dim=1)[:, :, None, None]  # [B, D + 1, 1, 1]
        identity = torch.eye(3, dtype=theta.dtype, device=theta.device)
        rotations = identity + angles.sin() * self.cross + (1 - angles.cos()) * self.cross_squared  # Rodrigues' formula
        product = rotations[:, self.slots[:, 0]]
        for slot in range(1, self.slots.shape[1]):
            product = product @ rotations[:, self.slots[:, slot]]
        return product

    def forward(self, theta: Float[Tensor, "B D"], root: Float[Tensor, "B 4 4"]) -> Float[Tensor, "B J 4 4"]:
        """Transforms `posed_from_rest` that carry rest space to the posed world.

        Args:
            theta: [B, D] joint angles, radians, in the order of the rig's table.
            root: [B, 4, 4] rigid world_from_root, acting on the whole rest space.

        Returns:
            [B, J, 4, 4] rigid.

        Gradients: flow to theta and root.

        Raises:
            ValueError: if theta does not have one column per pose angle.
        """
        if theta.shape[1] != self.num_dofs:
            raise ValueError(
                f"Skeleton(): theta must be [B, {self.num_dofs}] for this rig; got {list(theta.shape)}. "
                "Load pose and rig from the same capture."
            )
        linear = self.joint_rotations(theta)  # [B, J, 3, 3]
        offset = self.joint_positions - (linear @ self.joint_positions[:, :, None])[..., 0]  # turning about p is p - R p
        top = torch.cat([linear, offset[..., None]], dim=-1)
        bottom = top.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(len(theta), self.num_joints, 1, 4)
        identity = torch.eye(4, dtype=theta.dtype, device=theta.device).expand(len(theta), 1, 4, 4)
        transforms = torch.cat([torch.cat([top, bottom], dim=2), identity], dim=1)  # [B, J + 1, 4, 4]
        for ancestors in self.ancestors:
            transforms = transforms[:, ancestors] @ transforms
        return root[:, None] @ transforms[:, :-1]

    def posed_joints(self, posed_from_rest: Float[Tensor, "B J 4 4"]) -> Float[Tensor, "B J 3"]:
        """Positions of the joints in the posed world, metres."""
        return (posed_from_rest[..., :3, :3] @ self.joint_positions[:, :, None])[..., 0] + posed_from_rest[..., :3, 3]


def _depth(parents: np.ndarray) -> int:
    """Number of joints on the longest chain from the root."""
    depths = np.zeros(len(parents), dtype=np.int64)
    for joint, parent in enumerate(parents):
        depths[joint] = 1 if parent < 0 else depths[parent] + 1
    return int(depths.max())


def _cross_matrices(axes: Float[Tensor, "D 3"]) -> Float[Tensor, "D 3 3"]:
    """Matrices K with K v = axis x v."""
    x, y, z = axes.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).reshape(-1, 3, 3)
