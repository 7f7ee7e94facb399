"""Drive a fitted avatar in a few lines: bend its elbows, draw it from the front.

make fit
python examples/03_drive_an_avatar.py runs/default
"""

import sys
from pathlib import Path

from mitsuba_avatar.rendering.backend import select_variant

select_variant()

import numpy as np  # noqa: E402
import torch  # noqa: E402

from mitsuba_avatar.captures.cameras import Camera, look_at  # noqa: E402
from mitsuba_avatar.captures.colour import encode  # noqa: E402
from mitsuba_avatar.loaded_run import LoadedRun  # noqa: E402
from mitsuba_avatar.rendering.cameras import CameraBatch  # noqa: E402
from mitsuba_avatar.reporting.figures import save_image  # noqa: E402

WIDTH, HEIGHT = 240, 400

run = Path(sys.argv[1] if len(sys.argv) > 1 else "runs/default")
loaded = LoadedRun.open(run)
avatar, capture, names = loaded.avatar, loaded.capture, loaded.run.rig.dofs.names
renderer, occlusion = loaded.renderer(WIDTH, HEIGHT), loaded.occlusion()
root = torch.eye(4)[None]
face = torch.from_numpy(np.array(capture.face[0]))[None]
front = Camera("front", WIDTH, HEIGHT, 700.0, 700.0, WIDTH / 2, HEIGHT / 2, look_at(np.array([0, -3.8, 1.1]), np.array([0, 0, 0.9])))
cameras = CameraBatch.from_cameras([front])

for bend in (0.0, 0.5, 1.0):  # radians
    theta = torch.from_numpy(np.array(capture.theta[0]))[None]
    for side in ("left", "right"):
        theta[0, names.index(f"{side}_elbow_flexion")] = bend
    with torch.no_grad():
        open_share = occlusion.bake(avatar.pose_template(theta, root)[0])[None, None]
        output = avatar.decode(theta, root, face, None, cameras.centers[None], open_share)
        radiance, mask = renderer.render(output.vertices, output.textures[0], cameras)
        picture = encode(radiance + 0.18 * (1 - mask), "srgb").clamp(0, 1)  # over a grey backdrop
    path = run / "examples" / f"elbows_{bend:.1f}.png"
    save_image(path, picture[0].permute(1, 2, 0).numpy())
    print(path)  # noqa: T201
