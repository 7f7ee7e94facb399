"""Drive a fitted avatar in a few lines: bend its elbows, draw it from the front.

make fit
python examples/03_drive_an_avatar.py runs/default
"""

import sys
from pathlib import Path

from mitsuba_avatar.rendering.backend import select_variant

select_variant()

import torch  # noqa: E402

from mitsuba_avatar.driving.animation import FrameClock, animate, outline  # noqa: E402
from mitsuba_avatar.driving.signals import DrivingSignals  # noqa: E402
from mitsuba_avatar.loaded_run import LoadedRun  # noqa: E402
from mitsuba_avatar.reporting.camera_paths import orbit  # noqa: E402
from mitsuba_avatar.reporting.view_transform import ViewTransform, write_png  # noqa: E402

WIDTH, HEIGHT = 240, 400
BENDS = (0.0, 0.5, 1.0)  # radians

run = Path(sys.argv[1] if len(sys.argv) > 1 else "runs/default")
loaded = LoadedRun.open(run)
signals = DrivingSignals.of_capture(loaded.capture).chosen([0] * len(BENDS))  # pose, root and face of the capture's first frame
elbows = [angle for angle, name in enumerate(loaded.run.rig.dofs.names) if name.endswith("elbow_flexion")]
signals.theta[:, elbows] = torch.tensor(BENDS)[:, None]

latents = torch.zeros(len(BENDS), loaded.avatar.settings.latent_size)  # the most likely clothes
front = orbit(outline(loaded.avatar, signals), 1, WIDTH, HEIGHT)[0]
shots = [(row, front) for row in range(len(BENDS))]
transform, clock = ViewTransform(), FrameClock()
for frame in animate(loaded.avatar, signals, latents, shots, loaded.renderer(WIDTH, HEIGHT), loaded.occlusion(), clock):
    path = run / "examples" / f"elbows_{BENDS[frame.row]:.1f}.png"
    write_png(path, transform.apply(frame.radiance, frame.coverage), transform)
    print(path)  # noqa: T201
