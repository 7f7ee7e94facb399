"""Vector figures for papers: training curves of several runs, errors along the frames, errors per camera. PDF and SVG of each.

Files carry no date, so that the same numbers give the same bytes.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mitsuba_avatar.files import atomic_path
from mitsuba_avatar.reporting.aggregates import PER_CAMERA, PER_FRAME, grouped_means

WIDTH = 6.5  # inches: the text width of common paper formats
_STYLE = {"font.size": 8, "axes.spines.top": False, "axes.spines.right": False, "svg.hashsalt": "mitsuba_avatar", "pdf.fonttype": 42}


def training_curves(stem: Path, runs: Mapping[str, Sequence[Mapping[str, Any]]], panels: Mapping[str, str]) -> list[Path]:
    """Curves over the iterations, a line a run, a panel a quantity.

    Args:
        stem: path without ending; `.pdf` and `.svg` are written.
        runs: name -> records of the run's log.
        panels: key of the records -> heading with unit. Keys that no run has are left out.

    Raises:
        ValueError: if nothing is left to draw.
    """
    present = {key: title for key, title in panels.items() if any(record.get(key) is not None for log in runs.values() for record in log)}
    if not present:
        raise ValueError(f"training_curves(): expected records with any of {list(panels)}; found none. Check the runs' metrics.jsonl.")
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(WIDTH, 1.7 * -(-len(present) // 2)), layout="constrained")
        grid = np.ravel(figure.subplots(-(-len(present) // 2), 2, squeeze=False))
        for axes, (key, title) in zip(grid, present.items(), strict=False):
            smallest = []
            for name, log in runs.items():
                points = np.array([(record["iteration"], record[key]) for record in log if record.get(key) is not None]).reshape(-1, 2)
                axes.plot(*points.T, label=name, linewidth=0.9, marker="o" if len(points) < 12 else None, markersize=2)
                smallest += [points[:, 1].min()] if len(points) else []
            _finish(axes, title, "iteration", is_logarithmic=min(smallest, default=0) > 0 and "dB" not in title)
        for axes in grid[len(present) :]:
            axes.set_axis_off()
        if len(runs) > 1:
            _legend(figure, grid[0])
        return _save(figure, stem)


def frame_curves(stem: Path, rows: Sequence[Mapping[str, Any]], metric: str, title: str, split: str) -> list[Path]:
    """A metric along the frames of a split, a line a method, a panel a camera group.

    Args:
        stem: path without ending.
        rows: one a picture.
        metric: name of it in the rows.
        title: with unit.
        split: of the rows.

    Raises:
        ValueError: if no row of the split has the metric.
    """
    means = [row for row in grouped_means(rows, PER_FRAME) if row["split"] == split and metric in row]
    groups, values = _groups(means, metric, split, "frame_curves"), [row[metric] for row in means]
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(WIDTH, 1.9), layout="constrained")
        for axes, group in zip(np.ravel(figure.subplots(1, len(groups), sharey=True, squeeze=False)), groups, strict=True):
            for method in dict.fromkeys(row["method"] for row in means):
                points = sorted((row["frame"], row[metric]) for row in means if (row["method"], row["cameras"]) == (method, group))
                if points:
                    axes.plot(*zip(*points, strict=True), label=method, linewidth=0.9, marker="o", markersize=2)
            _finish(
                axes,
                f"{title}, {split} frames, {group} cameras",
                "frame",
                is_logarithmic=min(values) > 0 and max(values) > 20 * min(values),
            )
        _legend(figure, axes)
        return _save(figure, stem)


def camera_bars(stem: Path, rows: Sequence[Mapping[str, Any]], metric: str, title: str, split: str) -> list[Path]:
    """A metric per camera over a split, a bar a method; arguments and errors are those of `frame_curves`."""
    means = [row for row in grouped_means(rows, PER_CAMERA) if row["split"] == split and metric in row]
    _groups(means, metric, split, "camera_bars")
    methods = list(dict.fromkeys(row["method"] for row in means))
    cameras = list(dict.fromkeys((row["cameras"], row["camera"]) for row in means))
    cameras.sort(key=lambda camera: camera[0] == "held_out")
    values = {(row["method"], row["camera"]): row[metric] for row in means}
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(WIDTH, 2.1), layout="constrained")
        axes = figure.subplots()
        width = 0.8 / len(methods)
        for number, method in enumerate(methods):
            heights = [values.get((method, camera), np.nan) for _, camera in cameras]
            axes.bar(np.arange(len(cameras)) + (number - (len(methods) - 1) / 2) * width, heights, width, label=method)
        axes.set_xticks(
            np.arange(len(cameras)), [f"{camera}*" if group == "held_out" else camera for group, camera in cameras], rotation=60, ha="right"
        )
        _finish(axes, f"{title}, {split} frames", "camera (* held out)")
        _legend(figure, axes)
        return _save(figure, stem)


def _groups(means: Sequence[Mapping[str, Any]], metric: str, split: str, caller: str) -> list[str]:
    groups = sorted({row["cameras"] for row in means}, reverse=True)
    if not groups:
        raise ValueError(f"{caller}(): expected rows of split {split!r} with {metric}; found none. Measure it first.")
    return groups


def _finish(axes: Axes, title: str, below: str, is_logarithmic: bool = False) -> None:
    if is_logarithmic:
        axes.set_yscale("log")
    axes.set_title(title, loc="left", fontsize=8)
    axes.set_xlabel(below)
    axes.grid(alpha=0.25, linewidth=0.5)


def _legend(figure: Figure, axes: Axes) -> None:
    """One legend above all panels, where it hides nothing."""
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=4, frameon=False)


def _save(figure: Figure, stem: Path) -> list[Path]:
    paths = []
    for ending, metadata in ((".pdf", {"CreationDate": None}), (".svg", {"Date": None})):
        path = stem.with_name(stem.name + ending)
        with atomic_path(path) as temporary:
            figure.savefig(temporary, metadata=metadata)
        paths.append(path)
    return paths
