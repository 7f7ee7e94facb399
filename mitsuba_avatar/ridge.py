"""Ridge regression whose penalty is chosen on blocks of rows: what one thing tells of another, linearly.

Rows are frames in order of time. Blocks of consecutive ones are predicted from the others, because neighbours in time are nearly alike:
left out one by one, they would choose a penalty that learns frames by heart.

Symbols: N rows, A features, X targets, M rows that are asked for.
"""

import numpy as np
from jaxtyping import Float

PENALTIES = tuple(10.0**power for power in range(-3, 5))  # for features of unit variance
BLOCKS = 5


def ridge_prediction(
    features: Float[np.ndarray, "N A"], targets: Float[np.ndarray, "N X"], asked: Float[np.ndarray, "M A"]
) -> Float[np.ndarray, "M X"]:
    """Predict targets, linearly and without an intercept: centre both before.

    Args:
        features: of unit variance, or nearly.
        targets: in any unit.
        asked: features of the rows to predict.
    """
    rows = np.arange(len(features))
    losses = np.zeros(len(PENALTIES))
    for block in np.array_split(rows, min(BLOCKS, len(rows))):
        rest = np.setdiff1d(rows, block)
        solved = _Solved(features[rest], targets[rest])
        losses += [float(np.square(solved.predict(features[block], penalty) - targets[block]).sum()) for penalty in PENALTIES]
    return _Solved(features, targets).predict(asked, PENALTIES[int(np.argmin(losses))])


class _Solved:
    """The singular value decomposition of the features, which serves every penalty."""

    def __init__(self, features: np.ndarray, targets: np.ndarray):
        left, self.values, self.directions = np.linalg.svd(features, full_matrices=False)
        self.projected = left.T @ targets

    def predict(self, asked: np.ndarray, penalty: float) -> np.ndarray:
        shrunk = self.values / (self.values**2 + penalty)
        return (asked @ self.directions.T * shrunk) @ self.projected
