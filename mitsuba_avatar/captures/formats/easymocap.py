"""EasyMocap folders: intri.yml and extri.yml of OpenCV, images/<camera>/<frame>, optional mask/<camera>/ and keypoints3d/.

Cameras are world to camera in metres with pixel centres at integers; images keep their lens distortion, which `info.lenses` describes.
"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64
from scipy.spatial.transform import Rotation

from mitsuba_avatar.captures.cameras import Camera
from mitsuba_avatar.captures.formats.data_set import Contents, DataSet
from mitsuba_avatar.captures.formats.decoding import parse_json
from mitsuba_avatar.captures.formats.files import (
    FilesByFrame,
    FileSource,
    camera_from_matrices,
    extension_of,
    files_by_number,
    first_size,
    needed,
)
from mitsuba_avatar.captures.formats.opencv_yaml import read_opencv_yaml
from mitsuba_avatar.captures.formats.source import (
    SourceInfo,
    SourceOptions,
    chosen_cameras,
    common_frames,
    turned_points,
    upright_world,
)
from mitsuba_avatar.captures.undistortion import Lens

INTRINSICS_FILE = "intri.yml"
EXTRINSICS_FILE = "extri.yml"
RATIONAL_COUNT = 8  # coefficients that a camera can hold
DATA_SET = DataSet("EasyMocap folder", 30.0, "SMPL parameters are no rig of ours")
MASK_FOLDERS = ("mask", "masks", "mask_cihp", "mask-schp")


class EasyMocapSource(FileSource):
    """An EasyMocap folder with triangulated keypoints.

    Attributes:
        person: identity to follow in keypoints3d; None takes the first of each frame.
    """

    def __init__(
        self, path: Path, info: SourceInfo, images: FilesByFrame, masks: FilesByFrame, world_from_native: Float64[np.ndarray, "4 4"]
    ):
        super().__init__(info, images, masks, mask_is_label=True)
        self.path, self._world_from_native = path, world_from_native
        self.person: int | None = None

    def keypoints(self, frame_index: int) -> Float32[np.ndarray, "K 4"] | None:
        """Triangulated keypoints of the person, metres; confidence 0 throughout if nobody was found in this frame.

        Raises:
            ValueError: for a document of another schema.
        """
        number = self.info.frames[frame_index].number
        found = self._people(number)
        if found is None:
            first = next((rows for frame in self.info.frames if (rows := self._people(frame.number)) is not None), None)
            return None if first is None else np.zeros_like(first)
        found[:, :3] = turned_points(found[:, :3], self._world_from_native)
        return found

    def _people(self, number: int) -> Float32[np.ndarray, "K 4"] | None:
        """Keypoints of the person in one frame's file, in the data set's world."""
        path = self.path / "keypoints3d" / f"{number:06d}.json"
        if not path.is_file():
            return None
        document = parse_json(path.read_bytes(), str(path))
        try:
            people = {int(person["id"]): np.array(person["keypoints3d"], dtype=np.float32) for person in document}
        except (TypeError, KeyError, ValueError) as error:
            raise ValueError(
                f"EasyMocapSource: expected [{{'id', 'keypoints3d': [[x, y, z, confidence], ...]}}, ...] in {path}; got "
                f"{str(document)[:60]}. Triangulate again, or remove keypoints3d."
            ) from error
        if any(rows.ndim != 2 or rows.shape[1] not in (3, 4) for rows in people.values()):
            raise ValueError(f"EasyMocapSource: expected rows of x, y, z, confidence in {path}; got other rows. Triangulate again.")
        rows = people.get(self.person) if self.person is not None else next(iter(people.values()), None)
        if rows is not None and rows.shape[1] == 3:
            rows = np.concatenate([rows, np.ones_like(rows[:, :1])], axis=1)
        return rows


def open_easymocap(path: Path | str, options: SourceOptions = SourceOptions()) -> EasyMocapSource:  # noqa: B008 - frozen
    """Open an EasyMocap folder.

    Raises:
        FileNotFoundError: if a calibration file is missing.
        ValueError: for a calibration of another schema, a camera missing from it, or no frame that every camera has.
    """
    path = Path(path)
    folder = path / "images"
    recorded = sorted(entry.name for entry in folder.iterdir() if entry.is_dir()) if folder.is_dir() else []
    calibrated, intrinsics, extrinsics = _calibration(path)
    names, notes = chosen_cameras(calibrated, recorded, options.cameras, path)
    images = {name: files_by_number(folder / name) for name in names}
    mask_folder = next((path / name for name in MASK_FOLDERS if (path / name).is_dir()), path / MASK_FOLDERS[0])
    masks = {name: files_by_number(mask_folder / name) for name in names}
    numbers, missing = common_frames(None, needed(images, masks), path)
    native = {name: _camera(name, intrinsics, extrinsics, first_size(images[name]), path) for name in names}
    lenses = {name: _lens(name, intrinsics, path) for name in names}
    turn = upright_world(native.values(), options.up, path)
    contents = Contents(native, turn, numbers, missing, extension_of(images), any(masks.values()), lenses, notes)
    info = DATA_SET.info(path, options, contents)
    return EasyMocapSource(path, info, images, masks, turn)


def read_easymocap_cameras(path: Path, sizes: Mapping[str, tuple[int, int]]) -> dict[str, Camera]:
    """Cameras of intri.yml and extri.yml alone, without images.

    Args:
        path: folder of both files.
        sizes: (width, height) of the images or videos by name, where W_<name> and H_<name> do not say it; cameras without any size are
            left out.

    Returns:
        name -> Camera with its distortion, in the calibration's world and unit.

    Raises:
        FileNotFoundError: if either file is missing.
        ValueError: for files of another schema, no camera that both name, or a lens with more than eight coefficients.
    """
    calibrated, intrinsics, extrinsics = _calibration(path)
    if not calibrated:
        raise ValueError(
            f"read_easymocap_cameras(): expected names, K_<name> and T_<name> in {path / INTRINSICS_FILE} and {EXTRINSICS_FILE}; got "
            f"{list(intrinsics)[:4]}. Write them with cv2.FileStorage under these names."
        )
    cameras = {}
    for name in calibrated:
        stated = _stated_size(name, intrinsics)
        size = stated or sizes.get(name)
        if size is None:
            continue
        lens = _lens(name, intrinsics, path)
        if any(lens.coefficients[RATIONAL_COUNT:]):
            raise ValueError(
                f"read_easymocap_cameras(): expected at most k1, k2, p1, p2, k3, k4, k5, k6 of {name} in {path / INTRINSICS_FILE}; got "
                f"{len(lens.coefficients)} coefficients. Calibrate without the thin-prism and tilted models."
            )
        camera = _camera(name, intrinsics, extrinsics, size, path)
        cameras[name] = camera if lens.is_pinhole else replace(camera, distortion=lens.coefficients[:RATIONAL_COUNT])
    return cameras


def _calibration(path: Path) -> tuple[list[str], dict[str, Any], dict[str, Any]]:
    """Names that both files calibrate, and the files' entries."""
    intrinsics, extrinsics = read_opencv_yaml(path / INTRINSICS_FILE), read_opencv_yaml(path / EXTRINSICS_FILE)
    listed = [str(name) for name in intrinsics.get("names") or []]
    return [name for name in listed if f"K_{name}" in intrinsics and f"T_{name}" in extrinsics], intrinsics, extrinsics


def _stated_size(name: str, intrinsics: Mapping[str, Any]) -> tuple[int, int] | None:
    """(width, height) that the calibration was made at, if it says so."""
    stated = tuple(intrinsics.get(f"{axis}_{name}") for axis in "WH")
    return None if None in stated else (int(stated[0]), int(stated[1]))


def _camera(name: str, intrinsics: Mapping[str, Any], extrinsics: Mapping[str, Any], size: tuple[int, int], path: Path) -> Camera:
    """A camera of both files, at the images' size, in the data set's world."""
    stated = _stated_size(name, intrinsics)
    if stated is not None and stated != size:
        raise ValueError(
            f"open_easymocap(): expected images of {stated[0]}x{stated[1]} pixels for {name} by {path / 'intri.yml'}; got "
            f"{size[0]}x{size[1]}. Scale K (and W, H) with the images."
        )
    rotation = extrinsics.get(f"Rot_{name}")
    if not isinstance(rotation, np.ndarray):
        vector = extrinsics.get(f"R_{name}")
        if not isinstance(vector, np.ndarray) or vector.size != 3:
            raise ValueError(
                f"open_easymocap(): expected R_{name} (Rodrigues) or Rot_{name} (3x3) in {path / 'extri.yml'}; got neither. Calibrate."
            )
        rotation = Rotation.from_rotvec(vector.ravel()).as_matrix()
    matrices = [np.asarray(value, dtype=np.float64) for value in (intrinsics[f"K_{name}"], rotation, extrinsics[f"T_{name}"])]
    return camera_from_matrices(name, size, *matrices, path / INTRINSICS_FILE)


def _lens(name: str, intrinsics: Mapping[str, Any], path: Path) -> Lens:
    """Lens of a camera."""
    values = intrinsics.get(f"dist_{name}", intrinsics.get(f"D_{name}"))
    try:
        return Lens(() if values is None else tuple(float(value) for value in np.ravel(values)))
    except ValueError as error:
        raise ValueError(f"open_easymocap(): dist_{name} of {path / 'intri.yml'} is not usable. {error}") from error
