"""frames.csv: which moments a capture holds, and which of them train, validate and test.

A frame's *number* names its image files; its *index* is its row here and in every array of the capture. The two differ wherever a
capture starts late or skips frames.
"""

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from mitsuba_avatar.files import atomic_path

COLUMNS = ("frame", "time", "split", "segment")
SPLITS = ("train", "validation", "test")
STRESS = "stress"  # test segments whose name begins so hold motion far from training, and are reported apart


@dataclass(frozen=True)
class Frame:
    """One moment of a capture.

    Attributes:
        number: names the image files, `images/<camera>/<number:06d>.<extension>`.
        time: seconds from the capture's start.
        split: "train" may be learnt from; "validation" is held out within the training takes, to choose settings by; "test" is for
            reporting alone.
        segment: the take it belongs to, "range_of_motion" say; frames of one segment follow each other in time. A test
            segment whose name begins with "stress" is set apart, see `purpose`.
    """

    number: int
    time: float
    split: Literal["train", "validation", "test"]
    segment: str

    def __post_init__(self) -> None:
        if self.number < 0 or self.split not in SPLITS:
            raise ValueError(
                f"Frame(): expected a number >= 0 and a split of {', '.join(SPLITS)}; got {self.number} and {self.split!r}. "
                "Correct the frame."
            )

    @property
    def purpose(self) -> Literal["train", "validation", "test", "stress"]:
        """The split, but "stress" for frames of a stress segment: no figure of a test split counts them."""
        return "stress" if self.split == "test" and self.segment.startswith(STRESS) else self.split


def save_frames(path: Path | str, frames: Sequence[Frame]) -> None:
    """Write frames.csv; the file is whole or absent."""
    with atomic_path(path) as temporary:
        temporary.write_text(frames_text(frames), encoding="utf-8")


def frames_text(frames: Sequence[Frame]) -> str:
    """The text of frames.csv: equal frames give equal text."""
    _check_numbers(frames, "frames_text()")
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(COLUMNS)
    rows.writerows((frame.number, repr(float(frame.time)), frame.split, frame.segment) for frame in frames)
    return text.getvalue()


def load_frames(path: Path | str) -> tuple[Frame, ...]:
    """Read frames.csv. A byte-order mark, CRLF line ends, blank lines and further columns, as spreadsheets write them, are accepted.

    Returns:
        the frames by index.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: for missing columns, a value that cannot be read (names the line), no frames, or a number that occurs twice.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"load_frames(): expected a frame list at {path}; got none. Write it with save_frames().")
    with path.open(encoding="utf-8-sig", newline="") as file:
        rows = csv.DictReader(file, skipinitialspace=True)
        header = [column.strip() for column in rows.fieldnames or ()]
        if not set(COLUMNS) <= set(header):
            raise ValueError(
                f"load_frames(): expected the columns {','.join(COLUMNS)} in {path}; got {','.join(header)!r}. Separate with commas."
            )
        rows.fieldnames = header
        frames = tuple(_frame_from_row(path, rows.line_num, row) for row in rows)
    if not frames:
        raise ValueError(f"load_frames(): expected at least one frame in {path}; got none. List the frames of the capture.")
    _check_numbers(frames, f"load_frames(): {path}")
    return frames


def _frame_from_row(path: Path, line: int, row: dict[str, str]) -> Frame:
    """One line of the file."""
    try:
        return Frame(number=int(row["frame"]), time=float(row["time"]), split=row["split"].strip(), segment=row["segment"].strip())
    except (AttributeError, TypeError, ValueError) as error:
        values = [row[column] for column in COLUMNS]
        raise ValueError(
            f"load_frames(): expected 'number,seconds,{'|'.join(SPLITS)},segment' in line {line} of {path}; got {values}. Correct the line."
        ) from error


def _check_numbers(frames: Sequence[Frame], subject: str) -> None:
    """Frame numbers name files, so each may occur once."""
    seen: set[int] = set()
    for frame in frames:
        if frame.number in seen:
            raise ValueError(f"{subject} must list every frame once; got frame {frame.number} twice. Remove the repetition.")
        seen.add(frame.number)
