"""Which runs an ablation consists of, where each lies, and what is still to be done.

```
DIR/ours/seed_0/            a run folder (training/run_folder.py), measures.json beside its checkpoints, worker.log, capture.json
DIR/table.json, .md, .tex   when every run is measured
```
"""

import dataclasses
import hashlib
import json
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from mitsuba_avatar.ablation.rows import Row
from mitsuba_avatar.files import atomic_path
from mitsuba_avatar.presets import load_settings, resolve
from mitsuba_avatar.settings import Settings

# What a rehearsal changes in every row: registered meshes alone are learnt from, so that it takes a fraction of the time.
REHEARSAL = ("loss.image=0.0", "loss.mask=0.0", "loss.geometry_after=1.0", "training.poses_per_batch=4", "training.views_per_pose=1")
MEASURES = "measures.json"
PLANNED = "planned.yaml"  # settings that a worker is told to train with
ADOPTED = "adopted_from"  # of the measures of a run that was measured elsewhere, see ablation.adoption: which table they are from
CAPTURE_NOTE = "capture.json"  # which content of the capture a run was begun on
DIGESTED_ARRAYS = ("theta", "root", "face", "vertices")  # of a capture: what is learnt from
COUNTED_FOLDERS = ("images", "masks", "backgrounds")
BLOCK_BYTES = 1 << 22  # read at a time


@dataclass(frozen=True)
class PlannedRun:
    """A row with a seed.

    Attributes:
        row: which.
        settings: resolved, seed included.
        path: run folder.
        digest: of the capture as it is now, see `capture_digest`; None where it is not known.
    """

    row: Row
    settings: Settings
    path: Path
    digest: str | None = None

    @property
    def is_measured(self) -> bool:
        """Whether nothing is left to do."""
        return self.measures_path.is_file()

    @property
    def is_begun(self) -> bool:
        """Whether there is a checkpoint to go on from."""
        return (self.path / "checkpoints" / "checkpoints.json").is_file()

    @property
    def measures_path(self) -> Path:
        """File of the figures."""
        return self.path / MEASURES

    def measures(self) -> dict:
        """The figures of a measured run.

        Raises:
            ValueError: the file is damaged.
        """
        try:
            return json.loads(self.measures_path.read_text(encoding="utf-8"))
        except json.JSONDecodeError as error:
            raise ValueError(f"measures(): expected JSON in {self.measures_path}; got {error}. Remove it to measure again.") from error

    def save_measures(self, measures: dict) -> None:
        """Keep the figures; the run counts as done from then on."""
        with atomic_path(self.measures_path) as temporary:
            temporary.write_text(json.dumps(measures, indent=2, allow_nan=False) + "\n", encoding="utf-8")

    def note_capture(self) -> None:
        """Keep the digest of the capture beside the run, before a worker begins it; a run that goes on keeps the one it was begun with."""
        if self.is_begun or self.is_measured:
            return
        if self.digest is None:
            (self.path / CAPTURE_NOTE).unlink(missing_ok=True)
            return
        with atomic_path(self.path / CAPTURE_NOTE) as temporary:
            temporary.write_text(json.dumps({"digest": self.digest}) + "\n", encoding="utf-8")

    def noted_digest(self) -> str | None:
        """Digest of the capture that the run was begun on; None where none was noted.

        Raises:
            ValueError: the note is damaged.
        """
        note = self.path / CAPTURE_NOTE
        if not note.is_file():
            return None
        try:
            return json.loads(note.read_text(encoding="utf-8"))["digest"]
        except (ValueError, KeyError, TypeError) as error:  # no JSON, or other JSON
            raise ValueError(
                f"noted_digest(): expected the digest of a capture in {note}; got {error!r}. Remove the run's folder to train it again."
            ) from error

    def iterations_done(self) -> int:
        """Iterations that the run's log tells of; all of them once it is measured."""
        if self.is_measured:
            return self.settings.training.iterations
        log = self.path / "metrics.jsonl"
        if not log.is_file():
            return 0
        lines = log.read_bytes().splitlines()
        for line in reversed(lines[-2:]):  # the last may be cut short
            try:
                return int(json.loads(line)["iteration"])
            except (ValueError, KeyError):
                continue
        return 0


def plan_runs(
    folder: Path, rows: tuple[Row, ...], seeds: range, budget: float, capture: Path, overrides: list[str], digest: str | None = None
) -> list[PlannedRun]:
    """All runs of an ablation, seed by seed, so that a first complete table comes early.

    Args:
        folder: of the ablation.
        rows: which.
        seeds: which.
        budget: factor on the number of iterations of every row.
        capture: that all are trained on.
        overrides: `section.key value` words for every row alike.
        digest: of the capture, see `capture_digest`; None where it has none. Runs in the folder are not compared with it where they were
            begun or measured without one, as those of older versions were.

    Raises:
        ValueError: seeds or budget out of range, or the folder holds a run of other settings, or of other content of the capture.
    """
    if not seeds or seeds.start < 0 or budget <= 0:
        raise ValueError(
            "plan_runs(): expected one seed or more, counted from 0 or more, and a positive budget; got "
            f"{len(seeds)}, {seeds.start} and {budget:g}."
        )
    runs = []
    for seed in seeds:
        for row in rows:
            settings = resolve(row.preset, [*overrides, f"capture.path={capture.absolute()}", f"training.seed={seed}"])
            planned = PlannedRun(row, _scaled(settings, budget), folder / row.name / f"seed_{seed}", digest)
            _check_same(planned)
            _check_same_capture(planned)
            runs.append(planned)
    return runs


def compared_settings(settings: Settings) -> dict[str, object]:
    """Dotted key -> value, as JSON has it, of what must be the same for two runs to be comparable: every setting but the place of the
    capture, and the variant, which says where a run is computed ("auto" is resolved when it begins)."""
    sections = json.loads(json.dumps(dataclasses.asdict(settings)))
    del sections["rendering"]["variant"], sections["capture"]["path"]
    return {f"{section}.{name}": value for section, values in sections.items() for name, value in values.items()}


def capture_digest(capture: Path) -> str | None:
    """What tells a capture from another one in the same folder, say after it was filmed again: SHA-256 in hexadecimal.

    Of the names and bytes of description, cameras, frames and of the arrays that are learnt from, read in blocks. Images, masks and plates
    are too many to be read: their number and total size count, so that other pixels in as many bytes go unseen. Rig and `truth/` do not
    count. 150 MB of arrays and 7000 images take about a second.

    Args:
        capture: folder of a capture.

    Returns:
        64 digits; None where there is no whole capture.
    """
    # They load torch, and a worker imports this module before its variant is set.
    from mitsuba_avatar.captures.arrays import FRAME_ARRAYS
    from mitsuba_avatar.captures.folder import CAMERAS_FILE, DESCRIPTION_FILE, FRAMES_FILE

    if not (capture / DESCRIPTION_FILE).is_file():
        return None
    digest = hashlib.sha256()
    for name in (DESCRIPTION_FILE, CAMERAS_FILE, FRAMES_FILE, *(FRAME_ARRAYS[name].file_name for name in DIGESTED_ARRAYS)):
        if (capture / name).is_file():
            digest.update(f"{name} {(capture / name).stat().st_size}\n".encode())
            for block in _blocks(capture / name):
                digest.update(block)
    for name in COUNTED_FOLDERS:
        sizes = _file_sizes(capture / name)
        digest.update(f"{name} {len(sizes)} {sum(sizes)}\n".encode())
    return digest.hexdigest()


def _blocks(path: Path) -> Iterator[bytes]:
    """A file's bytes, so that memory does not grow with the file."""
    with path.open("rb") as file:
        while block := file.read(BLOCK_BYTES):
            yield block


def _file_sizes(folder: Path) -> list[int]:
    """Bytes of every file below a folder; temporary files, whose names start with a dot, do not count."""
    return [(Path(here) / name).stat().st_size for here, _, names in os.walk(folder) for name in names if not name.startswith(".")]


def _scaled(settings: Settings, budget: float) -> Settings:
    """Settings with all numbers of iterations multiplied."""
    training, loss = settings.training, settings.loss
    iterations = max(round(training.iterations * budget), 1)
    return dataclasses.replace(
        settings,
        training=dataclasses.replace(training, iterations=iterations),
        loss=dataclasses.replace(
            loss, geometry_iterations=round(loss.geometry_iterations * budget), kl_warm_up=round(loss.kl_warm_up * budget)
        ),
    )


def _check_same(planned: PlannedRun) -> None:
    """A table of runs that were not made alike would prove nothing."""
    saved = planned.path / "settings.yaml"
    if not saved.is_file():
        return
    was, wanted = (
        compared_settings(settings) | {"capture.path": settings.capture.path} for settings in (load_settings(saved), planned.settings)
    )
    changed = [f"{key} {before} -> {wanted[key]}" for key, before in was.items() if before != wanted[key]]
    if changed:
        raise ValueError(
            f"plan_runs(): expected {planned.path} to be new or of the same settings; got {', '.join(changed)}. "
            "Name another folder with --out."
        )


def _check_same_capture(planned: PlannedRun) -> None:
    """The same path is not the same capture: it may have been filmed again. What older versions left has no digest, and is accepted."""
    now = planned.digest
    if now is None or not (planned.is_measured or planned.is_begun):
        return
    if planned.is_measured and ADOPTED in planned.measures():
        return  # told when it was adopted
    was = planned.measures().get("capture_digest") if planned.is_measured else planned.noted_digest()
    if was is not None and was != now:
        raise ValueError(
            f"plan_runs(): expected {planned.path} to be new or of the capture that is in {planned.settings.capture.path} now (digest "
            f"{now[:12]}); got a run that was {'measured' if planned.is_measured else 'begun'} on other content of it (digest {was[:12]}). "
            "Name another folder with --out, or put the capture back as it was."
        )
