"""metrics.json as text: an aligned table for the terminal, Markdown for a note or the README, LaTeX (booktabs) for a paper, CSV.

Every kind shows the same rows: one for each split, camera group and method, so that methods stand below each other. `protocol` picks the
region that image errors are averaged over (`reporting.protocols`); without it, every metric of the file has a column.
"""

import csv
import io
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from mitsuba_avatar.reporting.protocols import Protocol, metric_name, protocol_of


@dataclass(frozen=True)
class _Column:
    """Heading of a metric, its unit, its decimals, and which way is better: 1 up, -1 down, 0 neither."""

    heading: str
    unit: str = ""
    decimals: int = 4
    better: int = 0


_COLUMNS = {
    "psnr": _Column("PSNR", "dB", 2, 1),
    "ssim": _Column("SSIM", "", 4, 1),
    "l1": _Column("L1", "0..255", 2, -1),
    "mse": _Column("MSE", "0..255", 1, -1),
    "flip": _Column("FLIP", "", 4, -1),
    "lpips": _Column("LPIPS", "", 4, -1),
    "iou": _Column("IoU", "", 4, 1),
    "silhouette_iou": _Column("IoU", "", 4, 1),
    "vertex_mm": _Column("vertices", "mm", 2, -1),
    "vertex_error_mm": _Column("vertices", "mm", 2, -1),
    "flicker": _Column("flicker", "0..255", 2, -1),
    "seam": _Column("seams", "0..255", 2, -1),
    "images": _Column("images", "", 0),
}
_ARROWS, _LATEX_ARROWS = {1: " ↑", -1: " ↓", 0: ""}, {1: r" $\uparrow$", -1: r" $\downarrow$", 0: ""}
_LATEX_SPECIAL = str.maketrans({character: f"\\{character}" for character in "&%$#_{}"} | {"~": r"\textasciitilde{}", "\\": "/"})


def metric_rows(metrics: Mapping[str, Any], protocol: Protocol | None = None) -> tuple[list[str], list[list[str]]]:
    """Headings and rows of formatted cells.

    Metrics without a heading of ours come after those with one, under their own name; a metric that a row lacks is a dash.
    """
    rows, names = _flat_rows(metrics, protocol)
    headings = ["split", "cameras", "method", *(_heading(name, protocol, _ARROWS, "({})") for name in names)]
    return headings, [[*keys, *(_cell(values.get(name), name) for name in names)] for keys, values in rows]


def terminal_table(metrics: Mapping[str, Any], protocol: Protocol | None = None) -> str:
    """Aligned columns, numbers flush right, a rule below the headings."""
    headings, rows = metric_rows(metrics, protocol)
    widths = [max(map(len, column)) for column in zip(headings, *rows, strict=True)]
    lines = [
        "  ".join(_aligned(cell, width, index) for index, (cell, width) in enumerate(zip(row, widths, strict=True)))
        for row in [headings, *rows]
    ]
    return "\n".join(line.rstrip() for line in [lines[0], "-" * len(lines[0]), *lines[1:]])


def markdown_table(metrics: Mapping[str, Any], protocol: Protocol | None = None) -> str:
    """A Markdown table with the same cells."""
    headings, rows = metric_rows(metrics, protocol)
    rule = ["---"] * 3 + ["---:"] * (len(headings) - 3)
    return "\n".join("| " + " | ".join(row) + " |" for row in [headings, rule, *rows])


def csv_table(metrics: Mapping[str, Any]) -> str:
    """Every metric at full precision, comma-separated, under its name in metrics.json."""
    rows, names = _flat_rows(metrics, None)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["split", "cameras", "method", *names])
    writer.writerows([*keys, *("" if values.get(name) is None else repr(values[name]) for name in names)] for keys, values in rows)
    return text.getvalue()


def latex_table(metrics: Mapping[str, Any], protocol: Protocol, caption: str = "", label: str = "") -> str:
    """A `table` with booktabs rules, to be read by `\\input`; the best value of each split and camera group is bold.

    Args:
        metrics: contents of metrics.json; keys of the first level name the rows.
        protocol: which image errors.
        caption, label: of the table; empty for none.
    """
    rows, names = _flat_rows(metrics, protocol)
    names = [name for name in names if name != "images"]
    best = _best(rows, names)
    lines = [r"% needs \usepackage{booktabs}", r"\begin{table}", r"  \centering"]
    lines += [f"  \\begin{{tabular}}{{lll{'r' * len(names)}}}", r"    \toprule"]
    headings = ["split", "cameras", "method", *(_heading(name, protocol, _LATEX_ARROWS, "[{}]") for name in names)]
    lines += ["    " + " & ".join(headings) + r" \\", r"    \midrule"]
    previous: tuple[str, str] | None = None
    for (split, cameras, method), values in rows:
        if previous not in (None, (split, cameras)):
            lines.append(r"    \addlinespace")
        is_first = previous != (split, cameras)
        cells = [split if is_first else "", cameras if is_first else "", method]
        cells = [cell.translate(_LATEX_SPECIAL) for cell in cells]
        for name in names:
            cell = _cell(values.get(name), name).replace("-", "--" if values.get(name) is None else "$-$")
            cells.append(f"\\textbf{{{cell}}}" if cell == best.get((split, cameras, name)) else cell)
        lines.append("    " + " & ".join(cells) + r" \\")
        previous = (split, cameras)
    lines += [r"    \bottomrule", r"  \end{tabular}"]
    lines += [f"  \\caption{{{caption.translate(_LATEX_SPECIAL)}}}"] if caption else []
    lines += [f"  \\label{{{label}}}"] if label else []
    return "\n".join([*lines, r"\end{table}", ""])


def _flat_rows(metrics: Mapping[str, Any], protocol: Protocol | None) -> tuple[list[tuple[tuple[str, str, str], dict]], list[str]]:
    """((split, cameras, method), values) of every row in order, and the metrics that have a column."""
    flat = [
        ((split, cameras, method), values)
        for method, splits in metrics.items()
        for split, groups in splits.items()
        for cameras, values in groups.items()
    ]
    order: dict[tuple[str, str], int] = {}
    for (split, cameras, _), _ in flat:
        order.setdefault((split, cameras), len(order))
    flat.sort(key=lambda row: order[row[0][:2]])  # stable: methods keep the order of the file
    present = dict.fromkeys(name for _, values in flat for name in values)
    if protocol is not None:
        present = dict.fromkeys(name for name in present if protocol_of(name) in (None, protocol))
        known = [metric_name(name, protocol) if protocol_of(name) else name for name in _COLUMNS]
    else:
        known = list(_COLUMNS)
    return flat, [name for name in known if name in present] + [name for name in present if name not in known]


def _column(name: str) -> _Column:
    """The column of a metric, whatever its protocol."""
    protocol = protocol_of(name)
    plain = name if protocol in (None, "mask") else name.removeprefix(f"{protocol}_")
    return _COLUMNS.get(plain, _Column(plain))


def _heading(name: str, protocol: Protocol | None, arrows: Mapping[int, str], unit_format: str) -> str:
    column, own = _column(name), protocol_of(name)
    prefix = f"{own} " if protocol is None and own not in (None, "mask") else ""
    unit = f" {unit_format.format(column.unit)}" if column.unit else ""
    return f"{prefix}{column.heading}{unit}{arrows[column.better]}"


def _best(rows: list[tuple[tuple[str, str, str], dict]], names: list[str]) -> dict[tuple[str, str, str], str]:
    """Best cell as printed of every split, camera group and metric that has a better direction and more than one value."""
    best: dict[tuple[str, str, str], str] = {}
    for split, cameras in dict.fromkeys(keys[:2] for keys, _ in rows):
        for name in names:
            values = [row[name] for keys, row in rows if keys[:2] == (split, cameras) and row.get(name) is not None]
            if (direction := _column(name).better) and len(values) > 1:
                best[split, cameras, name] = _cell(max(values) if direction > 0 else min(values), name)
    return best


def _cell(value: float | int | None, name: str) -> str:
    return "-" if value is None else f"{value:.{_column(name).decimals}f}"


def _aligned(cell: str, width: int, index: int) -> str:
    return cell.ljust(width) if index < 3 else cell.rjust(width)
