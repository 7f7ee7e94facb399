"""Which reader opens which format."""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from mitsuba_avatar.captures.formats.actorshq import open_actorshq
from mitsuba_avatar.captures.formats.avatarrex import open_avatarrex, open_thuman4
from mitsuba_avatar.captures.formats.dna_rendering import DnaRenderingSource
from mitsuba_avatar.captures.formats.easymocap import open_easymocap
from mitsuba_avatar.captures.formats.goliath import GoliathSource
from mitsuba_avatar.captures.formats.neuralbody import open_neuralbody
from mitsuba_avatar.captures.formats.source import Source, SourceOptions

FormatName = Literal["goliath", "actorshq", "easymocap", "zju", "avatarrex", "thuman4", "dna"]

_OPENERS: Mapping[FormatName, Callable[[Path, SourceOptions], Source]] = {
    "goliath": GoliathSource,
    "actorshq": open_actorshq,
    "easymocap": open_easymocap,
    "zju": open_neuralbody,
    "avatarrex": open_avatarrex,
    "thuman4": open_thuman4,
    "dna": DnaRenderingSource,
}

FORMAT_NAMES: tuple[FormatName, ...] = tuple(_OPENERS)
_FORMAT_PREFIX = re.compile(r"([A-Za-z0-9_]{2,}):(.*)", re.DOTALL)  # one letter is a drive


@dataclass(frozen=True)
class SourceName:
    """A data set of another format as commands name it: FORMAT:DIR."""

    format: FormatName
    path: Path

    @staticmethod
    def parse(name: str) -> "SourceName | None":
        """The data set that a word names; None for anything that does not begin with a format's name, or is a file's path.

        Raises:
            ValueError: for a word before the colon that is no format's.
        """
        match = _FORMAT_PREFIX.fullmatch(name)
        if match is None or Path(name).exists():
            return None
        if match.group(1) not in _OPENERS:
            raise ValueError(
                f"SourceName: expected a folder, or FORMAT:DIR with FORMAT one of {', '.join(_OPENERS)}; got {name!r}. Correct it."
            )
        return SourceName(match.group(1), Path(match.group(2)))

    def __str__(self) -> str:
        """The same word with an absolute path, so that it means the same elsewhere."""
        return f"{self.format}:{self.path.absolute()}"


def open_source(format_name: FormatName, path: Path | str, options: SourceOptions = SourceOptions()) -> Source:  # noqa: B008 - frozen
    """Open a capture of another format in place.

    Raises:
        FileNotFoundError: if the folder, or a file that every capture of the format has, is missing.
        ValueError: for an unknown format, files of another schema, or no frame that every camera has.
    """
    if format_name not in _OPENERS:
        raise ValueError(f"open_source(): expected one of the formats {', '.join(_OPENERS)}; got {format_name!r}. Choose one of them.")
    path = Path(path)
    if not path.is_dir():
        raise FileNotFoundError(f"open_source(): expected a folder at {path}; got none. Check the path.")
    return _OPENERS[format_name](path, options)
