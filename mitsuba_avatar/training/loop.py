"""The optimisation loop: batch -> avatar -> render -> losses -> backward -> step -> report.

Everything random in iteration i follows from the base seed and i, so that a resumed run continues the curve of an uninterrupted one up
to the order of float sums. Source: arXiv:2105.10441, section 3.6.
"""

import inspect
import json
import math
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from mitsuba_avatar.body.mesh import Laplacian
from mitsuba_avatar.body.rig import Rig
from mitsuba_avatar.captures.colour import encode
from mitsuba_avatar.files import atomic_path
from mitsuba_avatar.model.avatar import Avatar
from mitsuba_avatar.rendering.surface import SurfaceRenderer
from mitsuba_avatar.settings import Settings
from mitsuba_avatar.training.batches import FrameBatch, FrameReader, batches, training_sampler
from mitsuba_avatar.training.checkpoints import Checkpoints
from mitsuba_avatar.training.distributed import Process
from mitsuba_avatar.training.losses import LossInputs, evaluate_losses, loss_weights, weighted_sum

SEED_STRIDE = 1 << 20  # renderer seeds of different ranks and runs stay apart for a million iterations


class DivergedError(FloatingPointError):
    """Surface, loss or gradient are not finite; the message names iteration, frames and cameras."""


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
        self.model: nn.Module = _data_parallel(avatar) if process.is_distributed else avatar
        self.device = next(avatar.parameters()).device
        self.renderer = SurfaceRenderer(
            rig.topology,
            reader.width,
            reader.height,
            samples_per_pixel=settings.rendering.samples_per_pixel,
            boundary_samples_per_edge=settings.rendering.boundary_samples_per_edge,
        )
        self.laplacian = Laplacian(rig.topology).to(self.device)
        self.optimizer = torch.optim.Adam(avatar.parameters(), lr=training.learning_rate, fused=True)
        self.sampler = training_sampler(reader.capture, training, process)
        self.iteration = 0
        self.timer = StepTimer()

    def run(self, after_step: Callable[[int, dict[str, float]], bool]) -> bool:
        """Train from the current iteration to the last.

        Args:
            after_step: called as after_step(iterations done, loss terms); reports and saves. Training stops where it returns False.

        Returns:
            Whether the last iteration was reached.
        """
        with closing(batches(self.reader, self.sampler, self.iteration, self.settings.training.iterations)) as stream:
            while self.iteration < self.settings.training.iterations:
                with self.timer.part("data"):
                    batch = next(stream)
                terms = self.step(batch)
                self.iteration += 1
                if not after_step(self.iteration, terms):
                    return False
        return True

    def step(self, batch: FrameBatch) -> dict[str, float]:
        """One optimisation step.

        Returns:
            The loss terms, unweighted, and their weighted sum "loss"; means over the ranks of a distributed run.

        Raises:
            DivergedError: surface, a term or a gradient is not finite; no parameter was changed.
        """
        settings = self.settings
        weights = loss_weights(settings.loss, self.iteration)
        if not settings.model.use_latent:
            weights.pop("kl", None)
        if batch.vertices is None:
            weights = {name: weight for name, weight in weights.items() if name not in ("geometry", "laplacian")}
        for group in self.optimizer.param_groups:
            group["lr"] = self.learning_rate(self.iteration)
        batch = batch.to(self.device)
        with self.timer.part("decoder"):
            output, posterior = self.model(
                batch.vertices,
                batch.theta,
                batch.root,
                batch.face,
                batch.camera_centers,
                batch.ambient_occlusion,
                self.latent_noise(len(batch.frames)).to(self.device),
            )
        self._require_finite("surface", {"vertices": output.vertices.detach().abs().sum()}, batch)
        with self.timer.part("render"):
            seed = (settings.training.seed * self.process.num_ranks + self.process.rank) * SEED_STRIDE + self.iteration
            radiance, mask = self.renderer.render(output.vertices, output.textures.flatten(0, 1), batch.cameras, seed=seed)
            image = radiance + (1 - mask) * batch.backgrounds
        with self.timer.part("losses"):
            inputs = LossInputs(
                image=encode(image, "srgb"),
                mask=mask,
                target_image=batch.images,
                target_mask=batch.masks,
                vertices=output.vertices,
                tracked_vertices=batch.vertices,
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
        values = self._mean_over_ranks(torch.stack([loss.detach(), *(value.detach() for value in terms.values())]))
        return dict(zip(("loss", *terms), values.tolist(), strict=True))

    def is_any_rank(self, flag: bool) -> bool:
        """Whether the flag is set on at least one rank of the run; all ranks must ask."""
        return float(self._mean_over_ranks(torch.tensor(float(flag), device=self.device))) > 0

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

    def _mean_over_ranks(self, values: Tensor) -> Tensor:
        if self.process.is_distributed:
            values = values.clone()
            torch.distributed.all_reduce(values)
            values /= self.process.num_ranks
        return values

    def _require_finite(self, what: str, values: dict[str, Tensor], batch: FrameBatch) -> None:
        bad = [name for name, value in values.items() if not math.isfinite(float(value))]
        if bad:
            numbers = [self.reader.capture.frames[i].number for i in batch.frames]
            raise DivergedError(
                f"step(): {what} {', '.join(bad)} is not finite at iteration {self.iteration}, frames {numbers}, cameras "
                f"{batch.camera_names}. Lower training.learning_rate, or check these images; --resume continues from the last checkpoint."
            )


def _data_parallel(avatar: Avatar) -> DistributedDataParallel:
    """The avatar with its gradients averaged over the ranks.

    Buffers are constants (training statistics, tables of the rig): sending them with every step would cost more than the gradients.
    """
    options = inspect.signature(DistributedDataParallel).parameters
    # The option's name since torch 2.13; older versions know the second one alone, newer ones warn of it.
    name = "forward_sync_buffers" if "forward_sync_buffers" in options else "broadcast_buffers"
    return DistributedDataParallel(avatar, **{name: False})


class MetricsLog:
    """metrics.jsonl of a run: one JSON object a line, appended and flushed, so that a crash loses at most the line being written.

    Use it as a context manager, or `close` it.
    """

    def __init__(self, path: Path, resume_at: int = 0):
        """Open the log; lines of iterations beyond `resume_at` (written after the checkpoint that is resumed) are dropped."""
        kept = []
        if path.exists() and resume_at > 0:
            for line in path.read_text().splitlines():
                try:
                    record = json.loads(line)
                except json.JSONDecodeError:
                    continue  # the line that a crash cut short
                if record["iteration"] <= resume_at:
                    kept.append(line)
        with atomic_path(path) as temporary:
            temporary.write_text("".join(f"{line}\n" for line in kept))
        self._file = path.open("a")

    def __enter__(self) -> "MetricsLog":
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def write(self, record: dict[str, Any]) -> None:
        """Append a record."""
        self._file.write(json.dumps(record) + "\n")
        self._file.flush()
