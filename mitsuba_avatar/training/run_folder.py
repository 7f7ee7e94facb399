"""A run on disk: everything that `fit` writes, and all that is needed to use the avatar without its capture.

```
settings.yaml        resolved settings
rig.npz              the capture's rig
run.json             capture path, face signal's size, versions
metrics.jsonl        one line per logged iteration
checkpoints/         see training/checkpoints.py
camera_response.json what was learnt of each camera, if anything was
previews/            panels drawn during training
pictures/            held-out cameras, comparison with the baselines, curves
orbit.mp4            the avatar driven by the test split, on an orbit
metrics.json         what the evaluation measured
```
"""

import dataclasses
import json
from importlib.metadata import version
from pathlib import Path

from mitsuba_avatar import __version__
from mitsuba_avatar.body.rig import Rig, load_rig, save_rig
from mitsuba_avatar.captures.folder import Capture
from mitsuba_avatar.captures.formats.opening import SourceName
from mitsuba_avatar.files import atomic_path, check_writable
from mitsuba_avatar.model.avatar import Avatar, DrivingStatistics
from mitsuba_avatar.presets import load_settings, save_settings
from mitsuba_avatar.settings import Settings
from mitsuba_avatar.training.checkpoints import Checkpoints
from mitsuba_avatar.training.readiness import open_as_set

CAMERA_RESPONSE_FILE = "camera_response.json"
VERSIONED = ("mitsuba", "drjit", "torch", "numpy")


class RunFolder:
    """Paths and parts of one run. Make one with `create`, read one with `open`."""

    def __init__(self, path: Path, settings: Settings, rig: Rig, capture_path: Path, face_size: int):
        self.path, self.settings, self.rig = path, settings, rig
        self.capture_path, self.face_size = capture_path, face_size
        self.checkpoints = Checkpoints(path / "checkpoints", rig.fingerprint)

    @staticmethod
    def check_free(path: Path) -> None:
        """Check that a run can be written here, without writing anything.

        Raises:
            FileExistsError: the folder holds a run with a checkpoint.
            PermissionError: the folder cannot be made or written.
        """
        if (path / "checkpoints" / "checkpoints.json").exists():
            raise FileExistsError(
                f"RunFolder: expected a new run at {path}; got one. Continue it with --resume, or name another with --run."
            )
        check_writable(path)

    @staticmethod
    def create(path: Path, settings: Settings, rig: Rig, capture_path: Path, face_size: int) -> "RunFolder":
        """Write the start of a run; raises as `check_free`."""
        RunFolder.check_free(path)
        save_rig(path / "rig.npz", rig)
        facts = {
            "capture": str(capture_path.resolve()),
            "face_size": face_size,
            "versions": {"mitsuba_avatar": __version__} | {name: version(name) for name in VERSIONED},
        }
        with atomic_path(path / "run.json") as temporary:
            temporary.write_text(json.dumps(facts, indent=2))
        save_settings(path / "settings.yaml", settings)
        return RunFolder(path, settings, rig, capture_path, face_size)

    @staticmethod
    def open(path: Path | str) -> "RunFolder":
        """Read a run.

        Raises:
            FileNotFoundError: the folder holds no run.
            ValueError: a file of it is damaged.
        """
        path = Path(path)
        for name in ("settings.yaml", "rig.npz", "run.json"):
            if not (path / name).exists():
                raise FileNotFoundError(f"RunFolder.open(): expected a run with {name} in {path}; got none. Name a folder that fit wrote.")
        settings, rig = load_settings(path / "settings.yaml"), load_rig(path / "rig.npz")
        try:
            facts = json.loads((path / "run.json").read_text())
            return RunFolder(path, settings, rig, Path(facts["capture"]), facts["face_size"])
        except (ValueError, KeyError) as error:
            raise ValueError(
                f"RunFolder.open(): expected capture and face_size in {path / 'run.json'}; got: {error!r}. Restore the file."
            ) from error

    def open_capture(self) -> Capture:
        """The capture that the run was trained on, with the run's scale and held-out cameras.

        Raises:
            FileNotFoundError, ValueError: it is gone, or cannot be used.
        """
        is_in_place = SourceName.parse(self.settings.capture.path) is not None  # its folder in the cache may be gone
        return open_as_set(self.settings.capture.path if is_in_place else self.capture_path, self.settings.capture)

    def check_capture(self, capture: Capture, rig: Rig) -> None:
        """Check that a capture shows the body that the run was trained on.

        Raises:
            ValueError: it has another rig, or another face signal.
        """
        if rig.fingerprint != self.rig.fingerprint:
            raise ValueError(
                f"RunFolder: expected the rig of run {self.path} (fingerprint {self.rig.fingerprint[:12]}) in {capture.rig_path}; "
                f"got {rig.fingerprint[:12]}. Use a capture of the rig that the avatar was trained on, or train anew."
            )
        if capture.face is None or capture.face.shape[1] != self.face_size:
            got = "none" if capture.face is None else capture.face.shape[1]
            raise ValueError(
                f"RunFolder: expected a face signal of {self.face_size} numbers, as run {self.path} was trained on, in {capture.path}; "
                f"got {got}. Use a capture with the same face signal, or train anew."
            )

    def with_settings(self, settings: Settings) -> "RunFolder":
        """The run continued with other settings, which are saved with it.

        Raises:
            ValueError: the model's settings differ from the trained avatar's.
        """
        was, wanted = dataclasses.asdict(self.settings.model), dataclasses.asdict(settings.model)
        changed = [f"model.{name} {was[name]} -> {wanted[name]}" for name in was if was[name] != wanted[name]]
        if changed:
            raise ValueError(
                f"RunFolder: expected the model of run {self.path}; got {', '.join(changed)}. A trained model keeps its sizes: train anew."
            )
        save_settings(self.path / "settings.yaml", settings)
        return RunFolder(self.path, settings, self.rig, self.capture_path, self.face_size)

    def load_avatar(self, which: str = "last") -> Avatar:
        """The avatar of the "best" or "last" checkpoint, ready to be driven (evaluation mode).

        Raises:
            FileNotFoundError, ValueError: no checkpoint, or a damaged one; see `Checkpoints`.
        """
        state = self.checkpoints.load_avatar(which)
        model = self.settings.model
        avatar = Avatar(self.rig, model, DrivingStatistics.neutral(self.rig, self.face_size, model.texture_size))
        try:
            avatar.load_state_dict(state)
        except RuntimeError as error:  # torch lists every tensor that does not fit, a line each
            raise ValueError(
                f"load_avatar(): expected weights of the model of {self.path / 'settings.yaml'} in {self.checkpoints.folder}; got others: "
                f"{' '.join(str(error).split()[:30])} ... Restore settings.yaml, or train anew."
            ) from error
        return avatar.eval()

    @property
    def previews(self) -> Path:
        """Folder of the panels drawn during training."""
        return self.path / "previews"

    @property
    def pictures(self) -> Path:
        """Folder of the final pictures."""
        return self.path / "pictures"

    @property
    def log_path(self) -> Path:
        """Metrics of every logged iteration."""
        return self.path / "metrics.jsonl"

    @property
    def metrics_path(self) -> Path:
        """What the evaluation measured."""
        return self.path / "metrics.json"
