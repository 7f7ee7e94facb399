"""What each kind of take does with the pose angles, as curves over time: range of motion, gestures, held poses, recombined limbs.

All curves are sums of a few sines, so that they are smooth at any frame rate and the same for one seed. Angles stay in ranges within which
limbs keep clear of the trunk and each other; reaching brings forearm and hand to a few centimetres from the trunk.

Symbols: N frames, D pose angles. Radians, seconds; angles are offsets from the rig's rest pose.
"""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from mitsuba_avatar.body.rig import Rig
from mitsuba_avatar.filming.takes import Take

SIDES = ("left", "right")
SHARE_OF_LIMITS = 0.75  # of an angle's range, unless SAFE says otherwise
SHARE_OF_TRUNK = 0.55  # the same for each of the spine's five joints, which add up
SLOW_TRUNK = 0.7  # of that while limbs move slowly: bent farther, a shirt hangs free and its history decides where
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
}
# How people stand while nothing else moves: arms lower than at rest, elbows relaxed.
STANCE = {"shoulder_abduction": -0.26, "elbow_flexion": -0.22, "shoulder_flexion": -0.03}
TALKING = {"shoulder_abduction": -0.2, "shoulder_flexion": 0.32, "shoulder_inward_rotation": 0.12, "elbow_flexion": 0.5}
# An arm in front of the trunk, on its own side, 3 to 5 centimetres off the skin: hand before the hip, and before the chest.
REACH_LOW = {
    "shoulder_flexion": -0.41,
    "shoulder_abduction": -0.15,
    "shoulder_inward_rotation": 0.80,
    "elbow_flexion": 0.80,
    "forearm_pronation": -0.45,
    "clavicle_protraction": 0.15,
}
REACH_HIGH = {
    "shoulder_flexion": -0.05,
    "shoulder_abduction": 0.0,
    "shoulder_inward_rotation": 0.60,
    "elbow_flexion": 1.49,
    "forearm_pronation": -0.55,
    "clavicle_protraction": 0.0,
}
DEEPEST_REACH = 0.93  # of the way there, so that moving fingers keep off the trunk too
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
FINGERS = ("thumb", "index", "middle", "ring", "little")
SLOW = 6.0  # seconds of a typical there and back of a limb that moves alone
HOLD = 2.0  # seconds for which the body holds a pose
CHANGE = 0.5  # seconds from one held pose to the next
GIVE_WAY = 0.6  # radians that an arm lifts for each radian by which the trunk bends towards it
SETTLE = 1.2  # seconds in which a slow take leaves and reaches the stance


def range_of_motion(rig: Rig, take: Take, time: np.ndarray, rng: np.random.Generator) -> Float[np.ndarray, "N D"]:
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


def conversation(rig: Rig, take: Take, time: np.ndarray, rng: np.random.Generator) -> Float[np.ndarray, "N D"]:
    """Talking with the hands: slow drift of everything, faster beats of forearms and wrists."""
    base = {name: value * rng.uniform(0.75, 1.25) for name, value in TALKING.items()}
    theta = _pose(rig, base, len(time))
    for group in (*take.groups, "legs"):
        for index, name in _members(rig, group):
            lower, upper = _safe_range(rig, index, name)
            period = 1.6 if any(part in name for part in ("wrist", "forearm", "index", "middle", "ring", "little", "thumb")) else 3.2
            swing = _share(name) * 0.5 * (upper - lower) * waves(time, period, rng)
            theta[:, index] = np.clip(theta[:, index] + swing, lower, upper)
    return _curl_together(rig, theta, time, rng)


def recombined(rig: Rig, take: Take, time: np.ndarray, rng: np.random.Generator) -> Float[np.ndarray, "N D"]:
    """Wide movement of all groups at once."""
    theta = _pose(rig, STANCE, len(time))
    for group in take.groups:
        for index, name in _members(rig, group):
            lower, upper = _safe_range(rig, index, name)
            reach = 0.4 if "hip" in name or "knee" in name or "ankle" in name else 0.6
            middle, half = 0.5 * (lower + upper), 0.5 * (upper - lower)
            theta[:, index] = middle * reach + reach * half * waves(time, 2.6, rng)
    return _curl_together(rig, theta, time, rng)


def slow_limbs(
    rig: Rig, take: Take, time: np.ndarray, seed: int, shown: Mapping[str, float], rng: np.random.Generator
) -> Float[np.ndarray, "N D"]:
    """One limb on its own, or a few, slowly through most of their range, from the stance and back to it. Fingers are never still.

    Args:
        rig: of the person.
        take: whose groups move.
        time: [N] seconds from the take's beginning.
        seed: of the courses.
        shown: seconds of each group's course that earlier takes showed (`showing`); the take goes on from there.
        rng: of the fingers.
    """
    stance = _pose(rig, STANCE, len(time))
    remaining = time[-1] - time
    envelope = np.sin(0.5 * np.pi * np.clip(np.minimum(time, remaining) / SETTLE, 0, 1)) ** 2
    offsets = sum(limb_offsets(rig, group, shown.get(group, 0.0) + time, seed) for group in take.groups)
    return move_fingers(rig, stance + envelope[:, None] * offsets, time, rng)


def showing(take: Take, duration: float, shown: Mapping[str, float]) -> dict[str, float]:
    """Seconds of each group's course that takes have shown after a slow one of `duration` seconds.

    The next begins before this one ends, so that what is lost on the way to the stance is seen as well.
    """
    return {**shown, **{group: shown.get(group, 0.0) + max(duration - SETTLE, 0.0) for group in take.groups}}


def held_poses(rig: Rig, take: Take, time: np.ndarray, seed: int, rng: np.random.Generator) -> Float[np.ndarray, "N D"]:
    """The body holds one pose of one limb after another, exactly still, while the fingers move."""
    count = max(2, round((time[-1] - time[0]) / HOLD))
    places = np.array([limb_offsets(rig, take.groups[k % len(take.groups)], rng.uniform(0, 30, 1), seed)[0] for k in range(count)])
    progress = (time - time[0]) / max(time[-1] - time[0], 1e-9) * count
    index = np.minimum(progress.astype(int), count - 1)
    change = np.clip((progress - index - 1) * (HOLD / CHANGE) + 1, 0, 1)  # in the last part of a hold, towards the next
    change = np.where(index < count - 1, change * change * (3 - 2 * change), 0.0)
    theta = _pose(rig, STANCE, len(time)) + places[index] + change[:, None] * (places[np.minimum(index + 1, count - 1)] - places[index])
    return move_fingers(rig, theta, time, rng)


def recomposed_limbs(
    rig: Rig, take: Take, time: np.ndarray, seed: int, shown: Mapping[str, float], rng: np.random.Generator
) -> Float[np.ndarray, "N D"]:
    """Limbs move as the slow takes showed each of them, but together, each at another moment of what was `shown` of its course."""
    offsets = []
    for group in take.groups:
        known = shown.get(group, 0.0)
        start, speed, duration = rng.random(), rng.uniform(0.8, 1.2), max(time[-1] - time[0], 1e-9)
        speed = min(speed, known / duration)
        moments = 0.5 * SETTLE + start * (known - speed * duration) + speed * (time - time[0])
        offsets.append(limb_offsets(rig, group, moments, seed))
    return move_fingers(rig, _pose(rig, STANCE, len(time)) + take.extent * sum(offsets), time, rng)


def wild(rig: Rig, take: Take, time: np.ndarray, rng: np.random.Generator) -> Float[np.ndarray, "N D"]:
    """All groups at once, fast and to the ends of their ranges."""
    theta = _pose(rig, STANCE, len(time))
    for group in take.groups:
        for index, name in _members(rig, group):
            lower, upper = _safe_range(rig, index, name)
            theta[:, index] = 0.5 * (lower + upper) + 0.5 * (upper - lower) * _full(waves(time, 1.3, rng))
    return _curl_together(rig, theta, time, rng)


def limb_offsets(rig: Rig, group: str, time: np.ndarray, seed: int) -> Float[np.ndarray, "N D"]:
    """How far a limb that moves alone is from the stance at any moment: the same for one seed in every take."""
    rng = np.random.default_rng([seed, *group.encode()])
    offsets, stance = np.zeros((len(time), len(rig.dofs.names))), _pose(rig, STANCE, 1)[0]
    if group == "knee_bends":
        depth = 0.5 + 0.5 * _full(waves(time, SLOW, rng))
        for side in SIDES:
            for name, share in (("hip_flexion", 0.75), ("knee_flexion", 1.1), ("ankle_dorsiflexion", 0.3)):
                offsets[:, rig.dofs.names.index(f"{side}_{name}")] = share * depth
        return offsets
    if group.endswith("_reach"):
        depth, height = (0.5 + 0.5 * _full(waves(time, share * SLOW, rng)) for share in (0.6, 0.4))
        depth = DEEPEST_REACH * np.sin(0.5 * np.pi * depth)  # longer near the trunk than on the way
        for part, low in REACH_LOW.items():
            index = rig.dofs.names.index(group.replace("reach", part))
            offsets[:, index] = depth * (low + height * (REACH_HIGH[part] - low) - stance[index])
        return offsets
    shared = {part: waves(time, SLOW, rng) for part in ("flexion", "bend", "turn")}
    for index, name in _members(rig, group):
        lower, upper = _safe_range(rig, index, name)
        curve = waves(time, SLOW, rng)
        if group in ("trunk", "neck"):  # the joints of a chain turn together, or they would undo each other
            curve = 0.8 * shared[name.rpartition("_")[2]] + 0.4 * waves(time, 0.5 * SLOW, rng)
        offsets[:, index] = 0.5 * (lower + upper) + 0.5 * (upper - lower) * _full(curve) - stance[index]
        if group == "trunk":
            offsets[:, index] *= SLOW_TRUNK
    if group == "trunk":  # arms give way to the flank that comes towards them
        bend = offsets[:, [index for index, name in _members(rig, group) if name.endswith("bend")]].sum(axis=1)
        for side, sign in (("left", 1.0), ("right", -1.0)):
            towards = 0.5 * (sign * bend + np.hypot(bend, 0.1) - 0.1)
            offsets[:, rig.dofs.names.index(f"{side}_shoulder_abduction")] += GIVE_WAY * towards
    return offsets


def move_fingers(rig: Rig, theta: Float[np.ndarray, "N D"], time: np.ndarray, rng: np.random.Generator) -> Float[np.ndarray, "N D"]:
    """Every finger moves on its own, and with the others of its hand."""
    theta = theta.copy()
    for index, name in enumerate(rig.dofs.names):
        if name.removeprefix("left_").removeprefix("right_").startswith(FINGERS):
            lower, upper = _safe_range(rig, index, name)
            theta[:, index] = 0.5 * (lower + upper) + 0.5 * (upper - lower) * waves(time, 2.0, rng)
    return _curl_together(rig, theta, time, rng)


def stance(rig: Rig) -> Float[np.ndarray, "D"]:  # noqa: F821
    """How the person stands while nothing else moves."""
    return _pose(rig, STANCE, 1)[0]


def _curl_together(rig: Rig, theta: Float[np.ndarray, "N D"], time: np.ndarray, rng: np.random.Generator) -> Float[np.ndarray, "N D"]:
    """Fingers of a hand mostly open and close together."""
    theta = theta.copy()
    for side in SIDES:
        curl = 0.45 + 0.4 * waves(time, 1.8, rng)
        fingers = tuple(f"{side}_{finger}" for finger in ("index", "middle", "ring", "little"))
        for index, name in enumerate(rig.dofs.names):
            if name.startswith(fingers) and name.endswith("flexion"):
                theta[:, index] = 0.35 * theta[:, index] + 0.7 * curl
    return theta


def _members(rig: Rig, group: str) -> list[tuple[int, str]]:
    """(row, name) of the pose angles in a group."""
    arm = ("clavicle", "shoulder", "upper_arm", "elbow", "forearm", "wrist")
    leg = ("hip", "thigh", "knee", "shank", "ankle", "big_toe")
    starts = {
        "trunk": ("spine",),
        "neck": ("neck", "head"),
        "hands": tuple(f"{side}_{part}" for side in SIDES for part in ("wrist", *FINGERS)),
        **{f"{side}_arm": tuple(f"{side}_{part}" for part in arm) for side in SIDES},
        **{f"{side}_leg": tuple(f"{side}_{part}" for part in leg) for side in SIDES},
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


def waves(time: np.ndarray, period: float, rng: np.random.Generator) -> Float[np.ndarray, "N"]:  # noqa: F821
    """A smooth wandering curve within -1..1: three sines of periods around `period` seconds."""
    periods = period * np.array([1.9, 1.0, 0.62]) * rng.uniform(0.85, 1.2, 3)
    phases = rng.uniform(0, 2 * np.pi, 3)
    return (np.array([0.5, 0.35, 0.15]) * np.sin(2 * np.pi * time[:, None] / periods + phases)).sum(axis=1)


def _full(curve: Float[np.ndarray, "N"]) -> Float[np.ndarray, "N"]:  # noqa: F821
    """A curve of `waves`, which seldom comes near -1 and 1, stretched to do so, smoothly."""
    return np.sin(0.5 * np.pi * np.clip(1.25 * curve, -1, 1))
