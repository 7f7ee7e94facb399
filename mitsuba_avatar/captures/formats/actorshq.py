"""ActorsHQ: 160 cameras, masks, no body model.

calibration.csv holds camera-to-world poses (axis-angle and metres, OpenCV axes), focal lengths and principal points in units of the image's
width and height, counted from the image's corner.
"""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from mitsuba_avatar.captures.cameras import Camera
from mitsuba_avatar.captures.formats.data_set import Contents, DataSet
from mitsuba_avatar.captures.formats.decoding import read_table
from mitsuba_avatar.captures.formats.files import FileSource, extension_of, files_by_number, first_size, needed
from mitsuba_avatar.captures.formats.source import (
    SourceOptions,
    chosen_cameras,
    common_frames,
    upright_world,
)
from mitsuba_avatar.captures.rigid import inverse_rigid

COLUMNS = ("name", "w", "h", "rx", "ry", "rz", "tx", "ty", "tz", "fx", "fy", "px", "py")
DATA_SET = DataSet(
    "ActorsHQ",
    25.0,
    "the data set has no body model",
    "ActorsHQ licence (CC BY-NC 4.0)",
    folders=3,
    test_frames=300,  # by the custom of the papers that use it
)
SCALES = ("1x", "2x", "4x")


def open_actorshq(path: Path | str, options: SourceOptions = SourceOptions()) -> FileSource:  # noqa: B008 - frozen
    """Open a sequence at one scale (Actor01/Sequence1/4x); of a sequence's folder, the smallest images that are there.

    Raises:
        FileNotFoundError: if there is no calibration.csv.
        ValueError: for a table of another schema, or no frame that every camera has.
    """
    path = Path(path)
    if not (path / "calibration.csv").is_file():
        path = next((path / scale for scale in reversed(SCALES) if (path / scale / "calibration.csv").is_file()), path)
    calibration = path / "calibration.csv"
    rows = {row["name"]: row for row in read_table(calibration, COLUMNS)}
    folder = path / "rgbs"
    recorded = [entry.name for entry in folder.iterdir() if entry.is_dir()] if folder.is_dir() else []
    names, notes = chosen_cameras(list(rows), recorded, options.cameras, path)
    images = {name: files_by_number(folder / name, rf"{name}_rgb(\d+)") for name in names}
    masks = {name: files_by_number(path / "masks" / name, rf"{name}_mask(\d+)") for name in names}
    numbers, missing = common_frames(None, needed(images, masks), path)
    native = {name: _camera(rows[name], first_size(images[name]), calibration) for name in names}
    turn = upright_world(native.values(), options.up, path)
    contents = Contents(native, turn, numbers, missing, extension_of(images), any(masks.values()), notes=notes)
    info = DATA_SET.info(path, options, contents)
    return FileSource(info, images, masks)


def _camera(row: dict[str, str], size: tuple[int, int], where: Path) -> Camera:
    """A camera of the table, at the images' size, in the data set's world."""
    name, (width, height) = row["name"], size
    try:
        value = {key: float(row[key]) for key in COLUMNS[1:]}
    except ValueError as error:
        raise ValueError(f"open_actorshq(): expected numbers for {name} in {where}; got: {error}. Copy the file again.") from error
    if (width, height) != (value["w"], value["h"]):
        raise ValueError(
            f"open_actorshq(): expected images of {value['w']:.0f}x{value['h']:.0f} pixels for {name} by {where}; got {width}x{height}. "
            "Take images and calibration.csv of the same scale."
        )
    world_from_camera = np.eye(4)
    world_from_camera[:3, :3] = Rotation.from_rotvec([value["rx"], value["ry"], value["rz"]]).as_matrix()
    world_from_camera[:3, 3] = value["tx"], value["ty"], value["tz"]
    if max(value["fx"], value["px"]) > 0.1 * width:
        raise ValueError(
            f"open_actorshq(): expected fx and px of {name} in {where} in units of the image's width; got {value['fx']:g} and "
            f"{value['px']:g}, which look like pixels. Divide by the width, fy and py by the height."
        )
    return Camera(
        name,
        width,
        height,
        value["fx"] * width,
        value["fy"] * height,
        value["px"] * width,
        value["py"] * height,
        inverse_rigid(world_from_camera),
    )
