"""The ablation table from the figures of measured runs: Markdown, LaTeX (booktabs, best in bold), JSON; the paper's own beside it.

Errors are means over seeds with the deviation between seeds; a gap below that deviation means nothing.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mitsuba_avatar.ablation.plan import PlannedRun
from mitsuba_avatar.ablation.rows import Row
from mitsuba_avatar.files import atomic_path

LATENT_FIGURES = ("kl_nats", "active_entries", "frame_information_nats", "mutual_information_nats")  # of a run's measures
LATENT_DECIMALS = (1, 0, 2, 2)
LATENT_HEADINGS = ("KL (nats)", "active", "I(z; frame)", "I(z; drive)")  # the same, as the table calls them
HEADINGS = ("model", "train", "validation", "test", "over ours", "gap", *LATENT_HEADINGS, "paper train", "paper test")
REFERENCE = "ours"  # row that the others are compared with, seed by seed


@dataclass(frozen=True)
class Spread:
    """Mean over seeds, and the standard deviation between them; None where there is one seed."""

    mean: float
    deviation: float | None

    @classmethod
    def of(cls, values: Sequence[float]) -> "Spread":
        """Of one number a seed."""
        return cls(float(np.mean(values)), float(np.std(values, ddof=1)) if len(values) > 1 else None)

    def text(self, between: str = " ± ", decimals: int = 2) -> str:
        """As people write it."""
        return f"{self.mean:.{decimals}f}" + ("" if self.deviation is None else f"{between}{self.deviation:.{decimals}f}")


@dataclass(frozen=True)
class Entry:
    """A row of the table; errors by split, None where the capture has no such frames or the avatar no latent code.

    What the latent code says is measured as in reporting/disentanglement.py, in nats.
    """

    row: Row
    errors: dict[str, Spread]
    excesses: tuple[float, ...]  # per cent that the test error is above that of ours with the same seed; none for ours itself
    latent: tuple[Spread | None, ...]  # LATENT_FIGURES

    @property
    def gap(self) -> float | None:
        """Test less train error."""
        return self.errors["test"].mean - self.errors["train"].mean if "test" in self.errors else None


def summarize(runs: Sequence[PlannedRun]) -> list[Entry]:
    """One entry for each row, over the seeds that are measured; rows without any are left out."""
    entries = []
    measures: dict[Row, list[dict]] = {}
    for run in runs:
        if run.is_measured:
            measures.setdefault(run.row, []).append(run.measures())
    ours = {one["seed"]: driven_errors(one).get("test") for row, ones in measures.items() if row.name == REFERENCE for one in ones}
    for row in dict.fromkeys(run.row for run in runs):
        measured = measures.get(row, [])
        if not measured:
            continue
        errors = [driven_errors(one) for one in measured]
        parts = [one.get("disentanglement", {}) for one in measured]
        pairs = [(error["test"], ours[one["seed"]]) for error, one in zip(errors, measured, strict=True) if ours.get(one["seed"])]
        entries.append(
            Entry(
                row,
                {split: Spread.of([one[split] for one in errors]) for split in errors[0]},
                tuple(100 * (test / reference - 1) for test, reference in pairs) if row.name != REFERENCE else (),
                tuple(_spread(parts, name) for name in LATENT_FIGURES),
            )
        )
    return entries


def driven_errors(measures: dict) -> dict[str, float]:
    """Split -> the error that the table is about, driven with z = 0: of pictures, mean squared difference inside the mask in 0..255
    values; where a rehearsal has none, distance from the true surface in millimetres, of the clothes if they are known."""
    if "images" in measures:
        return {split: values["mse"] for split, values in measures["images"].items()}
    return {split: values.get("driven_garment_mm", values["driven_mm"]) for split, values in measures["geometry"].items()}


def markdown(entries: Sequence[Entry]) -> str:
    """The table as Markdown; the lowest train and test errors are bold. "over ours": test error above that of ours with the same seed, mean
    and deviation over seeds, and in how many seeds it is above."""
    lines = ["| " + " | ".join(HEADINGS) + " |", "|" + "---|" * len(HEADINGS)]
    lines += ["| " + " | ".join(_cells(entry, entries, "**{}**", " ± ", "%")) + " |" for entry in entries]
    return "\n".join(lines) + "\n"


def latex(entries: Sequence[Entry]) -> str:
    """The table as a LaTeX tabular for the package booktabs."""
    lines = [r"\begin{tabular}{l" + "r" * (len(HEADINGS) - 1) + "}", r"\toprule", " & ".join(HEADINGS) + r" \\", r"\midrule"]
    lines += [" & ".join(_cells(entry, entries, r"\textbf{{{}}}", r" $\pm$ ", r"\%")) + r" \\" for entry in entries]
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}"]) + "\n"


def write_tables(folder: Path, runs: Sequence[PlannedRun]) -> list[Entry]:
    """Write table.md, table.tex and table.json of all measured runs into a folder; returns the entries.

    The JSON lists every run: `name, seed, train, test` (see `driven_errors`) and all else that was measured.
    """
    entries = summarize(runs)
    rows = []
    for run in runs:
        if run.is_measured:
            measures = run.measures()
            rows.append({"name": run.row.name, "seed": measures["seed"], **driven_errors(measures), "measures": measures})
    texts = {"table.md": markdown(entries), "table.tex": latex(entries), "table.json": json.dumps(rows, indent=1) + "\n"}
    for name, text in texts.items():
        with atomic_path(folder / name) as temporary:
            temporary.write_text(text, encoding="utf-8")
    return entries


def _cells(entry: Entry, entries: Sequence[Entry], bold: str, between: str, percent: str) -> list[str]:
    """A row's cells, without the rules between them."""

    def error(split: str) -> str:
        if split not in entry.errors:
            return "-"
        best = min(other.errors[split].mean for other in entries if split in other.errors)
        text = entry.errors[split].text(between)
        return bold.format(text) if split != "validation" and entry.errors[split].mean == best else text

    def optional(value: Spread | None, decimals: int) -> str:
        return "-" if value is None else value.text(between, decimals)

    excess = "-"
    if entry.excesses:
        worse = sum(value > 0 for value in entry.excesses)
        excess = f"{Spread.of(entry.excesses).text(between, 0)} {percent} ({worse} of {len(entry.excesses)})"
    gap = "-" if entry.gap is None else f"{entry.gap:.2f}"
    published = ["-", "-"] if entry.row.published is None else [f"{value:.3f}" for value in entry.row.published]
    latent = [optional(value, decimals) for value, decimals in zip(entry.latent, LATENT_DECIMALS, strict=True)]
    return [entry.row.title, error("train"), error("validation"), error("test"), excess, gap, *latent, *published]


def _spread(parts: Sequence[dict], name: str) -> Spread | None:
    """Of a figure that every seed has."""
    return Spread.of([float(part[name]) for part in parts]) if all(name in part for part in parts) else None
