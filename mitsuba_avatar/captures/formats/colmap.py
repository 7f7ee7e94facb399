"""Cameras of a COLMAP reconstruction in text form: cameras.txt (one lens for each camera) and images.txt (where each image was taken).

COLMAP counts pixels from the image's corner, as we do, and its axes are OpenCV's; but its world has no unit and no direction of its own.
What comes back is in that world: scale it and turn it (`scaled_camera`, `source.upright_world`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath

import numpy as np
from scipy.spatial.transform import Rotation

from mitsuba_avatar.captures.cameras import Camera
from mitsuba_avatar.captures.formats.decoding import require_file

CAMERAS_FILE = "cameras.txt"
IMAGES_FILE = "images.txt"
CONVERSION = "Write the model as text: colmap model_converter --output_type TXT."

# Model -> names of its parameters, in the file's order. A lone f is both focal lengths.
PARAMETERS: Mapping[str, Sequence[str]] = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "FULL_OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
}
_COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")


def read_colmap(folder: Path) -> dict[str, Camera]:
    """Read the cameras of a reconstruction of one moment, an image of each camera.

    Args:
        folder: with cameras.txt and images.txt.

    Returns:
        name -> Camera with its distortion, in the reconstruction's world and unit, in order of the names. The name is the folder of an
        image in a folder (`cam01/000000.jpg`), else the image's own without its ending (`cam01.jpg`).

    Raises:
        FileNotFoundError: if either file is missing.
        ValueError: for lines of another schema, a lens model that is not listed in `PARAMETERS`, or two images of one camera.
    """
    lenses = _lenses(require_file(folder / CAMERAS_FILE, CONVERSION))
    path = require_file(folder / IMAGES_FILE, CONVERSION)
    cameras: dict[str, Camera] = {}
    # Each image has two lines, the second of which holds its feature points and may be empty.
    for line in [line for line in path.read_text(encoding="utf-8-sig").splitlines() if not line.startswith("#")][::2]:
        if not line.strip():
            continue
        camera = _camera(line.split(maxsplit=9), lenses, path)
        if camera.name in cameras:
            raise ValueError(
                f"read_colmap(): expected one image of every camera in {path}; got several of {camera.name!r}. Reconstruct one moment, "
                "or keep one image of each camera."
            )
        cameras[camera.name] = camera
    if not cameras:
        raise ValueError(f"read_colmap(): expected images in {path}; got none. Reconstruct again: no camera was registered.")
    return dict(sorted(cameras.items()))


def scaled_camera(camera: Camera, metres: float) -> Camera:
    """The camera in a world whose unit was `metres` long."""
    pose = camera.camera_from_world.copy()
    pose[:3, 3] *= metres
    return replace(camera, camera_from_world=pose)


def _lenses(path: Path) -> dict[str, tuple[int, int, dict[str, float]]]:
    """Camera id -> width, height, parameters by name."""
    lenses = {}
    for line in path.read_text(encoding="utf-8-sig").splitlines():
        if line.startswith("#") or not line.strip():
            continue
        words = line.split()
        if len(words) > 1 and words[1] not in PARAMETERS:
            raise ValueError(
                f"read_colmap(): expected a lens model of {', '.join(PARAMETERS)} in {path}; got {words[1]!r}. Reconstruct with "
                "--ImageReader.camera_model OPENCV, or undistort first (colmap image_undistorter)."
            )
        try:
            camera_id, model, width, height = words[0], words[1], int(words[2]), int(words[3])
            lenses[camera_id] = (width, height, dict(zip(PARAMETERS[model], map(float, words[4:]), strict=True)))
        except (ValueError, IndexError) as error:
            raise ValueError(
                f"read_colmap(): expected 'CAMERA_ID MODEL WIDTH HEIGHT PARAMS...' in {path}; got {line[:60]!r}. {CONVERSION}"
            ) from error
    return lenses


def _camera(words: Sequence[str], lenses: Mapping[str, tuple[int, int, dict[str, float]]], path: Path) -> Camera:
    """A camera of an image's line."""
    try:
        quaternion, translation = np.array(words[1:5], dtype=np.float64), np.array(words[5:8], dtype=np.float64)
        width, height, values = lenses[words[8].strip()]
        image = PurePosixPath(words[9].strip().replace("\\", "/"))
        pose = np.eye(4)  # SciPy's quaternions end with the scalar
        pose[:3, :3], pose[:3, 3] = Rotation.from_quat(quaternion[[1, 2, 3, 0]]).as_matrix(), translation
    except (KeyError, ValueError, IndexError) as error:
        raise ValueError(
            f"read_colmap(): expected 'IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME' of a camera in {CAMERAS_FILE} in {path}; got "
            f"{' '.join(words)[:60]!r}. {CONVERSION}"
        ) from error
    coefficients = tuple(values.get(key, 0.0) for key in _COEFFICIENTS[: 8 if "k6" in values else 4])
    return Camera(
        image.parts[0] if len(image.parts) > 1 else image.stem,
        width,
        height,
        values.get("fx", values.get("f", 0.0)),
        values.get("fy", values.get("f", 0.0)),
        values["cx"],
        values["cy"],
        pose,
        coefficients if any(coefficients) else (),
    )
