"""Write a capture in the neutral layout: here a posed rig, drawn flat into three cameras; yours has photographs instead.

python examples/02_write_a_capture.py /tmp/my_capture
python -m mitsuba_avatar.capture check /tmp/my_capture
"""

import sys
import tempfile
from pathlib import Path

from mitsuba_avatar.rendering.backend import select_variant

select_variant()

import numpy as np  # noqa: E402
import torch  # noqa: E402

from mitsuba_avatar.body.anny_rig import build_anny_rig  # noqa: E402
from mitsuba_avatar.body.driving import face_keypoints  # noqa: E402
from mitsuba_avatar.body.rig import save_rig  # noqa: E402
from mitsuba_avatar.body.skeleton import Skeleton  # noqa: E402
from mitsuba_avatar.body.skinning import pose_vertices  # noqa: E402
from mitsuba_avatar.captures.cameras import Camera, look_at  # noqa: E402
from mitsuba_avatar.captures.description import CaptureDescription  # noqa: E402
from mitsuba_avatar.captures.frames import Frame  # noqa: E402
from mitsuba_avatar.captures.silhouettes import silhouette  # noqa: E402
from mitsuba_avatar.captures.writer import CaptureWriter  # noqa: E402

folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(tempfile.mkdtemp()) / "capture"
rig = build_anny_rig()
frames = tuple(Frame(i, i / 10, "train" if i < 3 else "test", "wave") for i in range(4))
theta = np.zeros((len(frames), len(rig.dofs.names)), np.float32)
theta[:, rig.dofs.names.index("left_shoulder_abduction")] = np.linspace(0.0, 0.6, len(frames))
root = np.tile(np.eye(4, dtype=np.float32), (len(frames), 1, 1))
rest = torch.from_numpy(rig.rest_vertices).expand(len(frames), -1, -1)
transforms = Skeleton(rig)(torch.from_numpy(theta), torch.from_numpy(root))
vertices = pose_vertices(rest, transforms, torch.from_numpy(rig.skinning_weights)).numpy()

cameras = {}
for i, angle in enumerate((0.0, 2.1, 4.2)):
    centre = np.array([3.5 * np.sin(angle), -3.5 * np.cos(angle), 1.2])
    cameras[f"cam{i}"] = Camera(f"cam{i}", 120, 160, 230.0, 230.0, 60.0, 80.0, look_at(centre, np.array([0, 0, 0.9])))

description = CaptureDescription(name="wave", fps=10.0, background=(0.0, 0.0, 0.0), held_out_cameras=("cam2",))
writer = CaptureWriter(folder, description, cameras, frames)
rig_file = Path(tempfile.mkdtemp()) / "rig.npz"
save_rig(rig_file, rig)
writer.write_rig(rig_file)
writer.write_arrays(theta=theta, root=root, face=face_keypoints(rig, rest).numpy(), vertices=vertices)
for name, camera in cameras.items():
    for i in range(len(frames)):
        mask = silhouette(camera, vertices[i], rig.topology.faces)
        writer.write_mask(name, i, mask)
        writer.write_image(name, i, (mask[..., None] * np.array([200, 120, 90])).astype(np.uint8))
print(writer.finish().path)  # noqa: T201
