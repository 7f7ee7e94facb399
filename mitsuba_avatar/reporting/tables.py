"""metrics.json as text: an aligned table for the terminal, Markdown for a note or the README."""

from collections.abc import Mapping
from typing import Any

# Metric -> heading with unit and the better direction, and decimals.
_COLUMNS = {
    "psnr": ("PSNR (dB) ↑", 2),
    "ssim": ("SSIM ↑", 4),
    "l1": ("L1 (0..255) ↓", 2),
    "mse": ("MSE (0..255) ↓", 1),
    "silhouette_iou": ("IoU ↑", 4),
    "vertex_error_mm": ("vertices (mm) ↓", 2),
    "images": ("images", 0),
}


def metric_rows(metrics: Mapping[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Headings and rows of formatted cells, one row for each split, camera group and method, so that methods stand below each other.

    Metrics without a heading of ours come after those with one, under their own name; a metric that a row lacks is a dash.
    """
    flat = [
        (split, cameras, method, values)
        for method, splits in metrics.items()
        for split, groups in splits.items()
        for cameras, values in groups.items()
    ]
    order: dict[tuple[str, str], int] = {}
    for split, cameras, _, _ in flat:
        order.setdefault((split, cameras), len(order))
    flat.sort(key=lambda row: order[row[0], row[1]])  # stable: methods keep the order of the file
    present = dict.fromkeys(name for *_, values in flat for name in values)
    names = [name for name in _COLUMNS if name in present] + [name for name in present if name not in _COLUMNS]
    headings = ["split", "cameras", "method", *(_COLUMNS.get(name, (name, 4))[0] for name in names)]
    rows = [[split, cameras, method, *(_cell(values.get(name), name) for name in names)] for split, cameras, method, values in flat]
    return headings, rows


def terminal_table(metrics: Mapping[str, Any]) -> str:
    """Aligned columns, numbers flush right, a rule below the headings."""
    headings, rows = metric_rows(metrics)
    widths = [max(map(len, column)) for column in zip(headings, *rows, strict=True)]
    lines = [
        "  ".join(_aligned(cell, width, index) for index, (cell, width) in enumerate(zip(row, widths, strict=True)))
        for row in [headings, *rows]
    ]
    return "\n".join(line.rstrip() for line in [lines[0], "-" * len(lines[0]), *lines[1:]])


def markdown_table(metrics: Mapping[str, Any]) -> str:
    """A Markdown table with the same cells."""
    headings, rows = metric_rows(metrics)
    rule = ["---"] * 3 + ["---:"] * (len(headings) - 3)
    return "\n".join("| " + " | ".join(row) + " |" for row in [headings, rule, *rows])


def _cell(value: float | int | None, name: str) -> str:
    return "-" if value is None else f"{value:.{_COLUMNS.get(name, ('', 4))[1]}f}"


def _aligned(cell: str, width: int, index: int) -> str:
    return cell.ljust(width) if index < 3 else cell.rjust(width)
