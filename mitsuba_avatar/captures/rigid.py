"""Rigid transforms as 4x4 matrices: is one rigid, and its inverse. Numpy, float64 inside, any number of leading axes."""

import numpy as np
from jaxtyping import Bool, Float


def is_rigid(transforms: Float[np.ndarray, "*batch 4 4"], tolerance: float = 1e-3) -> Bool[np.ndarray, "*batch"]:
    """Tell which matrices are a rotation (no scale, no mirror) and a translation, with the last row 0 0 0 1.

    Args:
        transforms: [..., 4, 4].
        tolerance: largest deviation of an entry of R^T R from the identity, and of the last row. The default lets float32
            and five printed digits pass and catches a scale of 1.001.

    Returns:
        [...] False as well where an entry is not finite.
    """
    # A NaN or infinity becomes 0, so that it raises no warning on the way; whatever matrix that makes, is_finite refuses it.
    is_finite = np.isfinite(transforms).all(axis=(-1, -2))
    matrices = np.where(np.isfinite(transforms), transforms, 0.0).astype(np.float64)
    rotations = matrices[..., :3, :3]
    orthogonality = np.abs(np.swapaxes(rotations, -1, -2) @ rotations - np.eye(3)).max(axis=(-1, -2))
    last_row = np.abs(matrices[..., 3, :] - np.array([0.0, 0.0, 0.0, 1.0])).max(axis=-1)
    # A mirror is orthogonal too: its determinant is -1.
    return np.asarray(is_finite & (orthogonality <= tolerance) & (last_row <= tolerance) & (np.linalg.det(rotations) > 0))


def inverse_rigid(transforms: Float[np.ndarray, "*batch 4 4"]) -> Float[np.ndarray, "*batch 4 4"]:
    """Invert rigid transforms [..., 4, 4] without a linear solve: (R, t) becomes (R^T, -R^T t)."""
    inverse = np.zeros_like(transforms)
    rotations = np.swapaxes(transforms[..., :3, :3], -1, -2)
    inverse[..., :3, :3] = rotations
    inverse[..., :3, 3] = -(rotations @ transforms[..., :3, 3, None])[..., 0]
    inverse[..., 3, 3] = 1.0
    return inverse
