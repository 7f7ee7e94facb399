"""AvatarReX and THuman4.0: one JSON file of cameras (world to camera, metres, pixel centres at integers), images, masks, SMPL-X parameters.

AvatarReX: calibration_full.json, <camera>/<frame:08d>.jpg, <camera>/mask/pha/<frame:08d>.jpg, missing_img_files.txt.
THuman4.0: calibration.json, images/<camera>/<frame:08d>.jpg, masks/<camera>/<frame:08d>.jpg.
"""

from collections.abc import Callable, Mapping
from pathlib import Path, PureWindowsPath
from typing import Any

import numpy as np

from mitsuba_avatar.captures.cameras import Camera
from mitsuba_avatar.captures.formats.data_set import Contents, DataSet
from mitsuba_avatar.captures.formats.decoding import parse_json, require_file
from mitsuba_avatar.captures.formats.files import (
    FilesByFrame,
    FileSource,
    camera_from_matrices,
    extension_of,
    files_by_number,
    first_size,
    needed,
)
from mitsuba_avatar.captures.formats.source import (
    SourceInfo,
    SourceOptions,
    chosen_cameras,
    common_frames,
    upright_world,
)
from mitsuba_avatar.captures.undistortion import Lens

_FACTS = (30.0, "SMPL-X parameters are no rig of ours")
AVATARREX = DataSet("AvatarReX", *_FACTS, "AvatarReX: non-commercial research, no redistribution")
THUMAN4 = DataSet("THuman4.0", *_FACTS, "THuman4.0: non-commercial research, no redistribution")


class AvatarRexSource(FileSource):
    """A capture of AvatarReX or THuman4.0; `open_avatarrex` and `open_thuman4` make it."""

    def __init__(self, path: Path, info: SourceInfo, images: FilesByFrame, masks: FilesByFrame):
        super().__init__(info, images, masks)
        self.path = path

    def smplx(self) -> dict[str, np.ndarray] | None:
        """SMPL-X parameters of the whole capture as stored, a row for each frame *number*, in the *data set's* world; None if missing.

        Raises:
            ValueError: for a file that is no archive of arrays.
        """
        path = self.path / "smpl_params.npz"
        if not path.is_file():
            return None
        try:
            with np.load(path, allow_pickle=False) as stored:
                return {key: stored[key] for key in stored.files}
        except (ValueError, EOFError, OSError) as error:
            raise ValueError(f"AvatarRexSource: expected arrays in {path}; got: {error}. Copy it again.") from error


def open_avatarrex(path: Path | str, options: SourceOptions = SourceOptions()) -> AvatarRexSource:  # noqa: B008 - frozen
    """Open an AvatarReX capture.

    Raises:
        FileNotFoundError: if there is no calibration_full.json.
        ValueError: for a calibration of another schema, or no frame that every camera has.
    """
    path = Path(path)
    recorded = [entry.name for entry in path.iterdir() if files_by_number(entry)] if path.is_dir() else []

    def folders(name: str) -> tuple[Path, Path]:
        return path / name, path / name / "mask/pha"

    return _open(path, path / "calibration_full.json", recorded, folders, options, AVATARREX)


def open_thuman4(path: Path | str, options: SourceOptions = SourceOptions()) -> AvatarRexSource:  # noqa: B008 - frozen
    """Open a THuman4.0 capture. Raises as `open_avatarrex`, for calibration.json."""
    path = Path(path)
    folder = path / "images"
    recorded = [entry.name for entry in folder.iterdir() if entry.is_dir()] if folder.is_dir() else []

    def folders(name: str) -> tuple[Path, Path]:
        return path / "images" / name, path / "masks" / name

    return _open(path, path / "calibration.json", recorded, folders, options, THUMAN4)


def _open(
    path: Path,
    calibration: Path,
    recorded: list[str],
    folders: Callable[[str], tuple[Path, Path]],
    options: SourceOptions,
    data_set: DataSet,
) -> AvatarRexSource:
    """What both have in common; `folders` gives a camera's folders of images and masks."""
    require_file(calibration, "Name the folder of one subject.")
    document = parse_json(calibration.read_bytes(), str(calibration))
    if not isinstance(document, dict) or not all(isinstance(entry, dict) and {"K", "R", "T"} <= set(entry) for entry in document.values()):
        raise ValueError(
            f"open_avatarrex(): expected {{camera: {{'K', 'R', 'T'}}}} in {calibration}; got {str(document)[:60]}. "
            "Name the format that this file belongs to."
        )
    names, notes = chosen_cameras(list(document), recorded, options.cameras, path)
    images = {name: files_by_number(folders(name)[0]) for name in names}
    masks = {name: files_by_number(folders(name)[1]) for name in names}
    numbers, missing = common_frames(None, needed(images, masks), path, _listed_missing(path, names))
    native = {name: _camera(name, document[name], first_size(images[name]), calibration) for name in names}
    lenses = {name: Lens(tuple(float(v) for v in np.ravel(document[name].get("distCoeff") or ()))) for name in names}
    turn = upright_world(native.values(), options.up, path)
    contents = Contents(native, turn, numbers, missing, extension_of(images), any(masks.values()), lenses, notes)
    info = data_set.info(path, options, contents)
    return AvatarRexSource(path, info, images, masks)


def _camera(name: str, entry: Mapping[str, Any], size: tuple[int, int], where: Path) -> Camera:
    """A camera of the file, at the images' size, in the data set's world."""
    stated = entry.get("imgSize")
    if stated is not None and tuple(map(int, stated)) != size:
        raise ValueError(
            f"open_avatarrex(): expected images of {int(stated[0])}x{int(stated[1])} pixels for {name} by {where}; got "
            f"{size[0]}x{size[1]}. Take images and calibration of one resolution."
        )
    try:
        matrices = [np.array(entry[key], dtype=np.float64).reshape(shape) for key, shape in (("K", (3, 3)), ("R", (3, 3)), ("T", (3,)))]
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"open_avatarrex(): expected K and R of 9 and T of 3 numbers for {name} in {where}; got: {error}. Copy it again."
        ) from error
    return camera_from_matrices(name, size, *matrices, where)


def _listed_missing(path: Path, names: list[str]) -> dict[int, str]:
    """Frames that the capture reports missing for the cameras in use; paths in the list have backslashes."""
    file = path / "missing_img_files.txt"
    missing: dict[int, str] = {}
    for line in file.read_text(encoding="utf-8-sig").splitlines() if file.is_file() else []:
        entry = PureWindowsPath(line.strip())
        camera = next((part for part in entry.parts if part in names), None)
        if camera is not None and entry.stem.isdecimal():
            missing[int(entry.stem)] = f"image of {camera} listed in {file.name}"
    return missing
