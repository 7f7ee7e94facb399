"""The report of one or several runs: everything that a paper's results section takes from them, and a page for each.

```
comparison.png             capture, runs and baselines with insets and error maps
training.pdf .svg          curves of the logs
frames_<metric>, cameras_<metric> .pdf .svg      errors along the frames and per camera
table_<protocol>.tex       booktabs
table.csv table.md         every metric
pictures.csv per_camera.csv per_frame.csv
settings_<run>.yaml        that made them
report.json                what was reported: runs, checkpoints, captures, versions
<run>.html                 a page that needs nothing else
```
"""

import json
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from mitsuba_avatar.files import atomic_path
from mitsuba_avatar.reporting.aggregates import PER_CAMERA, PER_FRAME, grouped_means, joined_metrics, write_rows
from mitsuba_avatar.reporting.comparison import inset_grid
from mitsuba_avatar.reporting.curves import camera_bars, frame_curves, training_curves
from mitsuba_avatar.reporting.evaluation import METHODS, Evaluator
from mitsuba_avatar.reporting.figures import View, save_image
from mitsuba_avatar.reporting.metrics import read_records
from mitsuba_avatar.reporting.page import Figure, Section, write_page
from mitsuba_avatar.reporting.protocols import PROTOCOLS, protocol_of
from mitsuba_avatar.reporting.tables import csv_table, latex_table, markdown_table, metric_rows
from mitsuba_avatar.settings import Settings
from mitsuba_avatar.training.run_folder import RunFolder
from mitsuba_avatar.training.statistics import evenly_spaced

PANELS = {
    "image": "image loss (L1)",
    "mask": "mask loss",
    "geometry": "geometry loss",
    "laplacian": "Laplacian loss",
    "kl": "KL divergence (nats)",
    "validation_psnr": "PSNR of held-out cameras (dB)",
}
CURVES = {"psnr": "PSNR (dB)", "flip": "FLIP", "vertex_mm": "vertex error (mm)"}
PREVIEWS_SHOWN = 3


@dataclass(frozen=True)
class ReportedRun:
    """A run with what was measured of it.

    Attributes:
        name: unique among the reported.
        run: its folder.
        evaluator: that draws its avatar.
        means: contents of its metrics.json.
        pictures: rows of its metrics.csv.
        checkpoint: "best" or "last".
    """

    name: str
    run: RunFolder
    evaluator: Evaluator
    means: dict[str, Any]
    pictures: list[dict[str, Any]]
    checkpoint: str


class Report:
    """Writes the files of a report; the methods may be called in any order, `write_pages` last.

    Args:
        runs: of one capture.
        folder: to write into.

    Raises:
        ValueError: no runs, two of one name, or runs on different captures.
    """

    def __init__(self, runs: Sequence[ReportedRun], folder: Path):
        names = [run.name for run in runs]
        if not names or len(set(names)) != len(names):
            raise ValueError(f"Report(): expected runs of different names; got {names}. Rename a folder, or report them one by one.")
        captures = {str(run.evaluator.capture.path.resolve()) for run in runs}
        if len(captures) > 1:
            raise ValueError(
                f"Report(): expected runs that are judged by one capture; got {sorted(captures)}. Choose one for all with --capture."
            )
        self.runs, self.folder = list(runs), folder
        self.is_alone = len(self.runs) == 1

    @property
    def rows(self) -> list[dict[str, Any]]:
        """Measured pictures of all runs; with several, `method` is the run's name for its avatar, and only the first's baselines stay."""
        if self.is_alone:
            return self.runs[0].pictures
        rows = [row | {"method": run.name} for run in self.runs for row in run.pictures if row["method"] == "avatar"]
        return rows + [row for row in self.runs[0].pictures if row["method"] != "avatar"]

    def write_tables(self) -> list[Path]:
        """LaTeX for each protocol that was measured, CSV and Markdown, per-camera and per-frame CSV, settings and facts."""
        joined, paths = joined_metrics({run.name: run.means for run in self.runs}), []
        texts = {"table.csv": csv_table(joined), "table.md": markdown_table(joined) + "\n", "report.json": self._facts()}
        for protocol in self._protocols():
            caption = f"Errors averaged over the {protocol}; best of each group in bold."
            texts[f"table_{protocol}.tex"] = latex_table(joined, protocol, caption, f"tab:{protocol}")
        for name, text in texts.items():
            with atomic_path(self.folder / name) as temporary:
                temporary.write_text(text, encoding="utf-8")
            paths.append(self.folder / name)
        tables = {
            "pictures": self.rows,
            "per_camera": grouped_means(self.rows, PER_CAMERA),
            "per_frame": grouped_means(self.rows, PER_FRAME),
        }
        for name, rows in tables.items():
            write_rows(self.folder / f"{name}.csv", rows)
            paths.append(self.folder / f"{name}.csv")
        for run in self.runs:
            with atomic_path(self.folder / f"settings_{run.name}.yaml") as temporary:
                shutil.copyfile(run.run.path / "settings.yaml", temporary)
            paths.append(self.folder / f"settings_{run.name}.yaml")
        return paths

    def write_curves(self) -> list[Path]:
        """Vector figures of the logs and of the errors; what was not measured has none."""
        logs = {run.name: read_records(run.run.log_path) for run in self.runs if run.run.log_path.is_file()}
        paths = training_curves(self.folder / "training", logs, PANELS) if logs else []
        split = self._split()
        measured = {name for row in self.rows if row["split"] == split for name in row}
        for metric, title in CURVES.items():
            if metric in measured:
                paths += frame_curves(self.folder / f"frames_{metric}", self.rows, metric, title, split)
        if "psnr" in measured:
            paths += camera_bars(self.folder / "cameras_psnr", self.rows, "psnr", CURVES["psnr"], split)
        return paths

    def write_comparison(self, count: int) -> Path:
        """The comparison of `count` views: held-out cameras (all, where none is), frames spread over the test split.

        Raises:
            ValueError: no camera sees the person in any of the frames.
        """
        first = self.runs[0].evaluator
        names = first.capture.camera_names(held_out=True) or first.capture.camera_names()
        views: list[View] = []
        pictures: dict[str, list[np.ndarray]] = {}
        for number, frame in enumerate(evenly_spaced(first.capture.frame_indices(self._split()), count)):
            name = names[number % len(names)]
            batch = first.reader.read([frame], [[name]])
            if not batch.masks.any():
                continue
            views.append(
                View(f"{name} {first.capture.frames[frame].number}", batch.pictures(batch.images)[0], batch.coverage(batch.masks)[0])
            )
            for run in self.runs:
                shown = run.evaluator.reader.read([frame], [[name]])
                label = "avatar" if self.is_alone else run.name
                pictures.setdefault(label, []).append(shown.pictures(run.evaluator.draw("avatar", shown).images)[0])
            for method in METHODS[1:]:
                pictures.setdefault(method, []).append(batch.pictures(first.draw(method, batch).images)[0])
        if not views:
            raise ValueError(f"write_comparison(): expected views of the person in {first.capture.path}; got none. Check the masks.")
        path = self.folder / "comparison.png"
        save_image(path, inset_grid(views, pictures))
        return path

    def write_pages(self) -> list[Path]:
        """An HTML page for each run, from the files that the other methods have written."""
        return [self._write_page(run) for run in self.runs]

    def _write_page(self, run: ReportedRun) -> Path:
        split = self._split()
        groups = run.means.get("avatar", {}).get(split, {})
        best = groups.get("held_out") or groups.get("seen") or {}
        labels = {"psnr": "PSNR, dB", "ssim": "SSIM", "flip": "FLIP", "iou": "silhouette IoU", "vertex_mm": "vertex error, mm"}
        numbers = {label: f"{best[name]:.4g}" for name, label in labels.items() if name in best}
        index = run.run.checkpoints.index()
        facts = [
            f"capture {run.evaluator.capture.path.name}, {len(run.evaluator.capture.frames)} frames, "
            f"{len(run.evaluator.capture.cameras)} cameras; checkpoint {run.checkpoint}"
            + (f" (iteration {index.iteration_of(run.checkpoint)})" if index else ""),
            f"the figures below: {split} frames, {'held-out' if 'held_out' in groups else 'seen'} cameras, inside the mask",
        ]
        videos = [Figure(path, path.stem.replace("_", " ")) for path in sorted(run.run.path.glob("**/*.mp4"))]
        joined = joined_metrics({other.name: other.means for other in self.runs})
        tables = {f"image errors averaged over the {protocol}": metric_rows(joined, protocol) for protocol in self._protocols()}
        curves = [Figure(path, path.stem.replace("_", " ")) for path in sorted(self.folder.glob("*.svg"))]
        previews = sorted(run.run.previews.glob("*.png"))[-PREVIEWS_SHOWN:]
        comparison = [path for path in (self.folder / "comparison.png",) if path.is_file()]
        sections = [
            Section("Comparison", [Figure(path, "insets lie where the avatar's FLIP error is largest") for path in comparison]),
            Section("Videos", videos),
            Section("Errors", tables=tables),
            Section("Curves", curves),
            Section("Previews of the training", [Figure(path, f"iteration {path.stem.lstrip('0')}") for path in previews], is_folded=True),
            Section("Settings", tables={"changed ones are marked": _settings_table(run.run.settings)}, text_columns=2, is_folded=True),
        ]
        path = self.folder / f"{run.name}.html"
        write_page(path, f"Run {run.name}", facts, numbers, sections)
        return path

    def _protocols(self) -> list:
        """Protocols of which something was measured."""
        measured = {
            protocol_of(name)
            for run in self.runs
            for splits in run.means.values()
            for groups in splits.values()
            for values in groups.values()
            for name in values
        }
        return [protocol for protocol in PROTOCOLS if protocol in measured]

    def _split(self) -> str:
        """The split that figures show: test frames where there are some."""
        splits = {frame.purpose for frame in self.runs[0].evaluator.capture.frames}
        return "test" if "test" in splits else "train"

    def _facts(self) -> str:
        runs = []
        for run in self.runs:
            index = run.run.checkpoints.index()
            facts = json.loads((run.run.path / "run.json").read_text(encoding="utf-8"))
            runs.append(
                {
                    "name": run.name,
                    "run": str(run.run.path.resolve()),
                    "capture": str(run.evaluator.capture.path.resolve()),
                    "checkpoint": run.checkpoint,
                    "iteration": None if index is None else index.iteration_of(run.checkpoint),
                    "versions": facts.get("versions", {}),
                }
            )
        return json.dumps({"runs": runs}, indent=2) + "\n"


def _settings_table(settings: Settings) -> tuple[list[str], list[list[str]]]:
    """Every setting with its default, those that differ marked by a further cell."""
    rows, plain = [], Settings()
    for section in fields(settings):
        own, usual = getattr(settings, section.name), getattr(plain, section.name)
        for field in fields(own):
            value, default = getattr(own, field.name), getattr(usual, field.name)
            mark = ["*"] if value != default else []
            rows.append([section.name, field.name, str(value), str(default), *mark])
    return ["section", "setting", "value", "default"], rows
