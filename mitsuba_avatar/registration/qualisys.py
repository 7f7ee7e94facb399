"""Calibrations of Qualisys Track Manager (`.qca.txt`): XML with one entry a camera.

What the file holds, checked by triangulation: millimetres, Z up; focal lengths and principal point in 64ths of a pixel; a rotation whose
rows are the camera's axes with y up and z backwards; the camera's centre. Pixel centres are integers there, so half a pixel is added.
"""

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np

from mitsuba_avatar.captures.cameras import Camera

SUBPIXELS = 64.0
MILLIMETRES = 1000.0  # in a metre
OPENCV_FROM_QUALISYS = np.diag([1.0, -1.0, -1.0])


def load_qualisys(path: Path | str) -> dict[str, Camera]:
    """Read a calibration.

    Returns:
        name (the file's serial) -> Camera at the size of the calibrated video, with its distortion, in the file's order.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: for text that is no such calibration, a camera without its numbers, or two of one name; names file and camera.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"load_qualisys(): expected a calibration at {path}; got none. Name the .qca.txt file.")
    try:
        # Bytes, not text: the file declares its own encoding.
        entries = ElementTree.fromstring(path.read_bytes()).findall("./cameras/camera")
    except ElementTree.ParseError as error:
        raise ValueError(f"load_qualisys(): expected XML in {path}; got: {error}. Export the calibration again.") from error
    cameras: dict[str, Camera] = {}
    for entry in entries:
        camera = _camera(path, entry)
        if camera.name in cameras:
            raise ValueError(f"load_qualisys(): expected every camera once in {path}; got {camera.name!r} twice. Remove one.")
        cameras[camera.name] = camera
    if not cameras:
        raise ValueError(f"load_qualisys(): expected cameras in {path}; got none. Export a camera calibration from Qualisys.")
    return cameras


def _camera(path: Path, entry: ElementTree.Element) -> Camera:
    name = entry.get("serial", "?")
    try:
        video, transform, intrinsic = (_numbers(entry, tag) for tag in ("fov_video", "transform", "intrinsic"))
        rotation = OPENCV_FROM_QUALISYS @ np.array([[transform[f"r{row}{column}"] for column in (1, 2, 3)] for row in (1, 2, 3)])
        centre = np.array([transform[axis] for axis in "xyz"]) / MILLIMETRES
        left, right, vectors = np.linalg.svd(rotation)  # ten printed digits are not rigid to the last bit
        rotation = left @ vectors
        if np.linalg.det(rotation) < 0 or np.abs(right - 1).max() > 1e-3:
            raise ValueError("r11..r33 are no rotation")
        camera_from_world = np.eye(4)
        camera_from_world[:3, :3], camera_from_world[:3, 3] = rotation, -rotation @ centre
        return Camera(
            name=name,
            width=round(video["right"] - video["left"]) + 1,
            height=round(video["bottom"] - video["top"]) + 1,
            fx=intrinsic["focalLengthU"] / SUBPIXELS,
            fy=intrinsic["focalLengthV"] / SUBPIXELS,
            cx=intrinsic["centerPointU"] / SUBPIXELS - video["left"] + 0.5,
            cy=intrinsic["centerPointV"] / SUBPIXELS - video["top"] + 0.5,
            camera_from_world=camera_from_world,
            # Qualisys spells it without the second n.
            distortion=tuple(
                intrinsic[key] for key in ("radialDistortion1", "radialDistortion2", "tangentalDistortion1", "tangentalDistortion2")
            ),
        )
    except (KeyError, ValueError) as error:
        raise ValueError(
            f"load_qualisys(): expected fov_video, transform and intrinsic of camera {name!r} in {path}; got {error}. "
            "Export the calibration again."
        ) from error


def _numbers(entry: ElementTree.Element, tag: str) -> dict[str, float]:
    found = entry.find(tag)
    if found is None:
        raise KeyError(f"no {tag}")
    return {key: float(value) for key, value in found.attrib.items()}
