"""The optimisation loop: batch -> avatar -> render -> losses -> backward -> step -> report.

Everything random in iteration i follows from the base seed and i, so that a resumed run continues the curve of an uninterrupted one up
to the order of float sums. Source: arXiv:2105.10441, section 3.6.
"""

import json
import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from mitsuba_avatar.body.mesh import Laplacian
from mitsuba_avatar.body.rig import Rig
from mitsuba_avatar.captures.colour import encode
from mitsuba_avatar.model.avatar import Avatar
from mitsuba_avatar.rendering.surface import SurfaceRenderer
from mitsuba_avatar.settings import Settings
from mitsuba_avatar.training.batches import BatchSampler, FrameBatch, FrameReader, batches
from mitsuba_avatar.training.checkpoints import Checkpoints
from mitsuba_avatar.training.distributed import Process
from mitsuba_avatar.training.losses import LossInputs, evaluate_losses, loss_weights, weighted_sum

SEED_STRIDE = 1 << 20  # renderer seeds of different ranks and runs stay apart for a million iterations


class DivergedError(RuntimeError):
    """The loss is not finite; the message names iteration, terms, frames and cameras."""


class StepTimer:
    """Seconds spent in each named part of the step, averaged over the steps since the last `means`."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.steps = 0

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Time a part of the step."""
        start = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start

    def means(self) -> dict[str, float]:
        """Milliseconds per step of every part, and start over."""
        means = {name: 1e3 * total / max(self.steps, 1) for name, total in self.seconds.items()}
        self.seconds, self.steps = {}, 0
        return means


class Trainer:
    """One avatar in training.

    Args:
        avatar: on its device.
        rig: of the capture.
        reader: of the capture.
        settings: resolved.
        process: this process's rank.
    """

    def __init__(self, avatar: Avatar, rig: Rig, reader: FrameReader, settings: Settings, process: Process = Process()):  # noqa: B008
        training = settings.training
        self.avatar, self.reader, self.settings, self.process = avatar, reader, settings, process
        self.model: nn.Module = DistributedDataParallel(avatar) if process.is_distributed else avatar
        self.device = next(avatar.parameters()).device
        self.renderer = SurfaceRenderer(
            rig.topology,
            reader.width,
            reader.height,
            samples_per_pixel=settings.rendering.samples_per_pixel,
            boundary_samples_per_edge=settings.rendering.boundary_samples_per_edge,
        )
        self.laplacian = Laplacian(rig.topology).to(self.device)
        self.optimizer = torch.optim.Adam(avatar.parameters(), lr=training.learning_rate)
        self.sampler = BatchSampler(
            reader.capture.frame_indices("train"),
            [name for name in reader.capture.camera_names(held_out=False)],
            training.poses_per_batch,
            training.views_per_pose,
            training.seed,
            process.rank,
            process.num_ranks,
        )
        self.iteration = 0
        self.timer = StepTimer()

    def run(self, after_step: Callable[[int, dict[str, float]], None]) -> None:
        """Train from the current iteration to the last; `after_step(iterations done, loss terms)` reports, saves and may raise to stop."""
        stream = batches(self.reader, self.sampler, self.iteration, self.settings.training.iterations)
        while self.iteration < self.settings.training.iterations:
            with self.timer.part("data"):
                batch = next(stream)
            terms = self.step(batch)
            self.iteration += 1
            after_step(self.iteration, terms)
        stream.close()

    def step(self, batch: FrameBatch) -> dict[str, float]:
        """One optimisation step; returns the loss terms, unweighted, and their weighted sum "loss".

        Raises:
            DivergedError: a term or a gradient is not finite; nothing was changed.
        """
        settings = self.settings
        weights = loss_weights(settings.loss, self.iteration)
        if not settings.model.use_latent:
            weights.pop("kl", None)
        if batch.vertices is None:
            weights = {name: weight for name, weight in weights.items() if name not in ("geometry", "laplacian")}
        for group in self.optimizer.param_groups:
            group["lr"] = self.learning_rate(self.iteration)
        device = self.device
        tracked = None if batch.vertices is None else batch.vertices.to(device)
        with self.timer.part("decoder"):
            output, posterior = self.model(
                tracked,
                batch.theta.to(device),
                batch.root.to(device),
                batch.face.to(device),
                batch.camera_centers.to(device),
                batch.ambient_occlusion.to(device),
                self.latent_noise(len(batch.frames)).to(device),
            )
        with self.timer.part("render"):
            seed = (settings.training.seed * self.process.num_ranks + self.process.rank) * SEED_STRIDE + self.iteration
            radiance, mask = self.renderer.render(output.vertices, output.textures.flatten(0, 1), batch.cameras, seed=seed)
            image = radiance + (1 - mask) * batch.backgrounds.to(device)
        with self.timer.part("losses"):
            inputs = LossInputs(
                image=encode(image, "srgb"),
                mask=mask,
                target_image=encode(batch.images.to(device), "srgb"),
                target_mask=batch.masks.to(device),
                vertices=output.vertices,
                tracked_vertices=tracked,
                posterior=posterior,
                laplacian=self.laplacian,
            )
            terms = evaluate_losses(inputs, weights)
            loss = weighted_sum(terms, weights)
        self._require_finite("loss term", {name: value.detach() for name, value in terms.items()}, batch)
        with self.timer.part("backward"):
            self.optimizer.zero_grad(set_to_none=True)
            loss.backward()
        norm = nn.utils.clip_grad_norm_(self.avatar.parameters(), settings.training.gradient_clip)
        self._require_finite("gradient", {"norm": norm}, batch)
        with self.timer.part("optimizer"):
            self.optimizer.step()
        self.timer.steps += 1
        return {"loss": float(loss.detach()), **{name: float(value.detach()) for name, value in terms.items()}}

    def learning_rate(self, iteration: int) -> float:
        """Cosine from `learning_rate` to `learning_rate_final` over the run."""
        training = self.settings.training
        share = min(iteration / max(training.iterations, 1), 1.0)
        low, high = training.learning_rate_final, training.learning_rate
        return low + 0.5 * (high - low) * (1 + math.cos(math.pi * share))

    def latent_noise(self, poses: int) -> Float[Tensor, "P Z"]:
        """Standard normal numbers of this iteration's poses, this rank's share of the global batch's."""
        training = self.settings.training
        generator = torch.Generator().manual_seed(training.seed * SEED_STRIDE + self.iteration)
        noise = torch.randn(training.poses_per_batch, self.settings.model.latent_size, generator=generator)
        return noise[self.process.rank * poses : (self.process.rank + 1) * poses]

    def save(self, checkpoints: Checkpoints, psnr: float | None) -> None:
        """Write a checkpoint; see `Checkpoints.save`."""
        checkpoints.save(self.avatar.state_dict(), {"optimizer": self.optimizer.state_dict()}, self.iteration, psnr)

    def resume(self, checkpoints: Checkpoints) -> None:
        """Continue from the last checkpoint.

        Raises:
            FileNotFoundError, ValueError: no checkpoint, or one of another rig; see `Checkpoints`.
        """
        self.avatar.load_state_dict(checkpoints.load_avatar("last"))
        self.iteration, state = checkpoints.load_training()
        self.optimizer.load_state_dict(state["optimizer"])

    def _require_finite(self, what: str, values: dict[str, Tensor], batch: FrameBatch) -> None:
        bad = [name for name, value in values.items() if not math.isfinite(float(value))]
        if bad:
            numbers = [self.reader.capture.frames[i].number for i in batch.frames]
            raise DivergedError(
                f"step(): {what} {', '.join(bad)} is not finite at iteration {self.iteration}, frames {numbers}, cameras "
                f"{batch.camera_names}. Lower training.learning_rate, or check these images; --resume continues from the last checkpoint."
            )


class MetricsLog:
    """metrics.jsonl of a run: one JSON object a line, appended and flushed, so that a crash loses at most the line being written."""

    def __init__(self, path: Path, resume_at: int = 0):
        """Open the log; lines of iterations beyond `resume_at` (written after the checkpoint that is resumed) are dropped."""
        path.parent.mkdir(parents=True, exist_ok=True)
        kept = []
        if path.exists() and resume_at > 0:
            for line in path.read_text().splitlines():
                try:
                    record = json.loads(line)
                except json.JSONDecodeError:
                    continue  # the line that a crash cut short
                if record["iteration"] <= resume_at:
                    kept.append(line)
        path.write_text("".join(f"{line}\n" for line in kept))
        self._file = path.open("a")

    def write(self, record: dict[str, Any]) -> None:
        """Append a record."""
        self._file.write(json.dumps(record) + "\n")
        self._file.flush()
