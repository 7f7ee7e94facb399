"""Writing a capture: every file whole or absent, resumable, and taken for a capture only once `finish` was called."""

import itertools
import os
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8

from mitsuba_avatar.captures.arrays import save_frame_array
from mitsuba_avatar.captures.cameras import Camera, cameras_text
from mitsuba_avatar.captures.description import CaptureDescription, description_text
from mitsuba_avatar.captures.folder import CAMERAS_FILE, DESCRIPTION_FILE, FRAMES_FILE, UNFINISHED_FILE, Capture
from mitsuba_avatar.captures.frames import Frame, frames_text
from mitsuba_avatar.captures.image_store import MASKS_FOLDER, image_path, mask_path
from mitsuba_avatar.captures.images import EncodedImage, write_image, write_mask
from mitsuba_avatar.files import atomic_path


class CaptureWriter:
    """Writes one capture, file by file, in any order.

    Making a writer on a folder that an equal writer left unfinished resumes it: ask `has_image` and `has_mask` what is there
    already. `finish` comes last.

    Raises:
        FileExistsError: if the folder holds a finished capture, an unfinished one of other settings, or something else.
    """

    def __init__(self, path: Path | str, description: CaptureDescription, cameras: Mapping[str, Camera], frames: Sequence[Frame]):
        """Begin or resume the capture in the folder `path`, which is made if need be."""
        self.path = Path(path)
        self.description = description
        self.cameras = dict(cameras)
        self.frames = tuple(frames)
        unknown = [name for name in description.held_out_cameras if name not in self.cameras]
        if unknown or not self.cameras or not self.frames:
            raise ValueError(
                f"CaptureWriter(): expected cameras, frames, and held-out cameras among the cameras; got {len(self.cameras)} cameras, "
                f"{len(self.frames)} frames, unknown held-out {unknown}. Correct the description."
            )
        self._begin(
            {
                UNFINISHED_FILE: description_text(description),
                CAMERAS_FILE: cameras_text(self.cameras),
                FRAMES_FILE: frames_text(self.frames),
            }
        )

    def has_image(self, camera_name: str, frame_index: int) -> bool:
        """Whether this image was written already."""
        return self._image_path(camera_name, frame_index).is_file()

    def has_mask(self, camera_name: str, frame_index: int) -> bool:
        """Whether this mask was written already."""
        return self._mask_path(camera_name, frame_index).is_file()

    def has_all(self) -> bool:
        """Whether every image and every mask was written already; found out at the first that was not, without asking file by file."""
        missing = itertools.chain(self._missing(self._image_path), self._missing(self._mask_path))
        return next(missing, None) is None

    def write_image(self, camera_name: str, frame_index: int, encoded: EncodedImage) -> None:
        """Write an image.

        Args:
            camera_name: key of `cameras`.
            frame_index: row of `frames`, not the frame's number.
            encoded: [H, W, 3] in the capture's colour curve: uint8, or float32 for exr. `captures.colour.encode_bytes` makes it.

        Raises:
            ValueError: if the size is not the camera's, or the type not the extension's.
        """
        self._check_size(camera_name, encoded.shape)
        write_image(self._image_path(camera_name, frame_index), encoded)

    def write_mask(
        self, camera_name: str, frame_index: int, mask: Float[np.ndarray, "H W"] | UInt8[np.ndarray, "H W"] | Bool[np.ndarray, "H W"]
    ) -> None:
        """Write a mask [H, W]: coverage 0..1 (float), 0..255 (uint8), or bool. Raises as `write_image`."""
        self._check_size(camera_name, mask.shape)
        if mask.dtype != np.uint8:
            mask = np.rint(mask.astype(np.float32).clip(0.0, 1.0) * 255.0).astype(np.uint8)
        write_mask(self._mask_path(camera_name, frame_index), mask)

    def write_arrays(self, **arrays: np.ndarray) -> None:
        """Write some of theta [N, D], root [N, 4, 4], face [N, F], keypoints [N, K, 4], vertices [N, V, 3]; see captures/arrays.py.

        Raises:
            ValueError: for another name or shape.
        """
        for name, values in arrays.items():
            save_frame_array(self.path, name, values, len(self.frames))

    def write_rig(self, source: Path | str) -> None:
        """Copy a rig file into the capture."""
        with atomic_path(self.path / self.description.rig) as temporary:
            shutil.copyfile(source, temporary)

    def finish(self) -> Capture:
        """Declare the capture whole: check that every image is there, and every mask if there is any, then put capture.yaml in place.

        Images that are read in place must be found where `images_from` says.

        Returns:
            the capture, opened.

        Raises:
            FileNotFoundError: if images or masks are missing; names the first.
            ValueError: if the reader would refuse what was written; the capture stays unfinished.
        """
        if self.description.images_from is None:
            self._require_all(self._image_path, "images")
            if (self.path / MASKS_FOLDER).is_dir():
                self._require_all(self._mask_path, "masks")
        capture = Capture(self.path, self.description, self.cameras, self.frames)  # checks the arrays against frames and names
        capture.images.require()
        os.replace(self.path / UNFINISHED_FILE, self.path / DESCRIPTION_FILE)
        return Capture.open(self.path)

    def _begin(self, texts: dict[str, str]) -> None:
        """Put the small files in place, or find them there unchanged."""
        if (self.path / DESCRIPTION_FILE).exists():
            raise FileExistsError(
                f"CaptureWriter(): expected a new folder at {self.path}; got a finished capture. Choose another, or delete it."
            )
        self.path.mkdir(parents=True, exist_ok=True)
        if not (self.path / UNFINISHED_FILE).exists() and any(self.path.iterdir()):
            # A crash between the first two writes leaves cameras.json and frames.csv only: the marker is written last of the three.
            foreign = sorted(entry.name for entry in self.path.iterdir() if entry.name not in texts and not entry.name.startswith("."))
            if foreign:
                raise FileExistsError(
                    f"CaptureWriter(): expected an empty folder at {self.path}; got {foreign[:5]}. Choose another folder."
                )
        elif (self.path / UNFINISHED_FILE).exists():
            changed = [name for name, text in texts.items() if _text(self.path / name) != text]
            if changed:
                raise FileExistsError(
                    f"CaptureWriter(): expected to resume the same capture in {self.path}; got an unfinished one whose "
                    f"{', '.join(changed)} differ. Run with the settings that it was begun with, or delete the folder."
                )
        for name in (CAMERAS_FILE, FRAMES_FILE, UNFINISHED_FILE):
            with atomic_path(self.path / name) as temporary:
                temporary.write_text(texts[name], encoding="utf-8")

    def _missing(self, path_of: Callable[[str, int], Path]) -> Iterator[Path]:
        """Files that are not there, camera by camera. Folders are listed once; of millions of files, few names are in memory."""
        names = [path_of(next(iter(self.cameras)), index).name for index in range(len(self.frames))]  # every camera's are alike
        for camera in self.cameras:
            folder = path_of(camera, 0).parent
            listed = set(os.listdir(folder)) if folder.is_dir() else set()
            yield from (folder / name for name in names if name not in listed)

    def _require_all(self, path_of: Callable[[str, int], Path], what: str) -> None:
        """Refuse if some of the files are missing."""
        missing, total = list(self._missing(path_of)), len(self.cameras) * len(self.frames)
        if missing:
            raise FileNotFoundError(
                f"CaptureWriter.finish(): expected {total} {what} in {self.path}; got {total - len(missing)}, the first missing "
                f"is {missing[0]}. Write them, or leave their frame out."
            )

    def _check_size(self, camera_name: str, shape: tuple[int, ...]) -> None:
        """Refuse an image whose size is not its camera's."""
        if camera_name not in self.cameras:
            raise ValueError(f"CaptureWriter: expected a camera of {list(self.cameras)}; got {camera_name!r}. Correct the name.")
        camera = self.cameras[camera_name]
        if shape[:2] != (camera.height, camera.width):
            raise ValueError(
                f"CaptureWriter: expected {camera.height} rows of {camera.width} pixels for {camera_name}; got {shape[0]} of {shape[1]}. "
                "Arrays are [height, width]."
            )

    def _image_path(self, camera_name: str, frame_index: int) -> Path:
        """File of an image."""
        return image_path(self.path, camera_name, self.frames[frame_index].number, self.description.image_extension)

    def _mask_path(self, camera_name: str, frame_index: int) -> Path:
        """File of a mask."""
        return mask_path(self.path, camera_name, self.frames[frame_index].number)


def _text(path: Path) -> str:
    """Contents of a small file, empty if there is none."""
    return path.read_text(encoding="utf-8") if path.is_file() else ""
