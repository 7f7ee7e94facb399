"""Recorded faces from the CSV files of the app Live Link Face: ARKit's facial actions over time.

Each row holds a timecode, a count and the strengths; columns are matched by name, in any order and case. Columns of head and eye rotation
are left out: head and eyes are pose angles. Symbols: M recorded moments, N frames, A actions. Seconds; strengths 0..1.
"""

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float64

FRAME_RATES = (24, 25, 30, 50, 60)  # that the app records at; the timecode counts frames, and does not say of which rate
_TIMECODE = re.compile(r"(\d+):(\d\d):(\d\d)[:;](\d+(?:\.\d+)?)")
DAY = 86400.0  # seconds, after which timecodes start again


@dataclass(frozen=True, eq=False)  # arrays have no truth value to compare by
class FaceRecording:
    """A recorded face.

    Attributes:
        name: the file's name without ending.
        action_names: A names.
        times: [M] seconds from the first row, rising.
        strengths: [M, A] 0..1.
    """

    name: str
    action_names: tuple[str, ...]
    times: Float64[np.ndarray, "M"]  # noqa: F821
    strengths: Float64[np.ndarray, "M A"]

    def at(self, times: Float[np.ndarray, "N"]) -> Float64[np.ndarray, "N A"]:  # noqa: F821
        """Strengths at any times from 0 on; a recording that is too short is played back and forth."""
        end = self.times[-1]
        within = np.zeros_like(times) if end == 0 else end - np.abs(np.mod(times, 2 * end) - end)
        return np.stack([np.interp(within, self.times, column) for column in self.strengths.T], axis=1)


def read_live_link(path: Path | str, action_names: Sequence[str]) -> FaceRecording:
    """Read the actions `action_names` (ARKit's names) from a CSV file of Live Link Face.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: for missing columns (names them), a row that cannot be read (names the line), no rows, or times that do not rise.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"read_live_link(): expected a CSV file at {path}; there is none. Check the path in motion.face_recording.")
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            rows = csv.reader(file)
            header = [column.strip().lower() for column in next(rows, [])]
            columns = _columns(path, header, action_names)
            lines = [(rows.line_num, row) for row in rows if any(cell.strip() for cell in row)]
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(
            f"read_live_link(): expected a CSV file; {path} cannot be read ({error}). Export it from the app again."
        ) from error
    if not lines:
        raise ValueError(f"read_live_link(): expected at least one row in {path}; got none. Record for longer.")
    timecodes, strengths = zip(*(_row(path, line, row, header, columns) for line, row in lines), strict=True)
    times = _seconds(path, np.array(timecodes))
    return FaceRecording(path.stem, tuple(action_names), times, np.clip(np.array(strengths), 0, 1).reshape(len(times), len(columns)))


def _columns(path: Path, header: list[str], action_names: Sequence[str]) -> list[int]:
    """Column of each action."""
    missing = [name for name in ("Timecode", *action_names) if name.lower() not in header]
    if missing:
        raise ValueError(
            f"read_live_link(): expected a column for Timecode and each facial action in {path}; missing: {', '.join(missing)}. "
            "Export the CSV from Live Link Face in its ARKit mode."
        )
    return [header.index(name.lower()) for name in action_names]


def _row(path: Path, line: int, row: list[str], header: list[str], columns: list[int]) -> tuple[tuple[float, float], list[float]]:
    """(whole seconds, frames) of the timecode, and strengths."""
    timecode = _TIMECODE.fullmatch(row[header.index("timecode")].strip()) if len(row) == len(header) else None
    try:
        strengths = [float(row[column]) for column in columns] if timecode else []
    except ValueError:
        strengths = []
    if timecode is None or len(strengths) != len(columns) or not np.isfinite(strengths).all():
        raise ValueError(
            f"read_live_link(): expected a timecode HH:MM:SS:FF and {len(header) - 1} numbers in line {line} of {path}; "
            f"got {','.join(row)[:60]!r}. Remove the line or export the file again."
        )
    hours, minutes, seconds = (int(part) for part in timecode.groups()[:3])
    return (3600.0 * hours + 60.0 * minutes + seconds, float(timecode[4])), strengths


def _seconds(path: Path, timecodes: Float64[np.ndarray, "M 2"]) -> Float64[np.ndarray, "M"]:  # noqa: F821
    """Seconds from the first row. The highest frame number tells the rate, if the recording passes the end of a second."""
    highest = timecodes[:, 1].max()
    rate = next((rate for rate in FRAME_RATES if highest < rate), None)
    if rate is None:
        raise ValueError(
            f"read_live_link(): expected at most {FRAME_RATES[-1]} frames a second in {path}; got frame {highest:g}. Record slower."
        )
    if len(np.unique(timecodes[:, 0])) < 2:
        rate = FRAME_RATES[-1]  # the app's usual rate; within one second nothing tells
    times = timecodes[:, 0] + timecodes[:, 1] / rate
    times = times + DAY * np.concatenate([[0], np.cumsum(np.diff(times) < -DAY / 2)])
    if (np.diff(times) <= 0).any():
        row = int(np.flatnonzero(np.diff(times) <= 0)[0]) + 1
        raise ValueError(
            f"read_live_link(): expected timecodes that rise in {path}; row {row + 1} is not later than row {row}. Sort or remove the rows."
        )
    return times - times[0]
