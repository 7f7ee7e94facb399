"""Small documents of Goliath captures: cameras, frame lists, keypoints."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from mitsuba_avatar.captures.cameras import Camera
from mitsuba_avatar.captures.formats.decoding import parse_json, read_table

CALIBRATION_FILE = "camera_calibration.json"
METRES = 1e-3  # of a millimetre
SENSOR_SCALE = 2  # K is for a sensor of so many times the images' size


def calibration_entries(path: Path) -> dict[str, Mapping]:
    """Entries of camera_calibration.json by camera name."""
    document = parse_json(path.read_bytes(), str(path))
    entries = document.get("KRT") if isinstance(document, dict) else None
    if not isinstance(entries, list) or not all(isinstance(entry, dict) and {"cameraId", "K", "T"} <= set(entry) for entry in entries):
        raise ValueError(
            f"GoliathSource: expected {{'KRT': [{{'cameraId', 'K', 'T'}}, ...]}} in {path}; got {str(document)[:80]}. "
            "Name a body capture, or the format that this file belongs to."
        )
    return {str(entry["cameraId"]): entry for entry in entries}


def goliath_camera(name: str, entry: Mapping, size: tuple[int, int], path: Path) -> Camera:
    """A camera at the images' size, in metres and the capture's own world."""
    width, height = size
    try:
        intrinsics = np.array(entry["K"], dtype=np.float64).T
        camera_from_world = np.array(entry["T"], dtype=np.float64).T
        if intrinsics.shape != (3, 3) or camera_from_world.shape != (4, 4):
            raise ValueError(f"K {list(intrinsics.shape)} and T {list(camera_from_world.shape)}")
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"GoliathSource: expected K of 3x3 and T of 4x4 numbers for {name} in {path}; got {error}. Copy it again."
        ) from error
    if not (np.allclose(camera_from_world[3], [0, 0, 0, 1], atol=1e-6) and np.allclose(intrinsics[2], [0, 0, 1], atol=1e-6)):
        raise ValueError(
            f"GoliathSource: expected K and T of {name} in {path} stored transposed (0 0 1 and 0 0 0 1 in the last column); got "
            f"{intrinsics[2].tolist()} and {camera_from_world[3].tolist()}. Transpose them: that is how this format keeps them."
        )
    camera_from_world[:3, 3] *= METRES
    # Pixel centres of the sensor lie at integers: half a sensor pixel more counts from the corner, where scaling is plain division.
    centre = (intrinsics[:2, 2] + 0.5) / SENSOR_SCALE
    if not (0.3 * width < centre[0] < 0.7 * width and 0.3 * height < centre[1] < 0.7 * height):
        raise ValueError(
            f"GoliathSource: expected K of {name} in {path} for {SENSOR_SCALE * width}x{SENSOR_SCALE * height} pixels, twice the images' "
            f"size, stored transposed; got a principal point of {intrinsics[:2, 2].tolist()}. Take images and calibration of one release."
        )
    return Camera(
        name,
        width,
        height,
        float(intrinsics[0, 0] / SENSOR_SCALE),
        float(intrinsics[1, 1] / SENSOR_SCALE),
        float(centre[0]),
        float(centre[1]),
        camera_from_world,
    )


def frame_rows(path: Path, column: str) -> dict[int, str]:
    """Frame number -> value of a column."""
    rows = read_table(path, ("frame", column))
    try:
        return {int(row["frame"]): row[column] for row in rows}
    except ValueError as error:
        raise ValueError(f"GoliathSource: expected frame numbers in {path}; got: {error}. Copy it again.") from error


def keypoint_rows(document: object) -> dict[str, Float64[np.ndarray, "4"]] | None:
    """x, y, z, confidence by name, from [[id, x, y, z, confidence...], ...] or {id: [x, y, z, confidence...] or {x, y, z}}."""
    rows: dict[str, np.ndarray] = {}
    try:
        if isinstance(document, dict):
            for name, value in document.items():
                value = [value["x"], value["y"], value["z"], value.get("confidence", 1.0)] if isinstance(value, dict) else value
                rows[str(name)] = np.array([*value, 1.0][:4] if len(value) == 3 else value[:4], dtype=np.float64)
        elif isinstance(document, list):
            for value in document:
                rows[str(int(value[0]))] = np.array([*value[1:4], value[4] if len(value) > 4 else 1.0], dtype=np.float64)
        else:
            return None
    except (KeyError, TypeError, ValueError, IndexError):
        return None
    return rows if all(row.shape == (4,) for row in rows.values()) else None
