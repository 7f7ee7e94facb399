"""Does the mesh project onto the masks? And if not: which of the usual conversion mistakes explains it?

The measure is the intersection over union (IoU) of the projected mesh's silhouette and the mask, pooled over frames. When it is low,
each known trap is undone in turn ("what if the rotation was stored transposed?"), and the one after which the silhouettes clearly
agree better is named. The half-pixel traps cost too little IoU to look suspicious, so they are tried always.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from mitsuba_avatar.captures.cameras import Camera
from mitsuba_avatar.captures.rigid import inverse_rigid
from mitsuba_avatar.captures.silhouettes import silhouette

# A trap is named if undoing it removes this share of the disagreement 1 - IoU, and gains at least this much IoU. Loose clothing or
# tracking noise leave a disagreement that no trap removes.
REMOVED_SHARE = 0.4
LEAST_GAIN = 0.003
MOST_TRIAL_CAMERAS = 6  # evenly chosen among the suspicious ones; more would not change the verdict, only its cost

OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class Observation:
    """One image's mask and the mesh that should fill it.

    Attributes:
        camera: at the mask's size.
        frame_index: row of frames.csv.
        mask: [H, W] True on the person.
        vertices: [V, 3] mesh of this frame, metres, world axes.
        root: [4, 4] root pose by which a rig posed `vertices`; None if they were registered without one.
    """

    camera: Camera
    frame_index: int
    mask: Bool[np.ndarray, "H W"]
    vertices: Float[np.ndarray, "V 3"]
    root: Float[np.ndarray, "4 4"] | None = None


@dataclass(frozen=True)
class Trap:
    """A known conversion mistake.

    Attributes:
        name: what is wrong, as the end of "the likely trap: ...".
        remedy: what to do about it.
        undo: from an observation as given, and the width of a stored image pixel in pixels of the observation, to the one
            that would be right if the mistake was made; None if it cannot have been made.
        is_subpixel: costs so little IoU that it must be tried even when all looks well.
    """

    name: str
    remedy: str
    undo: Callable[[Observation, float], Observation | None]
    is_subpixel: bool = False


@dataclass(frozen=True)
class Diagnosis:
    """Result of `diagnose`.

    Attributes:
        iou: camera name -> IoU as given.
        low_cameras: those below the minimum.
        trap: the mistake that explains the disagreement, or None.
        trap_iou: IoU of the tried cameras with `trap` undone; as given where there is none.
        trials: (name of trap, IoU of the tried cameras), best first; empty if none had to be tried.
    """

    iou: dict[str, float]
    low_cameras: tuple[str, ...]
    trap: Trap | None
    trap_iou: float
    trials: tuple[tuple[str, float], ...] = field(default=())

    @property
    def is_good(self) -> bool:
        """Whether every camera agrees with the mesh and no trap is suspected."""
        return not self.low_cameras and self.trap is None


def diagnose(
    observations: Sequence[Observation],
    faces: Int[np.ndarray, "F 3"],
    minimum_iou: float = 0.7,
    pixel: float = 1.0,
    track: Callable[[Sequence, str], Iterable] = lambda items, _: items,
) -> Diagnosis:
    """Measure the agreement of mesh and masks and name the likely trap where it is bad.

    Args:
        observations: at least one; few frames suffice.
        faces: [F, 3].
        minimum_iou: a camera below this is suspicious.
        pixel: width of a stored image pixel in pixels of the observations: the factor by which those were made smaller.
        track: called with a sequence and a description, yields its items; a progress bar.
    """
    iou = silhouette_iou(track(observations, "Projecting the mesh"), faces)
    low_cameras = tuple(name for name, value in iou.items() if value < minimum_iou)
    suspicious = low_cameras or tuple(iou)
    tried = {suspicious[i] for i in np.linspace(0, len(suspicious) - 1, min(len(suspicious), MOST_TRIAL_CAMERAS)).round().astype(int)}
    trial_observations = [observation for observation in observations if observation.camera.name in tried]
    given = _pooled_iou(trial_observations, faces)
    traps = [trap for trap in TRAPS if low_cameras or trap.is_subpixel]
    trials = []
    for trap in track(traps, "Trying known traps"):
        undone = [trap.undo(observation, pixel) for observation in trial_observations]
        if all(observation is not None for observation in undone):
            trials.append((_pooled_iou(undone, faces), trap))
    trials.sort(key=lambda trial: -trial[0])
    best_iou, best = trials[0]
    is_clear = best_iou - given >= LEAST_GAIN and (1 - best_iou) <= (1 - REMOVED_SHARE) * (1 - given)
    return Diagnosis(
        iou, low_cameras, best if is_clear else None, best_iou if is_clear else given, tuple((trap.name, value) for value, trap in trials)
    )


def silhouette_iou(observations: Iterable[Observation], faces: Int[np.ndarray, "F 3"]) -> dict[str, float]:
    """Camera name -> intersection over union of projected mesh and mask, pooled over the camera's frames; 1 where both are empty."""
    counts: dict[str, np.ndarray] = {}
    for observation in observations:
        counts[observation.camera.name] = counts.get(observation.camera.name, 0) + _overlap(observation, faces)
    return {name: _iou(count) for name, count in counts.items()}


def _pooled_iou(observations: Iterable[Observation], faces: Int[np.ndarray, "F 3"]) -> float:
    """One IoU over all observations."""
    return _iou(sum((_overlap(observation, faces) for observation in observations), start=np.zeros(2, dtype=np.int64)))


def _overlap(observation: Observation, faces: Int[np.ndarray, "F 3"]) -> Int[np.ndarray, "2"]:
    """Pixels in the intersection and in the union."""
    projected = silhouette(observation.camera, observation.vertices, faces)
    return np.array([np.count_nonzero(projected & observation.mask), np.count_nonzero(projected | observation.mask)])


def _iou(count: Int[np.ndarray, "2"]) -> float:
    """Intersection over union of pixel counts."""
    return float(count[0] / count[1]) if count[1] else 1.0


# ---- The traps: each function undoes one mistake ----


def _with_pose(observation: Observation, camera_from_world: Float[np.ndarray, "4 4"]) -> Observation:
    """The observation by a camera elsewhere."""
    return replace(observation, camera=replace(observation.camera, camera_from_world=camera_from_world))


def _transpose_rotation(observation: Observation, pixel: float) -> Observation:
    """R^T was stored beside the right t."""
    pose = observation.camera.camera_from_world.copy()
    pose[:3, :3] = pose[:3, :3].T
    return _with_pose(observation, pose)


def _transpose_rotation_about_center(observation: Observation, pixel: float) -> Observation:
    """R^T was stored, and t = -R^T c computed from it with the right camera position c."""
    pose = observation.camera.camera_from_world.copy()
    pose[:3, :3] = pose[:3, :3].T
    pose[:3, 3] = -pose[:3, :3] @ observation.camera.center_world
    return _with_pose(observation, pose)


def _invert_pose(observation: Observation, pixel: float) -> Observation:
    """world_from_camera was stored."""
    return _with_pose(observation, observation.camera.world_from_camera)


def _from_opengl(observation: Observation, pixel: float) -> Observation:
    """Camera axes were OpenGL's: y up, z backward."""
    return _with_pose(observation, OPENCV_FROM_OPENGL @ observation.camera.camera_from_world)


def _from_opengl_inverse(observation: Observation, pixel: float) -> Observation:
    """world_from_camera with OpenGL's camera axes was stored, as in transforms.json of NeRF and in Blender."""
    return _with_pose(observation, OPENCV_FROM_OPENGL @ observation.camera.world_from_camera)


def _translation_from_position(observation: Observation, pixel: float) -> Observation:
    """The camera's position was stored where the translation belongs."""
    pose = observation.camera.camera_from_world.copy()
    pose[:3, 3] = -pose[:3, :3] @ pose[:3, 3]
    return _with_pose(observation, pose)


def _scale_translation(factor: float) -> Callable[[Observation, float], Observation]:
    """The translation was stored in another unit than the mesh."""

    def undo(observation: Observation, pixel: float) -> Observation:
        pose = observation.camera.camera_from_world.copy()
        pose[:3, 3] *= factor
        return _with_pose(observation, pose)

    return undo


def _scale_vertices(factor: float) -> Callable[[Observation, float], Observation]:
    """The mesh was stored in another unit than the cameras."""
    return lambda observation, pixel: replace(observation, vertices=observation.vertices * factor)


def _scale_intrinsics(factor: float) -> Callable[[Observation, float], Observation]:
    """Intrinsics belong to images of another size."""

    def undo(observation: Observation, pixel: float) -> Observation:
        camera = observation.camera
        scaled = replace(camera, fx=camera.fx * factor, fy=camera.fy * factor, cx=camera.cx * factor, cy=camera.cy * factor)
        return replace(observation, camera=scaled)

    return undo


def _center_principal_point(observation: Observation, pixel: float) -> Observation:
    """The principal point was lost; reading K transposed turns it into the last row."""
    camera = observation.camera
    return replace(observation, camera=replace(camera, cx=camera.width / 2, cy=camera.height / 2))


def _exchange_axes(observation: Observation, pixel: float) -> Observation:
    """x and y were exchanged in the intrinsics, as when (row, column) is read as (x, y)."""
    camera = observation.camera
    return replace(observation, camera=replace(camera, fx=camera.fy, fy=camera.fx, cx=camera.cy, cy=camera.cx))


def _shift_principal_point(shift: float) -> Callable[[Observation, float], Observation]:
    """The principal point was counted from another origin; `shift` in stored pixels."""

    def undo(observation: Observation, pixel: float) -> Observation:
        camera = observation.camera
        return replace(observation, camera=replace(camera, cx=camera.cx + shift * pixel, cy=camera.cy + shift * pixel))

    return undo


def _invert_root(observation: Observation, pixel: float) -> Observation | None:
    """rest_from_world was stored as root: posed vertices are root @ rest, and should be root^-1 @ rest."""
    if observation.root is None:
        return None
    inverse = inverse_rigid(observation.root.astype(np.float64))
    world_from_posed = inverse @ inverse
    return replace(observation, vertices=observation.vertices @ world_from_posed[:3, :3].T + world_from_posed[:3, 3])


def _from_y_up(observation: Observation, pixel: float) -> Observation:
    """The mesh stands along y while the cameras' world has z up."""
    x, y, z = observation.vertices.T
    return replace(observation, vertices=np.stack([x, -z, y], axis=-1))


TRAPS: tuple[Trap, ...] = (
    Trap("transposed rotation", "Transpose the upper left 3x3 block of every camera_from_world.", _transpose_rotation),
    Trap(
        "transposed rotation, with translations computed from it",
        "Transpose the rotation R of every camera_from_world and compute its translation again as -R c from the camera's position c.",
        _transpose_rotation_about_center,
    ),
    Trap("world_from_camera stored as camera_from_world", "Invert every camera_from_world.", _invert_pose),
    Trap("OpenGL camera axes (y up, z backward)", "Multiply every camera_from_world by diag(1, -1, -1, 1) from the left.", _from_opengl),
    Trap(
        "OpenGL world_from_camera (NeRF, Blender)",
        "Invert every camera_from_world, then multiply by diag(1, -1, -1, 1) from the left.",
        _from_opengl_inverse,
    ),
    Trap("camera positions stored as translations", "Replace every translation t by -R t.", _translation_from_position),
    Trap("camera translations in millimetres", "Divide the translations of camera_from_world by 1000.", _scale_translation(1e-3)),
    Trap("camera translations in centimetres", "Divide the translations of camera_from_world by 100.", _scale_translation(1e-2)),
    Trap("mesh in millimetres", "Divide the vertices by 1000.", _scale_vertices(1e-3)),
    Trap("mesh in centimetres", "Divide the vertices by 100.", _scale_vertices(1e-2)),
    Trap("mesh with y up", "Turn vertices and root poses from y up to z up: (x, y, z) becomes (x, -z, y).", _from_y_up),
    Trap("intrinsics of images half the size", "Multiply fx, fy, cx, cy by 2 (corner origin).", _scale_intrinsics(2.0)),
    Trap("intrinsics of images twice the size", "Divide fx, fy, cx, cy by 2 (corner origin).", _scale_intrinsics(0.5)),
    Trap("lost principal point (K read transposed)", "Read K transposed: cx and cy are in its last column.", _center_principal_point),
    Trap("x and y of the intrinsics exchanged", "Exchange fx with fy and cx with cy.", _exchange_axes),
    Trap("inverted root pose", "Invert root.npy: it holds world_from_root.", _invert_root),
    Trap(
        "half a pixel: the principal point counts from the first pixel's centre",
        "Add 0.5 to cx and cy: the origin is the image's corner.",
        _shift_principal_point(0.5),
        is_subpixel=True,
    ),
    Trap(
        "half a pixel: 0.5 was added to the principal point twice",
        "Subtract 0.5 from cx and cy: the origin is the image's corner.",
        _shift_principal_point(-0.5),
        is_subpixel=True,
    ),
)
