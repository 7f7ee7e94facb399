"""DNA-Rendering: one HDF5 file of images and one of annotations, read with h5py (an optional dependency).

<subject>.smc holds Camera_5mp/<camera>/color/<frame> and Camera_12mp/..., encoded images; <subject>_annots.smc holds
Camera_Parameter/<camera>/{K, D, RT}, Mask/<camera>/mask/<frame> and Keypoints_3D/keypoints3d. RT is camera to world, metres; images keep
their lens distortion D. The colour calibration that the file holds is not applied.
"""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from mitsuba_avatar.captures.cameras import Camera
from mitsuba_avatar.captures.formats.data_set import Contents, DataSet
from mitsuba_avatar.captures.formats.decoding import decode_labels, encoded_size
from mitsuba_avatar.captures.formats.files import camera_from_matrices
from mitsuba_avatar.captures.formats.source import (
    Source,
    SourceOptions,
    chosen_cameras,
    common_frames,
    turned_points,
    upright_world,
)
from mitsuba_avatar.captures.images import PNG_SIGNATURE
from mitsuba_avatar.captures.rigid import inverse_rigid, is_rigid
from mitsuba_avatar.captures.undistortion import Lens

if TYPE_CHECKING:
    import h5py

DATA_SET = DataSet("DNA-Rendering", 15.0, "SMPL-X parameters are no rig of ours", "DNA-Rendering: research only, by agreement")
IMAGE_GROUPS = ("Camera_5mp", "Camera_12mp")


class DnaRenderingSource(Source):
    """One subject of DNA-Rendering: a folder with its .smc file and its _annots.smc file.

    Raises:
        FileNotFoundError: if either file is missing.
        ValueError: for files that are not HDF5 or of another schema, or if h5py is not installed.
    """

    def __init__(self, path: Path | str, options: SourceOptions = SourceOptions()):  # noqa: B008 - frozen
        path = Path(path)
        self._images, self._annotations = _open_files(path)
        groups = [self._images[name] for name in IMAGE_GROUPS if name in self._images]
        self._colours = {_name(key): group[key]["color"] for group in groups for key in group if "color" in group[key]}
        if "Camera_Parameter" not in self._annotations:
            raise ValueError(
                f"DnaRenderingSource: expected Camera_Parameter in {self._annotations.filename}; got {list(self._annotations)}. "
                "Name a subject's annotations."
            )
        parameters = {_name(key): value for key, value in self._annotations["Camera_Parameter"].items()}
        masks = self._annotations.get("Mask", {})
        self._masks = {_name(key): masks[key]["mask"] for key in masks}
        names, notes = chosen_cameras(sorted(parameters), self._colours, options.cameras, path)
        available = {f"image of {name}": {int(key) for key in self._colours[name]} for name in names}
        if self._masks:
            available |= {f"mask of {name}": {int(key) for key in self._masks.get(name, ())} for name in names}
        numbers, missing = common_frames(None, available, path)
        self._first = {name: next(iter(self._colours[name])) for name in names}
        native = {name: self._camera(name, parameters[name]) for name in names}
        self._world_from_native = upright_world(native.values(), options.up, path)
        lenses = {name: Lens(tuple(float(value) for value in np.ravel(parameters[name]["D"][()]))) for name in names}
        first = self._bytes(self._colours[names[0]][self._first[names[0]]])
        contents = Contents(
            native,
            self._world_from_native,
            numbers,
            missing,
            "png" if first.startswith(PNG_SIGNATURE) else "jpg",
            bool(self._masks),
            lenses,
            (*notes, "the data set's colour calibration is not applied"),
        )
        self.info = DATA_SET.info(path, options, contents)

    def where(self, camera_name: str, frame_index: int) -> str:
        """The image's data set inside the file."""
        return f"{self._images.filename}:{self._dataset(self._colours[camera_name], frame_index).name}"

    def encoded_image(self, camera_name: str, frame_index: int) -> bytes:
        """Bytes of the encoded image."""
        return self._bytes(self._dataset(self._colours[camera_name], frame_index))

    def mask(self, camera_name: str, frame_index: int) -> UInt8[np.ndarray, "H W"] | None:
        """255 wherever the mask is not 0. Raises as `image`."""
        if camera_name not in self._masks:
            return None
        dataset = self._dataset(self._masks[camera_name], frame_index)
        where = f"{self._annotations.filename}:{dataset.name}"
        mask = np.where(decode_labels(self._bytes(dataset), where) != 0, np.uint8(255), np.uint8(0))
        self._check_size(mask, camera_name, where)
        return mask

    def keypoints(self, frame_index: int) -> Float32[np.ndarray, "K 4"] | None:
        """3D keypoints, metres; confidence 1 where the file has none.

        Raises:
            ValueError: for an array of another shape.
        """
        stored = self._annotations.get("Keypoints_3D/keypoints3d")
        if stored is None:
            return None
        if stored.ndim != 3 or stored.shape[2] not in (3, 4) or len(stored) <= self.info.frames[frame_index].number:
            raise ValueError(
                f"DnaRenderingSource: expected keypoints3d [frames, K, 3 or 4] in {self._annotations.filename}; got {list(stored.shape)}. "
                "Take images and annotations of one release."
            )
        rows = np.asarray(stored[self.info.frames[frame_index].number], dtype=np.float32)
        confidence = rows[:, 3:] if rows.shape[1] == 4 else np.ones_like(rows[:, :1])
        return np.concatenate([turned_points(rows[:, :3], self._world_from_native), confidence], axis=1)

    def smplx(self) -> dict[str, np.ndarray] | None:
        """SMPL-X parameters of the whole capture as stored, in the *data set's* world; None if missing."""
        group = self._annotations.get("SMPLx")
        return None if group is None else {key: group[key][()] for key in group}

    def _dataset(self, group: "h5py.Group", frame_index: int) -> "h5py.Dataset":
        """A frame's data set; names may be padded with zeros."""
        number = self.info.frames[frame_index].number
        return group[str(number)] if str(number) in group else next(group[key] for key in group if int(key) == number)

    @staticmethod
    def _bytes(dataset: "h5py.Dataset") -> bytes:
        """Contents of a data set of encoded bytes."""
        return np.asarray(dataset[()]).tobytes()

    def _camera(self, name: str, parameters: "h5py.Group") -> Camera:
        """A camera of the annotations, at the images' size, in the data set's world."""
        where = Path(self._annotations.filename)
        world_from_camera = np.asarray(parameters["RT"][()], dtype=np.float64)
        if world_from_camera.shape != (4, 4) or not is_rigid(world_from_camera):
            raise ValueError(f"DnaRenderingSource: expected a rigid RT [4, 4] of {name} in {where}; got {world_from_camera.tolist()}.")
        pose: Float64[np.ndarray, "4 4"] = inverse_rigid(world_from_camera)
        data = self._bytes(self._colours[name][self._first[name]])
        size = encoded_size(data, f"{self._images.filename}:{name}")
        return camera_from_matrices(name, size, np.asarray(parameters["K"][()], dtype=np.float64), pose[:3, :3], pose[:3, 3], where)


def _name(key: str) -> str:
    """A camera's name: two digits, as the annotations have it."""
    return f"{int(key):02d}" if key.isdecimal() else key


def _open_files(path: Path) -> tuple["h5py.File", "h5py.File"]:
    """The subject's two files."""
    try:
        import h5py
    except ImportError as error:
        raise ValueError(
            "DnaRenderingSource: expected h5py for .smc files; it is not installed. Install the extra: pip install mitsuba-avatar[dna]."
        ) from error
    annotations = sorted(path.glob("*_annots.smc"))
    images = sorted(set(path.glob("*.smc")) - set(annotations))
    if len(annotations) != 1 or len(images) != 1:
        raise FileNotFoundError(
            f"DnaRenderingSource: expected one SUBJECT.smc and one SUBJECT_annots.smc in {path}; got {len(images)} and {len(annotations)}. "
            "Put the two files of one subject into a folder of their own."
        )
    try:
        return h5py.File(images[0], "r"), h5py.File(annotations[0], "r")
    except OSError as error:
        raise ValueError(f"DnaRenderingSource: expected whole HDF5 files in {path}; got: {error}. Download them again.") from error
