"""Where driving signals come from: captures, our own arrays, BVH, Live Link Face, action codes of a head-set.

| file | body | face |
|---|---|---|
| a capture's folder, or FORMAT:DIR | its pose and root | its face signal, landmarks or action codes |
| a folder with theta.npy or pose.npy, root.npy, face.npy | the first two | the third |
| .npy | [N, D] pose angles, with root.npy beside it if there is one | [N, F] as trained, or [N, A] action codes |
| .bvh | retargeted | |
| .csv | | Live Link Face, or a table of action codes with a header of ARKit's names |

Symbols: N frames, D pose angles, F entries of the face signal, A facial actions. Radians, metres, seconds.
"""

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from mitsuba_avatar.body.anny_rig import facial_action_displacements, is_anny
from mitsuba_avatar.body.driving import face_keypoints
from mitsuba_avatar.body.rig import Rig, load_rig
from mitsuba_avatar.body.skeleton import Skeleton
from mitsuba_avatar.body.skinning import pose_vertices
from mitsuba_avatar.body.source_captures import capture_folder
from mitsuba_avatar.captures.folder import DESCRIPTION_FILE, Capture
from mitsuba_avatar.driving.face_signals import FaceKind
from mitsuba_avatar.driving.signals import consecutive_runs
from mitsuba_avatar.recordings.bvh import read_bvh
from mitsuba_avatar.recordings.humanoid import Humanoid
from mitsuba_avatar.recordings.live_link import FaceRecording, read_live_link
from mitsuba_avatar.recordings.retargeting import retarget

FASTEST_BVH = 30.0  # frames per second that recordings are read at, unless asked for otherwise


@dataclass(frozen=True, eq=False)  # arrays have no truth value to compare by
class BodyTrack:
    """Pose angles and root over time.

    Attributes:
        theta: [N, D] radians. root: [N, 4, 4].
        fps: frames per second.
        clips: runs of frames that follow each other.
        capture: that it was read from, and frames: its frame indices; None and empty for other sources.
        notes: for the user.
    """

    theta: Float[np.ndarray, "N D"]
    root: Float[np.ndarray, "N 4 4"]
    fps: float
    clips: tuple[slice, ...]
    capture: Capture | None = None
    frames: tuple[int, ...] = ()
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)  # arrays have no truth value to compare by
class FaceTrack:
    """A face signal over time: `recording.strengths` are its values, whatever their kind."""

    kind: FaceKind
    recording: FaceRecording
    capture: Capture | None = None

    @property
    def values(self) -> Float[np.ndarray, "N F"]:
        """[N, F] as recorded."""
        return self.recording.strengths


def load_body(path: Path | str, rig: Rig, fps: float = 0.0, split: str = "test", seconds: float = 0.0) -> BodyTrack:
    """Read what moves the body.

    Args:
        path: see the table of this module.
        rig: of the avatar.
        fps: frames per second to read a recording at, and of arrays, which do not say theirs; 0 for the source's own (arrays: 10).
        split: of a capture's frames: "train", "validation", "test", "stress" or "all".
        seconds: read no more than this; 0 for all.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file holds no motion, or not one of this rig.
    """
    path = capture_folder(path)
    if (path / DESCRIPTION_FILE).is_file():
        track = _body_of_capture(path, rig, split)
    elif path.suffix.lower() == ".bvh":
        track = _body_of_bvh(path, rig, fps, seconds)
    elif path.is_dir() or path.suffix.lower() == ".npy":
        track = _body_of_arrays(path, rig, fps or 10.0)
    elif not path.exists():
        raise FileNotFoundError(f"load_body(): expected a capture, .bvh or .npy at {path}; there is none. Check the path.")
    else:
        raise ValueError(f"load_body(): expected a capture, .bvh or .npy; got {path}. Convert the motion to one of these.")
    count = int(seconds * track.fps + 1e-6) if seconds else len(track.theta)
    if count < 1:
        raise ValueError(f"load_body(): expected at least one frame in {seconds} s at {track.fps:g} fps of {path}; got none. Ask for more.")
    if count >= len(track.theta):
        return track
    clips = tuple(slice(clip.start, min(clip.stop, count)) for clip in track.clips if clip.start < count)
    return BodyTrack(track.theta[:count], track.root[:count], track.fps, clips, track.capture, track.frames[:count], track.notes)


def load_face(path: Path | str, wanted: FaceKind, fps: float, split: str = "test") -> FaceTrack:
    """Read what moves the face.

    Args:
        path: see the table of this module.
        wanted: what the avatar was trained on: arrays with that many columns are taken for it.
        fps: of arrays and tables, which do not say theirs.
        split: of a capture's frames.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file holds no face signal.
    """
    path = capture_folder(path)
    if (path / DESCRIPTION_FILE).is_file():
        capture = Capture.open(path)
        if capture.face is None:
            raise FileNotFoundError(f"load_face(): expected face.npy in {path}; got none. Name another face, or none.")
        frames = capture.frame_indices(None if split == "all" else split)
        values = np.array(capture.face[frames], np.float64)
        kind = FaceKind.of_capture(capture.description, values.shape[1])
        return FaceTrack(kind, _recording(path, kind.names, values, capture.description.fps), capture)
    if path.is_dir():
        path = path / "face.npy"
    if path.suffix.lower() == ".csv":
        return _face_of_table(path, fps)
    if not path.is_file():
        raise FileNotFoundError(f"load_face(): expected a capture, .npy or .csv at {path}; there is none. Check the path.")
    if path.suffix.lower() != ".npy":
        raise ValueError(f"load_face(): expected a capture, .npy or .csv; got {path}. Convert the face signal to one of these.")
    values = _array(path, 2).astype(np.float64)
    return FaceTrack(_kind_of_array(path, values, wanted), _recording(path, wanted.names, values, fps))


def standing_on_floor(
    rig: Rig,
    theta: Float[np.ndarray, "N D"],
    root: Float[np.ndarray, "N 4 4"],
    clearance: Float[np.ndarray, "N"],  # noqa: F821
) -> Float[np.ndarray, "N 4 4"]:
    """The root raised or lowered so that the lowest point of every posed frame is `clearance` metres above z = 0."""
    skeleton, weights = Skeleton(rig), torch.from_numpy(rig.skinning_weights)
    rest, root = torch.from_numpy(rig.rest_vertices)[None], root.copy()
    with torch.no_grad():
        for frame in range(len(root)):
            transforms = skeleton(torch.from_numpy(theta[frame : frame + 1]), torch.from_numpy(root[frame : frame + 1]))
            root[frame, 2, 3] += clearance[frame] - float(pose_vertices(rest, transforms, weights)[..., 2].min())
    return root


def neutral_landmarks(rig: Rig) -> Float[np.ndarray, "K3"]:  # noqa: F821
    """[3 K] landmarks of a rig at rest, metres: what the landmarks of one body differ from another's by."""
    return face_keypoints(rig, torch.from_numpy(rig.rest_vertices)[None])[0].double().numpy()


def _body_of_capture(path: Path, rig: Rig, split: str) -> BodyTrack:
    capture = Capture.open(path)
    missing = [name for name in ("theta", "root") if getattr(capture, name) is None]
    if missing:
        raise FileNotFoundError(f"load_body(): expected {' and '.join(missing)} in {path}; got none. Add the files to the capture.")
    names = load_rig(capture.rig_path).dofs.names
    if names != rig.dofs.names:
        differing = sorted(set(names) ^ set(rig.dofs.names))
        raise ValueError(
            f"load_body(): expected the pose angles of the avatar's rig {rig.name!r} in {path}; got others: "
            f"{', '.join(differing[:4]) or 'another order'}{', ...' if len(differing) > 4 else ''}. Use a capture of the same rig."
        )
    frames = capture.frame_indices(None if split == "all" else split)
    clips = consecutive_runs(frames, [capture.frames[frame].segment for frame in frames])
    theta, root = np.array(capture.theta[frames], np.float32), np.array(capture.root[frames], np.float32)
    return BodyTrack(theta, root, capture.description.fps, clips, capture, tuple(frames))


def _body_of_bvh(path: Path, rig: Rig, fps: float, seconds: float) -> BodyTrack:
    recording = read_bvh(path)
    if not is_anny(rig):
        raise ValueError(
            f"load_body(): expected an avatar on the Anny rig for {path}; got {rig.name!r}. Drive it with its own pose angles."
        )
    person = Humanoid.of(recording)
    rate = fps or min(FASTEST_BVH, 1 / person.recording.frame_time)
    count = int((person.recording.duration - person.start) * rate + 1e-6) + 1
    if seconds:
        count = max(1, min(count, int(seconds * rate + 1e-6)))
    moved = retarget(rig, person, person.start + np.arange(count) / rate)
    root = standing_on_floor(rig, moved.theta, moved.root, moved.clearance)
    return BodyTrack(moved.theta, root, rate, (slice(0, count),), notes=(*moved.notes, moved.summary()))


def _body_of_arrays(path: Path, rig: Rig, fps: float) -> BodyTrack:
    folder = path if path.is_dir() else path.parent
    if path.is_dir():
        found = [folder / name for name in ("theta.npy", "pose.npy") if (folder / name).is_file()]
        if not found:
            raise FileNotFoundError(
                f"load_body(): expected {DESCRIPTION_FILE}, theta.npy or pose.npy in {folder}; got none. Name another folder."
            )
        path = found[0]
    elif not path.is_file():
        raise FileNotFoundError(f"load_body(): expected pose angles at {path}; there is no such file. Check the path.")
    theta = _array(path, 2)
    if theta.shape[1] != len(rig.dofs.names):
        raise ValueError(
            f"load_body(): expected {len(rig.dofs.names)} pose angles a frame, those of the rig {rig.name!r}, in {path}; got "
            f"{theta.shape[1]}. Write them in the order of the rig's table."
        )
    if (folder / "root.npy").is_file():
        root = _array(folder / "root.npy", 3)
        if root.shape != (len(theta), 4, 4):
            raise ValueError(
                f"load_body(): expected [{len(theta)}, 4, 4] in {folder / 'root.npy'}; got {list(root.shape)}. Save a matrix a frame."
            )
        notes = ()
    else:
        root, notes = np.tile(np.eye(4, dtype=np.float32), (len(theta), 1, 1)), (f"no root.npy beside {path.name}: the root stays",)
    return BodyTrack(theta, root, fps, (slice(0, len(theta)),), notes=notes)


def _face_of_table(path: Path, fps: float) -> FaceTrack:
    if not path.is_file():
        raise FileNotFoundError(f"load_face(): expected a CSV file at {path}; there is none. Check the path.")
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            rows = [row for row in csv.reader(file) if any(cell.strip() for cell in row)]
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"load_face(): expected a CSV file; {path} cannot be read ({error}). Export it again.") from error
    header = [column.strip() for column in rows[0]] if rows else []
    actions = facial_action_displacements()[0]
    if "timecode" in [name.lower() for name in header]:
        known = {name.lower() for name in header}
        recording = read_live_link(path, [name for name in actions if name.lower() in known])
        return FaceTrack(FaceKind("action_codes", recording.action_names), recording)
    wanted = {name.lower(): name for name in actions}
    columns = [place for place, name in enumerate(header) if name.lower() in wanted]
    if not columns or len(rows) < 2:
        raise ValueError(
            f"load_face(): expected a header of ARKit's facial actions, and rows of strengths, in {path}; "
            f"got {','.join(header)[:60]!r} and {max(len(rows) - 1, 0)} rows. Name the columns jawOpen, eyeBlinkLeft, ..."
        )
    try:
        values = np.array([[float(row[place]) for place in columns] for row in rows[1:]])
    except (ValueError, IndexError) as error:
        raise ValueError(f"load_face(): expected numbers in every row of {path}; got: {error}. Correct the table.") from error
    names = tuple(wanted[header[place].lower()] for place in columns)
    return FaceTrack(FaceKind("action_codes", names), _recording(path, names, np.clip(values, 0, 1), fps))


def _kind_of_array(path: Path, values: Float[np.ndarray, "N F"], wanted: FaceKind) -> FaceKind:
    """What an unnamed array holds, by its number of columns."""
    if values.shape[1] == len(wanted.names):
        return wanted
    actions = facial_action_displacements()[0]
    if values.shape[1] == len(actions):
        return FaceKind("action_codes", actions)
    raise ValueError(
        f"load_face(): expected {len(wanted.names)} columns ({wanted.signal}, as the avatar was trained) or {len(actions)} "
        f"(facial actions) in {path}; got {values.shape[1]}. Give action codes under their names in a .csv."
    )


def _recording(path: Path, names: Sequence[str], values: Float[np.ndarray, "N F"], fps: float) -> FaceRecording:
    return FaceRecording(path.stem, tuple(names), np.arange(len(values)) / fps, values)


def _array(path: Path, dimensions: int) -> Float[np.ndarray, "..."]:
    """A whole float array of a file, as float32."""
    try:
        values = np.load(path, allow_pickle=False)
    except (ValueError, EOFError) as error:
        raise ValueError(f"load_body(): expected a plain array in {path}; got: {error}. Save it with numpy.save().") from error
    if values.ndim != dimensions or not np.issubdtype(values.dtype, np.number) or len(values) == 0 or not np.isfinite(values).all():
        raise ValueError(
            f"load_body(): expected finite numbers with {dimensions} axes and a row a frame in {path}; got {values.dtype} "
            f"{list(values.shape)}. Repair the file."
        )
    return values.astype(np.float32)
