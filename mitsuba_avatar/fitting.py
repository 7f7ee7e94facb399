"""One fit from capture to report: opens or films the capture, prepares the avatar, trains it, evaluates it, draws it.

The stages do the work; this module is the order in which they are called.
"""

import dataclasses
import math
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from itertools import chain
from pathlib import Path
from typing import Any

import torch

from mitsuba_avatar.body.rig import Rig, load_rig
from mitsuba_avatar.body.source_captures import capture_folder
from mitsuba_avatar.captures.checks import check_values
from mitsuba_avatar.captures.folder import Capture
from mitsuba_avatar.driving.animation import FrameClock, animate, outline
from mitsuba_avatar.driving.signals import DrivingSignals
from mitsuba_avatar.filming.film import default_capture_path, film_capture
from mitsuba_avatar.filming.settings import StudioSettings
from mitsuba_avatar.model.avatar import Avatar
from mitsuba_avatar.presets import resolve
from mitsuba_avatar.progress import StageProgress, progress_bar, tracked
from mitsuba_avatar.rendering.ambient_occlusion import AmbientOcclusion, FrameOcclusion
from mitsuba_avatar.rendering.occlusion_ahead import OcclusionAhead
from mitsuba_avatar.rendering.surface import SurfaceRenderer
from mitsuba_avatar.reporting.camera_paths import orbit
from mitsuba_avatar.reporting.evaluation import Evaluator
from mitsuba_avatar.reporting.figures import loss_curves, save_image
from mitsuba_avatar.reporting.metrics import read_records
from mitsuba_avatar.reporting.presentation import Presentation, Shot
from mitsuba_avatar.reporting.tables import terminal_table
from mitsuba_avatar.reporting.video import write_video
from mitsuba_avatar.reporting.view_transform import ViewTransform
from mitsuba_avatar.settings import Settings
from mitsuba_avatar.training.batches import FrameReader
from mitsuba_avatar.training.distributed import Process, join_processes, leave_processes
from mitsuba_avatar.training.divergence import SkippedStep
from mitsuba_avatar.training.loop import MetricsLog, Trainer
from mitsuba_avatar.training.readiness import check_trainable, open_as_set
from mitsuba_avatar.training.run_folder import CAMERA_RESPONSE_FILE, RunFolder
from mitsuba_avatar.training.statistics import evenly_spaced, training_statistics

LOG_EVERY = 10  # iterations between lines of metrics.jsonl
VALIDATION_FRAMES = 4
BAKED_AT_ONCE = 300  # missing maps of occlusion: some seconds of work, for which no process is started


def open_capture(settings: Settings, process: Process = Process()) -> Capture:  # noqa: B008 - frozen
    """The capture that the settings name, or the embedded one, filmed on first use; checked before any long work.

    Raises:
        FileNotFoundError, ValueError: the capture is missing, unfinished or unusable; the message names file and remedy.
    """
    if settings.capture.path:
        if process.is_main:
            capture_folder(settings.capture.path, tracked)  # a data set of another format takes a while, once
        capture = open_as_set(settings.capture.path, settings.capture)
    else:
        studio = resolve("studio/default", kind=StudioSettings)
        folder = default_capture_path(studio)
        if process.is_main and not (folder / "capture.yaml").exists():
            sys.stderr.write("No capture given: filming the embedded one (once; later fits reuse it).\n")
            with StageProgress() as progress:
                film_capture(studio, folder, progress.update)
        while not (folder / "capture.yaml").exists():  # other ranks wait for the one that films
            time.sleep(1.0)
        capture = open_as_set(folder, settings.capture)
    check_values(capture, load_rig(capture.rig_path))
    return capture


class Fit:
    """A fit in progress. Make it with `prepare`, then `train`, then `present`; `leave` releases the other ranks."""

    def __init__(self, settings: Settings, run: RunFolder, trainer: Trainer, occlusion: FrameOcclusion, process: Process):
        self.settings, self.run, self.trainer, self.process = settings, run, trainer, process
        self.reader, self.avatar = trainer.reader, trainer.avatar
        self.occlusion = occlusion
        self._ahead: OcclusionAhead | None = None
        self.capture = self.reader.capture

    @staticmethod
    def prepare(settings: Settings, path: Path, process: Process, is_resumed: bool) -> "Fit":
        """Everything before the first step.

        Raises:
            FileNotFoundError, FileExistsError, PermissionError, ValueError: capture, run folder or checkpoint are not usable.
        """
        if process.is_main and not is_resumed:
            RunFolder.check_free(path)
        capture = open_capture(settings, process)
        rig = load_rig(capture.rig_path)
        check_trainable(capture, settings, process)
        is_on_gpu = settings.rendering.variant.startswith("cuda")
        join_processes(process, is_on_gpu)
        if is_resumed:
            run = RunFolder.open(path)
            run.check_capture(capture, rig)
            run = run.with_settings(settings)
            avatar = run.load_avatar("last").train()
        else:
            with progress_bar("mean texture", 1, is_shown=process.is_main) as bar:
                statistics = training_statistics(capture, rig, settings.model.texture_size, bar.update, settings.loss.looks_at_images)
            torch.manual_seed(settings.training.seed)
            avatar = Avatar(rig, settings.model, statistics)
            face_size = capture.face.shape[1]
            if process.is_main:
                run = RunFolder.create(path, settings, rig, capture.path, face_size)
            else:
                run = RunFolder(path, settings, rig, capture.path, face_size)
        avatar = avatar.to("cuda" if is_on_gpu else "cpu")
        occlusion = frame_occlusion(settings, rig, avatar, capture)
        reader = FrameReader(capture, occlusion)
        trainer = Trainer(avatar, rig, reader, settings, process)
        if is_resumed:
            trainer.resume(run.checkpoints)
        fit = Fit(settings, run, trainer, occlusion, process)
        if settings.loss.looks_at_images:
            fit.bake_occlusion()
        return fit

    def bake_occlusion(self) -> None:
        """Bake few missing maps at once, many beside the training: in the order in which it wants them, then those of other splits.

        Raises:
            ChildProcessError: the process that bakes beside the training cannot start.
        """
        count = len(self.capture.frames)
        missing = sum(not self.occlusion.is_baked(frame) for frame in range(count))
        if missing <= BAKED_AT_ONCE:
            with progress_bar("ambient occlusion", count, is_shown=self.process.is_main) as bar:
                self.occlusion.bake(bar.update)
            return
        if self.process.is_main:
            sys.stderr.write(f"{missing} maps of ambient occlusion are baked by a process of their own, beside the first steps.\n")
        coming = self.trainer.sampler.coming_frames(self.trainer.iteration, self.settings.training.iterations)
        self.reader.occlusion = self._ahead = OcclusionAhead(self.occlusion, chain(coming, range(count)))

    def train(self) -> bool:
        """Train to the end; False if the user stopped it, with everything saved.

        The log names every skipped batch, of a run that bad steps stop too. Lines at skipped iterations have no loss terms.

        Raises:
            DivergedError: too many bad steps; see `Trainer.run`.
        """
        training, draws = self.settings.training, self.settings.loss.looks_at_images
        trainer, is_main = self.trainer, self.process.is_main
        evaluator, presentation = self._tools(samples_per_pixel=4)
        shots = self._preview_shots()

        with ExitStack() as stack:
            is_interrupted = stack.enter_context(interrupts())
            bar = stack.enter_context(progress_bar("fitting", training.iterations, trainer.iteration, is_main))
            log = stack.enter_context(MetricsLog(self.run.log_path, trainer.iteration)) if is_main else None

            def after_step(iteration: int, terms: dict[str, float]) -> bool:
                is_stopping = trainer.is_any_rank(is_interrupted())
                if log is None:
                    return not is_stopping
                bar.update(iteration, **terms)
                is_last = iteration == training.iterations or is_stopping
                psnr = None
                if draws and (iteration % training.validate_every == 0 or is_last):
                    psnr = self._validate(evaluator)
                if iteration % LOG_EVERY == 0 or psnr is not None:
                    record = {"iteration": iteration, **terms, "learning_rate": trainer.learning_rate(iteration - 1)}
                    milliseconds = {f"{name}_ms": value for name, value in trainer.timer.means().items()}
                    log.write(
                        record
                        | milliseconds
                        | ({} if psnr is None else {"validation_psnr": psnr})
                        | skipped_record(trainer.guard.tell(), trainer.guard.num_skipped)
                    )
                if draws and (iteration % training.preview_every == 0 or is_last):
                    save_image(self.run.previews / f"{iteration:06d}.png", presentation.preview(shots))
                if iteration % training.checkpoint_every == 0 or is_last:
                    trainer.save(self.run.checkpoints, psnr)
                    if trainer.response is not None:
                        trainer.response.write_facts(self.run.path / CAMERA_RESPONSE_FILE)
                return not is_stopping

            try:
                return trainer.run(after_step)
            finally:  # the bad step that stops a run never comes to after_step, and those since the last line are still untold
                skipped = trainer.guard.tell()
                if log is not None and skipped:
                    # Counted as done: a run resumed before it repeats the step, and drops this line.
                    iteration = max(trainer.iteration, skipped[-1].iteration + 1)
                    log.write({"iteration": iteration} | skipped_record(skipped, trainer.guard.num_skipped))

    def present(self) -> None:
        """Evaluate the avatar and draw it: metrics, pictures, orbit.

        The last checkpoint is measured, not the best: the best is chosen by held-out cameras, and would flatter their figures.
        """
        evaluation = self.settings.evaluation
        self.avatar.load_state_dict(self.run.checkpoints.load_avatar("last"))
        self.avatar.eval()
        evaluator, presentation = self._tools(evaluation.samples_per_pixel)
        frames = evaluator.split_frames(evaluation.frames_per_split)
        with progress_bar("evaluating", sum(map(len, frames.values()))) as bar:
            metrics = evaluator.measure(frames, progress=bar.update)
        metrics.save(self.run.metrics_path)
        shots = held_out_shots(self.capture, frames.get("test") or frames["train"])
        save_image(self.run.pictures / "comparison.png", presentation.compare(shots))
        presentation.save_held_out_pictures(self.run.pictures / "held_out", shots)
        records = read_records(self.run.log_path)
        loss_curves(
            self.run.pictures / "curves.png",
            records,
            {"loss": ["loss"], "terms": ["image", "mask", "geometry", "laplacian", "kl"], "PSNR": ["validation_psnr"]},
        )
        self._draw_orbit(frames.get("test") or frames["train"])
        sys.stderr.write(terminal_table(metrics.means()) + "\n")

    def leave(self) -> None:
        """Disconnect from the other ranks, if any, and end what still bakes for this one."""
        if self._ahead is not None:
            self._ahead.close()
        leave_processes(self.process)

    def _tools(self, samples_per_pixel: int) -> tuple[Evaluator, Presentation]:
        renderer = SurfaceRenderer(self.run.rig.topology, self.reader.width, self.reader.height, samples_per_pixel)
        evaluator = Evaluator(self.avatar, self.reader, renderer)
        return evaluator, Presentation(evaluator, self.run.rig)

    def _validate(self, evaluator: Evaluator) -> float | None:
        """PSNR in dB of a few training frames seen by held-out cameras (by training cameras where there are no others).

        None where none of them sees the person.
        """
        self.avatar.eval()
        names = self.capture.camera_names(held_out=True) or self.capture.camera_names()
        frames = {"train": evenly_spaced(self.capture.frame_indices("train"), VALIDATION_FRAMES)}
        means = evaluator.measure(frames, ["avatar"], names).means()
        self.avatar.train()
        return next(iter(means["avatar"]["train"].values()))["psnr"] if means else None

    def _preview_shots(self) -> list[Shot]:
        """A training view, and the held-out cameras' views of two test frames."""
        capture = self.capture
        splits = {frame.purpose for frame in capture.frames}
        seen, held_out = capture.camera_names(held_out=False), capture.camera_names(held_out=True)
        train = capture.frame_indices("train")
        shots = [Shot(train[len(train) // 2], seen[0])]
        test = capture.frame_indices("test") if "test" in splits else train
        return shots + [Shot(test[(i + 1) * len(test) // 3], name) for i, name in enumerate((held_out or seen)[:2])]

    def _draw_orbit(self, frames: list[int]) -> None:
        """The avatar driven by the test split, a camera walking around it."""
        evaluation, capture = self.settings.evaluation, self.capture
        split = capture.frame_indices(capture.frames[frames[0]].purpose)
        along = [split[i * len(split) // evaluation.orbit_frames] for i in range(evaluation.orbit_frames)]
        rows = sorted(set(along))
        signals = DrivingSignals.of_capture(capture, rows)
        corners = outline(self.avatar, signals, most_frames=len(rows))
        cameras = orbit(corners, evaluation.orbit_frames, evaluation.orbit_width, evaluation.orbit_height)
        shots = [(rows.index(frame), camera) for frame, camera in zip(along, cameras, strict=True)]
        latents = torch.zeros(len(rows), self.settings.model.latent_size if self.settings.model.use_latent else 0)
        renderer = SurfaceRenderer(
            self.run.rig.topology, evaluation.orbit_width, evaluation.orbit_height, samples_per_pixel=evaluation.samples_per_pixel
        )
        with progress_bar("orbit", evaluation.orbit_frames) as bar:
            drawn = animate(self.avatar, signals, latents, shots, renderer, self.occlusion.occlusion, FrameClock())

            def pictures() -> Iterator:
                for done, frame in enumerate(drawn):
                    bar.update(done + 1)
                    yield ViewTransform().apply(frame.radiance, frame.coverage)

            write_video(self.run.path / "orbit.mp4", pictures(), fps=12.0)


def skipped_record(steps: list[SkippedStep], in_all: int) -> dict[str, Any]:
    """What a line of the log says of steps skipped since the last one: nothing where there are none.

    Args:
        steps: skipped since then.
        in_all: number of steps that the whole run skipped.
    """
    return {"skipped": [dataclasses.asdict(step) for step in steps], "skipped_in_all": in_all} if steps else {}


def frame_occlusion(settings: Settings, rig: Rig, avatar: Avatar, capture: Capture) -> FrameOcclusion:
    """The ambient occlusion of every frame of a capture, at the size that the avatar's shadow branch reads."""
    baker = AmbientOcclusion(
        rig.topology,
        settings.model.shadow_size,
        settings.rendering.ambient_occlusion_rays,
        settings.rendering.ambient_occlusion_distance,
    )
    return FrameOcclusion(baker, rig, avatar.template_vertices, capture.theta)


def held_out_shots(capture: Capture, frames: list[int], count: int = 4) -> list[Shot]:
    """A few frames spread over a list, each seen by the next of the held-out cameras (of all cameras where none is held out)."""
    names = capture.camera_names(held_out=True) or capture.camera_names()
    return [Shot(frame, names[i % len(names)]) for i, frame in enumerate(evenly_spaced(frames, count))]


@contextmanager
def interrupts() -> Iterator[Callable[[], bool]]:
    """Turn the first Ctrl-C (or SIGTERM) into a question that the loop asks between steps; a second one stops at once.

    Signals within a second of the first count as one: torchrun passes on the Ctrl-C that the terminal sends to every process anyway.
    """
    asked_at = math.inf

    def handle(number: int, frame: object) -> None:
        nonlocal asked_at
        if time.monotonic() > asked_at + 1.0:
            raise KeyboardInterrupt
        asked_at = min(asked_at, time.monotonic())

    previous = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: asked_at < math.inf
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
