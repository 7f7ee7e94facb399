"""The cameras' colour corrections as images get them and as the capture keeps them: `colour_correction.json`.

Corrections act on the linear radiance that sRGB bytes decode to. The file lets them be taken back, up to rounding and to what a gain
carried beyond white; the videos' own colours are in `.registration/frames_*/`.
"""

import json
import shutil
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float64, UInt8

from mitsuba_avatar.captures.colour import decode_bytes, encode_bytes
from mitsuba_avatar.captures.colour_calibration import correct_colours
from mitsuba_avatar.files import atomic_path
from mitsuba_avatar.registration.colour_agreement import ColourAgreement

CORRECTION_FILE = "colour_correction.json"
FORMAT_VERSION = 1


def corrected_image(image: UInt8[np.ndarray, "H W 3"], matrix: Float[np.ndarray, "3 4"]) -> UInt8[np.ndarray, "H W 3"]:
    """An image, or a background plate, of a camera after its correction [3, 4]; the same bytes where that is identity."""
    if np.array_equal(matrix, np.eye(3, 4)):
        return image
    return encode_bytes(correct_colours(decode_bytes(image, "srgb"), matrix.astype(np.float32)), "srgb")


def undoing(matrix: Float[np.ndarray, "3 4"]) -> Float64[np.ndarray, "3 4"]:
    """The correction [3, 4] that takes a correction back."""
    inverse = np.linalg.inv(matrix[:, :3].astype(np.float64))
    return np.concatenate([inverse, -inverse @ matrix[:, 3:]], axis=1)


def load_corrections(folder: Path | str) -> dict[str, Float64[np.ndarray, "3 4"]]:
    """Corrections that a capture's images carry, by camera; empty if they carry none.

    Raises:
        ValueError: if the file is not one of ours; names it.
    """
    path = Path(folder) / CORRECTION_FILE
    if not path.is_file():
        return {}
    try:
        document = json.loads(path.read_text(encoding="utf-8-sig"))
        if document["format_version"] != FORMAT_VERSION:
            raise ValueError(f"format_version {document['format_version']}")
        return {name: np.array(rows, np.float64).reshape(3, 4) for name, rows in document["cameras"].items()}
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ValueError(
            f"load_corrections(): expected cameras' 3 x 4 matrices of format_version {FORMAT_VERSION} in {path}; got {error!r}. "
            "Register again, or use the version of this package that wrote it."
        ) from error


def keep_corrections(folder: Path, agreement: ColourAgreement) -> None:
    """Write the file beside a capture that is being written; images that an earlier attempt wrote with other corrections are removed."""
    path = folder / CORRECTION_FILE
    text = None if agreement.correction == "none" else _text(agreement)
    stored = path.read_text(encoding="utf-8") if path.is_file() else None
    if stored == text:
        return
    if (folder / "images").is_dir():
        shutil.rmtree(folder / "images")
    if text is None:
        path.unlink()
        return
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _text(agreement: ColourAgreement) -> str:
    document = {
        "format_version": FORMAT_VERSION,
        "correction": agreement.correction,
        "reference": agreement.reference,
        "applies_to": "linear radiance of the recorded images: corrected = matrix[:, :3] recorded + matrix[:, 3]",
        "cameras": {name: matrix.round(6).tolist() for name, matrix in agreement.matrices.items()},
    }
    return json.dumps(document, indent=1) + "\n"
