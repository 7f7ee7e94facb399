"""Members of a zip, or of a folder that was unpacked from it, read one by one: nothing is extracted to disk."""

import zipfile
import zlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path, PurePosixPath

from mitsuba_avatar.files import atomic_path


class Archive:
    """Files of a zip by their names without folders.

    Opening reads the zip's directory at its end; members are read when asked for, and their checksums are compared.

    Raises:
        FileNotFoundError: if there is neither the zip nor an unpacked folder of its name.
        ValueError: for a file that is no whole zip.
    """

    def __init__(self, path: Path):
        self.path = path
        self._zip: zipfile.ZipFile | None = None
        folder = path.with_suffix("")
        if path.is_file():
            try:
                self._zip = zipfile.ZipFile(path)
            except (zipfile.BadZipFile, OSError) as error:
                raise ValueError(
                    f"Archive(): expected a whole zip at {path}; got {path.stat().st_size} bytes: {error}. Download or copy it again."
                ) from error
            members = [name for name in self._zip.namelist() if not name.endswith("/")]
        elif folder.is_dir():
            self.path = folder
            members = [entry.relative_to(folder).as_posix() for entry in folder.rglob("*") if entry.is_file()]
        else:
            raise FileNotFoundError(f"Archive(): expected {path}, or the folder {folder} unpacked from it; got neither. Copy it here.")
        self._members = {PurePosixPath(name).name: name for name in members}

    @staticmethod
    def is_at(path: Path) -> bool:
        """Whether the zip, or its unpacked folder, is there."""
        return path.is_file() or path.with_suffix("").is_dir()

    @property
    def names(self) -> Mapping[str, str]:
        """File name -> name inside the archive."""
        return self._members

    def numbers(self, extension: str) -> set[int]:
        """Numbers of the members `<digits>.<extension>`."""
        paths = [PurePosixPath(name) for name in self._members]
        return {int(path.stem) for path in paths if path.suffix == f".{extension}" and path.stem.isdecimal()}

    def where(self, name: str) -> str:
        """A member as messages name it."""
        return f"{self.path}:{self._members.get(name, name)}"

    def read(self, name: str) -> bytes:
        """Contents of a member.

        Raises:
            FileNotFoundError: if there is no such member.
            ValueError: if the member is truncated or damaged.
        """
        if name not in self._members:
            raise FileNotFoundError(f"Archive.read(): expected {name} in {self.path}; got {len(self._members)} other members.")
        if self._zip is None:
            return (self.path / self._members[name]).read_bytes()
        try:
            return self._zip.read(self._members[name])
        except (zipfile.BadZipFile, zlib.error, EOFError, OSError, NotImplementedError) as error:
            raise ValueError(
                f"Archive.read(): expected a whole member {self.where(name)}; got a damaged one: {error}. Download or copy the zip again."
            ) from error


def write_archive(path: Path, members: Sequence[str], contents: Callable[[int], bytes]) -> None:
    """Write an uncompressed zip, whole or not at all.

    Args:
        path: the zip.
        members: names inside it, in order.
        contents: called with each index, gives the member's bytes.
    """
    with atomic_path(path) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_STORED) as archive:
        for index, name in enumerate(members):
            archive.writestr(zipfile.ZipInfo(name, date_time=(1980, 1, 1, 0, 0, 0)), contents(index))
