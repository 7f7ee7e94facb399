"""Bytes of other formats' files as arrays and tables; every complaint names the file, or the zip and its member."""

import csv
import io
import json
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float32, Float64, Int64, UInt8
from PIL import Image, UnidentifiedImageError
from trimesh.exchange.ply import load_ply

from mitsuba_avatar.captures.images import require_eight_bits


def decode_image(data: bytes, where: str) -> UInt8[np.ndarray, "H W 3"]:
    """Decode an 8-bit colour image (png, jpg, avif, ...).

    Raises:
        ValueError: for a truncated image, something else, more than 8 bits a channel, or inks (CMYK) instead of light.
    """
    return _decoded(data, where, "RGB")


def decode_grey(data: bytes, where: str) -> UInt8[np.ndarray, "H W"]:
    """Decode a mask: [H, W], 0 to 255. Raises as `decode_image`."""
    return _decoded(data, where, "L")


def decode_labels(data: bytes, where: str) -> UInt8[np.ndarray, "H W"]:
    """Decode an image of labels: grey values, or the indices (not the colours) of a palette. Raises as `decode_image`."""
    return _decoded(data, where, "labels")


def encoded_size(data: bytes, where: str) -> tuple[int, int]:
    """(width, height) from an image's header alone. Raises as `decode_image`."""
    try:
        with Image.open(io.BytesIO(data)) as image:
            return image.size
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise _not_an_image(data, where, error) from error


def parse_json(data: bytes, where: str) -> Any:
    """A JSON document; a byte-order mark is accepted.

    Raises:
        ValueError: for text that is not JSON.
    """
    try:
        return json.loads(data.decode("utf-8-sig"))
    except ValueError as error:
        raise ValueError(f"parse_json(): expected JSON in {where}; got: {error}. Copy the file again.") from error


def parse_numbers(data: bytes, where: str, count: int | None = None) -> Float64[np.ndarray, "N"]:
    """Numbers separated by white space (one a line, say).

    Raises:
        ValueError: for another word, or another count than `count`.
    """
    try:
        numbers = np.array(data.decode("utf-8-sig").split(), dtype=np.float64)
    except ValueError as error:
        raise ValueError(f"parse_numbers(): expected numbers in {where}; got: {error}. Copy the file again.") from error
    if (count is not None and len(numbers) != count) or not np.isfinite(numbers).all():
        expected = "finite numbers" if count is None else f"{count} finite numbers"
        raise ValueError(f"parse_numbers(): expected {expected} in {where}; got {len(numbers)}. Take files of one release.")
    return numbers


def read_table(path: Path, columns: Sequence[str]) -> list[dict[str, str]]:
    """Rows of a CSV file with a header. A byte-order mark, CRLF, spaces and further columns are accepted.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if a column is missing, in the header or in a row.
    """
    require_file(path)
    with path.open(encoding="utf-8-sig", newline="") as file:
        rows = csv.DictReader(file, skipinitialspace=True)
        header = [column.strip() for column in rows.fieldnames or ()]
        if not set(columns) <= set(header):
            raise ValueError(
                f"read_table(): expected the columns {','.join(columns)} in {path}; got {','.join(header)!r}. Separate with commas."
            )
        rows.fieldnames = header
        table = []
        for row in rows:
            if any(row[column] is None for column in columns):
                raise ValueError(f"read_table(): expected {len(header)} values in line {rows.line_num} of {path}; got fewer. Correct it.")
            table.append({column: row[column].strip() for column in columns})
    return table


def decode_ply(data: bytes, where: str) -> tuple[Float32[np.ndarray, "V 3"], Int64[np.ndarray, "F 3"] | None]:
    """Vertices [V, 3] of a PLY mesh or point cloud in its own unit, and its triangles if it has any.

    Raises:
        ValueError: for a truncated file, one that is no PLY, or one without vertices.
    """
    try:
        mesh = load_ply(io.BytesIO(data), fix_texture=False)
        vertices = np.asarray(mesh["vertices"], dtype=np.float32).reshape(-1, 3)
        faces = mesh.get("faces")
    except (ValueError, KeyError, IndexError, TypeError, AttributeError, struct.error) as error:
        raise ValueError(f"decode_ply(): expected a whole PLY mesh in {where}; got {len(data)} bytes: {error}. Copy it again.") from error
    if not len(vertices):
        raise ValueError(f"decode_ply(): expected vertices in {where}; got none. Copy it again.")
    return vertices, None if faces is None or not len(faces) else np.asarray(faces, dtype=np.int64)


def encode_ply(vertices: Float32[np.ndarray, "V 3"], faces: Int64[np.ndarray, "F 3"] | None = None) -> bytes:
    """A binary PLY of vertices, and of triangles if they are given."""
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    header += [f"property float {axis}" for axis in "xyz"]
    body = np.ascontiguousarray(vertices, dtype="<f4").tobytes()
    if faces is not None:
        header += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
        corners = np.empty(len(faces), dtype=[("count", "u1"), ("corners", "<i4", 3)])
        corners["count"], corners["corners"] = 3, faces
        body += corners.tobytes()
    return ("\n".join([*header, "end_header"]) + "\n").encode("ascii") + body


def require_file(path: Path, remedy: str = "Copy it here.") -> Path:
    """The path, if a file is there.

    Raises:
        FileNotFoundError: if not.
    """
    if not path.is_file():
        raise FileNotFoundError(f"require_file(): expected a file at {path}; got none. {remedy}")
    return path


def _decoded(data: bytes, where: str, mode: Literal["RGB", "L", "labels"]) -> UInt8[np.ndarray, "H W *channels"]:
    """Decode with Pillow, refusing what would lose bits or turn inks into colours."""
    try:
        with Image.open(io.BytesIO(data)) as image:
            require_eight_bits(image, data, where, "decode_image")
            if mode == "labels":
                return np.array(image if image.mode in ("L", "P") else image.convert("RGB").getchannel(0))
            return np.array(image.convert(mode))
    except (OSError, SyntaxError, Image.DecompressionBombError) as error:
        raise _not_an_image(data, where, error) from error


def _not_an_image(data: bytes, where: str, error: Exception) -> ValueError:
    """The complaint about bytes that cannot be decoded."""
    reason = "it is no image" if isinstance(error, UnidentifiedImageError) else str(error)
    return ValueError(f"decode_image(): expected a whole image in {where}; got {len(data)} bytes: {reason}. Copy or export it again.")
