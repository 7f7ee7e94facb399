"""ZJU-MoCap and other captures in neuralbody's layout: annots.npy, images at the paths that it lists, masks beside them.

annots.npy is a pickled dictionary: {"cams": {"K", "D", "R", "T"}, "ims": [{"ims": [path of each camera]}, ...]}, T in millimetres, pixel
centres at integers. SMPL parameters: V = R(Rh) X(theta, root at zero) + Th, a rotation about the origin and not about the pelvis.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64

from mitsuba_avatar.captures.formats.data_set import Contents, DataSet
from mitsuba_avatar.captures.formats.decoding import require_file
from mitsuba_avatar.captures.formats.files import FilesByFrame, FileSource, camera_from_matrices, extension_of, first_size, needed
from mitsuba_avatar.captures.formats.safe_pickle import load_object_array
from mitsuba_avatar.captures.formats.source import (
    SourceInfo,
    SourceOptions,
    chosen_cameras,
    common_frames,
    turned_points,
    upright_world,
)
from mitsuba_avatar.captures.undistortion import Lens

DATA_SET = DataSet("ZJU-MoCap", 50.0, "SMPL parameters are no rig of ours", "ZJU-MoCap: research only, by agreement")
METRES = 1e-3  # of a millimetre
MASK_FOLDERS = ("mask_cihp", "mask")


class NeuralBodySource(FileSource):
    """A capture in neuralbody's layout; `open_neuralbody` makes it."""

    def __init__(
        self,
        path: Path,
        info: SourceInfo,
        images: FilesByFrame,
        masks: FilesByFrame,
        world_from_native: Float64[np.ndarray, "4 4"],
        first_number: int,
    ):
        super().__init__(info, images, masks, mask_is_label=True)
        self.path, self._world_from_native, self._first_number = path, world_from_native, first_number

    def vertices(self, frame_index: int) -> Float32[np.ndarray, "V 3"] | None:
        """SMPL vertices of a frame, metres, world axes; None if the capture has none.

        Raises:
            ValueError: for a file that is no array of points.
        """
        path = self.path / "vertices" / f"{self._number(frame_index)}.npy"
        if not path.is_file():
            return None
        try:
            points = np.load(path, allow_pickle=False)
        except (ValueError, EOFError) as error:
            raise ValueError(f"NeuralBodySource: expected an array of vertices in {path}; got: {error}. Copy it again.") from error
        return turned_points(points.reshape(-1, 3), self._world_from_native)

    def smpl(self, frame_index: int) -> dict[str, np.ndarray] | None:
        """SMPL parameters of a frame as stored: poses (1, 72), Rh (1, 3), Th (1, 3), shapes (1, 10), in the *data set's* world.

        Raises:
            ValueError: for a file that is no dictionary of arrays.
        """
        for folder in ("params", "new_params"):
            path = self.path / folder / f"{self._number(frame_index)}.npy"
            if path.is_file():
                return load_object_array(path.read_bytes(), str(path))
        return None

    def _number(self, frame_index: int) -> int:
        """Number in the names of parameter files; some captures count them from one."""
        return self.info.frames[frame_index].number + self._first_number


def open_neuralbody(path: Path | str, options: SourceOptions = SourceOptions()) -> NeuralBodySource:  # noqa: B008 - frozen
    """Open a capture in neuralbody's layout. Frame numbers are positions in its list of images.

    Raises:
        FileNotFoundError: if there is no annots.npy.
        ValueError: for a document of another schema, or no frame that every camera has.
    """
    path = Path(path)
    annotations = require_file(path / "annots.npy", "Name the folder of one capture (CoreView_377, say).")
    document = load_object_array(annotations.read_bytes(), str(annotations))
    try:
        cams = {key: [np.asarray(value, dtype=np.float64) for value in document["cams"][key]] for key in ("K", "D", "R", "T")}
        lists = [[str(name) for name in moment["ims"]] for moment in document["ims"]]
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(
            f"open_neuralbody(): expected {{'cams': {{'K', 'D', 'R', 'T'}}, 'ims': [{{'ims': [...]}}]}} in {annotations}; got "
            f"{type(error).__name__}: {error}. Name a capture in this layout."
        ) from error
    count = len(cams["K"])
    if not lists or any(len(moment) != count for moment in lists) or any(len(values) != count for values in cams.values()):
        raise ValueError(
            f"open_neuralbody(): expected {count} cameras in every list of {annotations}; got "
            f"{sorted({len(moment) for moment in lists})} images and {[len(values) for values in cams.values()]} matrices. Copy it again."
        )
    calibrated = [Path(name).parent.as_posix().replace("/", "_") or f"camera_{index}" for index, name in enumerate(lists[0])]
    recorded = [name for name, file in zip(calibrated, lists[0], strict=True) if (path / file).parent.is_dir()]
    names, notes = chosen_cameras(calibrated, recorded, options.cameras, path)
    places = {name: calibrated.index(name) for name in names}
    images = {
        name: {number: path / moment[place] for number, moment in enumerate(lists) if (path / moment[place]).is_file()}
        for name, place in places.items()
    }
    folder = next((name for name in MASK_FOLDERS if (path / name).is_dir()), MASK_FOLDERS[0])
    masks = {name: _masks(path, path / folder, files) for name, files in images.items()}
    numbers, missing = common_frames(list(range(len(lists))), needed(images, masks), path)
    native = {
        name: camera_from_matrices(
            name, first_size(images[name]), cams["K"][place], cams["R"][place], METRES * cams["T"][place], annotations
        )
        for name, place in places.items()
    }
    lenses = {name: Lens(tuple(float(value) for value in cams["D"][place].ravel())) for name, place in places.items()}
    turn = upright_world(native.values(), options.up, path)
    contents = Contents(native, turn, numbers, missing, extension_of(images), any(masks.values()), lenses, notes)
    info = DATA_SET.info(path, options, contents)
    counts_from_one = not any((path / kind / "0.npy").is_file() for kind in ("vertices", "params", "new_params"))
    return NeuralBodySource(path, info, images, masks, turn, int(counts_from_one))


def _masks(path: Path, folder: Path, images: dict[int, Path]) -> dict[int, Path]:
    """Masks at the images' paths below the mask folder, as PNG."""
    found = {number: (folder / file.relative_to(path)).with_suffix(".png") for number, file in images.items()}
    return {number: file for number, file in found.items() if file.is_file()}
