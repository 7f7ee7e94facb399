"""Take a fitted avatar to Blender or a web page: skeleton, skin, shapes and a walk of frames in one GLB, and what that loses.

make fit
python examples/05_export_to_gltf.py runs/default
"""

import io
import sys
from pathlib import Path

from mitsuba_avatar.rendering.backend import select_variant

select_variant()

import numpy as np  # noqa: E402
from PIL import Image  # noqa: E402

from mitsuba_avatar.exporting.character import CharacterSettings, make_character  # noqa: E402
from mitsuba_avatar.exporting.checking import check_reread, posing_error_mm  # noqa: E402
from mitsuba_avatar.exporting.glb import write_glb  # noqa: E402
from mitsuba_avatar.loaded_run import LoadedRun  # noqa: E402
from mitsuba_avatar.reporting.view_transform import ViewTransform  # noqa: E402

run = Path(sys.argv[1] if len(sys.argv) > 1 else "runs/default")
loaded = LoadedRun.open(run)
frames = loaded.capture.frame_indices("test")[:8]
character = make_character(loaded.avatar, loaded.run.rig, loaded.capture, frames, CharacterSettings(influences=8, pose_shapes=4))

radiance = loaded.avatar.mean_texture.permute(1, 2, 0).numpy()
png = io.BytesIO()
Image.fromarray(ViewTransform().apply(radiance, np.ones(radiance.shape[:2], np.float32))).save(png, format="png")

path = run / "examples" / "avatar.glb"
write_glb(path, character, png.getvalue())
check_reread(path, character)
print(path)  # noqa: T201
print(f"at most {posing_error_mm(path, character).max():.2f} mm from the avatar, frame by frame")  # noqa: T201
