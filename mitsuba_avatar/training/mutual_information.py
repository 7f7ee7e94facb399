"""How much the latent code tells about the driving signal, estimated while the avatar trains, and the penalty on it.

The statistics network (model/disentanglement.py) learns from a memory of recent posteriors q(z) and their driving signals c, not from the
current batch: a batch of a few poses has nearly nothing to shuffle, and its estimate is worthless. Every update draws its codes from
the posteriors anew; a network that saw one draw of each would learn that draw's noise by heart, and see nothing on a frame that it meets
again. Posteriors in the memory are up to a few hundred steps old; the network follows the encoder, which moves slowly. The avatar is
penalised on the codes of the current batch alone, paired with their own driving signals and with remembered ones.

The running estimate is taken on every batch *before* the network learns from it, and where it is zero or less there is no penalty. Without
this the penalty invents a leak: a network that has learnt its memory by heart sees structure in codes that are pure noise, and the
encoder, fleeing from that, makes real structure out of it (the KL divergence of a dead latent code rose from 0 to 40 nats in 30 steps).

Symbols: P poses of this rank, N of all ranks, Z latent size, D entries of the driving signal c. Nats.

Source: arXiv:2105.10441, section 3.5.2; MINE: arXiv:1801.04062.
"""

from collections.abc import Mapping
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.func import functional_call

from mitsuba_avatar.model.disentanglement import (
    LARGEST_SCORE,
    StatisticsNetwork,
    corrected_objective,
    log_mean_exp,
    mismatched,
    mutual_information_bound,
    without_common_shift,
)
from mitsuba_avatar.model.encoder import Posterior
from mitsuba_avatar.settings import DisentanglementSettings
from mitsuba_avatar.training.collectives import average_gradients, gather_rows
from mitsuba_avatar.training.distributed import Process

FEWEST_PAIRS = 64  # in the memory before the network learns: deviations and shuffles of fewer mean nothing
MISMATCHES = 4  # shuffles of a mini-batch; the mean of exp(f) is far noisier than the mean of f
# Weight of log^2 E[exp f], a constant of f that the bound leaves undetermined: pinned near zero it cannot wander into the score's limit.
DRIFT_WEIGHT = 0.1
ESTIMATE_RATE = 0.05  # of the moving average of mini-batch estimates
SEED_STRIDE = 1 << 20
MISMATCH_STREAMS, ROW_STREAMS, NOISE_STREAMS = 0, 1 << 10, 2 << 10  # of random numbers, of one number of pairs seen


class MutualInformation:
    """A running estimate of I(z; c), kept by one statistics network with its own optimizer.

    Args:
        latent_size: Z.
        driving_size: D.
        settings: of network and memory.
        seed: base seed.
        device: of the codes.
        process: this rank; all ranks hold the same memory and the same network.
    """

    def __init__(
        self,
        latent_size: int,
        driving_size: int,
        settings: DisentanglementSettings,
        seed: int = 0,
        device: torch.device | str = "cpu",
        process: Process = Process(),  # noqa: B008 - frozen
    ):
        self.settings, self.seed, self.process = settings, seed, process
        with torch.random.fork_rng(devices=[]):  # the avatar's own random numbers must not depend on this switch
            torch.manual_seed(seed)
            self.network = StatisticsNetwork(latent_size, driving_size, settings.statistics_channels).to(device)
        self.optimizer = torch.optim.Adam(self.network.parameters(), lr=settings.statistics_learning_rate, fused=True)
        self.mu = torch.zeros(settings.memory, latent_size, device=device)
        self.logvar = torch.zeros(settings.memory, latent_size, device=device)
        self.driving = torch.zeros(settings.memory, driving_size, device=device)
        self.seen = 0  # pairs observed so far; the memory is a ring
        self.mean_exp = 1.0  # moving average of E[exp f] over mismatched pairs
        self.running = 0.0  # moving average of the bound

    @property
    def estimate(self) -> float:
        """Nats, between 0 and LARGEST_SCORE: less than independence means a wrong network, more than the limit cannot be told apart."""
        return min(max(self.running, 0.0), LARGEST_SCORE)

    def penalty(self, z: Float[Tensor, "P Z"], driving: Float[Tensor, "P D"]) -> Float[Tensor, ""]:
        """The running estimate, with the gradient that lowers it.

        Args:
            z: [P, Z] codes as the decoder sees them. driving: [P, D] their driving signals.

        Gradients: to z only, less what shifts all codes alike (`without_common_shift`).
        """
        if self.seen < FEWEST_PAIRS or self.running <= 0:
            return 0.0 * z.sum().abs()  # differentiable like what follows
        frozen = {name: value.detach() for name, value in (*self.network.named_parameters(), *self.network.named_buffers())}
        others = self.driving[self._draw(0)]  # [K, D]
        z = without_common_shift(z)
        joint = functional_call(self.network, frozen, (z, driving.detach()))
        product = functional_call(self.network, frozen, (z[:, None], others[None]))  # [P, K]
        slope = corrected_objective(joint, product, self.mean_exp)
        return slope - slope.detach() + self.estimate

    def observe(self, posterior: Posterior, driving: Float[Tensor, "P D"]) -> None:
        """Remember a batch's posteriors (of all ranks) and train the statistics network on the memory. All ranks must call it."""
        rows = [gather_rows(values.detach(), self.process) for values in (posterior.mu, posterior.logvar, driving)]
        if self.seen >= FEWEST_PAIRS:
            self._judge(Posterior(*rows[:2]), rows[2])
        slots = ((self.seen + torch.arange(len(rows[0]))) % len(self.mu)).to(rows[0].device)
        self.mu[slots], self.logvar[slots], self.driving[slots] = rows
        self.seen += len(slots)
        if self.seen < FEWEST_PAIRS:
            return
        held = self._held()
        self.network.standardize_by(self._sample(Posterior(self.mu[:held], self.logvar[:held]), 0), self.driving[:held])
        for update in range(self.settings.updates):
            self._update(1 + update)

    def state_dict(self) -> dict[str, Any]:
        """What a resumed run must know."""
        return {
            "network": self.network.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "memory": [self.mu, self.logvar, self.driving],
            "numbers": [self.seen, self.mean_exp, self.running],
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a `state_dict`.

        Raises:
            ValueError: memory or network have other sizes.
        """
        memory = state["memory"]
        was = [len(memory[0]), state["network"]["score.weight"].shape[1]]
        wanted = [len(self.mu), self.settings.statistics_channels]
        if was != wanted:
            raise ValueError(
                f"MutualInformation: expected disentanglement.memory and disentanglement.statistics_channels of {was}, as the run began; "
                f"got {wanted}. Keep them, or train anew."
            )
        self.network.load_state_dict(state["network"])
        self.optimizer.load_state_dict(state["optimizer"])
        for own, saved in zip((self.mu, self.logvar, self.driving), memory, strict=True):
            own.copy_(saved)
        self.seen, self.mean_exp, self.running = state["numbers"]

    def _judge(self, posterior: Posterior, driving: Tensor) -> None:
        """Average the bound of the newest batch, drawn anew, into the running estimate. After the first pass over a capture the network has
        learnt from the same frames before, so that the estimate rises above the truth where codes tell frames apart."""
        z = self._sample(posterior, 0)
        with torch.no_grad():
            bound = mutual_information_bound(self.network(z, driving), self.network(z[:, None], self.driving[self._draw(0)][None]))
        self.running = (1 - ESTIMATE_RATE) * self.running + ESTIMATE_RATE * float(bound)

    def _update(self, stream: int) -> None:
        """One step of the statistics network up the bound."""
        rows = self._draw(stream)
        z, driving = self._sample(Posterior(self.mu[rows], self.logvar[rows]), stream), self.driving[rows]
        latent, driving = self.network.read_latent(z), self.network.read_driving(driving)
        joint = self.network.score_pairs(latent, driving)
        product = self.network.score_pairs(latent[None], mismatched(driving, MISMATCHES, self._generator(MISMATCH_STREAMS + stream)))
        rate = self.settings.moving_average
        self.mean_exp = (1 - rate) * self.mean_exp + rate * float(product.detach().exp().mean())
        loss = DRIFT_WEIGHT * log_mean_exp(product).square() - corrected_objective(joint, product, self.mean_exp)
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        average_gradients(self.network.parameters(), self.process)
        self.optimizer.step()

    def _held(self) -> int:
        """Rows of the memory that are filled."""
        return min(self.seen, len(self.mu))

    def _draw(self, stream: int) -> Tensor:
        """Random rows of the memory."""
        rows = torch.randint(self._held(), (self.settings.pairs,), generator=self._generator(ROW_STREAMS + stream))
        return rows.to(self.mu.device)

    def _sample(self, posterior: Posterior, stream: int) -> Tensor:
        """Codes drawn from posteriors."""
        noise = torch.randn(posterior.mu.shape, generator=self._generator(NOISE_STREAMS + stream))
        return posterior.sample(noise.to(posterior.mu))

    def _generator(self, stream: int) -> torch.Generator:
        """Random numbers that follow from the seed and from what was seen, so that a resumed run draws the same."""
        return torch.Generator().manual_seed((self.seed * SEED_STRIDE + self.seen) * 2**12 + stream)
