"""From one row a picture to means per camera and per frame, and the numbers of several runs side by side."""

import csv
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mitsuba_avatar.files import atomic_path
from mitsuba_avatar.reporting.metrics import PICTURE_COLUMNS

PER_CAMERA = ("method", "split", "cameras", "camera")
PER_FRAME = ("method", "split", "cameras", "frame")


def grouped_means(rows: Sequence[Mapping[str, Any]], keys: Sequence[str]) -> list[dict[str, Any]]:
    """Means of every metric over the rows that agree in `keys`, in the order in which the groups come; `images` counts the rows.

    A metric that only some rows have is averaged over those; one that none has is left out.

    Args:
        rows: of `metrics.load_pictures`.
        keys: PER_CAMERA or PER_FRAME, with `run` before where rows have one.
    """
    groups: dict[tuple, list[Mapping[str, Any]]] = {}
    for row in rows:
        groups.setdefault(tuple(row[key] for key in keys), []).append(row)
    means = []
    for values, members in groups.items():
        names = dict.fromkeys(name for row in members for name in row if name not in (*PICTURE_COLUMNS, "run"))
        numbers = {name: [row[name] for row in members if name in row] for name in names}
        averages = {name: math.fsum(found) / len(found) for name, found in numbers.items()}
        means.append(dict(zip(keys, values, strict=True)) | averages | {"images": len(members)})
    return means


def write_rows(path: Path | str, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write rows as CSV, columns in the order in which they come up; whole or not at all."""
    columns = list(dict.fromkeys(name for row in rows for name in row))
    with atomic_path(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        writer.writeheader()
        for row in rows:
            writer.writerow({name: f"{value:.6g}" if isinstance(value, float) else value for name, value in row.items()})


def joined_metrics(runs: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Contents of several metrics.json as one: every run's avatar under the run's name, then the first run's baselines.

    The metrics of a single run stay as they are.
    """
    if len(runs) == 1:
        return dict(next(iter(runs.values())))
    joined = {name: metrics["avatar"] for name, metrics in runs.items() if "avatar" in metrics}
    first = next(iter(runs.values()), {})
    return joined | {method: splits for method, splits in first.items() if method != "avatar"}
