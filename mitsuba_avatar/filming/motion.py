"""What the person does: joint angles, place in the room and facial actions of every frame, with training and test takes that differ.

Range of motion moves one group of limbs at a time, slowly, through most of its limits, while everything else rests. Conversation moves
hands, head and trunk together around a talking pose, with speech on the face. Test takes recombine: limbs that never moved together in
training do, in other rhythms. All curves are sums of a few sines, so that they are smooth at any frame rate and the same for one seed.

Symbols: N frames, D pose angles, A facial actions. Radians, metres, seconds; angles are offsets from the rig's rest pose.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32

from mitsuba_avatar.body.rig import Rig
from mitsuba_avatar.body.skeleton import Skeleton
from mitsuba_avatar.captures.frames import Frame
from mitsuba_avatar.filming.face import conversation_face, expression_tour, resting_face
from mitsuba_avatar.filming.settings import StudioSettings

SIDES = ("left", "right")
SHARE_OF_LIMITS = 0.75  # of an angle's range, unless SAFE says otherwise
FOOT_LIFT = 0.05  # metres that a foot must leave the floor before it clearly no longer carries the person
SHARE_OF_TRUNK = 0.55  # the same for each of the spine's five joints, which add up
# Ranges within which limbs keep clear of the trunk and each other (arms about 20 degrees off the torso or more; at rest they are 45
# degrees off) and near enough to it for portrait images to be filled.
SAFE = {
    "shoulder_abduction": (-0.32, 0.62),
    "shoulder_flexion": (-0.5, 0.85),
    "shoulder_inward_rotation": (-0.45, 0.45),
    "elbow_flexion": (-0.35, 1.1),
    "hip_flexion": (-0.2, 0.75),
    "hip_abduction": (-0.08, 0.3),
    "hip_inward_rotation": (-0.3, 0.2),
    "knee_flexion": (-0.05, 1.1),
    "ankle_dorsiflexion": (-0.4, 0.3),
    "finger_base_flexion": (-0.2, 1.2),
}
# How people stand while nothing else moves: arms lower than at rest, elbows relaxed.
STANCE = {"shoulder_abduction": -0.26, "elbow_flexion": -0.22, "shoulder_flexion": -0.03}
TALKING = {"shoulder_abduction": -0.2, "shoulder_flexion": 0.32, "shoulder_inward_rotation": 0.12, "elbow_flexion": 0.5}
SWING = {
    "trunk": 0.45,
    "neck": 0.5,
    "shoulder": 0.42,
    "elbow": 0.6,
    "forearm": 0.5,
    "wrist": 0.4,
    "fingers": 0.5,
    "clavicle": 0.4,
    "legs": 0.14,
}


@dataclass(frozen=True)
class Motion:
    """Everything that drives the person, frame by frame.

    Attributes:
        frames: N moments with split and segment.
        theta: [N, D] radians.
        root: [N, 4, 4] rigid world_from_root.
        actions: [N, A] strengths of the facial actions, 0..1.
    """

    frames: tuple[Frame, ...]
    theta: Float32[np.ndarray, "N D"]
    root: Float32[np.ndarray, "N 4 4"]
    actions: Float32[np.ndarray, "N A"]

    def segments(self) -> list[slice]:
        """Runs of frames that follow each other in time."""
        names = [frame.segment for frame in self.frames]
        starts = [index for index, name in enumerate(names) if index == 0 or names[index - 1] != name]
        return [slice(start, end) for start, end in zip(starts, [*starts[1:], len(names)], strict=True)]


@dataclass(frozen=True)
class Take:
    """A segment to be: which groups of angles move, and how.

    Attributes:
        groups: range of motion visits them one after the other; other takes move all of them at once.
        style: "range" (one group at a time), "conversation" or "recombined" (all at once, wide).
        share: of the split's frames.
    """

    name: str
    split: str
    style: str
    groups: tuple[str, ...]
    share: float


TAKES = (
    Take("range_of_motion_trunk_and_head", "train", "range", ("trunk", "neck", "legs"), 0.3),
    Take("range_of_motion_arms", "train", "range", ("left_arm", "right_arm", "both_arms", "hands"), 0.42),
    Take("conversation", "train", "conversation", ("arms", "trunk", "neck", "hands"), 0.28),
    Take("test_recombined", "test", "recombined", ("left_arm", "right_arm", "trunk", "neck", "legs"), 0.6),
    Take("test_conversation", "test", "conversation", ("arms", "trunk", "neck", "hands"), 0.4),
)


def perform(rig: Rig, settings: StudioSettings, action_names: Sequence[str], takes: tuple[Take, ...] = TAKES) -> Motion:
    """Plan every frame of a capture. The same settings give the same motion.

    Args:
        rig: names and limits of the pose angles.
        settings: numbers of frames, fps and seed.
        action_names: A facial actions, ARKit's names.
        takes: what is performed, in order.
    """
    frames: list[Frame] = []
    theta, root, actions = [], [], []
    for order, (take, count) in enumerate(_divide(takes, settings)):
        rng = np.random.default_rng([settings.seed, order])
        time = np.arange(count) / settings.motion.fps
        angles = {"range": _range_of_motion, "conversation": _conversation, "recombined": _recombined}[take.style](rig, take, time, rng)
        gaze, face = _face(take, time, action_names, rng)
        theta.append(_with_gaze(rig, angles, gaze))
        root.append(_wander(time, rng, turn=0.12 if take.style == "range" else 0.45))
        actions.append(face)
        frames += [Frame(len(frames) + index, (len(frames) + index) / settings.motion.fps, take.split, take.name) for index in range(count)]
    limits = rig.dofs.lower, rig.dofs.upper
    all_theta = np.clip(np.concatenate(theta), *limits).astype(np.float32)
    planted = plant_feet(rig, all_theta, np.concatenate(root).astype(np.float32))
    return Motion(tuple(frames), all_theta, planted, np.concatenate(actions).astype(np.float32))


def plant_feet(rig: Rig, theta: Float32[np.ndarray, "N D"], root: Float32[np.ndarray, "N 4 4"]) -> Float32[np.ndarray, "N 4 4"]:
    """Shift the root in the plane so that the standing foot does not slide over the floor, apart from the drift of `root` itself.

    Which foot stands is weighed smoothly by height. Heights are left alone: the surface, not the skeleton, stands on the floor.
    """
    skeleton = Skeleton(rig)
    with torch.no_grad():
        joints = skeleton.posed_joints(skeleton(torch.from_numpy(theta), torch.from_numpy(root))).numpy()
    ankles = [rig.joint_names.index(f"foot.{side}") for side in "LR"]
    clearance = joints[:, ankles, 2] - rig.joint_positions[ankles, 2]  # [N, 2] metres above standing height
    standing = np.exp(-(clearance - clearance.min(axis=1, keepdims=True)) / FOOT_LIFT)
    standing /= standing.sum(axis=1, keepdims=True)
    planted = np.einsum("nij,fj->nfi", root[:, :3, :3], rig.joint_positions[ankles]) + root[:, None, :3, 3]
    slip = ((joints[:, ankles] - planted) * standing[..., None]).sum(axis=1)  # [N, 3]
    shifted = root.copy()
    shifted[:, :2, 3] -= slip[:, :2]
    return shifted


def _divide(takes: tuple[Take, ...], settings: StudioSettings) -> list[tuple[Take, int]]:
    """Number of frames of each take: shares of the split's frames, rounded so that they add up; takes of no frame are left out."""
    counts = []
    for split, total in (("train", settings.motion.train_frames), ("test", settings.motion.test_frames)):
        chosen = [take for take in takes if take.split == split]
        ends = np.rint(np.cumsum([take.share for take in chosen]) / sum(take.share for take in chosen) * total).astype(int)
        counts += [(take, int(count)) for take, count in zip(chosen, np.diff(ends, prepend=0), strict=True) if count]
    return counts


def _range_of_motion(rig: Rig, take: Take, time: np.ndarray, rng: np.random.Generator) -> Float[np.ndarray, "N D"]:
    """Each group in its turn: a window of time in which its angles make one round trip through their safe range, out of phase."""
    theta = _pose(rig, STANCE, len(time))
    progress = (np.arange(len(time)) + 0.5) / len(time) * len(take.groups)
    for place, group in enumerate(take.groups):
        inside = np.clip((progress - place + 0.3) / 1.6, 0, 1)  # 0..1 within the group's window, which overlaps its neighbours'
        envelope = np.sin(np.pi * inside) ** 1.5
        for index, name in _members(rig, group):
            lower, upper = _safe_range(rig, index, name)
            phase = rng.uniform(-0.6, 0.6) + (np.pi * 0.5 if rng.random() < 0.5 else 0.0)
            swing = rng.uniform(0.7, 1.0) * np.sin(2 * np.pi * inside + phase)
            target = np.where(swing > 0, upper * swing, -lower * swing)
            theta[:, index] += envelope * (target - theta[:, index])
    return theta


def _conversation(rig: Rig, take: Take, time: np.ndarray, rng: np.random.Generator) -> Float[np.ndarray, "N D"]:
    """Talking with the hands: slow drift of everything, faster beats of forearms and wrists."""
    base = {name: value * rng.uniform(0.75, 1.25) for name, value in TALKING.items()}
    theta = _pose(rig, base, len(time))
    for group in (*take.groups, "legs"):
        for index, name in _members(rig, group):
            lower, upper = _safe_range(rig, index, name)
            period = 1.6 if any(part in name for part in ("wrist", "forearm", "index", "middle", "ring", "little", "thumb")) else 3.2
            swing = _share(name) * 0.5 * (upper - lower) * _waves(time, period, rng)
            theta[:, index] = np.clip(theta[:, index] + swing, lower, upper)
    return _curl_together(rig, theta, time, rng)


def _recombined(rig: Rig, take: Take, time: np.ndarray, rng: np.random.Generator) -> Float[np.ndarray, "N D"]:
    """Wide movement of all groups at once."""
    theta = _pose(rig, STANCE, len(time))
    for group in take.groups:
        for index, name in _members(rig, group):
            lower, upper = _safe_range(rig, index, name)
            reach = 0.4 if "hip" in name or "knee" in name or "ankle" in name else 0.6
            middle, half = 0.5 * (lower + upper), 0.5 * (upper - lower)
            theta[:, index] = middle * reach + reach * half * _waves(time, 2.6, rng)
    return _curl_together(rig, theta, time, rng)


def _curl_together(rig: Rig, theta: Float[np.ndarray, "N D"], time: np.ndarray, rng: np.random.Generator) -> Float[np.ndarray, "N D"]:
    """Fingers of a hand mostly open and close together."""
    theta = theta.copy()
    for side in SIDES:
        curl = 0.45 + 0.4 * _waves(time, 1.8, rng)
        fingers = tuple(f"{side}_{finger}" for finger in ("index", "middle", "ring", "little"))
        for index, name in enumerate(rig.dofs.names):
            if name.startswith(fingers) and name.endswith("flexion"):
                theta[:, index] = 0.35 * theta[:, index] + 0.7 * curl
    return theta


def _members(rig: Rig, group: str) -> list[tuple[int, str]]:
    """(row, name) of the pose angles in a group."""
    fingers = ("thumb", "index", "middle", "ring", "little")
    arm = ("clavicle", "shoulder", "upper_arm", "elbow", "forearm", "wrist")
    leg = ("hip", "thigh", "knee", "shank", "ankle", "big_toe")
    starts = {
        "trunk": ("spine",),
        "neck": ("neck", "head"),
        "hands": tuple(f"{side}_{part}" for side in SIDES for part in ("wrist", *fingers)),
        "left_arm": tuple(f"left_{part}" for part in arm),
        "right_arm": tuple(f"right_{part}" for part in arm),
        "legs": tuple(f"{side}_{part}" for side in SIDES for part in leg),
    }
    starts["arms"] = starts["both_arms"] = starts["left_arm"] + starts["right_arm"]
    return [(index, name) for index, name in enumerate(rig.dofs.names) if name.startswith(starts[group])]


def _safe_range(rig: Rig, index: int, name: str) -> tuple[float, float]:
    """Range within which an angle may move without bringing limbs into each other."""
    bare = name.removeprefix("left_").removeprefix("right_")
    if bare in SAFE:
        return SAFE[bare]
    share = SHARE_OF_TRUNK if name.startswith("spine") else SHARE_OF_LIMITS
    return share * float(rig.dofs.lower[index]), share * float(rig.dofs.upper[index])


def _share(name: str) -> float:
    """Part of its safe range that an angle uses while talking."""
    groups = {"trunk": "spine", "neck": ("neck", "head")}
    for group, start in groups.items():
        if name.startswith(start):
            return SWING[group]
    bare = name.split("_", 1)[1]
    for group in ("shoulder", "elbow", "forearm", "wrist", "clavicle"):
        if bare.startswith(group):
            return SWING[group]
    is_leg = bare.startswith(("hip", "thigh", "knee", "shank", "ankle", "big_toe"))
    return SWING["legs"] if is_leg else SWING["fingers"]


def _pose(rig: Rig, offsets: dict[str, float], count: int) -> Float[np.ndarray, "N D"]:
    """The rest pose changed by `offsets`, named without side, held for `count` frames."""
    theta = np.zeros((count, len(rig.dofs.names)))
    for name, value in offsets.items():
        for side in SIDES:
            theta[:, rig.dofs.names.index(f"{side}_{name}")] = value
    return theta


def _waves(time: np.ndarray, period: float, rng: np.random.Generator) -> Float[np.ndarray, "N"]:  # noqa: F821
    """A smooth wandering curve within -1..1: three sines of periods around `period` seconds."""
    periods = period * np.array([1.9, 1.0, 0.62]) * rng.uniform(0.85, 1.2, 3)
    phases = rng.uniform(0, 2 * np.pi, 3)
    return (np.array([0.5, 0.35, 0.15]) * np.sin(2 * np.pi * time[:, None] / periods + phases)).sum(axis=1)


def _wander(time: np.ndarray, rng: np.random.Generator, turn: float) -> Float[np.ndarray, "N 4 4"]:
    """Swaying by centimetres and turning by about `turn` radians on the spot."""
    root = np.tile(np.eye(4), (len(time), 1, 1))
    angle = turn * _waves(time, 5.0, rng)
    root[:, 0, 0], root[:, 0, 1] = np.cos(angle), -np.sin(angle)
    root[:, 1, 0], root[:, 1, 1] = np.sin(angle), np.cos(angle)
    root[:, 0, 3], root[:, 1, 3] = 0.03 * _waves(time, 4.0, rng), 0.03 * _waves(time, 4.5, rng)
    return root


def _face(
    take: Take, time: np.ndarray, names: Sequence[str], rng: np.random.Generator
) -> tuple[Float[np.ndarray, "N 2"], Float[np.ndarray, "N A"]]:
    """Gaze (elevation, turn to the person's left) and facial actions of a take."""
    gaze = np.stack([0.16 * _waves(time, 1.4, rng), 0.26 * _waves(time, 1.7, rng)], axis=1)
    if take.style == "conversation":
        return gaze, conversation_face(time, names, rng)
    if "arms" in take.name:  # expressions while the body is busy elsewhere
        return gaze, expression_tour(time, names, rng)
    return gaze, resting_face(time, names, rng)


def _with_gaze(rig: Rig, theta: Float[np.ndarray, "N D"], gaze: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N D"]:
    """Turn both eyes; abduction is outwards, so the right eye's has the other sign."""
    theta = theta.copy()
    for side, sign in (("left", 1.0), ("right", -1.0)):
        theta[:, rig.dofs.names.index(f"{side}_eye_elevation")] = gaze[:, 0]
        theta[:, rig.dofs.names.index(f"{side}_eye_abduction")] = sign * gaze[:, 1]
    return theta
