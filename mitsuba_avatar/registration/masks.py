"""Masks of all frames and cameras: from plates and graph cuts about the projected body, or those that came with the videos."""

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32
from torch import Tensor

from mitsuba_avatar.captures.images import is_complete, read_mask, write_image, write_mask
from mitsuba_avatar.registration.background import background_plate
from mitsuba_avatar.registration.foreground import bands_of, foreground_mask, soft_mask, widened
from mitsuba_avatar.registration.frames import FrameFolder
from mitsuba_avatar.registration.settings import MaskSettings
from mitsuba_avatar.registration.silhouette_refinement import SilhouetteProblem

# Posed vertices [M, V, 3] of frames.
Poser = Callable[[list[int]], Float32[Tensor, "M V 3"]]


@dataclass(frozen=True, eq=False)
class MaskFolder:
    """Masks as files: `<path>/<camera>/<frame:06d>.png`."""

    path: Path

    def mask_path(self, camera: str, frame: int) -> Path:
        """File of a mask."""
        return self.path / camera / f"{frame:06d}.png"

    def read(self, cameras: Sequence[str], frame: int) -> Float32[np.ndarray, "C H W"]:
        """Coverage 0..1 by some cameras."""
        return np.stack([read_mask(self.mask_path(camera, frame)).astype(np.float32) / np.float32(255) for camera in cameras])


def write_masks(
    folder: MaskFolder,
    frames: FrameFolder,
    problem: SilhouetteProblem,
    pose: Poser,
    settings: MaskSettings,
    progress: Callable[[int, int], None],
) -> None:
    """Cut the person out of every image; files that are there already are kept.

    Args:
        folder: to write to; one for each body that starts the cut.
        frames: images of static cameras.
        problem: draws the body in all cameras of `frames`, in their order.
        pose: the body.
        settings: of this step.
        progress: called as progress(done, total).
    """
    names = list(frames.cameras)
    missing = [frame for frame in range(frames.num_frames) if not all(_is_there(folder.mask_path(name, frame)) for name in names)]
    if not missing:
        return
    plates = _plates(folder, frames, problem, pose, settings)
    for done, frame in enumerate(missing):
        bodies = problem.covered(pose([frame]))[0].numpy()
        for name, body in zip(names, bodies, strict=True):
            plate, is_known = plates[name]
            bands = bands_of(body, settings.margin, settings.certain)
            mask = soft_mask(foreground_mask(frames.image(name, frame), plate, is_known, body, bands))
            write_mask(folder.mask_path(name, frame), np.rint(255 * mask).astype(np.uint8))
        progress(frames.num_frames - len(missing) + done + 1, frames.num_frames)


def copy_given_masks(folder: MaskFolder, frames: FrameFolder, progress: Callable[[int, int], None]) -> None:
    """Take the masks that came with the videos."""
    for frame in range(frames.num_frames):
        for name in frames.cameras:
            path = folder.mask_path(name, frame)
            path.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(frames.mask_path(name, frame), path)
        progress(frame + 1, frames.num_frames)


def _plates(
    folder: MaskFolder, frames: FrameFolder, problem: SilhouetteProblem, pose: Poser, settings: MaskSettings
) -> dict[str, tuple[np.ndarray, Bool[np.ndarray, "H W"]]]:
    """Plate of each camera and where it is known, also written beside the masks for people to look at."""
    chosen = np.unique(np.linspace(0, frames.num_frames - 1, min(settings.plate_frames, frames.num_frames)).round().astype(int)).tolist()
    bodies = np.concatenate([problem.covered(pose([frame])).numpy() for frame in chosen])
    plates = {}
    for index, name in enumerate(frames.cameras):
        covered = [widened(body, bands_of(body, settings.margin, settings.certain).margin) for body in bodies[:, index]]
        plates[name] = background_plate([frames.image(name, frame) for frame in chosen], covered)
        write_image(folder.path / f"plate_{name}.png", plates[name][0])
    return plates


def _is_there(path: Path) -> bool:
    return path.is_file() and is_complete(path)
