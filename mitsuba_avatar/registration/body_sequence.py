"""The unknowns of a registration, as one torch module: a pose and root per frame, a shape for all of them, offsets of landmarks.

Symbols: N frames, D pose angles, J joints, V vertices, K landmarks, S shape parameters. Metres, radians.
"""

import numpy as np
import torch
from jaxtyping import Float, Float32, Int
from torch import Tensor, nn
from torch.func import functional_call

from mitsuba_avatar.body.rig import Rig
from mitsuba_avatar.body.skeleton import Skeleton
from mitsuba_avatar.body.skinning import pose_vertices
from mitsuba_avatar.registration.body_shape import ShapeTangent
from mitsuba_avatar.registration.landmarks import rig_landmarks

ROOT_TURN_SCALE = 0.5  # radians of the root per unit of its parameter: its neighbours in the optimizer are angles of small joints


class BodySequence(nn.Module):
    """A body moving through N frames.

    Attributes:
        theta: [N, D] pose angles.
        turn: [N, 3] rotation vector about the root's joint, applied to `base_rotation` from the left.
        place: [N, 3] where the root's joint is.
        shape: [S] change of phenotype.
        landmark_offsets: [K, 3] at rest, between the rig's landmark and what the detector calls so.

    Args:
        rig: gives skeleton, limits and landmarks.
        tangent: rest shape and how it may change; taken at the rig's phenotype.
        theta: [N, D] start.
        root: [N, 4, 4] start.
    """

    def __init__(self, rig: Rig, tangent: ShapeTangent, theta: Float32[np.ndarray, "N D"], root: Float32[np.ndarray, "N 4 4"]):
        super().__init__()
        self.tangent, self.skeleton, self.dof_names = tangent, Skeleton(rig), rig.dofs.names
        landmarks = rig_landmarks(rig)
        self.vertex_lists = landmarks.from_vertices
        self.register_buffer("carriers", torch.from_numpy(landmarks.carriers))
        self.register_buffer("from_joints", torch.from_numpy(landmarks.from_joints).float())
        self.register_buffer("lower", torch.from_numpy(rig.dofs.lower))
        self.register_buffer("upper", torch.from_numpy(rig.dofs.upper))
        self.register_buffer("weights", torch.from_numpy(rig.skinning_weights))
        roots = torch.from_numpy(root)
        self.register_buffer("base_rotation", roots[:, :3, :3].clone())
        self.theta = nn.Parameter(torch.from_numpy(theta).clone())
        self.turn = nn.Parameter(torch.zeros(len(theta), 3))
        joint = torch.from_numpy(rig.joint_positions[0])
        self.place = nn.Parameter((roots[:, :3, :3] @ joint + roots[:, :3, 3]).clone())
        self.shape = nn.Parameter(torch.zeros(len(tangent.phenotype)))
        self.landmark_offsets = nn.Parameter(torch.zeros(len(landmarks.carriers), 3))

    def rest(self) -> tuple[Float[Tensor, "V 3"], Float[Tensor, "J 3"]]:
        """Rest vertices and joints of the present shape."""
        return self.tangent.rest(self.shape)

    def root(self, joints: Float[Tensor, "J 3"]) -> Float[Tensor, "N 4 4"]:
        """world_from_root of every frame."""
        rotation = rotation_matrices(ROOT_TURN_SCALE * self.turn) @ self.base_rotation
        translation = self.place - (rotation @ joints[0])
        bottom = rotation.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(len(rotation), 1, 4)
        return torch.cat([torch.cat([rotation, translation[..., None]], dim=2), bottom], dim=1)

    def transforms(self, joints: Float[Tensor, "J 3"], frames: Int[Tensor, "M"] | None = None) -> Float[Tensor, "M J 4 4"]:
        """posed_from_rest of the joints, of all frames or some."""
        theta, root = self.theta, self.root(joints)
        if frames is not None:
            theta, root = theta[frames], root[frames]
        return functional_call(self.skeleton, {"joint_positions": joints}, (theta, root))

    def landmarks(
        self, vertices: Float[Tensor, "V 3"], joints: Float[Tensor, "J 3"], transforms: Float[Tensor, "M J 4 4"]
    ) -> Float[Tensor, "M K 3"]:
        """Where the detector's landmarks are in the posed world."""
        from_vertices = torch.stack(
            [vertices[list(indices)].mean(0) if indices else vertices.new_zeros(3) for indices in self.vertex_lists]
        )
        places = self.from_joints @ joints + from_vertices + self.landmark_offsets  # [K, 3]
        moved = transforms[:, self.carriers]
        return (moved[..., :3, :3] @ places[..., None])[..., 0] + moved[..., :3, 3]

    def posed(self, rest: Float[Tensor, "M V 3"], transforms: Float[Tensor, "M J 4 4"]) -> Float[Tensor, "M V 3"]:
        """Skinned vertices."""
        return pose_vertices(rest, transforms, self.weights)

    def project_to_limits(self) -> None:
        """Bring angles back within the rig's limits and the shape within the phenotype's 0..1, in place."""
        with torch.no_grad():
            self.theta.copy_(self.theta.clamp(self.lower, self.upper))
            self.shape.copy_((self.tangent.phenotype + self.shape).clamp(0, 1) - self.tangent.phenotype)


def rotation_matrices(vectors: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3 3"]:
    """Rotations by rotation vectors (axis times radians); gradients are finite at zero too."""
    x, y, z = vectors.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).reshape(-1, 3, 3)
    squared = (vectors**2).sum(-1)[:, None, None] + 1e-12  # the square root has no derivative at zero
    angle = squared.sqrt()
    identity = torch.eye(3, dtype=vectors.dtype, device=vectors.device)
    return identity + (angle.sin() / angle) * cross + ((1 - angle.cos()) / squared) * (cross @ cross)
