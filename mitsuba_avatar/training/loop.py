"""The optimisation loop: batch -> avatar -> render -> losses -> backward -> step -> report.

Everything random in iteration i follows from the base seed and i, so that a resumed run continues the curve of an uninterrupted one up
to the order of float sums. Source: arXiv:2105.10441, section 3.6.
"""

import dataclasses
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
from mitsuba_avatar.model.encoder import Posterior
from mitsuba_avatar.model.keypoints import DrivenKeypoints, lists_face_landmarks
from mitsuba_avatar.rendering.surface import SurfaceRenderer
from mitsuba_avatar.settings import Settings
from mitsuba_avatar.training.batches import FrameBatch, FrameReader, batches, training_sampler
from mitsuba_avatar.training.camera_response import CameraResponse
from mitsuba_avatar.training.checkpoints import Checkpoints
from mitsuba_avatar.training.distributed import Process
from mitsuba_avatar.training.divergence import DivergedError, DivergenceGuard, SkippedStep
from mitsuba_avatar.training.losses import LATENT_TERMS, LossInputs, evaluate_losses, loss_weights, weighted_sum
from mitsuba_avatar.training.mutual_information import MutualInformation
from mitsuba_avatar.training.offset_maps import OffsetMaps
from mitsuba_avatar.training.precision import is_mixed

SEED_STRIDE = 1 << 20  # renderer seeds of different ranks and runs stay apart for a million iterations


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
        avatar.mixed_precision = is_mixed(training, self.device)
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
        self.offset_maps = OffsetMaps(avatar) if settings.model.use_latent else None
        self.information, self.keypoints = self._disentanglement(rig)
        self.response = CameraResponse.of(reader.capture, settings)
        if self.response is not None:
            self.response.to(self.device)
        self.guard = DivergenceGuard(training)
        self.iteration = 0
        self.timer = StepTimer()
        self._seconds_before, self._running_since = 0.0, None

    def run(self, after_step: Callable[[int, dict[str, float]], bool]) -> bool:
        """Train from the current iteration to the last.

        Args:
            after_step: called as after_step(iterations done, loss terms); reports and saves. Training stops where it returns False. Where
                the step was skipped, there are no terms.

        Returns:
            Whether the last iteration was reached.

        Raises:
            DivergedError: too many bad steps; single ones are skipped. after_step is not called after the last one; `guard.tell` names it.
        """
        read = self.reader.read if self.settings.loss.looks_at_images else self.reader.read_surfaces
        with self._clock_running(), closing(batches(read, self.sampler, self.iteration, self.settings.training.iterations)) as stream:
            while self.iteration < self.settings.training.iterations:
                with self.timer.part("data"):
                    batch = next(stream)
                terms: dict[str, float] = {}
                try:
                    terms = self.step(batch)
                except DivergedError as error:
                    self.guard.skip(SkippedStep(self.iteration, self._frame_numbers(batch), batch.camera_names, str(error)))
                self.iteration += 1
                if not after_step(self.iteration, terms):
                    return False
        return True

    @property
    def seconds(self) -> float:
        """Spent in `run`, over all sessions. Of a session that was killed, what came after its last checkpoint does not count: a resumed
        run repeats those steps."""
        return self._seconds_before + (0.0 if self._running_since is None else time.perf_counter() - self._running_since)

    def step(self, batch: FrameBatch) -> dict[str, float]:
        """One optimisation step.

        Returns:
            The loss terms, unweighted, and their weighted sum "loss"; means over the ranks of a distributed run.

        Raises:
            DivergedError: surface, a term or a gradient is not finite, or the loss explodes, here or on another rank; no parameter
                was changed.
        """
        for group in self.optimizer.param_groups:
            group["lr"] = self.learning_rate(self.iteration)
        batch = batch.to(self.device)
        weights = self._weights(batch)
        problem = None
        try:
            terms, posterior = self._losses(batch, weights)
            loss = weighted_sum(terms, weights)
            self._require_calm(float(loss.detach()), terms, weights, batch)
        except DivergedError as error:
            problem = error
        # Before the backward pass, where the ranks wait for each other: all skip the step, or none.
        if self.is_any_rank(problem is not None):
            raise problem or DivergedError(f"step(): another rank's batch of iteration {self.iteration} was refused; its message says why.")
        with self.timer.part("backward"):
            self.optimizer.zero_grad(set_to_none=True)
            if self.response is not None:
                self.response.zero_grad()
            loss.backward()
        norm = nn.utils.clip_grad_norm_(self.avatar.parameters(), self.settings.training.gradient_clip)
        self._require_finite("gradient", {"norm": norm}, batch)
        with self.timer.part("optimizer"):
            self.optimizer.step()
            if self.response is not None:
                self.response.step(self.learning_rate(self.iteration) / self.settings.training.learning_rate, self.process)
        if self.information is not None and posterior is not None:
            with self.timer.part("information"):
                self.information.observe(posterior, self.avatar.standardized_driving(batch.theta, batch.face))
        self.timer.steps += 1
        values = self._mean_over_ranks(torch.stack([loss.detach(), *(value.detach() for value in terms.values())]))
        means = dict(zip(("loss", *terms), values.tolist(), strict=True))
        self.guard.accept(means["loss"])
        return means

    def is_any_rank(self, flag: bool) -> bool:
        """Whether the flag is set on at least one rank of the run; all ranks must ask."""
        if not self.process.is_distributed:
            return flag
        return float(self._mean_over_ranks(torch.tensor(float(flag), device=self.device))) > 0

    def learning_rate(self, iteration: int) -> float:
        """Cosine from `learning_rate` to `learning_rate_final` over the run."""
        training = self.settings.training
        share = min(iteration / max(training.iterations, 1), 1.0)
        low, high = training.learning_rate_final, training.learning_rate
        return low + 0.5 * (high - low) * (1 + math.cos(math.pi * share))

    def latent_noise(self, poses: int) -> Float[Tensor, "P Z"]:
        """Standard normal numbers of this iteration's poses, this rank's share of the global batch's."""
        return self._normal_numbers(poses)[0]

    def prior_latents(self, poses: int) -> Float[Tensor, "P Z"]:
        """Latent codes drawn from the prior for this iteration's poses, independent of `latent_noise`."""
        return self._normal_numbers(poses)[1]

    def save(self, checkpoints: Checkpoints, psnr: float | None) -> None:
        """Write a checkpoint; see `Checkpoints.save`."""
        state = {"optimizer": self.optimizer.state_dict(), "guard": self.guard.state_dict(), "seconds": self.seconds}
        if self.information is not None:
            state["mutual_information"] = self.information.state_dict()
        if self.response is not None:
            state["camera_response"] = self.response.saved()
        checkpoints.save(self.avatar.state_dict(), state, self.iteration, psnr)

    def resume(self, checkpoints: Checkpoints) -> None:
        """Continue from the last checkpoint.

        What the checkpoint lacks, because it is older or because a loss term was off, begins anew.

        Raises:
            FileNotFoundError, ValueError: no checkpoint, or one of another rig; see `Checkpoints`.
        """
        self.avatar.load_state_dict(checkpoints.load_avatar("last"))
        self.iteration, state = checkpoints.load_training()
        self.optimizer.load_state_dict(state["optimizer"])
        if "guard" in state:
            self.guard.load_state_dict(state["guard"])
        self._seconds_before = state.get("seconds", 0.0)
        if self.information is not None and "mutual_information" in state:
            self.information.load_state_dict(state["mutual_information"])
        if self.response is not None and "camera_response" in state:
            self.response.restore(state["camera_response"])

    @contextmanager
    def _clock_running(self) -> Iterator[None]:
        """Let `seconds` grow."""
        self._running_since = time.perf_counter()
        try:
            yield
        finally:
            self._seconds_before, self._running_since = self.seconds, None

    def _disentanglement(self, rig: Rig) -> tuple[MutualInformation | None, DrivenKeypoints | None]:
        """What the two disentangling terms need, each where its weight asks for it."""
        settings, avatar = self.settings, self.avatar
        information = keypoints = None
        if settings.model.use_latent and settings.loss.mutual_information > 0:
            driving_size = len(avatar.standardize_theta.mean) + len(avatar.standardize_face.mean)
            information = MutualInformation(
                settings.model.latent_size, driving_size, settings.disentanglement, settings.training.seed, self.device, self.process
            )
        if settings.model.use_latent and settings.loss.perturbation > 0:
            face_signal = self.reader.capture.description.face_signal
            with_face = lists_face_landmarks(rig, face_signal, len(avatar.standardize_face.mean))
            keypoints = DrivenKeypoints(rig, avatar.template_vertices, with_face)
        return information, keypoints

    def _weights(self, batch: FrameBatch) -> dict[str, float]:
        """Weights of the terms that this iteration and batch have."""
        weights = loss_weights(self.settings.loss, self.iteration)
        absent = () if self.settings.model.use_latent else LATENT_TERMS
        if batch.vertices is None:
            absent = (*absent, "geometry", "laplacian")
        return {name: weight for name, weight in weights.items() if name not in absent}

    def _losses(self, batch: FrameBatch, weights: dict[str, float]) -> tuple[dict[str, Tensor], Posterior | None]:
        """Loss terms of a batch, and the posterior that its latent codes were drawn from."""
        noise = self.latent_noise(len(batch.frames)).to(self.device)
        if "image" in weights or "mask" in weights:
            inputs = self._rendered(batch, noise)
        else:
            inputs = self._surface_alone(batch, noise)
        latents = None if inputs.posterior is None else inputs.posterior.sample(noise)  # the forward pass drew the same
        with self.timer.part("losses"):
            terms = evaluate_losses(self._with_disentanglement(inputs, batch, latents), weights)
        self._require_finite("loss term", {name: value.detach() for name, value in terms.items()}, batch)
        return terms, inputs.posterior

    def _rendered(self, batch: FrameBatch, noise: Tensor) -> LossInputs:
        """Surface and pictures of a batch, beside what they should be."""
        settings = self.settings
        with self.timer.part("decoder"):
            output, posterior = self.model(
                self._offset_maps(batch), batch.theta, batch.root, batch.face, batch.camera_centers, batch.ambient_occlusion, noise
            )
        self._require_finite("surface", {"vertices": output.vertices.detach().abs().sum()}, batch)
        with self.timer.part("render"):
            seed = (settings.training.seed * self.process.num_ranks + self.process.rank) * SEED_STRIDE + self.iteration
            textures = output.textures.flatten(0, 1)
            image, mask = self.renderer.render(output.vertices, textures, batch.cameras, seed=seed, background=batch.backgrounds)
            if self.response is not None:
                image = self.response(image, mask, batch)
        return LossInputs(
            image=batch.within_views(encode(image, "srgb")),
            mask=batch.within_views(mask),
            target_image=batch.images,
            target_mask=batch.masks,
            vertices=output.vertices,
            tracked_vertices=batch.vertices,
            posterior=posterior,
            laplacian=self.laplacian,
        )

    def _surface_alone(self, batch: FrameBatch, noise: Tensor) -> LossInputs:
        """The same without pictures, for settings that do not look at them: a rehearsal on geometry takes a fraction of the time."""
        with self.timer.part("decoder"):
            vertices, posterior = self.avatar.reconstruct_surface(self._offset_maps(batch), batch.theta, batch.root, batch.face, noise)
        self._require_finite("surface", {"vertices": vertices.detach().abs().sum()}, batch)
        return LossInputs(vertices=vertices, tracked_vertices=batch.vertices, posterior=posterior, laplacian=self.laplacian)

    def _offset_maps(self, batch: FrameBatch) -> Tensor | None:
        """What the encoder reads; None for an avatar without."""
        return None if self.offset_maps is None else self.offset_maps.of(batch)

    def _with_disentanglement(self, inputs: LossInputs, batch: FrameBatch, latents: Tensor | None) -> LossInputs:
        """Inputs with the parts of the disentangling terms, where they are asked for."""
        if self.information is not None and latents is not None:
            driving = self.avatar.standardized_driving(batch.theta, batch.face)
            inputs = dataclasses.replace(inputs, mutual_information=self.information.penalty(latents, driving))
        if self.keypoints is not None:
            z = self.prior_latents(len(batch.frames)).to(self.device)
            rest_vertices = self.avatar.decode_rest_vertices(batch.theta, batch.face, z)
            inputs = dataclasses.replace(
                inputs,
                keypoints=self.keypoints.from_surface(rest_vertices, batch.theta, batch.root),
                driven_keypoints=self.keypoints.from_driving(batch.theta, batch.root, batch.face),
            )
        return inputs

    def _normal_numbers(self, poses: int) -> tuple[Float[Tensor, "P Z"], Float[Tensor, "P Z"]]:
        """Two independent draws for this rank's poses; both follow from seed and iteration."""
        training, rank = self.settings.training, self.process.rank
        generator = torch.Generator().manual_seed(training.seed * SEED_STRIDE + self.iteration)
        shape = (training.poses_per_batch, self.settings.model.latent_size)
        first, second = (torch.randn(shape, generator=generator)[rank * poses : (rank + 1) * poses] for _ in range(2))
        return first, second

    def _mean_over_ranks(self, values: Tensor) -> Tensor:
        if self.process.is_distributed:
            values = values.clone()
            torch.distributed.all_reduce(values)
            values /= self.process.num_ranks
        return values

    def _require_finite(self, what: str, values: dict[str, Tensor], batch: FrameBatch) -> None:
        bad = [name for name, value in values.items() if not math.isfinite(float(value))]
        if bad:
            raise DivergedError(f"step(): {what} {', '.join(bad)} is not finite {self._place_and_remedy(batch)}")

    def _require_calm(self, loss: float, terms: dict[str, Tensor], weights: dict[str, float], batch: FrameBatch) -> None:
        if self.guard.is_explosion(loss):
            largest = max(terms, key=lambda name: weights[name] * float(terms[name].detach()))
            raise DivergedError(
                f"step(): loss {loss:.4g} is more than {self.settings.training.explosion_factor:g} times its running mean "
                f"{self.guard.mean_loss:.4g} (training.explosion_factor), most of it from {largest}, {self._place_and_remedy(batch)}"
            )

    def _place_and_remedy(self, batch: FrameBatch) -> str:
        """Where a message's number was met, and what to do."""
        return (
            f"at iteration {self.iteration}, frames {self._frame_numbers(batch)}, cameras {batch.camera_names}. "
            "Lower training.learning_rate, or check these images; --resume continues from the last checkpoint."
        )

    def _frame_numbers(self, batch: FrameBatch) -> list[int]:
        """The capture's numbers of a batch's frames."""
        return [self.reader.capture.frames[i].number for i in batch.frames]


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
