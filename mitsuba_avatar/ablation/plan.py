"""Which runs an ablation consists of, where each lies, and what is still to be done.

```
DIR/ours/seed_0/            a run folder (training/run_folder.py), measures.json beside its checkpoints, worker.log
DIR/table.json, .md, .tex   when every run is measured
```
"""

import dataclasses
import json
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


@dataclass(frozen=True)
class PlannedRun:
    """A row with a seed.

    Attributes:
        row: which.
        settings: resolved, seed included.
        path: run folder.
    """

    row: Row
    settings: Settings
    path: Path

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


def plan_runs(folder: Path, rows: tuple[Row, ...], seeds: int, budget: float, capture: Path, overrides: list[str]) -> list[PlannedRun]:
    """All runs of an ablation, seed by seed, so that a first complete table comes early.

    Args:
        folder: of the ablation.
        rows: which.
        seeds: number of seeds, counted from 0.
        budget: factor on the number of iterations of every row.
        capture: that all are trained on.
        overrides: `section.key value` words for every row alike.

    Raises:
        ValueError: seeds or budget out of range, or the folder holds a run of other settings.
    """
    if seeds < 1 or budget <= 0:
        raise ValueError(f"plan_runs(): expected seeds of at least 1 and a positive budget; got {seeds} and {budget:g}.")
    runs = []
    for seed in range(seeds):
        for row in rows:
            settings = resolve(row.preset, [*overrides, f"capture.path={capture.absolute()}", f"training.seed={seed}"])
            planned = PlannedRun(row, _scaled(settings, budget), folder / row.name / f"seed_{seed}")
            _check_same(planned)
            runs.append(planned)
    return runs


def _scaled(settings: Settings, budget: float) -> Settings:
    """Settings with all numbers of iterations multiplied."""
    training, loss = settings.training, settings.loss
    iterations = max(round(training.iterations * budget), 1)
    return dataclasses.replace(
        settings,
        training=dataclasses.replace(training, iterations=iterations),
        loss=dataclasses.replace(loss, geometry_iterations=round(loss.geometry_iterations * budget)),
    )


def _check_same(planned: PlannedRun) -> None:
    """A table of runs that were not made alike would prove nothing."""
    saved = planned.path / "settings.yaml"
    if not saved.is_file():
        return
    was, wanted = load_settings(saved), planned.settings
    changed = [
        f"{section}.{name} {before} -> {after}"
        for section in ("capture", "model", "loss", "disentanglement", "camera_response", "training", "evaluation")
        for name, before in dataclasses.asdict(getattr(was, section)).items()
        if before != (after := dataclasses.asdict(getattr(wanted, section))[name])
    ]
    if changed:
        raise ValueError(
            f"plan_runs(): expected {planned.path} to be new or of the same settings; got {', '.join(changed)}. "
            "Name another folder with --out."
        )
