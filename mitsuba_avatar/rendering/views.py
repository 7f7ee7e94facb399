"""Camera rows for the kernels, and the coordinate frame that everything is computed in.

Local coordinates: world axes, centred on the mean of each mesh's own vertices, so that float32 keeps its precision wherever in the world
the person stands. Rays, projections and edges all start from these same rounded numbers.

A camera row: fx, fy, cx, cy | rotation world to camera, row by row | camera centre in local coordinates; a pixel is
(fx x / z + cx, fy y / z + cy), where x_camera = R (x_local - centre). Depths are z in camera axes; rays are scaled so that their
parameter equals depth.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mitsuba_avatar.rendering.backend import loaded_mitsuba
from mitsuba_avatar.rendering.cameras import CameraBatch

ROW = 16
NEAR = 1e-3  # metres; points nearer to the camera plane have no projection


@dataclass(frozen=True)
class Placement:
    """P meshes and B views in local coordinates.

    Attributes:
        vertices: [P, V, 4] metres, last entry 0.
        views: [B, 16] camera rows.
        centers: [B, 4] camera centres and the mesh index.
    """

    vertices: Float[Tensor, "P V 4"]
    views: Float[Tensor, "B 16"]
    centers: Float[Tensor, "B 4"]


def place(vertices: Float[Tensor, "P V 3"], cameras: CameraBatch, mesh_index: Int[Tensor, " B"]) -> Placement:
    """Centre the meshes of a batch and write the camera rows of views that look at mesh `mesh_index[b]`."""
    device = vertices.device
    mean = vertices.mean(dim=1)
    rotation, mesh_index = cameras.camera_from_world[:, :3, :3].to(device), mesh_index.to(device)
    centers = cameras.centers.to(device) - mean[mesh_index]
    views = torch.cat([cameras.intrinsics.to(device), rotation.reshape(-1, 9), centers], dim=1)
    centers = torch.cat([centers, mesh_index[:, None].to(torch.float32)], dim=1)
    packets = vertices.new_zeros(*vertices.shape[:2], 4)
    torch.sub(vertices, mean[:, None], out=packets[:, :, :3])
    return Placement(packets, views, centers)


@dataclass
class View:
    """One camera per lane, gathered from the table."""

    focal: tuple
    principal: tuple
    rotation: tuple  # nine floats
    center: object  # Vector3f

    @staticmethod
    def gather(table, index) -> "View":
        """Read row `index` of the flat table."""
        import drjit as dr

        mi = loaded_mitsuba()
        # Rows are four packets of four floats, 16-byte aligned.
        packets = [dr.gather(mi.Vector4f, table, index * (ROW // 4) + k) for k in range(ROW // 4)]
        focal_x, focal_y, principal_x, principal_y, *rotation, x, y, z = (value for packet in packets for value in packet)
        return View((focal_x, focal_y), (principal_x, principal_y), tuple(rotation), mi.Vector3f(x, y, z))

    def to_camera(self, point):
        """Local point (Vector3f) to camera axes."""
        mi = loaded_mitsuba()
        r, p = self.rotation, point - self.center
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

    def direction(self, pixel):
        """Direction (Vector3f, world axes) of the ray through a pixel position (Point2f), of unit depth: its parameter is depth."""
        mi = loaded_mitsuba()
        x, y = (pixel.x - self.principal[0]) / self.focal[0], (pixel.y - self.principal[1]) / self.focal[1]
        return self.to_world_direction(mi.Vector3f(x, y, 1.0))
