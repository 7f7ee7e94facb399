"""Views inside a Dr.Jit kernel: camera rows in one table, so that a single launch serves every view of every pose.

Three frames: *world*; *local*, world axes with the origin at the mean of the mesh that a view looks at; *scene*, the merged meshes set
apart (see `scene`). Scene coordinates are rounded to float32 where they stand, and local coordinates are those minus the mesh's offset,
which float32 subtracts exactly: rays traced in the scene and edges projected from local coordinates agree to the last bit. Without that
a ray that should pass just outside an edge may hit it.

A row holds 20 floats: fx, fy, cx, cy | rotation R (9, row by row) | local camera centre (3) | scene camera centre (3) | mesh index (1),
where x_camera = R (x_local - centre). Depths are z in camera axes; rays are scaled so that their parameter equals depth.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mitsuba_avatar.rendering.backend import loaded_mitsuba
from mitsuba_avatar.rendering.cameras import CameraBatch
from mitsuba_avatar.rendering.scene import separation

ROW = 20
NEAR = 1e-3  # metres; points nearer to the camera plane have no projection


@dataclass(frozen=True)
class Placement:
    """Where P meshes stand in local and scene coordinates.

    Attributes:
        scene_vertices: [P, V, 3] metres, rounded.
        offset: [P, 3] metres from local to scene coordinates.
        views: [B, 20] camera rows.
        centers: [B, 4] local camera centres and the mesh index.
    """

    scene_vertices: Float[Tensor, "P V 3"]
    offset: Float[Tensor, "P 3"]
    views: Float[Tensor, "B 20"]
    centers: Float[Tensor, "B 4"]


def place(vertices: Float[Tensor, "P V 3"], cameras: CameraBatch, mesh_index: Int[Tensor, " B"]) -> Placement:
    """Set the meshes of a batch apart and write the camera rows of views that look at mesh `mesh_index[b]`."""
    device = vertices.device
    mean = vertices.mean(dim=1)
    rotation, mesh_index = cameras.camera_from_world[:, :3, :3].to(device), mesh_index.to(device)
    centers = cameras.centers.to(device)
    offset = torch.zeros_like(mean)
    offset[:, 0] = separation(vertices, centers) * torch.arange(len(mean), device=device)
    scene_vertices = (vertices - mean[:, None]) + offset[:, None]
    scene_centers = (centers - mean[mesh_index]) + offset[mesh_index]
    local_centers = scene_centers - offset[mesh_index]
    mesh_column = mesh_index[:, None].to(torch.float32)
    views = torch.cat([cameras.intrinsics.to(device), rotation.reshape(-1, 9), local_centers, scene_centers, mesh_column], dim=1)
    return Placement(scene_vertices.contiguous(), offset, views.contiguous(), torch.cat([local_centers, mesh_column], dim=1).contiguous())


@dataclass
class View:
    """One camera per lane, gathered from the table."""

    focal: tuple
    principal: tuple
    rotation: tuple  # nine floats
    local_center: object  # Vector3f
    scene_center: object  # Point3f
    mesh: object  # UInt32

    @staticmethod
    def gather(table, index) -> "View":
        """Read row `index` of the flat table."""
        import drjit as dr

        mi = loaded_mitsuba()
        # Rows are five packets of four floats, 16-byte aligned.
        packets = [dr.gather(mi.Vector4f, table, index * (ROW // 4) + k) for k in range(ROW // 4)]
        r = [packets[1][0], packets[1][1], packets[1][2], packets[1][3], *[packets[2][k] for k in range(4)], packets[3][0]]
        return View(
            focal=(packets[0][0], packets[0][1]),
            principal=(packets[0][2], packets[0][3]),
            rotation=tuple(r),
            local_center=mi.Vector3f(packets[3][1], packets[3][2], packets[3][3]),
            scene_center=mi.Point3f(packets[4][0], packets[4][1], packets[4][2]),
            mesh=mi.UInt32(packets[4][3]),
        )

    def to_camera(self, point):
        """Local point (Vector3f) to camera axes."""
        mi = loaded_mitsuba()
        r, p = self.rotation, point - self.local_center
        return mi.Vector3f(
            r[0] * p.x + r[1] * p.y + r[2] * p.z,
            r[3] * p.x + r[4] * p.y + r[5] * p.z,
            r[6] * p.x + r[7] * p.y + r[8] * p.z,
        )

    def to_world_direction(self, direction):
        """Camera-axes direction (or gradient) to world axes: the transposed rotation."""
        mi = loaded_mitsuba()
        r = self.rotation
        return mi.Vector3f(
            r[0] * direction.x + r[3] * direction.y + r[6] * direction.z,
            r[1] * direction.x + r[4] * direction.y + r[7] * direction.z,
            r[2] * direction.x + r[5] * direction.y + r[8] * direction.z,
        )

    def project(self, point_camera):
        """Camera-axes point to pixels (Point2f); meaningless for z below NEAR, which the caller masks."""
        import drjit as dr

        mi = loaded_mitsuba()
        inverse_depth = dr.rcp(dr.maximum(point_camera.z, NEAR))
        return mi.Point2f(
            self.focal[0] * point_camera.x * inverse_depth + self.principal[0],
            self.focal[1] * point_camera.y * inverse_depth + self.principal[1],
        )

    def project_derivative(self, point_camera, motion):
        """How fast a point's pixel position (Point2f) moves where the point moves by `motion` (world axes)."""
        import drjit as dr

        mi = loaded_mitsuba()
        r = self.rotation
        x, y, z = (r[3 * i] * motion.x + r[3 * i + 1] * motion.y + r[3 * i + 2] * motion.z for i in range(3))
        inverse_depth = dr.rcp(dr.maximum(point_camera.z, NEAR))
        along_x = (x - point_camera.x * z * inverse_depth) * inverse_depth
        along_y = (y - point_camera.y * z * inverse_depth) * inverse_depth
        return mi.Point2f(self.focal[0] * along_x, self.focal[1] * along_y)

    def project_adjoint(self, point_camera, gradient_pixel):
        """Gradient with respect to a point from the gradient with respect to its pixel position."""
        import drjit as dr

        mi = loaded_mitsuba()
        inverse_depth = dr.rcp(dr.maximum(point_camera.z, NEAR))
        gx = gradient_pixel.x * self.focal[0] * inverse_depth
        gy = gradient_pixel.y * self.focal[1] * inverse_depth
        gz = -(gx * point_camera.x + gy * point_camera.y) * inverse_depth
        return self.to_world_direction(mi.Vector3f(gx, gy, gz))

    def ray(self, pixel, depth_limit):
        """Scene ray through a pixel position (Point2f); its parameter is depth, and it ends at `depth_limit` metres."""
        mi = loaded_mitsuba()
        direction = mi.Vector3f((pixel.x - self.principal[0]) / self.focal[0], (pixel.y - self.principal[1]) / self.focal[1], 1.0)
        ray = mi.Ray3f(self.scene_center, self.to_world_direction(direction))
        ray.maxt = depth_limit
        return ray
