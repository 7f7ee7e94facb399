"""Figures of a filmed capture: `info.json`, and the table of how much of the surface pose explains.

info.json     hidden_mm (what the better of two predictions from pose leaves over, root mean square), frames, cameras, seconds, and more
truth/filming_log.csv     a line for every process that filmed: seconds, frames
"""

import csv
import json
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from tempfile import TemporaryFile

import numpy as np
from jaxtyping import Float32

from mitsuba_avatar.files import atomic_path
from mitsuba_avatar.filming.hidden_state import Error, HiddenState, angles_that_move, measure_hidden_state
from mitsuba_avatar.filming.motion import body_angles, pose_distances
from mitsuba_avatar.filming.performance import Performance, Progress

INFO = "info.json"
LOG = "filming_log.csv"
MOST_FRAMES = 3000  # that the predictions are fitted to and scored on
START_NOISE = 0.001  # metres by which the garment starts elsewhere, for the chaos floor


def log_filming(truth: Path, seconds: float, frames: int) -> None:
    """Add a line on what one process did."""
    truth.mkdir(parents=True, exist_ok=True)
    with (truth / LOG).open("a", newline="", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerow([f"{seconds:.1f}", frames])


def write_info(folder: Path, performance: Performance, rest_vertices: Float32[np.ndarray, "N V 3"]) -> dict[str, object]:
    """Measure a filmed capture and write info.json into its folder.

    Args:
        folder: the capture's.
        performance: what was filmed.
        rest_vertices: the registered surface without the skeleton's movement, metres.
    """
    hidden = hidden_state(performance, rest_vertices)
    seconds = sum(float(row[0]) for row in csv.reader((folder / "truth" / LOG).read_text(encoding="utf-8").splitlines()))
    images = list((folder / "images").rglob("*.png"))
    info = {
        "hidden_mm": None if hidden is None else hidden.hidden_mm,
        "hidden_state": None if hidden is None else asdict(hidden),
        "test_pose_distance_deg": distances_of_segments(performance),
        "frames": len(performance),
        "cameras": performance.settings.cameras.train + performance.settings.cameras.held_out,
        "images": len(images),
        "bytes": sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()),
        "seconds": seconds,
        "notes": list(performance.motion.notes),
    }
    with atomic_path(folder / INFO) as temporary:
        temporary.write_text(json.dumps(info, indent=1) + "\n", encoding="utf-8")
    return info


def distances_of_segments(performance: Performance) -> dict[str, float]:
    """Median distance of each test segment's poses from the nearest training pose, degrees (over the body's angles)."""
    distances = np.degrees(pose_distances(performance.person.rig, performance.motion))
    segments: dict[str, list[float]] = {}
    for frame, distance in zip(performance.motion.frames, distances, strict=True):
        if frame.split == "test":
            segments.setdefault(frame.segment, []).append(float(distance))
    return {name: float(np.median(values)) for name, values in segments.items()}


def hidden_state(performance: Performance, rest_vertices: Float32[np.ndarray, "N V 3"], floor: Error | None = None) -> HiddenState | None:
    """How much pose explains of the clothes' shape: of the simulated garment, or of the whole surface where cloth is only displaced.

    None if there is nothing to score on. Frames of stress segments are left out.
    """
    frames, person = performance.motion.frames, performance.person
    scored = [index for index, frame in enumerate(frames) if frame.purpose in ("train", "test")]
    kept = np.array(scored[:: -(-len(scored) // MOST_FRAMES)])
    is_train = np.array([frames[index].split == "train" for index in kept])
    if is_train.sum() < 2 or is_train.all():
        return None
    if person.outfit is None:
        angles, vertices = np.flatnonzero(body_angles(person.rig)), rest_vertices[kept]
    else:
        angles = angles_that_move(person.rig, person.outfit.mesh)
        vertices = rest_vertices[kept][:, person.outfit.mesh.body_vertices]
    theta, actions = performance.motion.theta[kept], performance.motion.actions[kept]
    return measure_hidden_state(theta[:, angles], vertices, is_train, floor=floor, whole=np.concatenate([theta, actions], axis=1))


def measure_gates(performance: Performance, progress: Callable[[str, int, int], None]) -> tuple[HiddenState, dict[str, float]]:
    """Simulate what is not simulated yet, and measure what a capture of it could show; no image is made.

    Returns:
        how much pose explains, with the chaos floor where a garment is simulated, and the distances of `distances_of_segments`.

    Raises:
        ValueError: if there are no test frames to score on, or a garment explodes.
    """
    performance.simulate_missing(range(len(performance)), lambda done, total: progress("simulating cloth", done, total))
    floor = None
    if performance.person.outfit is not None:
        floor = chaos_floor(performance, lambda done, total: progress("simulating from another start", done, total))
    shape = (len(performance), performance.person.rig.topology.num_vertices, 3)
    with TemporaryFile() as scratch:  # as large as the capture's surfaces, which memory need not hold
        rest = np.memmap(scratch, np.float32, "w+", shape=shape)
        for frame in range(len(performance)):
            rest[frame] = performance.surfaces(frame).rest
            progress("collecting surfaces", frame + 1, len(performance))
        hidden = hidden_state(performance, rest, floor)
    if hidden is None:
        raise ValueError("measure_gates(): expected training and test frames; got a script without one of them. Set motion.test_frames.")
    return hidden, distances_of_segments(performance)


def chaos_floor(performance: Performance, progress: Progress) -> Error:
    """How far garments drift apart that start a millimetre apart: what no signal, not even the whole past, can predict.

    Simulates every test segment once more. Both garments are compared in the world; their bodies are equal.
    """
    clothing = replace(performance.settings.clothing, start_noise=START_NOISE)
    scored = [
        (order, frames)
        for order, frames in enumerate(performance.motion.segments())
        if performance.motion.frames[frames.start].purpose == "test"
    ]
    total = sum(frames.stop - frames.start for _, frames in scored)
    coarse, differences = len(performance.person.outfit.mesh.body_vertices), []
    for order, frames in scored:
        for index, other in enumerate(performance.resimulated(order, clothing)):
            differences.append(other[:coarse] - performance.garment(frames.start + index)[:coarse])
            progress(len(differences), total)
    return Error.of(np.stack(differences))
