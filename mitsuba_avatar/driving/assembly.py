"""From tracks of body and face to driving signals of one avatar: the same frames, the face signal that it was trained on.

Symbols: N frames, D pose angles, F entries of the face signal. Radians, metres.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from mitsuba_avatar.body.anny_rig import is_anny
from mitsuba_avatar.body.rig import Rig, load_rig
from mitsuba_avatar.captures.description import load_description
from mitsuba_avatar.captures.folder import DESCRIPTION_FILE, Capture
from mitsuba_avatar.driving.face_signals import FaceKind, FaceModel, converted
from mitsuba_avatar.driving.signals import DrivingSignals
from mitsuba_avatar.driving.sources import BodyTrack, FaceTrack, neutral_landmarks
from mitsuba_avatar.model.avatar import Avatar
from mitsuba_avatar.training.run_folder import RunFolder


@dataclass(frozen=True, eq=False)  # tensors have no truth value to compare by
class AssembledDrive:
    """What drives an avatar.

    Attributes:
        signals: of all frames.
        setting: "matched" where the capture that the avatar learnt from drives it, otherwise "unmatched".
        notes: what was assumed and converted, for the user.
    """

    signals: DrivingSignals
    setting: str
    notes: tuple[str, ...]


def trained_face(run: RunFolder) -> FaceKind:
    """What the face signal of a run's avatar holds: as its capture says, or where that is gone, as its size suggests."""
    path = run.capture_path / DESCRIPTION_FILE
    if path.is_file():
        return FaceKind.of_capture(load_description(path), run.face_size)
    landmarks = FaceKind.of_rig(run.rig)
    if len(landmarks.names) == run.face_size:
        return landmarks
    return FaceKind("action_codes", tuple(str(entry) for entry in range(run.face_size)))


def assemble(
    run: RunFolder, avatar: Avatar, body: BodyTrack, face: FaceTrack | None, training: Callable[[], DrivingSignals]
) -> AssembledDrive:
    """Put body and face together.

    Args:
        run: of the avatar.
        avatar: whose mean training face stands in where nothing moves the face.
        body: what moves the body.
        face: what moves the face, or None.
        training: gives the training frames' signals; called only where action codes are turned into landmarks or back, which needs the
            person's neutral face.

    Raises:
        ValueError: the face signal cannot be turned into what the avatar was trained on, or has another number of frames.
    """
    count, rig, wanted = len(body.theta), run.rig, trained_face(run)
    notes = list(body.notes)
    if face is None:
        values = np.tile(avatar.standardize_face.mean.cpu().double().numpy(), (count, 1))
        notes.append("no face given: the face keeps the mean of the training frames")
    else:
        values, found = _face_values(face, body, count)
        notes += found
        if face.kind.signal != wanted.signal:
            model = FaceModel.of_rig(rig, _landmarks(wanted, training)) if is_anny(rig) else None
            notes.append(f"face: {face.kind.signal} turned into {wanted.signal} through the rig's facial actions")
        else:
            model = None
            values = _on_this_face(values, face, wanted, rig)
        values = converted(values, face.kind, wanted, model, rig)
        if values.shape[1] != run.face_size:
            raise ValueError(
                f"assemble(): expected a face signal of {run.face_size} numbers, as the avatar was trained on; got {values.shape[1]}. "
                "Use a signal of the same kind."
            )
    signals = DrivingSignals(
        torch.from_numpy(np.asarray(body.theta, np.float32)),
        torch.from_numpy(np.asarray(body.root, np.float32)),
        torch.from_numpy(np.asarray(values, np.float32)),
        body.fps,
        body.clips,
    )
    captures = [track.capture for track in (body, face) if track is not None]
    is_matched = all(capture is not None and capture.path.resolve() == run.capture_path.resolve() for capture in captures)
    return AssembledDrive(signals, "matched" if is_matched else "unmatched", tuple(dict.fromkeys(notes)))


def _face_values(face: FaceTrack, body: BodyTrack, count: int) -> tuple[Float[np.ndarray, "N F"], list[str]]:
    """A row for each frame of the body, and notes."""
    values, duration = face.values, count / body.fps
    is_same = face.capture is not None and body.capture is not None and face.capture.path.resolve() == body.capture.path.resolve()
    if is_same and len(values) >= count:
        return values[:count], []
    if len(values) == 1:
        return np.repeat(values, count, axis=0), ["face: one frame, held"]
    end = float(face.recording.times[-1])
    note = f"face: {end:.1f} s of {face.recording.name}" + (" played back and forth" if end + 1 / body.fps < duration - 1e-6 else "")
    return face.recording.at(np.arange(count) / body.fps), [note]


def _landmarks(wanted: FaceKind, training: Callable[[], DrivingSignals]) -> Float[np.ndarray, "T K3"] | None:
    """Landmarks of the training frames, where the avatar was trained on landmarks."""
    return training().face.numpy() if wanted.signal == "keypoints" else None


def _on_this_face(values: Float[np.ndarray, "N F"], face: FaceTrack, wanted: FaceKind, rig: Rig) -> Float[np.ndarray, "N F"]:
    """Landmarks of another body of the same rig carried over: their offset from that body's face at rest, added to this one's."""
    if wanted.signal != "keypoints" or face.capture is None:
        return values
    other, own = _rig_of(face.capture), neutral_landmarks(rig)
    if other is None or not values.shape[1] == 3 * len(other.face_keypoint_vertices) == len(own):
        return values  # not the rig's landmarks
    return values + own - neutral_landmarks(other)


def _rig_of(capture: Capture) -> Rig | None:
    return load_rig(capture.rig_path) if capture.rig_path.is_file() else None
