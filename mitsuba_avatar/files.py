"""Files that are whole or absent: everything the project writes goes to a temporary sibling first and is renamed when complete."""

import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def atomic_path(path: Path | str) -> Iterator[Path]:
    """Yield a temporary path beside `path`; on success it replaces `path`, on any failure it is removed and `path` stays as it was.

    The temporary name keeps the ending, because many writers choose their format by it. Parent folders are made.

    Raises:
        OSError: whatever the writer or the rename raises (no permission, disk full); the old file survives.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.{uuid.uuid4().hex[:8]}{path.suffix}")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def cache_folder() -> Path:
    """Folder for things made once and reused: the built rig, the embedded default capture.

    `MITSUBA_AVATAR_CACHE` names another place; the default follows the XDG base directory specification.
    """
    chosen = os.environ.get("MITSUBA_AVATAR_CACHE")
    if chosen:
        return Path(chosen).expanduser()
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "mitsuba_avatar"
