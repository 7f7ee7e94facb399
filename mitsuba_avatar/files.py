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


def check_writable(folder: Path | str) -> None:
    """Check that files can be written into a folder that may not exist yet; makes nothing.

    Raises:
        PermissionError: the folder, or the nearest one above it that exists, cannot be written.
    """
    existing = Path(folder).absolute()
    while not existing.exists() and existing != existing.parent:
        existing = existing.parent
    if not existing.is_dir():
        raise PermissionError(f"check_writable(): expected a folder at {folder}; got {existing}, which is a file. Name another place.")
    if not os.access(existing, os.W_OK | os.X_OK):
        raise PermissionError(f"check_writable(): expected permission to write into {existing}; got none. Name another place.")


def cache_folder() -> Path:
    """Folder for things made once and reused: the built rig, the embedded default capture.

    `MITSUBA_AVATAR_CACHE` names another place; the default follows the XDG base directory specification.
    """
    chosen = os.environ.get("MITSUBA_AVATAR_CACHE")
    if chosen:
        return Path(chosen).expanduser()
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "mitsuba_avatar"
