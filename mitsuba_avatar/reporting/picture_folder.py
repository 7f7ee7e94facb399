"""A folder that pictures are drawn into, by one process or several, today or tomorrow: `render.json` says what they were drawn with.

Pictures of other settings never mix: a folder takes only what its `render.json` says. What it cannot know before the first picture (the
number of samples that fit into a time) is settled by whoever comes first, and holds for all pictures from then on.
"""

import json
import os
import uuid
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from mitsuba_avatar.files import atomic_path, check_writable

SETTINGS_FILE = "render.json"


class PictureFolder:
    """Pictures of one path under one set of settings.

    Args:
        path: the folder; it need not exist.
        settings: all that decides what pictures look like; values that JSON knows.
        is_overwritten: draw everything anew, with these settings.

    Raises:
        ValueError: the folder's pictures were drawn with other settings.
        PermissionError: if nothing can be written there.
    """

    def __init__(self, path: Path, settings: Mapping[str, Any], is_overwritten: bool = False):
        check_writable(path)
        self.path, self._overwritten = path, is_overwritten
        self._settings = json.loads(json.dumps(dict(settings)))  # as it will be read back
        self._stored: dict[str, Any] | None = None
        file = path / SETTINGS_FILE
        if is_overwritten or not file.exists():
            return
        try:
            self._stored = json.loads(file.read_text(encoding="utf-8"))
            stored = dict(self._stored["settings"])
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(f"PictureFolder(): expected settings in {file}; got: {error!r}. Remove it, or use --overwrite.") from error
        for key in sorted(set(stored) | set(self._settings)):
            if stored.get(key) != self._settings.get(key):
                raise ValueError(
                    f"PictureFolder(): expected pictures with {key} = {stored.get(key)!r}, as {path} has them; got "
                    f"{self._settings.get(key)!r}. Draw into another --out, or use --overwrite."
                )

    def settle(self, find_out: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """What was found out for this folder: by the first process that asks, `find_out` is not called again. Writes render.json."""
        file = self.path / SETTINGS_FILE
        if self._stored is None:
            text = json.dumps({"settings": self._settings, "settled": find_out()}, indent=1) + "\n"
            if self._overwritten:
                with atomic_path(file) as temporary:
                    temporary.write_text(text, encoding="utf-8")
            else:
                self.path.mkdir(parents=True, exist_ok=True)
                draft = file.with_name(f".{SETTINGS_FILE}.{uuid.uuid4().hex[:8]}")
                try:
                    draft.write_text(text, encoding="utf-8")
                    with suppress(FileExistsError):
                        os.link(draft, file)  # whole at once, and refused where another process was faster
                finally:
                    draft.unlink(missing_ok=True)
            self._stored = json.loads(file.read_text(encoding="utf-8"))
        return dict(self._stored["settled"])

    def needs(self, name: str) -> bool:
        """Whether a file is still to be written."""
        return self._overwritten or not (self.path / name).exists()
