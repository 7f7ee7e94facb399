"""The calibration that lies beside the videos, whichever tool wrote it, in our conventions: metres, Z up, world to camera.

| files | written by | unit and up |
|---|---|---|
| cameras.json | captures/cameras.py | metres, Z up |
| *.qca.txt | Qualisys Track Manager | millimetres, Z up |
| intri.yml, extri.yml | OpenCV's FileStorage, as EasyMocap names its entries | of the checkerboard, metres; up along the cameras |
| cameras.txt, images.txt | COLMAP (also in sparse/0 or sparse) | unknown: must be told; up as the cameras stand |
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mitsuba_avatar.captures.cameras import Camera, load_cameras
from mitsuba_avatar.captures.folder import CAMERAS_FILE
from mitsuba_avatar.captures.formats import colmap, easymocap
from mitsuba_avatar.captures.formats.source import SURE_ANGLE_DEG, degrees_off, turned_camera, upright_world
from mitsuba_avatar.registration.qualisys import load_qualisys
from mitsuba_avatar.registration.settings import CalibrationSettings

COLMAP_FOLDERS = ("", "sparse/0", "sparse")
Sizes = Mapping[str, tuple[int, int]]


@dataclass(frozen=True)
class Calibration:
    """Which files hold a recording's cameras; `find_calibration` makes one.

    Attributes:
        path: file or folder, for messages.
        read: takes (width, height) of the videos by name, for formats that do not say the images' size; gives cameras in the files'
            own world.
        is_upright: whether that world's Z points up.
        has_unit: whether its unit is known, and its axes mean anything.
    """

    path: Path
    read: Callable[[Sizes], dict[str, Camera]]
    is_upright: bool = True
    has_unit: bool = True

    def cameras(self, sizes: Sizes, settings: CalibrationSettings) -> dict[str, Camera]:
        """Cameras in metres, Z up.

        Raises:
            ValueError: for files of another schema, a unit that nobody named, or cameras that do not tell which way is up.
        """
        cameras = self.read(sizes)
        if not self.has_unit and settings.metres == 0:
            first, second = list(cameras.values())[:2] if len(cameras) > 1 else 2 * list(cameras.values())
            distance = float(np.linalg.norm(first.center_world - second.center_world))
            raise ValueError(
                f"Calibration(): expected calibration.metres, because {self.path} has no unit; got 0. Measure between two cameras: "
                f"{first.name} and {second.name} are {distance:.4f} units apart, so give their metres divided by that."
            )
        if settings.metres > 0:
            cameras = {name: colmap.scaled_camera(camera, settings.metres) for name, camera in cameras.items()}
        if self.is_upright and settings.up == "auto":
            return cameras
        turn = upright_world(cameras.values(), settings.up, self.path, has_axes=self.has_unit)
        off = degrees_off(cameras.values(), turn, self.path) if settings.up == "auto" else 0.0
        if off > SURE_ANGLE_DEG:
            raise ValueError(
                f"Calibration(): expected cameras that stand along an axis of the world of {self.path}, to tell which way is up; got "
                f"{off:.0f} degrees off the nearest. Say calibration.up=z (or the axis that points up), or calibration.up=cameras to take "
                "up as they stand."
            )
        return {name: turned_camera(camera, turn) for name, camera in cameras.items()}


def find_calibration(path: Path) -> Calibration:
    """The one calibration of a folder of videos; reads nothing. Our own cameras.json goes before any other.

    Raises:
        FileNotFoundError: if there is none.
        ValueError: if there are several.
    """
    if (path / CAMERAS_FILE).is_file():
        return Calibration(path / CAMERAS_FILE, lambda _: load_cameras(path / CAMERAS_FILE))
    found = [Calibration(file, lambda _, file=file: load_qualisys(file)) for file in sorted(path.glob("*.qca.txt"))]
    if (path / easymocap.INTRINSICS_FILE).is_file():
        found.append(
            Calibration(path / easymocap.INTRINSICS_FILE, lambda sizes: easymocap.read_easymocap_cameras(path, sizes), is_upright=False)
        )
    for folder in (path / name for name in COLMAP_FOLDERS):
        if (folder / colmap.CAMERAS_FILE).is_file() and (folder / colmap.IMAGES_FILE).is_file():
            file = folder / colmap.IMAGES_FILE
            found.append(Calibration(file, lambda _, folder=folder: colmap.read_colmap(folder), is_upright=False, has_unit=False))
    if not found:
        raise FileNotFoundError(
            f"find_calibration(): expected {CAMERAS_FILE}, *.qca.txt (Qualisys), intri.yml and extri.yml (OpenCV), or cameras.txt and "
            f"images.txt (COLMAP, as text) in {path}; got none. Put the calibration there that belongs to the videos."
        )
    if len(found) > 1:
        raise ValueError(
            f"find_calibration(): expected one calibration in {path}; got {[calibration.path.name for calibration in found]}. "
            "Keep the one that belongs to the videos."
        )
    return found[0]
