"""A capture on disk: its layout, and the lazy reader.

```
capture.yaml      what it is (captures/description.py); added last, so a folder without it is no whole capture
cameras.json      captures/cameras.py
frames.csv        captures/frames.py
images/<camera>/<frame number:06d>.<extension>      masks/<camera>/<frame number:06d>.png
backgrounds/<camera>.<extension>      optional: what the camera sees without the person
pose.npy root.npy face.npy keypoints.npy vertices.npy      captures/arrays.py
rig.npz           body/rig.py; this package only knows where it lies
```

Opening reads the three small text files and the headers of the arrays. Images are decoded when asked for and never kept, arrays are
memory-mapped: memory does not grow with the number of frames. Missing pieces are None or a FileNotFoundError that names them.

Where capture.yaml has `images_from`, images, masks and plates stay in a data set of another format and are read there
(captures/formats/in_place.py); everything else lies here.
"""

import difflib
from pathlib import Path

import numpy as np
from jaxtyping import Float32
from PIL import Image

from mitsuba_avatar.captures.arrays import FRAME_ARRAYS, open_frame_array
from mitsuba_avatar.captures.cameras import Camera, load_cameras
from mitsuba_avatar.captures.colour import encode
from mitsuba_avatar.captures.description import CaptureDescription, load_description
from mitsuba_avatar.captures.formats.in_place import SourceImages
from mitsuba_avatar.captures.formats.opening import FORMAT_NAMES
from mitsuba_avatar.captures.frames import Frame, load_frames
from mitsuba_avatar.captures.image_store import FolderImages, ImageStore, decoded
from mitsuba_avatar.captures.images import EncodedImage

DESCRIPTION_FILE = "capture.yaml"
UNFINISHED_FILE = "capture.unfinished.yaml"
CAMERAS_FILE = "cameras.json"
FRAMES_FILE = "frames.csv"


class Capture:
    """A whole capture, read lazily. `Capture.open` makes one.

    Attributes:
        path: its folder.
        description: contents of capture.yaml.
        cameras: name -> Camera, at the size that `image` returns.
        frames: by index.
        image_scale: factor by which images and cameras are resampled on reading.
        images: where images, masks and plates come from.
        theta, root, face, keypoints, vertices: [N, ...] float32, memory-mapped, None where the capture has none; see captures/arrays.py.
    """

    def __init__(
        self, path: Path, description: CaptureDescription, cameras: dict[str, Camera], frames: tuple[Frame, ...], image_scale: float = 1.0
    ):
        """Combine parts that were read already; see `open`."""
        self.path = path
        self.description = description
        self.cameras = {name: camera.resized(image_scale) for name, camera in cameras.items()} if image_scale != 1.0 else cameras
        self.frames = frames
        self.image_scale = image_scale
        self._stored_cameras = cameras
        self.images: ImageStore = FolderImages(path, description.image_extension)
        if description.images_from is not None:
            self.images = SourceImages(path, description, cameras)
        self.theta = open_frame_array(path, "theta", len(frames))
        self.root = open_frame_array(path, "root", len(frames))
        self.face = open_frame_array(path, "face", len(frames))
        self.keypoints = open_frame_array(path, "keypoints", len(frames))
        self.vertices = open_frame_array(path, "vertices", len(frames))
        self._check_names()

    @classmethod
    def open(cls, path: Path | str, image_scale: float = 1.0) -> "Capture":
        """Open a capture and check what can be checked without decoding images or reading arrays.

        Args:
            path: the capture's folder.
            image_scale: 0 < scale <= 1; images, masks and cameras are resampled by it when read (box filter, in linear light).

        Raises:
            FileNotFoundError: if there is no capture here, it is unfinished, or a file of it is missing.
            ValueError: for a file that cannot be used; names the file, what was expected, and the remedy.
        """
        path = Path(path)
        if not 0 < image_scale <= 1:
            raise ValueError(f"Capture.open(): expected 0 < image_scale <= 1; got {image_scale}. Captures are only ever made smaller.")
        if not path.is_dir():
            raise FileNotFoundError(f"Capture.open(): expected a capture's folder at {path}; got none. Check the path.")
        if not (path / DESCRIPTION_FILE).is_file():
            raise FileNotFoundError(_why_not_a_capture(path))
        description = load_description(path / DESCRIPTION_FILE)
        return cls(path, description, load_cameras(path / CAMERAS_FILE), load_frames(path / FRAMES_FILE), image_scale)

    def __reduce__(self):
        """Workers of a data loader open the capture again: pickling a memory map would copy the whole array."""
        return Capture.open, (self.path, self.image_scale)

    @property
    def rig_path(self) -> Path:
        """Where the rig lies, or would lie: the capture may have none."""
        return self.path / self.description.rig

    def encoded_image(self, camera_name: str, frame_index: int) -> EncodedImage:
        """Decode an image file: [H, W, 3] as stored and at stored size, uint8 or, for exr, float32.

        Raises:
            FileNotFoundError: if the image is missing.
            ValueError: if the file is truncated or its size is not the camera's.
        """
        return self.images.image(self.stored_camera(camera_name), self._frame(frame_index).number)

    def image(self, camera_name: str, frame_index: int) -> Float32[np.ndarray, "H W 3"]:
        """Linear values of an image [H, W, 3], where 1 is the file's white; at the size of `cameras`. Raises as `encoded_image`."""
        linear = self.images.linear(self.stored_camera(camera_name), self._frame(frame_index).number, self.description.colour_curve)
        return self._resampled(linear, camera_name)

    def display_image(self, camera_name: str, frame_index: int) -> Float32[np.ndarray, "H W 3"]:
        """Display-encoded (sRGB) values of an image [H, W, 3], at the size of `cameras`; as stored, where the file holds just that.

        Raises as `encoded_image`.
        """
        if self.description.colour_curve == "srgb" and self.image_scale == 1.0:
            return self.encoded_image(camera_name, frame_index).astype(np.float32) / np.float32(255.0)
        return encode(self.image(camera_name, frame_index), "srgb")

    def mask(self, camera_name: str, frame_index: int) -> Float32[np.ndarray, "H W"]:
        """Coverage of the person [H, W], 0 background to 1 person; at the size of `cameras`. Raises as `encoded_image`."""
        stored = self.images.mask(self.stored_camera(camera_name), self._frame(frame_index).number)
        return self._resampled((stored.astype(np.float32) / np.float32(255.0))[..., None], camera_name)[..., 0]

    def background(self, camera_name: str) -> Float32[np.ndarray, "H W 3"] | None:
        """Linear values [H, W, 3] of what a camera sees without the person: its plate, else the uniform background; None if unknown.

        Raises:
            ValueError: if the plate is truncated or its size is not the camera's.
        """
        camera = self.cameras[self.stored_camera(camera_name).name]
        plate = self.images.background(self.stored_camera(camera_name))
        if plate is not None:
            return self._resampled(decoded(plate, self.description.colour_curve), camera_name)
        if self.description.background is None:
            return None
        return np.broadcast_to(np.array(self.description.background, np.float32), (camera.height, camera.width, 3))

    def frame_indices(self, split: str | None = None, segment: str | None = None) -> list[int]:
        """Indices of the frames of a split and a segment, in order; None means all.

        Frames of stress segments belong to the split "stress" here, whatever their own is: see `Frame.purpose`.

        Raises:
            ValueError: for a split or segment that the capture does not have.
        """
        for kind, attribute, wanted in (("split", "purpose", split), ("segment", "segment", segment)):
            known = sorted({getattr(frame, attribute) for frame in self.frames})
            if wanted is not None and wanted not in known:
                raise ValueError(
                    f"Capture.frame_indices(): expected a {kind} of {known} in {self.path}; got {wanted!r}. Choose one of them."
                )
        return [i for i, frame in enumerate(self.frames) if split in (None, frame.purpose) and segment in (None, frame.segment)]

    def camera_names(self, held_out: bool | None = None) -> list[str]:
        """Names of all cameras (None), of those that training may see (False), or of the held-out ones (True), in file order."""
        return [name for name in self.cameras if held_out is None or (name in self.description.held_out_cameras) == held_out]

    def stored_camera(self, name: str) -> Camera:
        """The camera at the size of its image files, whatever `image_scale` is.

        Raises:
            ValueError: for an unknown name; suggests the nearest.
        """
        if name not in self._stored_cameras:
            nearest = difflib.get_close_matches(name, self._stored_cameras, n=1, cutoff=0.0)[0]
            raise ValueError(f"Capture: expected a camera of {self.path / CAMERAS_FILE}; got {name!r}. Did you mean {nearest!r}?")
        return self._stored_cameras[name]

    def _frame(self, index: int) -> Frame:
        """The frame at an index; negative indices are refused, because they would hide an error of one."""
        if not 0 <= index < len(self.frames):
            raise IndexError(
                f"Capture: expected a frame index in 0..{len(self.frames) - 1} of {self.path / FRAMES_FILE}; got {index}. "
                "Give the row, not the frame's number."
            )
        return self.frames[index]

    def _resampled(self, pixels: Float32[np.ndarray, "h w C"], camera_name: str) -> Float32[np.ndarray, "H W C"]:
        """Average pixels over the area of the larger ones."""
        if self.image_scale == 1.0:
            return pixels
        size = (self.cameras[camera_name].width, self.cameras[camera_name].height)
        channels = [
            Image.fromarray(np.ascontiguousarray(channel)).resize(size, Image.Resampling.BOX) for channel in np.moveaxis(pixels, -1, 0)
        ]
        return np.stack([np.asarray(channel) for channel in channels], axis=-1)

    def _check_names(self) -> None:
        """Refuse names in capture.yaml that do not match cameras or arrays."""
        unknown = [name for name in self.description.held_out_cameras if name not in self.cameras]
        if unknown:
            raise ValueError(
                f"Capture.open(): expected held_out_cameras of {self.path / DESCRIPTION_FILE} in cameras.json; got unknown {unknown}. "
                f"Known are {list(self.cameras)}."
            )
        for key, array, name in (("face_names", self.face, "face"), ("keypoint_names", self.keypoints, "keypoints")):
            names = getattr(self.description, key)
            if names and array is not None and len(names) != array.shape[1]:
                raise ValueError(
                    f"Capture.open(): expected a name for each of the {array.shape[1]} columns of "
                    f"{self.path / FRAME_ARRAYS[name].file_name}; got {len(names)} {key} in "
                    f"{self.path / DESCRIPTION_FILE}. Correct one of the two files."
                )


def _why_not_a_capture(path: Path) -> str:
    """Tell an unfinished capture from a folder that never was one."""
    if (path / UNFINISHED_FILE).is_file():
        return (
            f"Capture.open(): expected a whole capture in {path}; got an unfinished one (no {DESCRIPTION_FILE}). "
            "Run the command that was writing it again: it resumes where it stopped."
        )
    return (
        f"Capture.open(): expected {DESCRIPTION_FILE}, {CAMERAS_FILE} and {FRAMES_FILE} in {path}; got no {DESCRIPTION_FILE}. "
        f"Name a folder in this layout, or a data set as FORMAT:DIR, FORMAT one of {', '.join(FORMAT_NAMES)}."
    )
