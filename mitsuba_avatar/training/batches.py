"""Training batches: a few poses, several views of each, decoded ahead of time and the same for every run with the same seed.

What iteration i sees depends on the seed and i alone, so that a resumed run continues the same curve, and ranks of a distributed run
take disjoint slices of one global batch. Symbols: P poses, N views a pose, B = P * N images.

Cameras may differ in size. All are drawn on one film of the largest width W and height H, so that nothing is built or compiled anew; an
image lies in its upper left corner, and what lies beyond is zero and counts nowhere (`FrameBatch.within_views`).
"""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mitsuba_avatar.captures.arrays import FRAME_ARRAYS
from mitsuba_avatar.captures.cameras import film_size
from mitsuba_avatar.captures.colour import encode
from mitsuba_avatar.captures.folder import CAMERAS_FILE, Capture
from mitsuba_avatar.rendering.ambient_occlusion import FrameOcclusion
from mitsuba_avatar.rendering.cameras import CameraBatch
from mitsuba_avatar.rendering.occlusion_ahead import OcclusionAhead
from mitsuba_avatar.settings import TrainingSettings
from mitsuba_avatar.training.distributed import Process

AHEAD = 2  # batches decoded in advance: enough to hide the disk, little memory


@dataclass(frozen=True)
class FrameBatch:
    """P poses, N views each; images are pose-major. What only pictures need is None where none were read (`FrameReader.read_surfaces`).

    Attributes:
        frames: P frame indices.
        camera_names: P lists of N names.
        theta: [P, D] radians. root: [P, 4, 4]. face: [P, F].
        vertices: [P, V, 3] registered mesh, metres; None where the capture has none.
        ambient_occlusion: [P, 1, S, S]; None without pictures.
        images: [B, 3, H, W] display-encoded (sRGB), as losses and metrics compare them. masks: [B, 1, H, W]. None without pictures.
        backgrounds: [B, 3, H, W] linear radiance; None without pictures.
        cameras: B cameras; None without pictures.
        sizes: (width, height) of the B images; images, masks and backgrounds are zero beyond. None without pictures.
    """

    frames: list[int]
    camera_names: list[list[str]]
    theta: Float[Tensor, "P D"]
    root: Float[Tensor, "P 4 4"]
    face: Float[Tensor, "P F"]
    vertices: Float[Tensor, "P V 3"] | None
    ambient_occlusion: Float[Tensor, "P 1 S S"] | None = None
    images: Float[Tensor, "B 3 H W"] | None = None
    masks: Float[Tensor, "B 1 H W"] | None = None
    backgrounds: Float[Tensor, "B 3 H W"] | None = None
    cameras: CameraBatch | None = None
    sizes: list[tuple[int, int]] | None = None

    @property
    def camera_centers(self) -> Float[Tensor, "P N 3"]:
        """[P, N, 3] metres, world axes."""
        return self.cameras.centers.view(len(self.frames), -1, 3).to(self.theta.device)

    def within_views(self, values: Float[Tensor, "B C H W"]) -> Float[Tensor, "B C H W"]:
        """Rendered values with zeros beyond each view's image, as the batch's own have them: no loss then looks there.

        Gradients: to the values within.
        """
        height, width = values.shape[2:]
        if all(size == (width, height) for size in self.sizes):
            return values
        widths, heights = torch.tensor(self.sizes, device=values.device).unbind(1)
        columns, rows = torch.arange(width, device=values.device), torch.arange(height, device=values.device)
        is_inside = (columns < widths[:, None])[:, None, None] & (rows < heights[:, None])[:, None, :, None]
        return torch.where(is_inside, values, 0.0)

    def pictures(self, values: Float[Tensor, "B C H W"]) -> list[Float[np.ndarray, "h w C"]]:
        """Images of the batch as numpy has them, each [h, w, C] at its own camera's size, from any device."""
        return [
            values[row, :, :height, :width].permute(1, 2, 0).contiguous().cpu().numpy() for row, (width, height) in enumerate(self.sizes)
        ]

    def coverage(self, masks: Float[Tensor, "B 1 H W"]) -> list[Float[np.ndarray, "h w"]]:
        """Masks of the batch as numpy has them, each [h, w] at its own camera's size."""
        return [picture[..., 0] for picture in self.pictures(masks)]

    def to(self, device: torch.device) -> "FrameBatch":
        """The batch with its tensors on a device; cameras stay with the host, which only the renderer's set-up reads."""
        tensors = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        moved = {name: value.to(device) for name, value in tensors.items() if isinstance(value, Tensor)}
        return dataclasses.replace(self, **moved)


BatchReader = Callable[[list[int], list[list[str]]], FrameBatch]  # from frames and the names of the cameras that see each


class FrameReader:
    """Reads chosen frames and views of a capture as a batch.

    Attributes:
        width, height: of the film that holds every camera's image.

    Raises:
        FileNotFoundError, ValueError: the capture cannot be read as batches; see `check_readable`.
    """

    def __init__(self, capture: Capture, occlusion: FrameOcclusion | OcclusionAhead):
        check_readable(capture)
        self.capture, self.occlusion = capture, occlusion
        self.width, self.height = film_size(capture.cameras.values())

    def read(self, frames: list[int], camera_names: list[list[str]]) -> FrameBatch:
        """Decode the images of P frames, N cameras each; raises what `Capture.image` raises, naming the file."""
        capture = self.capture
        images, masks, backgrounds, cameras = [], [], [], []
        for frame, names in zip(frames, camera_names, strict=True):
            for name in names:
                mask = capture.mask(name, frame)
                background = capture.background(name)
                if background is None:
                    background = np.zeros((*mask.shape, 3), np.float32)
                    images.append(encode(composited(capture.image(name, frame), mask, None), "srgb"))
                else:
                    images.append(capture.display_image(name, frame))
                masks.append(mask)
                backgrounds.append(background)
                cameras.append(capture.cameras[name])
        return dataclasses.replace(
            self.read_surfaces(frames, camera_names),
            ambient_occlusion=self.occlusion.maps(frames),
            images=stacked_views(images, self.width, self.height),
            masks=stacked_views([mask[..., None] for mask in masks], self.width, self.height),
            backgrounds=stacked_views(backgrounds, self.width, self.height),
            cameras=CameraBatch.from_cameras(cameras),
            sizes=[(camera.width, camera.height) for camera in cameras],
        )

    def read_surfaces(self, frames: list[int], camera_names: list[list[str]]) -> FrameBatch:
        """The same batch without what only pictures need; opens no image and bakes no occlusion."""
        capture = self.capture
        return FrameBatch(
            frames=frames,
            camera_names=camera_names,
            theta=_rows(capture.theta, frames),
            root=_rows(capture.root, frames),
            face=_rows(capture.face, frames),
            vertices=None if capture.vertices is None else _rows(capture.vertices, frames),
        )


def check_driving(capture: Capture) -> None:
    """Check that a capture can drive an avatar.

    Raises:
        FileNotFoundError: a driving signal is missing.
    """
    missing = [FRAME_ARRAYS[name].file_name for name in ("theta", "root", "face") if getattr(capture, name) is None]
    if missing:
        raise FileNotFoundError(
            f"check_driving(): expected {', '.join(missing)} in {capture.path}; got none. An avatar is driven by them: add the files."
        )


def check_readable(capture: Capture) -> None:
    """Check that a capture has what a batch holds; opens no image.

    Raises:
        FileNotFoundError: a driving signal or the masks are missing.
        ValueError: a camera is distorted.
    """
    check_driving(capture)
    if not capture.images.has_masks:
        raise FileNotFoundError(
            f"check_readable(): expected masks in {capture.images.masks_place}; got none. Segment the person in every image first."
        )
    capture.images.require()
    distorted = [name for name, camera in capture.cameras.items() if camera.is_distorted]
    if distorted:
        raise ValueError(
            f"check_readable(): expected pinhole cameras in {capture.path / CAMERAS_FILE}; got distortion for {distorted}. "
            "Undistort the images and leave the coefficients out."
        )


class BatchSampler:
    """Which frames and cameras each iteration sees.

    Frames come in a fresh random order each pass over the capture; cameras of a frame are drawn without repetition.

    Args:
        frames: indices to draw from.
        camera_names: cameras to draw from.
        poses, views: P of the *global* batch, N.
        seed: base seed.
        rank, num_ranks: this process's slice of the poses.
    """

    def __init__(self, frames: list[int], camera_names: list[str], poses: int, views: int, seed: int, rank: int = 0, num_ranks: int = 1):
        if poses % num_ranks:
            raise ValueError(
                f"BatchSampler(): {poses} poses a batch cannot be shared by {num_ranks} processes. "
                "Make training.poses_per_batch a multiple of the number of processes."
            )
        if views > len(camera_names):
            raise ValueError(
                f"BatchSampler(): training.views_per_pose is {views}, but the capture has {len(camera_names)} training cameras. Lower it."
            )
        self.frames, self.camera_names = frames, camera_names
        self.poses, self.views, self.seed = poses, views, seed
        self.rank, self.num_ranks = rank, num_ranks

    def draw(self, iteration: int) -> tuple[list[int], list[list[str]]]:
        """Frames and camera names of an iteration, this rank's share."""
        cameras = np.random.default_rng([self.seed, 1, iteration])
        frames, names = [], []
        for slot in range(iteration * self.poses, (iteration + 1) * self.poses):
            order = np.random.default_rng([self.seed, 0, slot // len(self.frames)]).permutation(len(self.frames))
            frames.append(self.frames[order[slot % len(self.frames)]])
            names.append([self.camera_names[i] for i in cameras.permutation(len(self.camera_names))[: self.views]])
        share = self.poses // self.num_ranks
        own = slice(self.rank * share, (self.rank + 1) * share)
        return frames[own], names[own]

    def coming_frames(self, start: int, stop: int) -> Iterator[int]:
        """Frames of iterations start..stop-1 in the order of this rank's batches, for one pass over the capture at most."""
        for iteration in range(start, min(stop, start + -(-len(self.frames) // self.poses))):
            yield from self.draw(iteration)[0]


def training_sampler(capture: Capture, training: TrainingSettings, process: Process) -> BatchSampler:
    """The sampler of a fit: training frames, seen by the cameras that are not held out. Raises as `BatchSampler`."""
    return BatchSampler(
        capture.frame_indices("train"),
        capture.camera_names(held_out=False),
        training.poses_per_batch,
        training.views_per_pose,
        training.seed,
        process.rank,
        process.num_ranks,
    )


def batches(read: BatchReader, sampler: BatchSampler, start: int, stop: int) -> Iterator[FrameBatch]:
    """Batches of iterations start..stop-1, in order; a thread decodes the next ones meanwhile (image decoding releases Python's lock).

    Args:
        read: `FrameReader.read`, or `FrameReader.read_surfaces`.
        sampler: what each iteration sees.
        start, stop: iterations.
    """
    with ThreadPoolExecutor(max_workers=1, thread_name_prefix="batches") as pool:
        waiting: list[Future[FrameBatch]] = []
        try:
            for iteration in range(start, stop):
                while len(waiting) < AHEAD and iteration + len(waiting) < stop:
                    waiting.append(pool.submit(read, *sampler.draw(iteration + len(waiting))))
                yield waiting.pop(0).result()
        finally:
            for future in waiting:
                future.cancel()


def composited(
    image: Float[np.ndarray, "H W 3"], mask: Float[np.ndarray, "H W"], background: Float[np.ndarray, "H W 3"] | None
) -> Float[np.ndarray, "H W 3"]:
    """The image to compare renders with: as captured where the background is known, on black otherwise."""
    return image if background is not None else image * mask[..., None]


def _rows(values: Float[np.ndarray, "N *shape"], frames: list[int]) -> Float[Tensor, "P *shape"]:
    return torch.from_numpy(np.stack([values[i] for i in frames]).astype(np.float32))


def stacked_views(images: Sequence[Float[np.ndarray, "_ _ C"]], width: int, height: int) -> Float[Tensor, "B C H W"]:
    """Images of several sizes on one film: each in the upper left corner, zeros beyond. Pixels keep their coordinates."""
    film = torch.zeros(len(images), images[0].shape[2], height, width)
    for row, image in enumerate(images):
        film[row, :, : image.shape[0], : image.shape[1]] = torch.from_numpy(np.ascontiguousarray(image)).permute(2, 0, 1)
    return film
