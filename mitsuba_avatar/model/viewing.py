"""Where the cameras are, as every texel of the body sees them: the coordinates that condition the view branch.

The direction to the camera is turned back to rest space by the texel's own skinning rotation, so that it does not change when body
and camera move together: a texture can depend on the camera relative to the body part, never on where the body stands. It is taken
from the rig's own posed surface: what the avatar adds, a few centimetres, turns it by about a degree at most, and no gradient runs from
texture to geometry by way of the view.

Symbols: S texels along the map, P poses, N cameras a pose. Metres, world axes.
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from mitsuba_avatar.body.skinning import pose_vertices, rest_directions_from_posed
from mitsuba_avatar.body.uv import UvAtlas


class ViewMaps(nn.Module):
    """View coordinates of every texel: unit direction to the camera in rest space, and its cosine with the rest surface's normal.

    Args:
        atlas: texel grid of the maps.
        rest_vertices: [V, 3] rest space, metres.
        rest_normals: [V, 3] unit.
        skinning_weights: [V, J] rows sum to 1.
    """

    def __init__(
        self,
        atlas: UvAtlas,
        rest_vertices: Float[Tensor, "V 3"],
        rest_normals: Float[Tensor, "V 3"],
        skinning_weights: Float[Tensor, "V J"],
    ):
        super().__init__()
        self.size = atlas.size
        positions, normals, weights = (
            _at_texels(atlas, values) for values in (rest_vertices, rest_normals, skinning_weights)
        )  # [S * S, ...]
        # Derived from rig and template, hence no part of a checkpoint.
        self.register_buffer("positions", positions, persistent=False)
        self.register_buffer("normals", functional.normalize(normals, dim=-1), persistent=False)
        self.register_buffer("weights", weights, persistent=False)

    def forward(self, posed_from_rest: Float[Tensor, "P J 4 4"], camera_centers: Float[Tensor, "P N 3"]) -> Float[Tensor, "P N 4 S S"]:
        """View coordinates of every texel for every camera; texels outside the charts continue their nearest neighbour within.

        Args:
            posed_from_rest: [P, J, 4, 4] rigid transforms of the joints.
            camera_centers: [P, N, 3] metres, world axes.

        Gradients: flow to both arguments.
        """
        poses, cameras = camera_centers.shape[:2]
        posed = pose_vertices(self.positions.expand(poses, -1, -1), posed_from_rest, self.weights)  # [P, S * S, 3]
        to_camera = camera_centers[:, :, None] - posed[:, None]  # [P, N, S * S, 3]
        directions = rest_directions_from_posed(to_camera, posed_from_rest, self.weights)
        cosines = (directions * self.normals).sum(-1, keepdim=True)
        coordinates = torch.cat([directions, cosines], dim=-1)  # [P, N, S * S, 4]
        return coordinates.transpose(-1, -2).reshape(poses, cameras, 4, self.size, self.size)


def _at_texels(atlas: UvAtlas, values: Float[Tensor, "V C"]) -> Float[Tensor, "texels C"]:
    """Values of vertices, interpolated at every texel, row by row."""
    return atlas.texels_from_vertices(values[None])[0].flatten(1).T.contiguous()
