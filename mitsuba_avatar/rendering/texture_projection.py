"""Captured images carried back onto the surface: the mean texture that an untrained avatar starts from, and baselines are drawn with.

Every texel looks at every camera that sees it unoccluded and well inside the mask, and averages the radiance found there, weighted by
the squared cosine of the viewing angle (grazing views are blurred and often off by a pixel).
"""

import torch
from jaxtyping import Bool, Float, Int
from scipy.ndimage import distance_transform_edt
from torch import Tensor
from torch.nn import functional

from mitsuba_avatar.body.mesh import vertex_normals
from mitsuba_avatar.body.rig import Topology
from mitsuba_avatar.body.uv import UvAtlas
from mitsuba_avatar.rendering.backend import loaded_mitsuba
from mitsuba_avatar.rendering.bridge import flat_array
from mitsuba_avatar.rendering.cameras import CameraBatch
from mitsuba_avatar.rendering.scene import MeshScene

LIFT = 2e-3  # metres from the surface to the start of a visibility ray
INSIDE_MASK = 0.99  # coverage below this is an edge pixel, mixed with the background


class TextureProjection:
    """Weighted mean of what cameras saw at each texel, accumulated frame by frame.

    Args:
        topology: mesh and atlas.
        size: texels of the texture's sides.
    """

    def __init__(self, topology: Topology, size: int):
        self.atlas = UvAtlas(topology, size)
        self.faces = torch.from_numpy(topology.faces)
        self.scene = MeshScene(topology.faces, topology.num_vertices)
        self.covered = torch.nonzero(self.atlas.covered.flatten())[:, 0]
        self.size = size
        self.radiance = torch.zeros(len(self.covered), 3)
        self.weight = torch.zeros(len(self.covered), 1)

    def add(
        self, vertices: Float[Tensor, "V 3"], images: Float[Tensor, "B 3 H W"], masks: Float[Tensor, "B 1 H W"], cameras: CameraBatch
    ) -> None:
        """Add one frame, seen by B cameras.

        Args:
            vertices: [V, 3] mesh of the frame, world axes, metres.
            images: [B, 3, H, W] linear radiance.
            masks: [B, 1, H, W] coverage in 0..1.
            cameras: B cameras.
        """
        normals = vertex_normals(vertices[None], self.faces)
        surface = self.atlas.texels_from_vertices(torch.cat([vertices[None], normals], dim=2))[0]
        points, normals = surface.flatten(1)[:, self.covered].t().split(3, dim=1)  # [T, 3] each
        normals = functional.normalize(normals, dim=1)
        centers = cameras.centers
        to_camera = functional.normalize(centers[:, None] - points, dim=2)  # [B, T, 3]
        cosine = (to_camera * normals).sum(2)
        pixels, depth = project(cameras, points)
        height, width = images.shape[2:]
        grid = torch.stack([2 * pixels[..., 0] / width - 1, 2 * pixels[..., 1] / height - 1], dim=-1)[:, None]  # [B, 1, T, 2]
        eroded = -functional.max_pool2d(-masks, kernel_size=3, stride=1, padding=1)
        sampled = functional.grid_sample(torch.cat([images, eroded], dim=1), grid, align_corners=False)[:, :, 0]  # [B, 4, T]
        candidate = (cosine > 0.1) & (depth > 0) & (sampled[:, 3] > INSIDE_MASK)
        weight = cosine.square() * (candidate & self._is_visible(vertices, points + LIFT * normals, centers, candidate))
        self.radiance += torch.einsum("bt,bct->tc", weight, sampled[:, :3])
        self.weight += weight.sum(0)[:, None]

    def mean(self) -> Float[Tensor, "3 S S"]:
        """Mean radiance, [3, S, S]; texels that no camera saw, and those between charts, continue the nearest seen one.

        Raises:
            ValueError: no camera saw any texel.
        """
        is_seen = self.weight[:, 0] > 0
        if not bool(is_seen.any()):
            raise ValueError(
                "TextureProjection.mean(): no camera saw the mesh inside its mask. "
                "Run `python -m mitsuba_avatar.capture check` on the capture: cameras, masks or poses do not match."
            )
        texture = torch.zeros(3, self.size * self.size)
        texture[:, self.covered[is_seen]] = (self.radiance[is_seen] / self.weight[is_seen]).t()
        known = torch.zeros(self.size * self.size, dtype=torch.bool)
        known[self.covered[is_seen]] = True
        row, column = distance_transform_edt(~known.view(self.size, self.size).numpy(), return_distances=False, return_indices=True)
        nearest: Int[Tensor, "S S"] = torch.from_numpy(row.astype("int64") * self.size + column)
        return texture[:, nearest]

    def _is_visible(
        self, vertices: Float[Tensor, "V 3"], points: Float[Tensor, "T 3"], centers: Float[Tensor, "B 3"], candidate: Bool[Tensor, "B T"]
    ) -> Bool[Tensor, "B T"]:
        import drjit as dr

        mi = loaded_mitsuba()
        self.scene.update(flat_array(vertices))
        count = len(points)
        lane = dr.arange(mi.UInt32, len(centers) * count)
        point = dr.gather(mi.Point3f, flat_array(points), lane % count)
        center = dr.gather(mi.Point3f, flat_array(centers), lane // count)
        ray = mi.Ray3f(point, center - point)
        ray.maxt = 1.0
        hidden = self.scene.scene.ray_test(ray, coherent=False, active=flat_array(candidate.float()) > 0)
        open_share = dr.select(hidden, mi.Float(0.0), mi.Float(1.0))
        return mi.TensorXf(open_share, (len(centers), count)).torch().clone() > 0


def project(cameras: CameraBatch, points: Float[Tensor, "T 3"]) -> tuple[Float[Tensor, "B T 2"], Float[Tensor, "B T"]]:
    """Pixels and depths (metres) of world points in every camera; pixels mean nothing where depth is not positive."""
    rotation, translation = cameras.camera_from_world[:, :3, :3], cameras.camera_from_world[:, :3, 3]
    in_camera = points @ rotation.transpose(1, 2) + translation[:, None]
    depth = in_camera[..., 2]
    normalized = in_camera[..., :2] / depth.clamp(min=1e-6)[..., None]
    return normalized * cameras.intrinsics[:, None, :2] + cameras.intrinsics[:, None, 2:], depth
