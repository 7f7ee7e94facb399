"""Where the files lie that the project ships beside its code: presets in configs/, Mitsuba scenes in scenes/.

In a checkout (and an editable installation of one) both folders stand next to the package; a wheel carries them inside it.
"""

import difflib
from pathlib import Path
from typing import Literal

_PACKAGE = Path(__file__).parent


def resource_folder(kind: Literal["configs", "scenes"]) -> Path:
    """The folder of presets or of scenes."""
    installed = _PACKAGE / kind
    # The wheel's place is asked first: beside an installed package lie other projects, which may have a folder of this name.
    return installed if installed.is_dir() else _PACKAGE.parent / kind


def find_resource(kind: Literal["configs", "scenes"], name: str, ending: str) -> Path:
    """Find a preset or a scene by path or by name.

    Args:
        kind: which of the shipped folders to look in.
        name: path of a file of the user's (this wins), or a file of the folder, with or without its ending: `dome`, `ablation/no_latent`.
        ending: `.yaml`, `.xml`.

    Raises:
        FileNotFoundError: if neither exists; the message lists the names that do, the nearest first.
    """
    folder = resource_folder(kind)
    for candidate in (Path(name).expanduser(), folder / name, folder / f"{name}{ending}"):
        if candidate.is_file():
            return candidate
    known = sorted(path.relative_to(folder).with_suffix("").as_posix() for path in folder.rglob(f"*{ending}"))
    nearest = difflib.get_close_matches(name.removeprefix(f"{kind}/").removesuffix(ending), known, n=len(known) or 1, cutoff=0.0)
    raise FileNotFoundError(
        f"find_resource(): expected a file, or a name of {kind}/; got {name!r}. "
        f"Known names: {', '.join(nearest) or 'none'}; or give the path of a {ending} file."
    )
