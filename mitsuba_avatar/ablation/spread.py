"""A figure over the seeds of a row: its mean, and how far seeds lie apart."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Spread:
    """Mean over seeds, and the standard deviation between them; None where there is one seed."""

    mean: float
    deviation: float | None

    @classmethod
    def of(cls, values: Sequence[float]) -> "Spread":
        """Of one number a seed."""
        return cls(float(np.mean(values)), float(np.std(values, ddof=1)) if len(values) > 1 else None)

    def text(self, between: str = " ± ", decimals: int = 2) -> str:
        """As people write it."""
        return f"{self.mean:.{decimals}f}" + ("" if self.deviation is None else f"{between}{self.deviation:.{decimals}f}")
