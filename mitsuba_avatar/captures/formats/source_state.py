"""Whether a data set is still the one that was opened: a fingerprint that survives copying and costs no reading of images."""

import hashlib
import os
from pathlib import Path

from mitsuba_avatar.captures.formats.files import EXTENSIONS

LARGEST_READ = 1 << 24  # bytes; a calibration is smaller, an archive larger


def source_state(path: Path) -> str:
    """Fingerprint of a data set's folder: names of all files, sizes of those that are no images, contents of small ones at its top.

    Added or missing cameras and frames change it, and so does another calibration or archive; another copy in another place, or at
    another time, does not. Files whose names start with a dot do not count. Listing a million images takes about a second.

    Raises:
        FileNotFoundError: if there is no such folder.
    """
    if not path.is_dir():
        raise FileNotFoundError(f"source_state(): expected a folder at {path}; got none. Check the path.")
    digest = hashlib.sha256()
    for folder, subfolders, names in os.walk(path):
        subfolders[:] = sorted(name for name in subfolders if not name.startswith("."))
        here = Path(folder)
        digest.update(f"{here.relative_to(path).as_posix()}\n".encode())
        for name in sorted(names):
            if name.startswith("."):
                continue
            digest.update(f"{name}\n".encode())
            if os.path.splitext(name)[1] in EXTENSIONS:
                continue
            size = (here / name).stat().st_size
            digest.update(f"{size}\n".encode())
            if here == path and size <= LARGEST_READ:
                digest.update((here / name).read_bytes())
    return digest.hexdigest()[:16]
