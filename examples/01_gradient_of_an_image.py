"""The renderer alone: move a triangle mesh so that its image matches a target, by gradient descent through Mitsuba.

python examples/01_gradient_of_an_image.py
"""

from mitsuba_avatar.rendering.backend import select_variant

select_variant()  # before anything that imports torch or Dr.Jit

import numpy as np  # noqa: E402
import torch  # noqa: E402
import trimesh  # noqa: E402

from mitsuba_avatar.body.rig import Topology  # noqa: E402
from mitsuba_avatar.captures.cameras import Camera, look_at  # noqa: E402
from mitsuba_avatar.rendering.cameras import CameraBatch  # noqa: E402
from mitsuba_avatar.rendering.surface import SurfaceRenderer  # noqa: E402

WIDTH, HEIGHT = 96, 72

sphere = trimesh.creation.icosphere(subdivisions=3, radius=0.3)
faces = np.asarray(sphere.faces, np.int64)
points = np.asarray(sphere.vertices, np.float32)
uv = np.stack([np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi) + 0.5, points[:, 2] / 0.6 + 0.5], 1).clip(0, 1).astype(np.float32)
topology = Topology(num_vertices=len(points), faces=faces, uv=uv, uv_faces=faces)

positions = [np.array([1.5, -0.4, 0.3]), np.array([-0.3, 1.4, 0.2])]
cameras = CameraBatch.from_cameras(
    [Camera(f"cam{i}", WIDTH, HEIGHT, 90.0, 90.0, WIDTH / 2, HEIGHT / 2, look_at(p, np.zeros(3))) for i, p in enumerate(positions)]
)
texture = torch.rand(1, 3, 8, 12, generator=torch.Generator().manual_seed(0)).expand(2, -1, -1, -1)
rest = torch.from_numpy(points)[None]
renderer = SurfaceRenderer(topology, WIDTH, HEIGHT, samples_per_pixel=4)

true_shift = torch.tensor([0.08, -0.05, 0.10])
with torch.no_grad():
    target, target_mask = renderer.render(rest + true_shift, texture, cameras)

shift = torch.zeros(3, requires_grad=True)
optimizer = torch.optim.Adam([shift], lr=0.01)
for step in range(61):
    radiance, mask = renderer.render(rest + shift, texture, cameras, seed=step)
    loss = (radiance - target).abs().mean() + (mask - target_mask).square().mean()
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
    if step % 20 == 0:
        print(f"step {step:3d}  loss {loss.item():.5f}  shift error {(shift.detach() - true_shift).norm() * 1000:.1f} mm")  # noqa: T201
