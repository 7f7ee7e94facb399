"""Checks of a capture's values, before any long work: arrays that are not numbers, lengths that are not metres, images that are damaged.

`Capture.open` checks what text files and headers tell; here arrays are read through once, block by block, and image files are looked
at one by one. What only a projection shows is in captures/reprojection.py.
"""

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float32

from mitsuba_avatar.captures.arrays import FRAME_ARRAYS
from mitsuba_avatar.captures.folder import Capture
from mitsuba_avatar.captures.rigid import is_rigid

BLOCK_BYTES = 1 << 24  # arrays are read in blocks of this size, so that memory does not grow with the number of frames
TALLEST_METRES = 5.0  # nobody, arms up on a box; a person in centimetres is 170
SMALLEST_METRES = 0.2  # nobody, curled up; a person normalized to a unit box or in kilometres is smaller
FARTHEST_METRES = 100.0  # nobody walks farther from the origin inside a capture stage
LARGEST_ANGLE = 4 * np.pi  # radians; two full turns of one joint, while degrees soon exceed it


@runtime_checkable
class RigSizes(Protocol):
    """What the checks need to know of a rig: `topology.num_vertices` and `dofs.names`.

    `body.rig.Rig` fits. Captures come before bodies in the package, so they cannot import it.
    """

    topology: Any
    dofs: Any


def check_values(capture: Capture, rig: RigSizes | None = None) -> None:
    """Run `check_arrays` and, for every frame, `check_images`. Raises as they do."""
    check_arrays(capture, rig)
    check_images(capture, range(len(capture.frames)))


def check_arrays(capture: Capture, rig: RigSizes | None = None) -> None:
    """Check the arrays that the capture has: shapes against the rig, finite values, metres, radians, rigid roots.

    Raises:
        ValueError: names file, frame, expectation and remedy.
    """
    if rig is not None:
        _check_width(capture, "vertices", capture.vertices, rig.topology.num_vertices, "vertices of the topology")
        _check_width(capture, "theta", capture.theta, len(rig.dofs.names), "joint angles of the dof table")
    for name, check in _ROW_CHECKS.items():
        array = getattr(capture, name)
        if array is None:
            continue
        for start, rows in _blocks(array):
            for problem, is_bad, remedy in check(rows):
                if is_bad.any():
                    index = start + int(np.argmax(is_bad))
                    raise ValueError(
                        f"check_arrays(): {_array_path(capture, name)}: {problem} in frame index {index} "
                        f"(number {capture.frames[index].number}). {remedy}"
                    )


def check_images(capture: Capture, frame_indices: Iterable[int]) -> None:
    """Check that images and masks of some frames exist, are whole, have their camera's size, and that masks are not labels 0 and 1.

    Masks are optional, but a capture that has some must have them all. Costs about 0.4 ms a small file.

    Raises:
        FileNotFoundError: for a missing file.
        ValueError: for a truncated file, a wrong size, or a mask of labels. Names file, expectation and remedy.
    """
    capture.images.require()
    for index in frame_indices:
        number = capture.frames[index].number
        for name in capture.cameras:
            camera = capture.stored_camera(name)
            capture.images.check_image(camera, number)
            if capture.images.has_masks:
                capture.images.check_mask(camera, number)


def _check_width(capture: Capture, name: str, array: Float32[np.ndarray, "N *row"] | None, expected: int, of_what: str) -> None:
    """Refuse an array whose second axis is not the rig's."""
    if array is not None and array.shape[1] != expected:
        raise ValueError(
            f"check_arrays(): expected {expected} {of_what} of {capture.rig_path} in {_array_path(capture, name)}; got {array.shape[1]}. "
            "Take rig and arrays from the same source: they belong to different topologies."
        )


def _array_path(capture: Capture, name: str) -> Path:
    """File of an array."""
    return capture.path / FRAME_ARRAYS[name].file_name


def _blocks(array: Float32[np.ndarray, "N *row"]) -> Iterator[tuple[int, Float32[np.ndarray, "n *row"]]]:
    """First index and rows of consecutive blocks of bounded size, read from the file one after the other."""
    rows_per_block = max(1, BLOCK_BYTES // max(1, array[:1].nbytes))
    for start in range(0, len(array), rows_per_block):
        yield start, np.array(array[start : start + rows_per_block])


# What a check of rows yields: a problem, which rows have it, and the remedy.
Findings = Iterator[tuple[str, Bool[np.ndarray, "n"], str]]


def _is_not_finite(rows: Float32[np.ndarray, "n *row"]) -> Bool[np.ndarray, "n"]:
    """Rows with a NaN or an infinity."""
    return ~np.isfinite(rows.reshape(len(rows), -1)).all(axis=1)


def _theta_findings(rows: Float32[np.ndarray, "n D"]) -> Findings:
    """Angles."""
    yield "expected finite joint angles; got NaN or infinity", _is_not_finite(rows), "Track the frame again, or remove it from the capture."
    largest = float(np.abs(rows).max(initial=0.0))
    yield (
        f"expected radians; got an angle of {largest:.1f}, which looks like degrees",
        (np.abs(rows) > LARGEST_ANGLE).any(axis=1),
        "Multiply by pi / 180.",
    )


def _root_findings(rows: Float32[np.ndarray, "n 4 4"]) -> Findings:
    """Root poses."""
    yield "expected finite root poses; got NaN or infinity", _is_not_finite(rows), "Track the frame again, or remove it from the capture."
    yield (
        "expected rigid root poses (rotation without scale or mirror, last row 0 0 0 1); got another matrix",
        ~is_rigid(rows),
        "Divide out the scale; a matrix stored transposed has its translation in the last row.",
    )
    farthest = float(np.abs(rows[:, :3, 3]).max(initial=0.0))
    yield (
        f"expected root translations in metres; got {farthest:.0f}, which looks like millimetres or centimetres",
        (np.abs(rows[:, :3, 3]) > FARTHEST_METRES).any(axis=1),
        "Divide by 1000 or 100.",
    )


def _face_findings(rows: Float32[np.ndarray, "n F"]) -> Findings:
    """Face signals."""
    yield "expected a finite face signal; got NaN or infinity", _is_not_finite(rows), "Fill the frame from its neighbours, or remove it."


def _keypoint_findings(rows: Float32[np.ndarray, "n K 4"]) -> Findings:
    """Keypoints: places count only where the confidence is positive, so trackers may leave NaN elsewhere."""
    is_used = ~(rows[..., 3] <= 0)
    is_bad = (is_used & ~np.isfinite(rows).all(axis=-1)).any(axis=1)
    yield (
        "expected finite keypoints where the confidence is positive; got NaN or infinity",
        is_bad,
        "Set the confidence of lost keypoints to 0.",
    )
    distance = np.abs(np.where(is_used[..., None], rows[..., :3], 0.0)).max(axis=(1, 2), initial=0.0)
    farthest = float(distance.max(initial=0.0))
    yield (
        f"expected keypoints in metres; got a coordinate of {farthest:.0f}, which looks like millimetres or centimetres",
        distance > FARTHEST_METRES,
        "Divide x, y and z by 1000 or 100.",
    )


def _vertex_findings(rows: Float32[np.ndarray, "n V 3"]) -> Findings:
    """Registered meshes."""
    yield "expected finite vertices; got NaN or infinity", _is_not_finite(rows), "Register the frame again, or remove it from the capture."
    extent = np.ptp(rows, axis=1).max(axis=-1)
    tallest, smallest = float(extent.max(initial=0.0)), float(extent.min(initial=np.inf))
    unit, divisor = ("millimetres", 1000) if tallest > 100 * TALLEST_METRES else ("centimetres", 100)
    yield (
        f"expected a person in metres; got one {tallest:.0f} m tall, which looks like {unit}",
        extent > TALLEST_METRES,
        f"Divide the vertices by {divisor}.",
    )
    yield (
        f"expected a person in metres; got one {smallest:.3g} m tall, which looks normalized or in another unit",
        extent < SMALLEST_METRES,
        "Multiply the vertices by the normalization's scale.",
    )


_ROW_CHECKS: dict[str, Callable[[np.ndarray], Findings]] = {
    "theta": _theta_findings,
    "root": _root_findings,
    "face": _face_findings,
    "keypoints": _keypoint_findings,
    "vertices": _vertex_findings,
}
