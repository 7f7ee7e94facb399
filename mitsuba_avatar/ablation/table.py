"""The ablation table from the figures of measured runs: Markdown, LaTeX (booktabs, best in bold), JSON; the paper's own beside it.

Errors are means over seeds with the deviation between seeds; a gap below that deviation means nothing.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mitsuba_avatar.ablation.measure_tables import measures_markdown
from mitsuba_avatar.ablation.plan import PlannedRun, compared_settings
from mitsuba_avatar.ablation.rows import Row
from mitsuba_avatar.ablation.spread import Spread
from mitsuba_avatar.files import atomic_path

LATENT_FIGURES = ("kl_nats", "active_entries", "frame_information_nats", "mutual_information_nats")  # of a run's measures
LATENT_DECIMALS = (1, 0, 2, 2)
LATENT_HEADINGS = ("KL (nats)", "active", "I(z; frame)", "I(z; drive)")  # the same, as the table calls them
PAPER_HEADINGS = ("paper train", "paper test")
HEADINGS = ("model", "train", "validation", "test", "over ours", "gap", *LATENT_HEADINGS, *PAPER_HEADINGS)
COST_HEADINGS = ("seeds", "minutes", "thousand parameters")  # before the paper's, in Markdown alone: the LaTeX is wide enough
REFERENCE = "ours"  # row that the others are compared with, seed by seed


@dataclass(frozen=True)
class Entry:
    """A row of the table; errors by split, None where the capture has no such frames or the avatar no latent code.

    What the latent code says is measured as in reporting/disentanglement.py, in nats.
    """

    row: Row
    errors: dict[str, Spread]
    excesses: tuple[float, ...]  # per cent that the test error is above that of ours with the same seed; none for ours itself
    takes: dict[str, Spread]  # test take -> its error; empty where a run does not tell
    take_excesses: tuple[float, ...]  # as `excesses`, but means over takes of the excess in each: a hard take counts as much as an easy one
    latent: tuple[Spread | None, ...]  # LATENT_FIGURES
    seeds: int  # that are measured
    minutes: float | None  # of training, mean over seeds; None where a run does not tell
    parameters: int | None  # of the avatar

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
    references = {one["seed"]: one for row, ones in measures.items() if row.name == REFERENCE for one in ones}
    ours = {seed: driven_errors(one).get("test") for seed, one in references.items()}
    for row in dict.fromkeys(run.row for run in runs):
        measured = measures.get(row, [])
        if not measured:
            continue
        errors = [driven_errors(one) for one in measured]
        parts = [one.get("disentanglement", {}) for one in measured]
        minutes = [_scaled(one, "training_seconds", 60) for one in measured]
        pairs = [(error["test"], ours[one["seed"]]) for error, one in zip(errors, measured, strict=True) if ours.get(one["seed"])]
        entries.append(
            Entry(
                row,
                {split: Spread.of([one[split] for one in errors]) for split in errors[0]},
                tuple(100 * (test / reference - 1) for test, reference in pairs) if row.name != REFERENCE else (),
                _take_spreads(measured),
                _take_excesses(measured, references) if row.name != REFERENCE else (),
                tuple(_spread(parts, name) for name in LATENT_FIGURES),
                len(measured),
                None if None in minutes else float(np.mean(minutes)),
                measured[0].get("parameters"),
            )
        )
    return entries


def driven_errors(measures: dict) -> dict[str, float]:
    """Split -> the error that the table is about, driven with z = 0: of pictures, mean squared difference inside the mask in 0..255
    values; where a rehearsal has none, distance from the true surface in millimetres, of the clothes if they are known."""
    if "images" in measures:
        return {split: values["mse"] for split, values in measures["images"].items()}
    return {split: values.get("driven_garment_mm", values["driven_mm"]) for split, values in measures["geometry"].items()}


def _takes(measures: dict) -> dict[str, float]:
    """Test take -> error, of runs that were measured take by take."""
    return measures.get("images", {}).get("test", {}).get("takes", {})


def _take_spreads(measured: Sequence[dict]) -> dict[str, Spread]:
    """Test take -> its error over seeds; empty where the seeds do not all tell the same takes."""
    takes = [_takes(one) for one in measured]
    if any(one.keys() != takes[0].keys() for one in takes):
        return {}
    return {name: Spread.of([one[name] for one in takes]) for name in takes[0]}


def _take_excesses(measured: Sequence[dict], references: dict[int, dict]) -> tuple[float, ...]:
    """For each seed that ours has, too: the mean over takes of the per cent by which the error is above that of ours in the same take."""
    pairs = [(_takes(one), _takes(references[one["seed"]])) for one in measured if one["seed"] in references]
    return tuple(
        float(np.mean([100 * (row[name] / ours[name] - 1) for name in row])) for row, ours in pairs if row and row.keys() == ours.keys()
    )


def takes_markdown(entries: Sequence[Entry]) -> str:
    """Test errors take by take, as Markdown; empty where no row tells them. In "over ours" every take counts alike, unlike in the table."""
    names = list(dict.fromkeys(name for entry in entries for name in entry.takes))
    if not names:
        return ""
    lines = [["model", *names, "over ours, mean over takes"], ["---"] * (len(names) + 2)]
    for entry in entries:
        cells = [entry.takes[name].text(decimals=1) if name in entry.takes else "-" for name in names]
        lines.append([entry.row.title, *cells, _excess(entry.take_excesses, " ± ", "%")])
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def markdown(entries: Sequence[Entry]) -> str:
    """The table as Markdown; the lowest train and test errors are bold. "over ours": test error above that of ours with the same seed, mean
    and deviation over seeds, and in how many seeds it is above. A row with fewer seeds than others says so, and is never bold."""
    rows = [HEADINGS, *(_cells(entry, entries, "**{}**", " ± ", "%") for entry in entries)]
    costs = [COST_HEADINGS, *(_cost_cells(entry, entries) for entry in entries)]
    lines = [
        "| " + " | ".join((*row[: -len(PAPER_HEADINGS)], *cost, *row[-len(PAPER_HEADINGS) :])) + " |"
        for row, cost in zip(rows, costs, strict=True)
    ]
    return "\n".join([lines[0], "|" + "---|" * (len(HEADINGS) + len(COST_HEADINGS)), *lines[1:]]) + "\n"


def latex(entries: Sequence[Entry]) -> str:
    """The table as a LaTeX tabular for the package booktabs; a row with fewer seeds than others says so beside its name."""
    lines = [r"\begin{tabular}{l" + "r" * (len(HEADINGS) - 1) + "}", r"\toprule", " & ".join(HEADINGS) + r" \\", r"\midrule"]
    for entry in entries:
        title, *cells = _cells(entry, entries, r"\textbf{{{}}}", r" $\pm$ ", r"\%")
        if entry.seeds < _most_seeds(entries):
            title += f" ({_seeds(entry, entries)} seeds)"
        lines.append(" & ".join([title, *cells]) + r" \\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}"]) + "\n"


def write_tables(folder: Path, runs: Sequence[PlannedRun]) -> list[Entry]:
    """Write table.md, table.tex and table.json of all measured runs into a folder; returns the entries.

    The JSON lists every run: `name, seed, train, test` (see `driven_errors`), `seeds` (of its row that are measured), `minutes` (of its
    training), `thousand_parameters`, `settings` (see `compared_settings`), and all that was measured.
    """
    entries = summarize(runs)
    seeds = {entry.row: entry.seeds for entry in entries}
    rows = []
    for run in runs:
        if run.is_measured:
            measures = run.measures()
            errors = driven_errors(measures)
            costs = {
                "seeds": seeds[run.row],
                "minutes": _scaled(measures, "training_seconds", 60),
                "thousand_parameters": _scaled(measures, "parameters", 1000),
            }
            made = {"settings": compared_settings(run.settings), "measures": measures}
            rows.append({"name": run.row.name, "seed": measures["seed"], **errors, **costs, **made})
    tables = "\n".join(text for text in (markdown(entries), takes_markdown(entries), measures_markdown(runs)) if text)
    texts = {"table.md": tables, "table.tex": latex(entries), "table.json": json.dumps(rows, indent=1) + "\n"}
    for name, text in texts.items():
        with atomic_path(folder / name) as temporary:
            temporary.write_text(text, encoding="utf-8")
    return entries


def _cells(entry: Entry, entries: Sequence[Entry], bold: str, between: str, percent: str) -> list[str]:
    """A row's cells under HEADINGS, without the rules between them."""
    most = _most_seeds(entries)

    def error(split: str) -> str:
        if split not in entry.errors:
            return "-"
        text = entry.errors[split].text(between)
        is_best = split != "validation" and entry.seeds == most and entry.errors[split].mean == _best(split, entries)
        return bold.format(text) if is_best else text

    def optional(value: Spread | None, decimals: int) -> str:
        return "-" if value is None else value.text(between, decimals)

    excess = _excess(entry.excesses, between, percent)
    gap = "-" if entry.gap is None else f"{entry.gap:.2f}"
    published = ["-", "-"] if entry.row.published is None else [f"{value:.3f}" for value in entry.row.published]
    latent = [optional(value, decimals) for value, decimals in zip(entry.latent, LATENT_DECIMALS, strict=True)]
    return [entry.row.title, error("train"), error("validation"), error("test"), excess, gap, *latent, *published]


def _excess(values: Sequence[float], between: str, percent: str) -> str:
    """Mean and deviation of per cents over seeds, and in how many seeds they are positive."""
    if not values:
        return "-"
    return f"{Spread.of(values).text(between, 0)} {percent} ({sum(value > 0 for value in values)} of {len(values)})"


def _cost_cells(entry: Entry, entries: Sequence[Entry]) -> list[str]:
    """A row's cells under COST_HEADINGS."""
    minutes = "-" if entry.minutes is None else f"{entry.minutes:.1f}"
    return [_seeds(entry, entries), minutes, "-" if entry.parameters is None else f"{entry.parameters / 1000:.0f}"]


def _seeds(entry: Entry, entries: Sequence[Entry]) -> str:
    """How many seeds are measured, beside how many the others have where those are more."""
    most = _most_seeds(entries)
    return str(entry.seeds) if entry.seeds == most else f"{entry.seeds} of {most}"


def _most_seeds(entries: Sequence[Entry]) -> int:
    return max(entry.seeds for entry in entries)


def _best(split: str, entries: Sequence[Entry]) -> float | None:
    """Lowest error of the rows with all seeds; None where there are no two of them to compare."""
    most = _most_seeds(entries)
    means = [entry.errors[split].mean for entry in entries if entry.seeds == most and split in entry.errors]
    return min(means) if len(means) > 1 else None


def _scaled(measures: dict, name: str, unit: int) -> float | None:
    """A figure in larger units; None where an older run does not have it."""
    return measures[name] / unit if name in measures else None


def _spread(parts: Sequence[dict], name: str) -> Spread | None:
    """Of a figure that every seed has."""
    return Spread.of([float(part[name]) for part in parts]) if all(name in part for part in parts) else None
