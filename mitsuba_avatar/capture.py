"""Look at a capture, check it, convert it: `python -m mitsuba_avatar.capture info|check PATH`, `convert --from FORMAT SOURCE PATH`.

`info` lists cameras, frames and files. `check` reads all values, projects the mesh into every camera on a few frames, compares it
with the masks, draws a contact sheet, and exits with 1 and the likely trap where they disagree. `convert` writes a capture from
another data set's files, or a Goliath body capture from a capture.
"""

import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from jaxtyping import Float
from rich.console import Console
from rich.filesize import decimal
from rich.table import Table

from mitsuba_avatar.body.rig import Rig, load_rig
from mitsuba_avatar.body.skinning import posed_rest_surface
from mitsuba_avatar.body.source_captures import capture_folder
from mitsuba_avatar.captures.arrays import FRAME_ARRAYS
from mitsuba_avatar.captures.checks import check_arrays, check_images
from mitsuba_avatar.captures.colour import encode_bytes
from mitsuba_avatar.captures.contact_sheet import Tile, overlay, save_contact_sheet
from mitsuba_avatar.captures.folder import Capture
from mitsuba_avatar.captures.reprojection import Diagnosis, Observation, diagnose
from mitsuba_avatar.captures.rigid import inverse_rigid
from mitsuba_avatar.command_line import interruptible
from mitsuba_avatar.converting import ConvertCommand, run_conversion
from mitsuba_avatar.progress import tracked
from mitsuba_avatar.rendering.backend import BackendError

SHEET_CAMERAS = 8  # columns of the contact sheet; more are not readable
FARTHEST_SURFACE = 0.25  # metres; mean distance of registered mesh and posed rig that loose clothing can explain

CapturePath = Annotated[Path, tyro.conf.Positional]
PosedMesh = tuple[Float[np.ndarray, "V 3"], Float[np.ndarray, "4 4"] | None]  # vertices, and the root if a rig posed them


def info(path: CapturePath) -> None:
    """List the cameras, frames, arrays and files of a capture, and what is missing.

    Args:
        path: Folder of the capture, or FORMAT:DIR, a data set of another format.
    """
    capture = Capture.open(capture_folder(path, tracked))
    console = Console()
    description = capture.description
    console.print(
        f"{description.name}: {len(capture.cameras)} cameras, {len(capture.frames)} frames at {description.fps:g} fps", highlight=False
    )
    console.print(
        f"colour {description.colour_curve}, images {description.image_extension}, face signal {description.face_signal}, "
        f"licence {description.licence or 'not stated'}, source {description.source or 'not stated'}",
        highlight=False,
    )
    if description.images_from is not None:
        place = f"{description.images_from.format}:{description.images_from.path}"
        console.print(f"images and masks are read in place from {place}", highlight=False, soft_wrap=True)
    console.print(_camera_table(capture))
    console.print(_frame_table(capture))
    console.print(_file_table(capture))


def check(path: CapturePath, frames: int = 3, out: Path = Path("capture_check"), minimum_iou: float = 0.7, size: int = 640) -> None:
    """Check all values of a capture, and on a few frames whether the mesh projects onto the masks; names the likely trap if not.

    Args:
        path: Folder of the capture, or FORMAT:DIR, a data set of another format.
        frames: How many frames to project, evenly spaced.
        out: Folder for the contact sheet.
        minimum_iou: A camera whose silhouette agrees less than this with the masks is wrong. Loose clothing over an unclothed
            mesh stays above 0.7.
        size: Images are made smaller until their longer side has this many pixels.
    """
    if frames < 1 or size < 16:
        raise ValueError(f"check(): expected at least 1 frame and 16 pixels; got {frames} and {size}. Give larger numbers.")
    path = capture_folder(path, tracked)
    capture = Capture.open(path)
    longest = max(max(camera.width, camera.height) for camera in capture.cameras.values())
    capture = Capture.open(path, image_scale=min(1.0, size / longest))
    rig = _rig_of(capture)
    check_arrays(capture, rig)
    check_images(capture, tracked(range(len(capture.frames)), "Checking images and masks"))
    indices = np.linspace(0, len(capture.frames) - 1, min(frames, len(capture.frames))).round().astype(int).tolist()
    meshes = {index: _mesh(capture, rig, index) for index in indices}
    has_masks = capture.images.has_masks
    diagnosis = _diagnosis(capture, rig, meshes, minimum_iou) if has_masks else None
    sheet = out / f"{capture.path.resolve().name}.png"
    _draw_sheet(sheet, capture, rig, meshes, diagnosis)
    console = Console()
    if diagnosis is not None:
        console.print(_agreement_table(diagnosis))
    console.print(f"Contact sheet: {sheet}", highlight=False, soft_wrap=True)
    _require_pose_agreement(capture, rig, indices)
    if diagnosis is None:
        console.print("Values are fine. There are no masks to compare with: look at the contact sheet.", highlight=False)
    elif diagnosis.is_good:
        console.print("The capture is fine: values, files, and the mesh projects onto the masks.", highlight=False)
    else:
        raise ValueError(_complaint(capture, diagnosis, minimum_iou))


def _rig_of(capture: Capture) -> Rig:
    """The capture's rig; its faces are needed whatever gives the vertices."""
    if not capture.rig_path.is_file():
        raise FileNotFoundError(
            f"check(): expected a rig at {capture.rig_path}; got none. "
            "Add the rig whose topology vertices.npy has: its faces give the silhouette."
        )
    if capture.vertices is None and (capture.theta is None or capture.root is None):
        raise FileNotFoundError(
            f"check(): expected vertices.npy, or pose.npy and root.npy, in {capture.path}; got neither. "
            "Add registered meshes or tracked poses."
        )
    return load_rig(capture.rig_path)


def _mesh(capture: Capture, rig: Rig, index: int) -> PosedMesh:
    """Vertices [V, 3] of a frame, and the root by which they were posed (None if registered)."""
    if capture.vertices is not None:
        return np.array(capture.vertices[index]), None
    return posed_rest_surface(rig, capture.theta[index], capture.root[index]), np.array(capture.root[index])


def _diagnosis(capture: Capture, rig: Rig, meshes: dict[int, PosedMesh], minimum_iou: float) -> Diagnosis:
    """Compare meshes and masks in all cameras."""
    observations = [
        Observation(camera, index, capture.mask(name, index) > 0.5, vertices, root)
        for index, (vertices, root) in meshes.items()
        for name, camera in capture.cameras.items()
    ]
    return diagnose(observations, rig.topology.faces, minimum_iou, pixel=capture.image_scale, track=tracked)


def _require_pose_agreement(capture: Capture, rig: Rig, indices: Sequence[int]) -> None:
    """Where a capture has both, the rig posed by theta and root must lie near the registered mesh."""
    if capture.vertices is None or capture.theta is None or capture.root is None:
        return
    for index in indices:
        registered, theta, root = np.array(capture.vertices[index]), capture.theta[index], np.array(capture.root[index])
        distance = _mean_distance(registered, posed_rest_surface(rig, theta, root))
        if distance > FARTHEST_SURFACE:
            with_inverse = _mean_distance(registered, posed_rest_surface(rig, theta, inverse_rigid(root)))
            trap = (
                "The likely trap: inverted root pose. Invert root.npy: it holds world_from_root."
                if with_inverse < 0.5 * distance
                else "Take pose.npy, root.npy and vertices.npy from the same tracking, frame by frame."
            )
            raise ValueError(
                f"check(): expected the rig, posed by pose.npy and root.npy, within {FARTHEST_SURFACE} m of vertices.npy in "
                f"{capture.path}; got {distance:.2f} m on average in frame index {index}. {trap}"
            )


def _mean_distance(first: Float[np.ndarray, "V 3"], second: Float[np.ndarray, "V 3"]) -> float:
    """Mean distance of corresponding vertices, metres."""
    return float(np.linalg.norm(first - second, axis=-1).mean())


def _complaint(capture: Capture, diagnosis: Diagnosis, minimum_iou: float) -> str:
    """Why the check fails, in one message."""
    lowest = min(diagnosis.iou, key=diagnosis.iou.get)
    found = f"got IoU {diagnosis.iou[lowest]:.3f} in {lowest}"
    if diagnosis.low_cameras:
        found += f", {len(diagnosis.low_cameras)} of {len(diagnosis.iou)} cameras below {minimum_iou}"
    remedy = "No known trap explains it: look at the contact sheet, then at calibration and tracking."
    if 0 < len(diagnosis.low_cameras) < len(diagnosis.iou):
        remedy = f"Other cameras agree: calibration or images of {', '.join(diagnosis.low_cameras)} belong elsewhere."
    if diagnosis.trap is not None:
        where = "" if len(diagnosis.low_cameras) in (0, len(diagnosis.iou)) else f" in {', '.join(diagnosis.low_cameras)}"
        remedy = f"The likely trap{where}: {diagnosis.trap.name} (undoing it gives {diagnosis.trap_iou:.3f}). {diagnosis.trap.remedy}"
    return f"check(): expected the mesh to project onto the masks of {capture.path}; {found}. {remedy}"


def _draw_sheet(path: Path, capture: Capture, rig: Rig, meshes: dict[int, PosedMesh], diagnosis: Diagnosis | None) -> None:
    """One row of tiles for each frame, suspicious cameras first in the choice."""
    low_cameras = diagnosis.low_cameras if diagnosis is not None else ()
    chosen = sorted(capture.cameras, key=lambda name: name not in low_cameras)[:SHEET_CAMERAS]
    rows = []
    for index, (vertices, _) in tracked(list(meshes.items()), "Drawing the contact sheet"):
        row = []
        for name in chosen:
            mask = capture.mask(name, index) > 0.5 if diagnosis is not None else None
            pixels = overlay(encode_bytes(capture.image(name, index), "srgb"), mask, capture.cameras[name], vertices, rig.topology.faces)
            caption = f"{name}  #{capture.frames[index].number}" + (f"  IoU {diagnosis.iou[name]:.3f}" if diagnosis is not None else "")
            row.append(Tile(pixels, caption, is_suspicious=name in low_cameras))
        rows.append(row)
    save_contact_sheet(path, rows, f"{capture.description.name}: does the mesh project onto the masks?")


def _agreement_table(diagnosis: Diagnosis) -> Table:
    """IoU of cameras, and of the tried traps where something is wrong."""
    table = Table("camera", "IoU of mesh and mask")
    for name, value in diagnosis.iou.items():
        table.add_row(name, f"{value:.3f}" + ("  low" if name in diagnosis.low_cameras else ""))
    if not diagnosis.is_good:
        table.add_section()
        for name, value in diagnosis.trials[:5]:
            table.add_row(f"what if: {name}", f"{value:.3f}")
    return table


def _camera_table(capture: Capture) -> Table:
    """One line for each camera."""
    table = Table("camera", "pixels", "fx", "fy", "position (m)", "use", "images", "masks")
    for name, camera in capture.cameras.items():
        position = " ".join(f"{value:.2f}" for value in camera.center_world)
        use = "held out" if name in capture.description.held_out_cameras else "training"
        counts = [capture.images.amount(kind, name)[0] for kind in ("images", "masks")]
        table.add_row(name, f"{camera.width}x{camera.height}", f"{camera.fx:.1f}", f"{camera.fy:.1f}", position, use, *map(str, counts))
    return table


def _frame_table(capture: Capture) -> Table:
    """One line for each segment and split."""
    table = Table("segment", "split", "frames", "numbers", "seconds")
    groups = Counter((frame.segment, frame.split) for frame in capture.frames)
    for (segment, split), count in groups.items():
        frames = [frame for frame in capture.frames if (frame.segment, frame.split) == (segment, split)]
        times = f"{frames[0].time:.2f} to {frames[-1].time:.2f}"
        table.add_row(segment, split, str(count), f"{frames[0].number} to {frames[-1].number}", times)
    return table


def _file_table(capture: Capture) -> Table:
    """One line for each kind of file: what is there, what is missing, bytes."""
    table = Table("part", "there", "size")
    expected = len(capture.cameras) * len(capture.frames)
    for kind in ("images", "masks"):
        counts = [capture.images.amount(kind, name) for name in capture.cameras]
        count, size = sum(count for count, _ in counts), sum(size for _, size in counts)
        there = f"{count} of {expected}" if count else "missing"
        table.add_row(kind, there, decimal(size))
    for name, kind in FRAME_ARRAYS.items():
        array = getattr(capture, name)
        there = "missing" if array is None else "x".join(map(str, array.shape))
        table.add_row(f"{name} ({kind.file_name})", there, decimal(0 if array is None else array.nbytes))
    has_rig = capture.rig_path.is_file()
    table.add_row(
        f"rig ({capture.description.rig})", "there" if has_rig else "missing", decimal(capture.rig_path.stat().st_size if has_rig else 0)
    )
    return table


@interruptible("capture", kept="finished files are whole and kept. Give the same command again to write all of them.")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; 0 if all is well, 1 with one line on the error stream if the capture is not usable."""
    try:
        chosen = tyro.extras.subcommand_cli_from_dict(
            {"info": info, "check": check, "convert": ConvertCommand},
            prog="python -m mitsuba_avatar.capture",
            description=__doc__,
            args=arguments,
        )
        if isinstance(chosen, ConvertCommand):
            run_conversion(chosen)
    except (ValueError, OSError, BackendError) as error:
        Console(stderr=True).print(f"error: {error}", style="red", markup=False, highlight=False, soft_wrap=True)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
