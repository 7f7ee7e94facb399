"""The pose angles of the Anny skeleton: which joint bends which way, and how far.

Every axis is derived from the rest skeleton. An angle is described by what it does, "turn the bone towards a direction" or "turn about
the bone", so that positive means the same on both sides: flexion, abduction (away from the midline or the middle finger), inward
rotation of arm and thigh, pronation. The left side is computed, the right is its mirror image. The trunk, neck and head turn about
world axes: positive flexion forwards, bend and turn to the person's left.

The person faces -Y, has the left hand at +X and the head at +Z. All angles are zero in the rest pose, in which elbows are already bent
by about 43 degrees and fingers by a little; limits count from there. Radians.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from mitsuba_avatar.body.rig import DofTable

LEFT, FORWARD, UP = np.eye(3) * [1, -1, 1]
MIRROR = np.array([1.0, -1.0, -1.0])  # of an axis of rotation in the plane x = 0: a pseudovector keeps its component along the normal

# Trunk, neck and head: joint, then (lower, upper) of flexion, bend, turn.
_MIDLINE = {
    "spine05": ((-0.25, 0.5), (-0.3, 0.3), (-0.2, 0.2)),
    "spine04": ((-0.2, 0.35), (-0.2, 0.2), (-0.15, 0.15)),
    "spine03": ((-0.2, 0.35), (-0.2, 0.2), (-0.2, 0.2)),
    "spine02": ((-0.2, 0.35), (-0.2, 0.2), (-0.25, 0.25)),
    "spine01": ((-0.2, 0.35), (-0.2, 0.2), (-0.25, 0.25)),
    "neck01": ((-0.3, 0.4), (-0.3, 0.3), (-0.3, 0.3)),
    "neck03": ((-0.35, 0.35), (-0.3, 0.3), (-0.5, 0.5)),
    "head": ((-0.4, 0.4), (-0.3, 0.3), (-0.6, 0.6)),
}

# Bones of one limb segment turn about the segment's own line, from its first joint to the next segment's.
_SEGMENTS = {
    "upperleg01": ("upperleg01", "lowerleg01"),
    "upperleg02": ("upperleg01", "lowerleg01"),
    "lowerleg01": ("lowerleg01", "foot"),
    "lowerleg02": ("lowerleg01", "foot"),
    "upperarm01": ("upperarm01", "lowerarm01"),
    "upperarm02": ("upperarm01", "lowerarm01"),
    "lowerarm01": ("lowerarm01", "wrist"),
    "lowerarm02": ("lowerarm01", "wrist"),
}


@dataclass(frozen=True)
class _Angle:
    """One row of the table to be: `turn_to` names a direction that a positive angle moves the bone to, None means about the bone."""

    name: str
    joint: str
    turn_to: str | None
    lower: float
    upper: float


_LEFT_LIMBS = (
    _Angle("hip_flexion", "upperleg01", "forward", -0.4, 2.0),
    _Angle("hip_abduction", "upperleg01", "left", -0.4, 0.7),
    _Angle("hip_inward_rotation", "upperleg01", None, -0.6, 0.5),
    _Angle("thigh_twist", "upperleg02", None, -0.3, 0.3),
    _Angle("knee_flexion", "lowerleg01", "backward", -0.1, 2.4),
    _Angle("shank_twist", "lowerleg02", None, -0.3, 0.3),
    _Angle("ankle_dorsiflexion", "foot", "up", -0.8, 0.45),
    _Angle("ankle_inversion", "foot", "sole_inwards", -0.3, 0.5),
    _Angle("big_toe_flexion", "toe1-1", "down", -0.9, 0.5),
    _Angle("clavicle_elevation", "clavicle", "up", -0.2, 0.5),
    _Angle("clavicle_protraction", "clavicle", "forward", -0.35, 0.35),
    _Angle("shoulder_flexion", "upperarm01", "forward", -1.0, 1.7),
    _Angle("shoulder_abduction", "upperarm01", "left_up", -0.8, 1.6),
    _Angle("shoulder_inward_rotation", "upperarm01", None, -0.8, 0.9),
    _Angle("upper_arm_twist", "upperarm02", None, -0.4, 0.4),
    _Angle("elbow_flexion", "lowerarm01", "bend", -0.75, 1.6),
    _Angle("forearm_pronation", "lowerarm02", None, -1.2, 1.2),
    _Angle("wrist_flexion", "wrist", "palm", -1.1, 1.2),
    _Angle("wrist_ulnar_deviation", "wrist", "little_finger", -0.35, 0.55),
    _Angle("thumb_base_flexion", "finger1-1", "little_finger", -0.4, 0.6),
    _Angle("thumb_base_abduction", "finger1-1", "palm", -0.4, 0.6),
    _Angle("thumb_middle_flexion", "finger1-2", "thumb_pad", -0.4, 0.9),
    _Angle("thumb_tip_flexion", "finger1-3", "thumb_pad", -0.5, 1.2),
    *(
        _Angle(f"{name}_{part}", f"finger{number}-{bone}", turn_to, lower, upper)
        for number, name, away in (
            (2, "index", "thumb"),
            (3, "middle", "thumb"),
            (4, "ring", "little_finger"),
            (5, "little", "little_finger"),
        )
        for part, bone, turn_to, lower, upper in (
            ("base_flexion", 1, "palm", -0.4, 1.4),
            ("base_abduction", 1, away, -0.12, 0.3),
            ("middle_flexion", 2, "palm", -0.2, 1.6),
            ("tip_flexion", 3, "palm", -0.2, 1.1),
        )
    ),
    _Angle("eye_elevation", "eye", "up", -0.5, 0.45),
    _Angle("eye_abduction", "eye", "left", -0.5, 0.5),
)


@dataclass(frozen=True)
class RestSkeleton:
    """Rest joints of a person facing -Y: names with endings .L and .R, [J, 3] positions and [J, 3] bone directions (unit)."""

    names: tuple[str, ...]
    positions: Float[np.ndarray, "J 3"]
    directions: Float[np.ndarray, "J 3"]

    def position(self, name: str) -> Float[np.ndarray, "3"]:
        """Rest position of a joint by name, metres."""
        return self.positions[self.names.index(name)]

    def direction(self, name: str) -> Float[np.ndarray, "3"]:
        """Unit direction of a joint's bone by name."""
        return self.directions[self.names.index(name)]


def anny_dof_table(skeleton: RestSkeleton) -> DofTable:
    """Names, joints, axes and limits of all pose angles, in the order midline, left side, right side.

    Raises:
        ValueError: if the skeleton lacks a joint (`tuple.index`) or a bone lies along the direction it should turn to.
    """
    rows: list[tuple[str, str, np.ndarray, float, float]] = []
    for joint, limits in _MIDLINE.items():
        # About world axes: +X leans the head forwards, +Y to the left, +Z turns the face left. A turn acts first, then bend, then flexion.
        for part, axis, (lower, upper) in zip(("flexion", "bend", "turn"), (LEFT, -FORWARD, UP), limits, strict=True):
            rows.append((f"{joint}_{part}", joint, axis, lower, upper))
    left = [(angle, _left_axis(skeleton, angle)) for angle in _LEFT_LIMBS]
    rows += [(f"left_{angle.name}", f"{angle.joint}.L", axis, angle.lower, angle.upper) for angle, axis in left]
    rows += [(f"right_{angle.name}", f"{angle.joint}.R", axis * MIRROR, angle.lower, angle.upper) for angle, axis in left]
    names, joints, axes, lower, upper = zip(*rows, strict=True)
    return DofTable(
        names=names,
        joints=np.array([skeleton.names.index(joint) for joint in joints], dtype=np.int64),
        axes=np.stack(axes).astype(np.float32),
        lower=np.array(lower, dtype=np.float32),
        upper=np.array(upper, dtype=np.float32),
    )


def _left_axis(skeleton: RestSkeleton, angle: _Angle) -> Float[np.ndarray, "3"]:
    """Unit axis of a left-side angle, in rest world axes."""
    bone = _left_bone(skeleton, angle.joint)
    if angle.turn_to is None:
        return bone
    if angle.turn_to == "sole_inwards":  # about the foot's length, which the ankle's bone roughly is
        level = bone * [1, 1, 0]
        return -level / np.linalg.norm(level)
    if angle.joint == "eye":
        bone = FORWARD
    targets = {"forward": FORWARD, "backward": -FORWARD, "left": LEFT, "up": UP, "down": -UP, "left_up": LEFT + UP}
    targets |= _hand_directions(skeleton)
    if angle.turn_to == "bend":  # the elbow's hinge is perpendicular to the plane that upper arm and forearm span
        bone, targets["bend"] = _left_bone(skeleton, "upperarm01"), bone
    axis = np.cross(bone, targets[angle.turn_to])
    length = np.linalg.norm(axis)
    if length < 0.1:
        raise ValueError(
            f"anny_dof_table(): expected {angle.joint} across the direction {angle.turn_to!r}; got a bone along it. Change the rest pose."
        )
    return axis / length


def _left_bone(skeleton: RestSkeleton, joint: str) -> Float[np.ndarray, "3"]:
    """Unit direction of a left bone, of its whole segment for arms and legs."""
    if joint not in _SEGMENTS:
        return skeleton.direction(f"{joint}.L")
    start, end = (skeleton.position(f"{name}.L") for name in _SEGMENTS[joint])
    return (end - start) / np.linalg.norm(end - start)


def _hand_directions(skeleton: RestSkeleton) -> dict[str, np.ndarray]:
    """Unit directions in the left hand at rest: out of the palm, across it to either side, and where the thumb's pad faces."""
    knuckles = [skeleton.position(f"finger{number}-1.L") for number in (2, 3, 4, 5)]
    along = np.mean(knuckles, axis=0) - skeleton.position("wrist.L")
    along /= np.linalg.norm(along)
    across = knuckles[3] - knuckles[0]
    across -= along * (across @ along)
    across /= np.linalg.norm(across)
    palm = np.cross(across, along)
    return {"palm": palm, "little_finger": across, "thumb": -across, "thumb_pad": (across + palm) / np.sqrt(2)}
