"""The measures behind the claim, row by row: does the avatar shade, is its code disentangled, is its surface nearer to the truth.

One Markdown table each, means and deviations over seeds, of what `analysis` measured of every run. Which figure is what, and its unit, is
told in docs/ablation.md.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from mitsuba_avatar.ablation.plan import PlannedRun
from mitsuba_avatar.ablation.rows import Row
from mitsuba_avatar.ablation.spread import Spread


@dataclass(frozen=True)
class Column:
    """A figure of a run.

    Attributes:
        heading: as the table calls it.
        path: keys that lead to it in the run's measures.
        decimals: that are written.
    """

    heading: str
    path: tuple[str, ...]
    decimals: int

    def text(self, measured: Sequence[dict]) -> str:
        """Mean and deviation over seeds; a dash where not every seed has the figure."""
        values = [_at(one, self.path) for one in measured]
        return "-" if None in values else Spread.of(values).text(decimals=self.decimals)


MEAN_CODE = (
    Column("train", ("images_mean_code", "train", "mse"), 2),
    Column("validation", ("images_mean_code", "validation", "mse"), 2),
    Column("test", ("images_mean_code", "test", "mse"), 2),
    Column("nats of the offset", ("disentanglement", "offset_nats"), 1),
)
SHADING = (
    Column("train: slope", ("shading", "train", "slope"), 2),
    Column("test: slope", ("shading", "test", "slope"), 2),
    Column("fell", ("shading", "test", "darker"), 3),
    Column("rose", ("shading", "test", "lighter"), 3),
    Column("squared error where occlusion changed", ("shading", "test", "changed_mse"), 0),
    Column("elsewhere", ("shading", "test", "unchanged_mse"), 0),
)
DISENTANGLEMENT = (
    Column("latent swap: joints", ("disentanglement", "latent_swap", "body_keypoints_mm"), 2),
    Column("landmarks", ("disentanglement", "latent_swap", "face_landmarks_mm"), 2),
    Column("clothes", ("disentanglement", "latent_swap", "vertices_mm", "garment"), 1),
    Column("drive swap: joints", ("disentanglement", "drive_swap", "body_keypoints_mm"), 2),
    Column("landmarks", ("disentanglement", "drive_swap", "face_landmarks_mm"), 2),
    Column("hidden state, validation", ("disentanglement", "hidden_state_r2", "validation"), 2),
    Column("test", ("disentanglement", "hidden_state_r2", "test"), 2),
    Column("face moves body", ("disentanglement", "spurious", "face_moves_body_mm"), 2),
    Column("pose moves face", ("disentanglement", "spurious", "pose_moves_face_mm"), 2),
)
GEOMETRY = (
    Column("registered", ("geometry", "train", "registered_mm"), 2),
    Column("decoded", ("geometry", "train", "decoded_mm"), 2),
    Column("driven", ("geometry", "train", "driven_mm"), 2),
    Column("clothes: registered", ("geometry", "train", "registered_garment_mm"), 2),
    Column("decoded", ("geometry", "train", "decoded_garment_mm"), 2),
    Column("driven", ("geometry", "train", "driven_garment_mm"), 2),
    Column("test: driven", ("geometry", "test", "driven_mm"), 2),
    Column("clothes: driven", ("geometry", "test", "driven_garment_mm"), 2),
)
TITLES = {"Driven with the mean code": MEAN_CODE, "Shading": SHADING, "Disentanglement": DISENTANGLEMENT, "Geometry": GEOMETRY}


def measures_markdown(runs: Sequence[PlannedRun]) -> str:
    """All tables, each under its title; one that no run has a figure for is left out."""
    measured: dict[Row, list[dict]] = {}
    for run in runs:
        if run.is_measured:
            measured.setdefault(run.row, []).append(run.measures())
    tables = (_table(title, columns, measured) for title, columns in TITLES.items())
    return "\n".join(table for table in tables if table)


def _table(title: str, columns: Sequence[Column], measured: dict[Row, list[dict]]) -> str:
    lines = [[row.title, *(column.text(ones) for column in columns)] for row, ones in measured.items()]
    if all(cell == "-" for line in lines for cell in line[1:]):
        return ""
    lines = [["model", *(column.heading for column in columns)], ["---"] * (len(columns) + 1), *lines]
    return f"## {title}\n\n" + "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def _at(measures: Any, path: tuple[str, ...]) -> float | None:
    """Figure at the end of a path of keys; None where it was not measured."""
    for key in path:
        if not isinstance(measures, dict) or key not in measures:
            return None
        measures = measures[key]
    return measures
