"""A run on disk: everything that `fit` writes, and all that is needed to use the avatar without its capture.

```
settings.yaml        resolved settings
rig.npz              the capture's rig
run.json             capture path, face signal's size, versions
metrics.jsonl        one line per logged iteration
checkpoints/         see training/checkpoints.py
previews/            panels drawn during training
pictures/            held-out cameras, comparison with the baselines, curves
orbit.mp4            the avatar driven by the test split, on an orbit
metrics.json         what the evaluation measured
```
"""

import json
from importlib.metadata import version
from pathlib import Path

from mitsuba_avatar import __version__
from mitsuba_avatar.body.rig import Rig, load_rig, save_rig
from mitsuba_avatar.files import atomic_path
from mitsuba_avatar.model.avatar import Avatar, DrivingStatistics
from mitsuba_avatar.presets import load_settings, save_settings
from mitsuba_avatar.settings import Settings
from mitsuba_avatar.training.checkpoints import Checkpoints

VERSIONED = ("mitsuba", "drjit", "torch", "numpy")


class RunFolder:
    """Paths and parts of one run. Make one with `create`, read one with `open`."""

    def __init__(self, path: Path, settings: Settings, rig: Rig, capture_path: Path, face_size: int):
        self.path, self.settings, self.rig = path, settings, rig
        self.capture_path, self.face_size = capture_path, face_size
        self.checkpoints = Checkpoints(path / "checkpoints", rig.fingerprint)

    @staticmethod
    def create(path: Path, settings: Settings, rig: Rig, capture_path: Path, face_size: int) -> "RunFolder":
        """Write the start of a run.

        Raises:
            FileExistsError: the folder holds a run already.
            OSError: it cannot be written.
        """
        if (path / "settings.yaml").exists():
            raise FileExistsError(f"RunFolder.create(): {path} holds a run. Continue it with --resume, or name another with --run.")
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
        """
        path = Path(path)
        for name in ("settings.yaml", "rig.npz", "run.json"):
            if not (path / name).exists():
                raise FileNotFoundError(f"RunFolder.open(): expected a run with {name} in {path}; got none. Name a folder that fit wrote.")
        facts = json.loads((path / "run.json").read_text())
        return RunFolder(path, load_settings(path / "settings.yaml"), load_rig(path / "rig.npz"), Path(facts["capture"]), facts["face_size"])

    def load_avatar(self, which: str = "best") -> Avatar:
        """The avatar of the "best" or "last" checkpoint, ready to be driven (evaluation mode).

        Raises:
            FileNotFoundError, ValueError: no checkpoint, or a damaged one; see `Checkpoints`.
        """
        state = self.checkpoints.load_avatar(which)
        avatar = Avatar(self.rig, self.settings.model, DrivingStatistics.neutral(self.rig, self.face_size, self.settings.model.texture_size))
        avatar.load_state_dict(state)
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
