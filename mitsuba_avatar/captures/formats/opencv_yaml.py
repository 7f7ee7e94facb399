"""The part of OpenCV's FileStorage YAML that calibrations use: numbers, lists of strings, matrices.

`%YAML:1.0` and `!!opencv-matrix` keep ordinary YAML readers from these files; once both are taken away, the rest is plain YAML.
"""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from mitsuba_avatar.captures.formats.decoding import require_file


def read_opencv_yaml(path: Path) -> dict[str, Any]:
    """Entries of a FileStorage file; matrices become float64 arrays [rows, cols].

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: for text that is no YAML, or a matrix whose data do not fill it.
    """
    text = require_file(path, "Calibrate the cameras first.").read_text(encoding="utf-8-sig")
    body = re.sub(r"^%YAML[^\n]*\n(---[^\n]*\n)?", "", text).replace("!!opencv-matrix", "")
    # OpenCV separates key and value of short entries by a colon alone.
    body = re.sub(r"^(\s*[A-Za-z_][\w.-]*):(?=[^\s:])", r"\1: ", body, flags=re.MULTILINE)
    try:
        document = yaml.safe_load(body)
    except yaml.YAMLError as error:
        raise ValueError(f"read_opencv_yaml(): expected OpenCV YAML in {path}; got: {error}. Write it with cv2.FileStorage.") from error
    if not isinstance(document, dict):
        raise ValueError(f"read_opencv_yaml(): expected named entries in {path}; got {str(document)[:60]!r}. Name a calibration file.")
    return {str(key): _value(value, str(key), path) for key, value in document.items()}


def opencv_yaml_text(entries: Mapping[str, Any]) -> str:
    """Text of a FileStorage file of numbers, lists of strings, and matrices."""
    lines = ["%YAML:1.0", "---"]
    for key, value in entries.items():
        if isinstance(value, np.ndarray):
            data = ", ".join(repr(float(number)) for number in value.ravel())
            lines += [f"{key}: !!opencv-matrix", f"   rows: {value.shape[0]}", f"   cols: {value.shape[1]}", "   dt: d"]
            lines += [f"   data: [ {data} ]"]
        elif isinstance(value, list):
            lines += [f"{key}:", *(f'   - "{item}"' for item in value)]
        else:
            lines.append(f"{key}: {value}")
    return "\n".join(lines) + "\n"


def _value(value: Any, key: str, path: Path) -> Any:
    """A matrix of its entries; anything else as it is."""
    if not isinstance(value, dict) or not {"rows", "cols", "data"} <= set(value):
        return value
    try:
        return np.array(value["data"], dtype=np.float64).reshape(int(value["rows"]), int(value["cols"]))
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"read_opencv_yaml(): expected {value['rows']}x{value['cols']} numbers for {key} in {path}; got {len(value['data'])}. "
            "Copy the file again."
        ) from error
