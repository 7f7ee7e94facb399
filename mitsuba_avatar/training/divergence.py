"""The divergence guard: a step whose numbers are not finite, or whose loss explodes, is skipped and told; repeated ones stop the run.

A single bad step comes from a damaged image or an unlucky batch, and the run can do without it. Several bad steps near each other mean
that the model itself is gone, or that the capture is full of such frames: going on would waste the night.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from mitsuba_avatar.settings import TrainingSettings

WINDOW = 20  # iterations among which bad steps are counted
AVERAGED = 20.0  # accepted steps that the running mean of the loss spans; before as many, no step is called an explosion


class DivergedError(FloatingPointError):
    """A step's numbers are unusable; the message names iteration, frames, cameras and term."""


@dataclass(frozen=True)
class SkippedStep:
    """One bad step.

    Attributes:
        iteration: which.
        frames: frame numbers of its batch.
        cameras: camera names, a list for each frame.
        reason: what was wrong, in full.
    """

    iteration: int
    frames: list[int]
    cameras: list[list[str]]
    reason: str


class DivergenceGuard:
    """Watches the loss of accepted steps and counts the skipped ones.

    Args:
        settings: how many bad steps stop the run, and how large an explosion is.
    """

    def __init__(self, settings: TrainingSettings):
        self.settings = settings
        self.mean_loss, self.accepted = 0.0, 0
        self.num_skipped = 0
        self.recent: list[int] = []  # iterations of the skipped steps within the window
        self.untold: list[SkippedStep] = []

    def is_explosion(self, loss: float) -> bool:
        """Whether a loss is out of all proportion to those before it."""
        return self.accepted >= AVERAGED and loss > self.settings.explosion_factor * self.mean_loss

    def accept(self, loss: float) -> None:
        """Count a good step."""
        self.accepted += 1
        self.mean_loss += (loss - self.mean_loss) / min(self.accepted, AVERAGED)

    def skip(self, step: SkippedStep) -> None:
        """Count a bad step.

        Raises:
            DivergedError: it is one too many.
        """
        self.num_skipped += 1
        self.untold.append(step)
        self.recent = [iteration for iteration in self.recent if iteration > step.iteration - WINDOW] + [step.iteration]
        allowed = self.settings.skipped_steps
        if len(self.recent) > allowed:
            raise DivergedError(
                f"run(): expected at most {allowed} bad steps within {WINDOW} iterations (training.skipped_steps); got {len(self.recent)}, "
                f"{self.num_skipped} in all. The last one: {step.reason}"
            )

    def tell(self) -> list[SkippedStep]:
        """Steps skipped since the last call."""
        told, self.untold = self.untold, []
        return told

    def state_dict(self) -> dict[str, Any]:
        """What a resumed run must know."""
        return {"mean_loss": self.mean_loss, "accepted": self.accepted, "num_skipped": self.num_skipped, "recent": list(self.recent)}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a `state_dict`."""
        self.mean_loss, self.accepted = state["mean_loss"], state["accepted"]
        self.num_skipped, self.recent = state["num_skipped"], list(state["recent"])
