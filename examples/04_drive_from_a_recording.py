"""Drive a fitted avatar from a BVH recording in a few lines, with two ways to make up the latent code, side by side.

make fit
python examples/04_drive_from_a_recording.py runs/default walk.bvh
"""

import sys
from pathlib import Path

from mitsuba_avatar.rendering.backend import select_variant

select_variant()

import numpy as np  # noqa: E402

from mitsuba_avatar.driving.animation import FrameClock, animate, outline  # noqa: E402
from mitsuba_avatar.driving.assembly import assemble  # noqa: E402
from mitsuba_avatar.driving.imputation import make_imputation  # noqa: E402
from mitsuba_avatar.driving.limits import clamped  # noqa: E402
from mitsuba_avatar.driving.sources import load_body  # noqa: E402
from mitsuba_avatar.driving.training_latents import TrainingLatents  # noqa: E402
from mitsuba_avatar.loaded_run import LoadedRun  # noqa: E402
from mitsuba_avatar.reporting.camera_paths import orbit  # noqa: E402
from mitsuba_avatar.reporting.video import write_video  # noqa: E402
from mitsuba_avatar.reporting.view_transform import ViewTransform  # noqa: E402

WIDTH, HEIGHT = 200, 300

loaded = LoadedRun.open(sys.argv[1] if len(sys.argv) > 1 else "runs/default")
avatar, rig = loaded.avatar, loaded.run.rig
motion = load_body(sys.argv[2] if len(sys.argv) > 2 else loaded.capture.path, rig, fps=10.0, seconds=2.0)
training = TrainingLatents.encode(avatar, loaded.capture)
drive = assemble(loaded.run, avatar, motion, None, lambda: training.signals)
signals, report = clamped(drive.signals.in_place(), rig)
print(report.summary())  # noqa: T201

shots = list(enumerate(orbit(outline(avatar, signals), len(signals), WIDTH, HEIGHT)))
renderer, occlusion, clock = loaded.renderer(WIDTH, HEIGHT), loaded.occlusion(), FrameClock()
columns = []
for name in ("zero", "nearest"):
    latents = make_imputation(name, training.mu.shape[1], training).latents(signals)
    frames = animate(avatar, signals, latents, shots, renderer, occlusion, clock)
    columns.append([ViewTransform().apply(frame.radiance, frame.coverage) for frame in frames])
path = Path(loaded.run.path) / "examples" / "driven.mp4"
write_video(path, (np.concatenate(pair, axis=1) for pair in zip(*columns, strict=True)), fps=signals.fps)
print(clock.summary())  # noqa: T201
print(path)  # noqa: T201
