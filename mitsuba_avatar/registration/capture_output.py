"""Writing the registered recording as a capture that `python -m mitsuba_avatar.fit` takes."""

from collections.abc import Callable
from pathlib import Path
from typing import Literal

import numpy as np

from mitsuba_avatar.body.rig import save_rig
from mitsuba_avatar.captures.description import CaptureDescription
from mitsuba_avatar.captures.folder import Capture
from mitsuba_avatar.captures.frames import Frame
from mitsuba_avatar.captures.images import read_mask
from mitsuba_avatar.captures.writer import CaptureWriter
from mitsuba_avatar.registration.colour_agreement import ColourAgreement
from mitsuba_avatar.registration.colour_correction import corrected_image, keep_corrections
from mitsuba_avatar.registration.frames import FrameFolder
from mitsuba_avatar.registration.keypoints_2d import LANDMARKS
from mitsuba_avatar.registration.keypoints_3d import PersonKeypoints
from mitsuba_avatar.registration.masks import MaskFolder
from mitsuba_avatar.registration.recording import Recording
from mitsuba_avatar.registration.registration_report import RegistrationQuality
from mitsuba_avatar.registration.settings import OutputSettings
from mitsuba_avatar.registration.silhouette_refinement import RegisteredBody, posed_vertices, sequence_of

RIG_FILE = "rig.npz"


def write_capture(
    out: Path,
    recording: Recording,
    settings: OutputSettings,
    body: RegisteredBody,
    parts: tuple[FrameFolder, MaskFolder, PersonKeypoints, RegistrationQuality, ColourAgreement],
    progress: Callable[[int, int], None],
    before_end: Callable[[], None] = lambda: None,
) -> Capture:
    """Write images, masks and arrays of the kept frames; what is there already is kept, capture.yaml comes last.

    The face signal is neutral: landmarks of the rig at rest, the same in every frame, because no face was tracked.

    Args:
        out: folder of the capture.
        recording: gives the frame rate.
        settings: names, split, held-out cameras.
        body: registered.
        parts: images, masks, keypoints, which frames are kept, and what corrects the cameras' colours.
        progress: called as progress(done, total).
        before_end: writes whatever else belongs into the folder, when all is there but capture.yaml.

    Raises:
        FileExistsError: if the folder holds another capture.
    """
    frames, masks, person, quality, colour = parts
    kept = np.flatnonzero(quality.is_kept)
    rig = body.rig()
    description = CaptureDescription(
        name=settings.name or out.name,
        fps=recording.fps,
        face_signal="keypoints",
        keypoint_names=LANDMARKS,
        held_out_cameras=settings.held_out_cameras,
        licence=settings.licence,
        source=settings.source,
    )
    listed = [
        Frame(int(number), float(number) / recording.fps, split_of(index, len(kept), settings.test_share), "recording")
        for index, number in enumerate(kept)
    ]
    writer = CaptureWriter(out, description, frames.cameras, listed)
    keep_corrections(out, colour)
    for index, number in enumerate(kept.tolist()):
        for name in frames.cameras:
            if not writer.has_image(name, index):
                writer.write_image(name, index, corrected_image(frames.image(name, number), colour.matrices[name]))
            writer.write_mask(name, index, read_mask(masks.mask_path(name, number)))
        progress(index + 1, len(kept))
    sequence = sequence_of(body.fitted)
    landmarks = rig.rest_vertices[rig.face_keypoint_vertices].reshape(1, -1)
    writer.write_arrays(
        theta=body.fitted.theta[kept],
        root=body.fitted.root[kept],
        face=np.repeat(landmarks, len(kept), axis=0),
        keypoints=person.positions[kept],
        vertices=np.concatenate([posed_vertices(body, sequence, [number]).numpy() for number in kept.tolist()]),
    )
    save_rig(out / RIG_FILE, rig)
    before_end()
    return writer.finish()


def split_of(index: int, count: int, test_share: float) -> Literal["train", "test"]:
    """The last share of the frames tests; at least one where any is asked for."""
    tests = max(1, round(test_share * count)) if test_share > 0 else 0
    return "test" if index >= count - tests else "train"
