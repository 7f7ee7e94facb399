"""Keypoints that the driving signal fixes and the decoded surface shows: what perturbation consistency compares.

Body keypoints are joints. The driving signal gives them by forward kinematics; the surface shows them through the skin around each,
whose mean offset from the posed template is the offset of the joint. Face landmarks are vertices of the rest surface, which the face
signal itself lists (captures whose face signal is "keypoints"). Whatever latent code is drawn, both sides must agree. Metres.

Symbols: P poses, V vertices, K keypoints (body, then face), D pose angles, F entries of the face signal.

Source: arXiv:2105.10441, section 3.5.3.
"""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from mitsuba_avatar.body.driving import face_keypoints
from mitsuba_avatar.body.rig import Rig
from mitsuba_avatar.body.skeleton import Skeleton
from mitsuba_avatar.body.skinning import blend_transforms
from mitsuba_avatar.body.sparse import SparseLinear

SKIN_REACH = 2.0  # of the distance from a joint to its nearest skin: the skin around the joint, not that of one side alone
FEWEST_VERTICES = 16  # around a joint: a wrinkle must average away
FOLLOWS = 0.5  # skinning weight, joint and parent together, that makes a vertex skin of the joint


class DrivenKeypoints(nn.Module):
    """Both sides of the comparison.

    Args:
        rig: names joints and landmarks.
        template_vertices: [V, 3] rest surface without displacement: on it both sides agree in every pose.
        with_face: whether the face signal is the position of the rig's landmarks, see `lists_face_landmarks`.
    """

    def __init__(self, rig: Rig, template_vertices: Float[Tensor, "V 3"], with_face: bool):
        super().__init__()
        self.rig, self.with_face = rig, with_face
        self.skeleton = Skeleton(rig)
        self.regressor = joint_regressor(rig)
        # Only the skin that some joint is read off needs to be posed: a fraction of the body.
        skin = self.regressor.transposed_offset.diff() > 0
        self.register_buffer("skin", torch.nonzero(skin)[:, 0], persistent=False)
        self.register_buffer("template_vertices", template_vertices.detach().clone(), persistent=False)
        self.register_buffer("skinning_weights", torch.from_numpy(rig.skinning_weights)[self.skin], persistent=False)
        self.register_buffer("joints", torch.from_numpy(rig.keypoint_joints), persistent=False)
        self.to(template_vertices.device)

    @property
    def num_body(self) -> int:
        """Body keypoints; face landmarks follow them."""
        return len(self.joints)

    def from_driving(self, theta: Float[Tensor, "P D"], root: Float[Tensor, "P 4 4"], face: Float[Tensor, "P F"]) -> Float[Tensor, "P K 3"]:
        """What the driving signal asks for: joints in the posed world, then landmarks seen from the head, along rest axes.

        Gradients: to all arguments.
        """
        body = self.skeleton.posed_joints(self.skeleton(theta, root))[:, self.joints]
        return torch.cat([body, face.unflatten(1, (-1, 3))], dim=1) if self.with_face else body

    def from_surface(
        self, rest_vertices: Float[Tensor, "P V 3"], theta: Float[Tensor, "P D"], root: Float[Tensor, "P 4 4"]
    ) -> Float[Tensor, "P K 3"]:
        """The same keypoints as a decoded surface shows them in a pose.

        Args:
            rest_vertices: [P, V, 3] decoded, rest space.
            theta: [P, D]. root: [P, 4, 4].

        Gradients: to all arguments.
        """
        posed_from_rest = self.skeleton(theta, root)
        turns = blend_transforms(posed_from_rest, self.skinning_weights)[..., :3]  # [P, S, 3, 3]; the shift is the same on both surfaces
        moved = (turns * (rest_vertices - self.template_vertices)[:, self.skin, None]).sum(-1)  # [P, S, 3]
        everywhere = torch.zeros_like(rest_vertices).index_copy(1, self.skin, moved)
        offsets = self.regressor(everywhere.transpose(0, 1).flatten(1))  # [K, P * 3]
        body = self.skeleton.posed_joints(posed_from_rest)[:, self.joints] + offsets.unflatten(1, (-1, 3)).transpose(0, 1)
        return torch.cat([body, face_keypoints(self.rig, rest_vertices).unflatten(1, (-1, 3))], dim=1) if self.with_face else body


def lists_face_landmarks(rig: Rig, face_signal: str, face_size: int) -> bool:
    """Whether a capture's face signal lists the positions of the rig's landmarks.

    Args:
        rig: of the capture.
        face_signal: what the capture's description calls it, "keypoints" or another.
        face_size: F.
    """
    return face_signal == "keypoints" and face_size == 3 * len(rig.face_keypoint_vertices)


def joint_regressor(rig: Rig) -> SparseLinear:
    """Mean over the skin around each body keypoint, [K, V]: rows sum to 1.

    The skin around a joint are the vertices that follow it or its parent and lie within `SKIN_REACH` times the distance of the nearest
    of them.
    """
    rows, columns, weights = [], [], []
    for row, joint in enumerate(rig.keypoint_joints):
        parent = int(rig.joint_parents[joint])
        follows = rig.skinning_weights[:, [int(joint)] if parent < 0 else [int(joint), parent]].sum(1)
        distance = np.linalg.norm(rig.rest_vertices - rig.joint_positions[joint], axis=1)
        skin = np.flatnonzero(follows > FOLLOWS)
        # Joints of the skeleton may lie where no skin follows them: then the nearest skin of all stands in.
        skin = skin if len(skin) >= FEWEST_VERTICES else np.arange(len(distance))
        skin = skin[np.argsort(distance[skin], kind="stable")]
        count = max(FEWEST_VERTICES, int((distance[skin] <= SKIN_REACH * distance[skin[0]]).sum()))
        columns.append(skin[:count])
        rows.append(np.full(len(columns[-1]), row))
        weights.append(np.full(len(columns[-1]), 1.0 / len(columns[-1])))
    shape = (len(rig.keypoint_joints), rig.topology.num_vertices)
    return SparseLinear(np.concatenate(rows), np.concatenate(columns), np.concatenate(weights), shape)
