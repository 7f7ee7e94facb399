"""Ridge regression whose penalty is chosen on blocks of rows: what one thing tells of another, linearly.

Rows are frames in order of time. Blocks of consecutive ones are predicted from the others, because neighbours in time are nearly alike:
left out one by one, they would choose a penalty that learns frames by heart.

Symbols: N rows, A features, X targets, M rows that are asked for.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float
from scipy.linalg import cho_factor, cho_solve

PENALTIES = tuple(10.0**power for power in range(-3, 5))  # for features of unit variance
BLOCKS = 5


def ridge_prediction(
    features: Float[np.ndarray, "N A"], targets: Float[np.ndarray, "N X"], asked: Float[np.ndarray, "M A"]
) -> Float[np.ndarray, "M X"]:
    """Predict targets, linearly and without an intercept: centre both before. Solved over rows, because they are fewer than targets.

    Args:
        features: of unit variance, or nearly.
        targets: in any unit.
        asked: features of the rows to predict.
    """
    gram = features @ features.T
    rows = np.arange(len(features))
    blocks = np.array_split(rows, min(BLOCKS, len(rows)))

    def loss(penalty: float) -> float:
        total = 0.0
        for block in blocks:
            rest = np.setdiff1d(rows, block)
            predicted = _solve(gram[np.ix_(rest, rest)], targets[rest], penalty)(gram[np.ix_(block, rest)])
            total += float(np.square(predicted - targets[block]).sum())
        return total

    return _solve(gram, targets, min(PENALTIES, key=loss))(asked @ features.T)


def _solve(gram: np.ndarray, targets: np.ndarray, penalty: float) -> Callable[[np.ndarray], np.ndarray]:
    coefficients = cho_solve(cho_factor(gram + penalty * np.eye(len(gram))), targets)
    return lambda cross: cross @ coefficients
