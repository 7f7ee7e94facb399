"""Reconstruct frames with a fitted avatar: `python -m mitsuba_avatar.reconstruct RUN [--split test] [--frames 8]`.

Root pose, joint angles, face and latent code are found by gradient descent through the renderer, frame after frame, from the views of
the training cameras. Prints and writes the errors before and after, beside those of driving with a zero latent code, on training and
held-out cameras. Frames that are done are kept, so a stopped command goes on. docs/driving.md has the rest.
"""

import dataclasses
import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
import tyro

from mitsuba_avatar.command_line import interruptible
from mitsuba_avatar.files import atomic_path
from mitsuba_avatar.rendering import backend

if TYPE_CHECKING:  # these load torch and Dr.Jit, which must wait for the variant
    from mitsuba_avatar.driving.reconstruction import BodyState, DrawnState, Reconstructor
    from mitsuba_avatar.driving.reconstruction_folder import ReconstructedFrame, ReconstructionFolder
    from mitsuba_avatar.loaded_run import LoadedRun
    from mitsuba_avatar.training.batches import FrameBatch, FrameReader

METHODS = ("driven", "start", "reconstructed")
SHOWN = 4  # frames of the picture


@dataclass(frozen=True)
class ReconstructCommand:
    """Reconstruct frames of a capture with a run's avatar."""

    run: Annotated[Path, tyro.conf.Positional]  # run folder that fit wrote
    capture: str = ""  # another capture of the same rig, a folder or FORMAT:DIR; default: the one it was trained on
    split: Literal["test", "train", "stress"] = "test"
    first: int | None = None  # number of the first frame; default: the split's
    frames: int = 8  # how many; 0: all from the first on
    every: int = 1  # take every n-th frame of the split
    start: Literal["tracked", "previous"] = "tracked"  # pose and face begin at the capture's own, or where the frame before ended
    steps: int = 60  # of descent, each frame
    views_per_step: int = 4  # cameras that each step looks at
    mesh: bool = False  # let the registered mesh count as well as the images
    pull: float = 1e-3  # towards the start
    seed: int = 0
    checkpoint: str = "last"  # best or last
    out: str = ""  # folder; default: RUN/reconstructions/<split>_<start>
    variant: str = "auto"  # Mitsuba variant


@interruptible("reconstruct", kept="finished frames are kept. Give the same command again to go on.")
def main(arguments: list[str] | None = None) -> int:
    """Run the command; returns the exit status."""
    command = tyro.cli(ReconstructCommand, args=arguments)
    try:
        if command.frames < 0 or command.every < 1:
            raise ValueError(f"expected --frames of 0 or more and --every of 1 or more; got {command.frames} and {command.every}.")
        backend.select_variant(command.variant)
        return _reconstruct(command)
    except (ValueError, OSError, backend.BackendError) as error:
        sys.stderr.write(f"reconstruct: {error}\n")
        return 2


def _reconstruct(command: ReconstructCommand) -> int:
    # Imported after the variant is set, because these modules load torch and Dr.Jit.
    from mitsuba_avatar.driving.reconstruction import ReconstructionSettings, Reconstructor
    from mitsuba_avatar.driving.reconstruction_folder import ReconstructionFolder
    from mitsuba_avatar.loaded_run import LoadedRun
    from mitsuba_avatar.rendering.surface import SurfaceRenderer
    from mitsuba_avatar.reporting.tables import terminal_table

    settings = ReconstructionSettings(
        steps=command.steps, views_per_step=command.views_per_step, pull=command.pull, use_mesh=command.mesh, seed=command.seed
    )
    loaded = LoadedRun.open(command.run, command.capture, command.checkpoint)
    frames = _frames(command, loaded)
    out = Path(command.out) if command.out else loaded.run.path / "reconstructions" / f"{command.split}_{command.start}"
    facts = {"capture": str(loaded.capture.path.resolve()), "checkpoint": command.checkpoint, "start": command.start}
    index = loaded.run.checkpoints.index()
    facts |= {"iteration": None if index is None else index.iteration_of(command.checkpoint), "every": command.every, "first": frames[0]}
    folder = ReconstructionFolder(out, facts | dataclasses.asdict(settings))
    reader, rendering = _reader(loaded), loaded.run.settings.rendering
    renderer = SurfaceRenderer(
        loaded.run.rig.topology, reader.width, reader.height, rendering.samples_per_pixel, rendering.boundary_samples_per_edge
    )
    reconstructor = Reconstructor(loaded.avatar, loaded.run.rig, renderer, loaded.occlusion(), loaded.run.settings.loss, settings)
    results = _descend(command, loaded, reader, reconstructor, folder, frames)
    numbers = [loaded.capture.frames[frame].number for frame in frames]
    folder.save_signals(numbers, [result.state for result in results])
    table = _measure(loaded, reader, reconstructor, folder, frames, results)
    sys.stdout.write(f"{terminal_table(table)}\n{out}\n")
    return 0


def _frames(command: ReconstructCommand, loaded: "LoadedRun") -> list[int]:
    """Frame indices of the sequence."""
    capture = loaded.capture
    frames = capture.frame_indices(command.split)
    if command.first is not None:
        numbers = [capture.frames[frame].number for frame in frames]
        if command.first not in numbers:
            raise ValueError(f"expected --first among frames {numbers[0]}..{numbers[-1]} of split {command.split}; got {command.first}.")
        frames = frames[numbers.index(command.first) :]
    frames = frames[:: command.every]
    return frames[: command.frames] if command.frames else frames


def _reader(loaded: "LoadedRun") -> "FrameReader":
    """Reads frames; occlusion maps come from the reconstructor, which moves the pose."""
    from mitsuba_avatar.rendering.ambient_occlusion import FrameOcclusion
    from mitsuba_avatar.training.batches import FrameReader

    occlusion = FrameOcclusion(loaded.occlusion(), loaded.run.rig, loaded.avatar.template_vertices, loaded.capture.theta)
    return FrameReader(loaded.capture, occlusion)


def _descend(
    command: ReconstructCommand,
    loaded: "LoadedRun",
    reader: "FrameReader",
    reconstructor: "Reconstructor",
    folder: "ReconstructionFolder",
    frames: list[int],
) -> list["ReconstructedFrame"]:
    """Frame after frame, each from the one before where they belong to one segment."""
    from mitsuba_avatar.driving.reconstruction_folder import ReconstructedFrame
    from mitsuba_avatar.progress import progress_bar

    capture, results, previous = loaded.capture, [], None
    names = capture.camera_names(held_out=False)
    with progress_bar("reconstructing", len(frames)) as bar:
        for done, frame in enumerate(frames):
            number, segment = capture.frames[frame].number, capture.frames[frame].segment
            result = folder.load(number)
            if result is None:
                tracked = _tracked(loaded, frame)
                follows = previous is not None and capture.frames[frames[done - 1]].segment == segment
                start = tracked if not follows else previous if command.start == "previous" else dataclasses.replace(tracked, z=previous.z)
                began = time.perf_counter()
                state, losses = reconstructor.fit(start, reader.read([frame], [names]))
                result = ReconstructedFrame(start, state, np.array(losses, np.float32), time.perf_counter() - began)
                folder.save(number, result)
            previous = result.state
            results.append(result)
            bar.update(done + 1, loss=float(result.losses[-1]))
    return results


def _tracked(loaded: "LoadedRun", frame: int) -> "BodyState":
    """The capture's own driving signals, with a zero latent code: what driving uses."""
    import torch

    from mitsuba_avatar.driving.reconstruction import BodyState

    capture, settings = loaded.capture, loaded.avatar.settings
    theta, root, face = (
        torch.from_numpy(np.array(values[frame], np.float32))[None] for values in (capture.theta, capture.root, capture.face)
    )
    return BodyState(theta, root, face, torch.zeros(1, settings.latent_size if settings.use_latent else 0))


def _measure(
    loaded: "LoadedRun",
    reader: "FrameReader",
    reconstructor: "Reconstructor",
    folder: "ReconstructionFolder",
    frames: list[int],
    results: list["ReconstructedFrame"],
) -> dict:
    """Errors of all frames by method and camera group; writes reconstruction.json and reconstruction.png."""
    from mitsuba_avatar.progress import progress_bar
    from mitsuba_avatar.reporting.figures import View, comparison_grid, save_image
    from mitsuba_avatar.reporting.metrics import MetricsAccumulator

    capture, metrics = loaded.capture, MetricsAccumulator()
    held_out, names = capture.camera_names(held_out=True), capture.camera_names()
    renderer = loaded.renderer(reader.width, reader.height)
    shown = {frames[round(i * (len(frames) - 1) / max(1, SHOWN - 1))] for i in range(SHOWN)}
    views, pictures, rows = [], {method: [] for method in METHODS}, []
    with progress_bar("measuring", len(frames)) as bar:
        for done, (frame, result) in enumerate(zip(frames, results, strict=True)):
            batch = reader.read([frame], [names])
            states = dict(zip(METHODS, (_tracked(loaded, frame), result.start, result.state), strict=True))
            drawn = {method: reconstructor.draw(state, batch, renderer) for method, state in states.items()}
            for method in METHODS:
                _add_metrics(metrics, method, capture.frames[frame].split, drawn[method], batch, set(held_out))
            if frame in shown:
                place = names.index(held_out[len(views) % len(held_out)]) if held_out else 0
                label = f"{names[place]} {capture.frames[frame].split} {capture.frames[frame].number}"
                views.append(View(label, batch.pictures(batch.images)[place], batch.coverage(batch.masks)[place]))
                for method in METHODS:
                    pictures[method].append(batch.pictures(drawn[method].images)[place])
            rows.append(_row(loaded, frame, result))
            bar.update(done + 1)
    means = metrics.means()
    save_image(folder.path / "reconstruction.png", comparison_grid(views, pictures))
    report = {"means": means, "frames": rows, "cameras_optimized": capture.camera_names(held_out=False), "cameras_held_out": held_out}
    with atomic_path(folder.path / "reconstruction.json") as temporary:
        temporary.write_text(json.dumps(report, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    return means


def _add_metrics(
    metrics: "MetricsAccumulator", method: str, split: str, drawn: "DrawnState", batch: "FrameBatch", held_out: set[str]
) -> None:
    """Count every view that sees the person."""
    from mitsuba_avatar.reporting.metrics import image_metrics, silhouette_iou, vertex_error_mm

    images, references, masks = batch.pictures(drawn.images), batch.pictures(batch.images), batch.coverage(batch.masks)
    silhouettes = batch.coverage(drawn.masks)
    for view, name in enumerate(batch.camera_names[0]):
        if not masks[view].any():
            continue
        values = image_metrics(images[view], references[view], masks[view])
        values["iou"] = silhouette_iou(silhouettes[view], masks[view])
        if batch.vertices is not None:
            values["vertex_mm"] = vertex_error_mm(drawn.vertices[0].numpy(), batch.vertices[0].numpy())
        metrics.add(method, split, "held_out" if name in held_out else "seen", values)


def _row(loaded: "LoadedRun", frame: int, result: "ReconstructedFrame") -> dict:
    """What happened in one frame."""
    tracked = _tracked(loaded, frame)
    moved = result.state.root[0, :3, 3] - tracked.root[0, :3, 3]
    return {
        "frame": loaded.capture.frames[frame].number,
        "loss_start": float(result.losses[0]),
        "loss_end": float(result.losses[-1]),
        "seconds": result.seconds,
        "largest_angle_change": float((result.state.theta - tracked.theta).abs().max()),  # radians, from the capture's own
        "root_shift": float(moved.norm()),  # metres, from the capture's own
        "latent_norm": float(result.state.z.norm()),
    }


if __name__ == "__main__":
    sys.exit(main())
