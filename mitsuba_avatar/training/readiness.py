"""Whether a fit can begin: everything about capture and settings that would otherwise fail after minutes of work."""

import dataclasses
from pathlib import Path

from mitsuba_avatar.body.source_captures import capture_folder
from mitsuba_avatar.captures.folder import Capture
from mitsuba_avatar.settings import CaptureSettings, Settings
from mitsuba_avatar.training.batches import check_readable, training_sampler
from mitsuba_avatar.training.distributed import Process


def open_as_set(path: Path | str, settings: CaptureSettings) -> Capture:
    """Open a capture at the scale, and with the held-out cameras, that the settings ask for.

    Args:
        path: the capture's folder, or FORMAT:DIR (body/source_captures.py).
        settings: of the run; `settings.path` is not read.

    Raises:
        FileNotFoundError, ValueError: the capture cannot be used (see `Capture.open`), or has no camera of a held-out name.
    """
    capture = Capture.open(capture_folder(path), settings.image_scale)
    if settings.held_out_cameras:
        for name in settings.held_out_cameras:
            capture.stored_camera(name)  # refuses unknown names
        capture.description = dataclasses.replace(capture.description, held_out_cameras=settings.held_out_cameras)
    return capture


def check_trainable(capture: Capture, settings: Settings, process: Process) -> None:
    """Check that an avatar can be learnt from a capture with these settings; opens no image.

    Raises:
        FileNotFoundError: a file is missing that these settings need.
        ValueError: the cameras cannot be rendered, or there are too few frames, cameras or poses for a batch.
    """
    check_readable(capture)
    if settings.model.use_latent and capture.vertices is None:
        raise FileNotFoundError(
            f"check_trainable(): expected registered meshes for the encoder in {capture.path / 'vertices.npy'}; got none. "
            "Add the file, or set model.use_latent false."
        )
    if not settings.loss.looks_at_images:
        if capture.vertices is None:
            raise FileNotFoundError(
                f"check_trainable(): expected registered meshes in {capture.path / 'vertices.npy'}, because loss.image and loss.mask "
                "are 0; got none. Add the file, or raise one of the two."
            )
        if process.is_distributed:
            raise ValueError(
                "check_trainable(): expected one process, because loss.image and loss.mask are 0; "
                f"got {process.num_ranks}. Start fit without torchrun."
            )
    if len(capture.frame_indices("train")) < 2:
        raise ValueError(
            f"check_trainable(): expected at least two training frames in {capture.path / 'frames.csv'}; got one. "
            "A mean and a nearest other frame need two."
        )
    training_sampler(capture, settings.training, process)  # refuses batches that cannot be filled
