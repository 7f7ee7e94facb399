"""Where on the body a vertex lies: membership of limbs, position along them, neighbourhoods. What clothing and paint are laid out by.

Anny names its joints by limb, counted from the trunk outwards, with the side as the ending (`upperarm01.L`); this module alone in the
studio relies on those names. The person stands upright in rest space, faces -Y and has the left hand at +X. Metres.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int
from scipy import sparse
from scipy.sparse import csgraph

from mitsuba_avatar.body.mesh import unique_edges
from mitsuba_avatar.body.rig import Rig, Topology

SIDES = ("L", "R")
ARM = ("upperarm", "lowerarm", "wrist", "metacarpal", "finger")
HAND = ("wrist", "metacarpal", "finger")
LEG = ("upperleg", "lowerleg", "foot", "toe")
FOOT = ("foot", "toe")
NECK_AND_HEAD = ("neck", "head", "eye")


@dataclass(frozen=True)
class Anatomy:
    """A rig's rest surface with names for its parts.

    Attributes:
        rig: the rig described.
        smoothing: [V, V] sparse matrix, mean of a vertex's neighbours.
        piece: [V] which connected piece of the surface a vertex belongs to; piece 0 is the largest, the skin.
    """

    rig: Rig
    smoothing: sparse.csr_matrix
    piece: Int[np.ndarray, "V"]  # noqa: F821

    @classmethod
    def of(cls, rig: Rig) -> "Anatomy":
        """Analyse a rig.

        Raises:
            ValueError: if the rig lacks the joints that the studio dresses and moves by.
        """
        wanted = [
            f"{name}.{side}" for name in ("upperarm01", "lowerarm01", "wrist", "upperleg01", "lowerleg01", "foot", "eye") for side in SIDES
        ]
        missing = [name for name in (*wanted, "neck01", "head", "spine05") if name not in rig.joint_names]
        if missing:
            raise ValueError(
                f"Anatomy.of(): expected Anny's joints; {missing} are missing from rig {rig.name!r}. Film a rig of build_anny_rig()."
            )
        adjacency = neighbours(rig.topology)
        piece = csgraph.connected_components(adjacency, directed=False)[1]
        by_size = np.argsort(-np.bincount(piece), kind="stable")
        rank = np.empty_like(by_size)
        rank[by_size] = np.arange(len(by_size))
        degree = np.asarray(adjacency.sum(axis=1)).ravel()
        return cls(rig=rig, smoothing=sparse.diags(1 / np.maximum(degree, 1)) @ adjacency, piece=rank[piece])

    def joint(self, name: str) -> Float64[np.ndarray, "3"]:
        """Rest position of a joint, metres; float64, because garments and paint are laid out once and exactly."""
        return self.rig.joint_positions[self.rig.joint_names.index(name)].astype(np.float64)

    def weight(self, prefixes: tuple[str, ...], side: str = "") -> Float32[np.ndarray, "V"]:  # noqa: F821
        """[V] summed skinning weight of the joints whose names begin with one of `prefixes` (and end with `side`): 1 well inside a limb."""
        chosen = [name.startswith(prefixes) and (not side or name.endswith(f".{side}")) for name in self.rig.joint_names]
        return self.rig.skinning_weights[:, chosen].sum(axis=1)

    def smooth(self, values: Float[np.ndarray, "V C"], rounds: int, free: Bool[np.ndarray, "V"] | None = None) -> Float[np.ndarray, "V C"]:  # noqa: F821
        """Average over neighbours, `rounds` times; vertices that are not `free` keep their values."""
        for _ in range(rounds):
            averaged = self.smoothing @ values
            values = averaged if free is None else np.where(free[:, None], averaged, values)
        return values

    def axis(self, start: str, end: str) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"], float]:
        """A limb as the line between two joints: start, unit direction, length in metres."""
        begin, direction = self.joint(start), self.joint(end) - self.joint(start)
        length = float(np.linalg.norm(direction))
        return begin, direction / length, length


def neighbours(topology: Topology) -> sparse.csr_matrix:
    """[V, V] symmetric matrix of ones where two vertices share an edge."""
    starts, ends = unique_edges(topology.faces).T
    rows, columns = np.concatenate([starts, ends]), np.concatenate([ends, starts])
    return sparse.csr_matrix((np.ones(len(rows)), (rows, columns)), shape=(topology.num_vertices, topology.num_vertices))


def smooth_step(value: Float[np.ndarray, "*shape"], low: float, high: float) -> Float[np.ndarray, "*shape"]:
    """0 below `low`, 1 above `high`, with zero slope at both; `low` > `high` falls instead."""
    t = np.clip((value - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)
