"""The rig: what a person's surface is made of and how joint angles move it, as plain numpy arrays.

A `Rig` is static: no pose, no image. `save_rig` and `load_rig` keep it in one `.npz` (the `rig.npz` of a capture) and refuse a file
that does not hold together. Metres, radians, world axes with Z up; a vertex is *welded*: texture seams live in `uv_faces` alone,
because a mesh split at its seams has false silhouettes there.

Symbols: V vertices, F faces, T texture coordinates, J joints, D degrees of freedom (pose angles), K face landmarks.

Source: arXiv:2105.10441, sections 3.2 to 3.4 (registered topology, joint angles theta, linear blend skinning).
"""

import hashlib
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Int64

from mitsuba_avatar.files import atomic_path

FORMAT_VERSION = 1
WEIGHT_TOLERANCE = 1e-5  # by which a row of skinning weights may miss one: the rounding of float32 sums


@dataclass(frozen=True, eq=False)  # arrays have no truth value to compare by; a rig is itself alone
class Topology:
    """Triangles of the welded surface and of its texture atlas.

    Attributes:
        num_vertices: V.
        faces: [F, 3] vertex of each corner, counter-clockwise seen from outside.
        uv: [T, 2] in [0, 1], OBJ orientation (v = 1 is the image's first row, see `body.uv`).
        uv_faces: [F, 3] row of `uv` of each corner.

    Raises:
        ValueError: if an index is out of range or a texture coordinate is outside [0, 1].
    """

    num_vertices: int
    faces: Int64[np.ndarray, "F 3"]
    uv: Float32[np.ndarray, "T 2"]
    uv_faces: Int64[np.ndarray, "F 3"]

    def __post_init__(self) -> None:
        _check_shape("faces", self.faces, (len(self.faces), 3))
        _check_shape("uv", self.uv, (len(self.uv), 2))
        _check_shape("uv_faces", self.uv_faces, (len(self.faces), 3))
        _check_indices("faces", self.faces, self.num_vertices)
        _check_indices("uv_faces", self.uv_faces, len(self.uv))
        _check_finite("uv", self.uv)
        if self.uv.min() < 0 or self.uv.max() > 1:
            raise ValueError(
                f"Topology(): expected uv in [0, 1]; got {self.uv.min():.4f}..{self.uv.max():.4f}. Pack the atlas into one unit square."
            )


@dataclass(frozen=True, eq=False)  # arrays have no truth value to compare by; a rig is itself alone
class DofTable:
    """What each pose angle turns. The angles of one joint multiply in table order: R_j = R(a_1) R(a_2) ..., so the last acts first.

    Attributes:
        names: D unique names.
        joints: [D] joint that the angle turns.
        axes: [D, 3] unit vectors in rest world axes; an angle turns counter-clockwise about its axis.
        lower, upper: [D] limits in radians, lower < upper.

    Raises:
        ValueError: if names repeat, lengths differ, an axis is not a unit vector or a range is empty.
    """

    names: tuple[str, ...]
    joints: Int64[np.ndarray, "D"]
    axes: Float32[np.ndarray, "D 3"]
    lower: Float32[np.ndarray, "D"]
    upper: Float32[np.ndarray, "D"]

    def __post_init__(self) -> None:
        count = len(self.names)
        if len(set(self.names)) != count:
            repeated = sorted({name for name in self.names if self.names.count(name) > 1})
            raise ValueError(f"DofTable(): expected unique names; got {repeated} more than once. Rename them.")
        for field, shape in (("joints", (count,)), ("axes", (count, 3)), ("lower", (count,)), ("upper", (count,))):
            _check_shape(field, getattr(self, field), shape)
            _check_finite(field, getattr(self, field))
        lengths = np.linalg.norm(self.axes, axis=1)
        if count and np.abs(lengths - 1).max() > 1e-4:
            worst = int(np.abs(lengths - 1).argmax())
            raise ValueError(f"DofTable(): expected unit axes; got length {lengths[worst]:.4f} for {self.names[worst]!r}. Normalise it.")
        if np.any(self.lower >= self.upper):
            worst = int(np.argmax(self.lower - self.upper))
            raise ValueError(
                f"DofTable(): expected lower < upper; got {self.lower[worst]:.3f}..{self.upper[worst]:.3f} for "
                f"{self.names[worst]!r}. Give limits in radians."
            )


@dataclass(frozen=True, eq=False)  # arrays have no truth value to compare by; a rig is itself alone
class Rig:
    """A surface, a skeleton and the weights that tie them.

    Attributes:
        name: what the rig was made from.
        topology: triangles and texture atlas.
        rest_vertices: [V, 3] metres, world axes, feet on z = 0.
        joint_names: J unique names.
        joint_parents: [J] parent before child; -1 marks the one root, joint 0.
        joint_positions: [J, 3] rest position of each joint's centre of rotation, metres, world axes.
        skinning_weights: [V, J] >= 0, rows sum to 1.
        dofs: the pose angles theta.
        face_region: [V] in [0, 1], 1 where facial movement displaces the surface.
        face_keypoint_names, face_keypoint_vertices: K landmarks of the face, each a vertex.
        keypoint_names: joints that serve as the body's 3D keypoints.

    Raises:
        ValueError: if the parts do not fit each other; the message names the part.
    """

    name: str
    topology: Topology
    rest_vertices: Float32[np.ndarray, "V 3"]
    joint_names: tuple[str, ...]
    joint_parents: Int64[np.ndarray, "J"]
    joint_positions: Float32[np.ndarray, "J 3"]
    skinning_weights: Float32[np.ndarray, "V J"]
    dofs: DofTable
    face_region: Float32[np.ndarray, "V"]
    face_keypoint_names: tuple[str, ...]
    face_keypoint_vertices: Int64[np.ndarray, "K"]
    keypoint_names: tuple[str, ...]

    def __post_init__(self) -> None:
        vertices, joints = self.topology.num_vertices, len(self.joint_names)
        if len(self.rest_vertices) != vertices:
            raise ValueError(
                f"Rig(): rest_vertices must be [{vertices}, 3] for this Topology; got {list(self.rest_vertices.shape)}. "
                "Load mesh and topology from the same file."
            )
        for field, shape in (
            ("rest_vertices", (vertices, 3)),
            ("joint_parents", (joints,)),
            ("joint_positions", (joints, 3)),
            ("skinning_weights", (vertices, joints)),
            ("face_region", (vertices,)),
            ("face_keypoint_vertices", (len(self.face_keypoint_names),)),
        ):
            _check_shape(field, getattr(self, field), shape)
            _check_finite(field, getattr(self, field))
        _check_indices("face_keypoint_vertices", self.face_keypoint_vertices, vertices)
        _check_indices("dofs.joints", self.dofs.joints, joints)
        self._check_tree()
        self._check_weights()

    def _check_tree(self) -> None:
        """Joint 0 is the only root; every other parent comes before its child."""
        order = np.arange(len(self.joint_names))
        lowest = np.where(order == 0, -1, 0)
        wrong = np.flatnonzero((self.joint_parents >= order) | (self.joint_parents < lowest))
        if len(wrong):
            joint = int(wrong[0])
            raise ValueError(
                f"Rig(): expected every parent before its child and -1 for joint 0 alone; got parent {self.joint_parents[joint]} "
                f"for joint {joint} ({self.joint_names[joint]}). Sort the joints from the root outwards."
            )
        unknown = sorted(set(self.keypoint_names) - set(self.joint_names))
        if unknown:
            raise ValueError(f"Rig(): expected keypoint_names among the joints; got {unknown}. Use joint names.")

    def _check_weights(self) -> None:
        if self.skinning_weights.min() < 0:
            raise ValueError(f"Rig(): expected skinning_weights >= 0; got {self.skinning_weights.min():.3g}. Clip and normalise the rows.")
        sums = self.skinning_weights.sum(axis=1, dtype=np.float64)
        worst = int(np.abs(sums - 1).argmax())
        if abs(sums[worst] - 1) > WEIGHT_TOLERANCE:
            raise ValueError(
                f"Rig(): expected rows of skinning_weights that sum to 1; got {sums[worst]:.6f} for vertex {worst}. Normalise the rows."
            )

    @property
    def keypoint_joints(self) -> Int64[np.ndarray, "N"]:
        """[N] joint of each body keypoint."""
        return np.array([self.joint_names.index(name) for name in self.keypoint_names], dtype=np.int64)

    @property
    def fingerprint(self) -> str:
        """16 hexadecimal digits of topology, pose angles and face landmarks: what a trained avatar needs to be the same."""
        digest = hashlib.sha256()
        for array in (self.topology.faces, self.topology.uv, self.topology.uv_faces, self.face_keypoint_vertices):
            digest.update(np.ascontiguousarray(array).tobytes())
        digest.update("\n".join((*self.joint_names, "", *self.dofs.names)).encode())
        return digest.hexdigest()[:16]


_TOPOLOGY_ARRAYS = ("faces", "uv", "uv_faces")
_DOF_ARRAYS = ("joints", "axes", "lower", "upper")
_RIG_ARRAYS = ("rest_vertices", "joint_parents", "joint_positions", "skinning_weights", "face_region", "face_keypoint_vertices")
_NAME_LISTS = ("joint_names", "face_keypoint_names", "keypoint_names")


def save_rig(path: Path | str, rig: Rig) -> None:
    """Write a rig as one compressed `.npz`, whole or not at all.

    Raises:
        OSError: no permission or disk full; an older file survives.
    """
    arrays = {name: getattr(rig.topology, name) for name in _TOPOLOGY_ARRAYS}
    arrays |= {f"dof_{name}": getattr(rig.dofs, name) for name in _DOF_ARRAYS}
    arrays |= {name: getattr(rig, name) for name in _RIG_ARRAYS}
    arrays |= {name: np.array(getattr(rig, name), dtype=np.str_) for name in _NAME_LISTS}
    arrays |= {"dof_names": np.array(rig.dofs.names, dtype=np.str_), "name": np.array(rig.name), "format_version": np.array(FORMAT_VERSION)}
    with atomic_path(path) as temporary:
        np.savez_compressed(temporary, **arrays)


def load_rig(path: Path | str) -> Rig:
    """Read a rig and check that it holds together.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the file is not a rig of this format, an array is missing, or the parts do not fit (the message names file and part).
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"load_rig(): expected a rig file; {path} does not exist. Give the rig.npz of a capture.")
    try:
        # Opened here, because np.load leaves the file open when it cannot read it.
        with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
            arrays = {key: stored[key] for key in stored.files}
    except (zipfile.BadZipFile, ValueError, EOFError, AttributeError) as error:
        raise ValueError(f"load_rig(): expected an .npz rig; {path} cannot be read ({error}). Write it again with save_rig().") from error
    expected = {*_TOPOLOGY_ARRAYS, *_RIG_ARRAYS, *_NAME_LISTS, "dof_names", "name", "format_version"}
    expected |= {f"dof_{name}" for name in _DOF_ARRAYS}
    missing = sorted(expected - set(arrays))
    if missing:
        raise ValueError(f"load_rig(): expected arrays {missing} in {path}; they are missing. Write the file with save_rig().")
    if int(arrays["format_version"]) != FORMAT_VERSION:
        raise ValueError(
            f"load_rig(): expected rig format {FORMAT_VERSION}; {path} has {int(arrays['format_version'])}. "
            "Build the rig again with this version."
        )
    try:
        return _rig_from_arrays(arrays)
    except ValueError as error:
        raise ValueError(f"load_rig(): {path} does not hold together. {error}") from error


def _rig_from_arrays(arrays: dict[str, np.ndarray]) -> Rig:
    """Build (and thereby check) a rig from the arrays of its file; number types are made the run-time ones."""

    def numbers(key: str) -> np.ndarray:
        array = arrays[key]
        return array.astype(np.int64 if np.issubdtype(array.dtype, np.integer) else np.float32)

    def names(key: str) -> tuple[str, ...]:
        return tuple(str(name) for name in arrays[key])

    topology = Topology(num_vertices=len(arrays["rest_vertices"]), **{name: numbers(name) for name in _TOPOLOGY_ARRAYS})
    dofs = DofTable(names=names("dof_names"), **{name: numbers(f"dof_{name}") for name in _DOF_ARRAYS})
    return Rig(
        name=str(arrays["name"]),
        topology=topology,
        dofs=dofs,
        **{name: numbers(name) for name in _RIG_ARRAYS},
        **{name: names(name) for name in _NAME_LISTS},
    )


def _check_shape(field: str, array: np.ndarray, shape: tuple[int, ...]) -> None:
    if array.shape != shape:
        raise ValueError(f"Rig(): {field} must be {list(shape)}; got {list(array.shape)}. Write all parts of the rig together.")


def _check_finite(field: str, array: np.ndarray) -> None:
    if not np.isfinite(array).all():
        count = int((~np.isfinite(array)).sum())
        raise ValueError(f"Rig(): expected finite {field}; got {count} NaN or infinite values. Repair the source of the rig.")


def _check_indices(field: str, array: np.ndarray, count: int) -> None:
    if array.size and (array.min() < 0 or array.max() >= count):
        raise ValueError(
            f"Rig(): expected {field} in 0..{count - 1}; got {array.min()}..{array.max()}. Take faces and points from the same mesh."
        )
