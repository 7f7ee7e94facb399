"""Runs that were measured elsewhere: seeds trained on other machines, or in an earlier table, join this one instead of being trained again.

A table's JSON holds all that was measured of every run, and the settings it was made with. A run is adopted by writing its figures where
its own worker would have left them, with a note of where they are from.
"""

import json
import sys
from pathlib import Path

from mitsuba_avatar.ablation.plan import ADOPTED, PlannedRun, compared_settings
from mitsuba_avatar.presets import save_settings
from mitsuba_avatar.settings import Settings


def adopt(runs: list[PlannedRun], table: Path) -> list[PlannedRun]:
    """Take the figures of planned runs that are neither begun nor measured here from another table.

    Runs of the table that are not planned are passed over. Runs measured on other content of the capture are adopted, and told on stderr:
    pictures that are filmed again on another machine differ in single bytes.

    Args:
        runs: planned.
        table: table.json, as `write_tables` leaves it.

    Returns:
        The runs that were adopted.

    Raises:
        FileNotFoundError, ValueError: no such table, no table, or a run in it was made with other settings than planned.
    """
    rows = {(row["name"], row["seed"]): row for row in _rows(table)}
    adopted = [run for run in runs if (run.row.name, run.settings.training.seed) in rows and not run.is_begun and not run.is_measured]
    for run in adopted:  # all, before any is written
        _check_made_alike(run, rows[run.row.name, run.settings.training.seed], table)
    for run in adopted:
        run.path.mkdir(parents=True, exist_ok=True)
        save_settings(run.path / "settings.yaml", run.settings)
        run.save_measures(rows[run.row.name, run.settings.training.seed]["measures"] | {ADOPTED: str(table)})
    others = sorted({digest[:12] for digest in (run.measures().get("capture_digest") for run in adopted) if digest})
    here = next((run.digest for run in adopted if run.digest), None)
    if here is not None and others != [here[:12]]:
        sys.stderr.write(
            f"Runs from {table} were measured on captures of digest {', '.join(others) or 'unknown'}; that of this one is {here[:12]}. "
            "That is well where one preset was filmed on several machines.\n"
        )
    return adopted


def _rows(table: Path) -> list[dict]:
    """Runs of a table.json."""
    if not table.is_file():
        raise FileNotFoundError(f"adopt(): expected table.json of another ablation; there is no {table}. Correct --measured.")
    try:
        rows = json.loads(table.read_text(encoding="utf-8"))
        if all({"name", "seed", "measures"} <= row.keys() for row in rows):
            return rows
    except (ValueError, AttributeError, TypeError):  # no JSON, or other JSON
        pass
    raise ValueError(
        f"adopt(): expected runs with name, seed and measures in {table}; got something else. Name a table.json with --measured."
    )


def _check_made_alike(run: PlannedRun, row: dict, table: Path) -> None:
    """A table of runs that were not made alike would prove nothing. A setting that is younger than the table had its default then."""
    if row.get("settings") is None:
        raise ValueError(
            f"adopt(): expected the settings of {row['name']}, seed {row['seed']}, in {table}; got none, as older versions wrote it. "
            "Train it again."
        )
    was = compared_settings(Settings()) | row["settings"]
    changed = [f"{key} {was[key]} -> {value}" for key, value in compared_settings(run.settings).items() if was[key] != value]
    if changed:
        raise ValueError(
            f"adopt(): expected {row['name']}, seed {row['seed']}, of {table} to be of the same settings; got {', '.join(changed)}. "
            "Leave --measured out, or give the overrides and the budget that the table was made with."
        )
