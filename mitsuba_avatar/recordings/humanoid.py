"""Which joint of a recorded skeleton is which part of the body, and how the skeleton stands at rest.

The names of the CMU database and MotionBuilder (LeftUpLeg, LowerBack), of Mixamo (mixamorig:LeftUpLeg) and of Poser-like exports of the
CMU database (lThigh, abdomen) are known; case, namespaces, spaces and underscores do not matter.

Symbols: N frames, J joints. Metres; axes as in the recording until `Humanoid.rig_from_file` turns them: person facing -Y, left +X, up +Z.
"""

import difflib
import re
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from mitsuba_avatar.recordings.bvh import BvhRecording, joint_transforms

_SIDED = {
    "clavicle": ("shoulder", "collar", "clavicle"),
    "upper_arm": ("arm", "uparm", "upperarm", "shldr"),
    "forearm": ("forearm", "lowarm", "lowerarm"),
    "hand": ("hand", "wrist"),
    "thigh": ("upleg", "thigh", "upperleg"),
    "shin": ("leg", "lowleg", "lowerleg", "shin", "calf"),
    "foot": ("foot", "ankle"),
    "toes": ("toebase", "toe", "toes"),
}
_MIDLINE = {
    "hips": ("hips", "hip", "pelvis"),
    "head": ("head",),
}
_NEXT = {"upper_arm": "forearm", "forearm": "hand", "thigh": "shin", "shin": "foot", "foot": "toes"}
_OPTIONAL = ("clavicle", "toes")
_SPINE = ("lowerback", "abdomen", "spine", "spine1", "spine2", "spine3", "spine4", "chest", "upperchest", "chest2")
LEAP = 0.4  # entries of a rotation matrix that change by this from one frame to the next are no motion
UPRIGHT = 0.5  # a pose stands if head and feet are at least that part of a leg's length above and below the hips


@dataclass(frozen=True, eq=False)  # arrays have no truth value to compare by
class Humanoid:
    """A recording, read as a person.

    Attributes:
        recording: what was read.
        joints: part of the body -> joint: "hips", "chest", "waist", "head", "left_upper_arm", ...; optional parts may be missing.
        rest_rotations: [J, 3, 3] world rotations, along the file's axes, of the pose taken as rest.
        rest_positions: [J, 3] joints in that pose.
        rig_from_file: [3, 3] rotation from the file's axes to the rig's.
        leg_length: metres, hip to ankle, mean of both sides.
        rest_is_first_frame: the file's zero pose does not stand upright, so its first frame serves as rest.
        ignored: joints that no part of the rig follows.
    """

    recording: BvhRecording
    joints: dict[str, int]
    rest_rotations: Float64[np.ndarray, "J 3 3"]
    rest_positions: Float64[np.ndarray, "J 3"]
    rig_from_file: Float64[np.ndarray, "3 3"]
    leg_length: float
    rest_is_first_frame: bool
    ignored: tuple[str, ...]

    @classmethod
    def of(cls, recording: BvhRecording) -> "Humanoid":
        """Find the parts of the body and a rest pose that stands upright.

        Raises:
            ValueError: if a part is missing (names it and the nearest joints), or neither zero pose nor first frame stands upright.
        """
        joints = _parts(recording)
        zero = np.tile(np.eye(3), (1, len(recording.joint_names), 1, 1))
        for rotations, translations in (
            (zero, recording.offsets[None]),
            (recording.rotations[:1], recording.translations[:1]),
        ):
            world, positions = joint_transforms(recording.parents, rotations, translations)
            rig_from_file = _upright(positions[0], joints, snap=rotations is zero)
            if rig_from_file is None:
                continue
            lengths = [
                np.linalg.norm(recording.offsets[joints[f"{side}_{part}"]]) for side in ("left", "right") for part in ("shin", "foot")
            ]
            ignored = sorted(
                name for joint, name in enumerate(recording.joint_names) if joint not in joints.values() and not _is_tip(recording, joint)
            )
            return cls(
                recording=recording,
                joints=joints,
                rest_rotations=world[0],
                rest_positions=positions[0],
                rig_from_file=rig_from_file,
                leg_length=float(np.sum(lengths) / 2),
                rest_is_first_frame=rotations is not zero,
                ignored=tuple(ignored),
            )
        raise ValueError(
            f"Humanoid(): expected {recording.name} to stand upright with all rotations zero, or in its first frame; it does neither. "
            "Export it with a T-pose as rest or as first frame."
        )

    @property
    def start(self) -> float:
        """Seconds at which the motion begins: one frame late if the first is a T-pose put before it, from which the body leaps."""
        if len(self.recording.rotations) < 3:
            return 0.0
        leap, step = (
            np.abs(
                self.recording.rotations[index + 1, list(self.joints.values())]
                - self.recording.rotations[index, list(self.joints.values())]
            )
            for index in (0, 1)
        )
        return self.recording.frame_time if leap.max() > LEAP and step.max() < 0.5 * leap.max() else 0.0

    def bone(self, part: str) -> Float64[np.ndarray, "3"]:
        """Where a part's bone points at rest, rig axes, not normalised: to the next part; from the hand to the middle of its fingers."""
        side, _, bare = part.partition("_")
        following = f"{side}_{_NEXT[bare]}" if bare in _NEXT else None
        joint = self.joints[part]
        if following in self.joints:
            tips = [self.joints[following]]
        else:
            below = [other for other in range(len(self.recording.parents)) if self._is_below(other, joint)]
            tips = [other for other in below if "thumb" not in self.recording.joint_names[other].lower()]
        away = self.rest_positions[tips] - self.rest_positions[joint] if tips else np.zeros((1, 3))
        direction = away.mean(axis=0)
        if np.linalg.norm(direction) < 1e-4:  # nothing below it: on in line with the bone above
            direction = self.rest_positions[joint] - self.rest_positions[self.recording.parents[joint]]
        return self.rig_from_file @ direction

    def _is_below(self, joint: int, ancestor: int) -> bool:
        while joint >= 0 and joint != ancestor:
            joint = int(self.recording.parents[joint])
        return joint == ancestor


def _is_tip(recording: BvhRecording, joint: int) -> bool:
    return not (recording.parents == joint).any()


def _plain(name: str) -> str:
    """A name without namespace, case and separators; `lThigh` and `Thigh_L` become `leftthigh`."""
    bare = re.split(r"[:|]", name)[-1]
    bare = re.sub(r"^mixamorig\d*_?", "", bare)
    bare = re.sub(r"^([lr])(?=[A-Z])", lambda match: {"l": "left", "r": "right"}[match[1]], bare)
    bare = re.sub(r"^(.*)[_.]([LRlr])$", lambda match: {"l": "left", "r": "right"}[match[2].lower()] + match[1], bare)
    return re.sub(r"[^a-z0-9]", "", bare.lower())


def _parts(recording: BvhRecording) -> dict[str, int]:
    """Part of the body -> joint."""
    plain = [_plain(name) for name in recording.joint_names]
    wanted = dict(_MIDLINE)
    wanted |= {f"{side}_{part}": tuple(side + name for name in names) for side in ("left", "right") for part, names in _SIDED.items()}
    joints, missing = {}, []
    for part, names in wanted.items():
        found = next((name for name in names if name in plain), None)
        if found is not None:
            joints[part] = plain.index(found)
        elif part.split("_", 1)[-1] not in _OPTIONAL:
            missing.append((part, names))
    if missing:
        part, names = missing[0]
        near = [recording.joint_names[plain.index(name)] for name in difflib.get_close_matches(names[0], plain, n=3, cutoff=0.0)]
        raise ValueError(
            f"Humanoid(): expected joints for {', '.join(name for name, _ in missing)} in {recording.name}; got none of a known name. "
            f"{part} would be one of {', '.join(names)}; the file's nearest: {', '.join(near)}. "
            "Rename the joints as MotionBuilder or Mixamo do."
        )
    return joints | _spine(recording, joints)


def _spine(recording: BvhRecording, joints: dict[str, int]) -> dict[str, int]:
    """The chest, from which both arms and the neck go off, and the waist halfway down to the hips."""
    chains = []
    for part in ("left_upper_arm", "right_upper_arm", "head"):
        chain = [joints[part]]
        while chain[-1] >= 0:
            chain.append(int(recording.parents[chain[-1]]))
        chains.append(chain[1:-1])
    common = [joint for joint in chains[0] if joint in chains[1] and joint in chains[2]]
    between = [joint for joint in common if joint != joints["hips"]]
    if not between:
        raise ValueError(
            f"Humanoid(): expected a spine between hips and arms in {recording.name}; arms hang at {recording.joint_names[common[0]]}. "
            f"Give the skeleton a joint such as {', '.join(_SPINE[2:5])}."
        )
    return {"chest": between[0], "waist": between[len(between) // 2]}


def _upright(positions: Float64[np.ndarray, "J 3"], joints: dict[str, int], snap: bool) -> Float64[np.ndarray, "3 3"] | None:
    """Rotation to the rig's axes of someone who stands upright; None if the pose does not stand.

    Up is an axis of the file. Left is too where a zero pose is given (`snap`), whose hips may be modelled a little askew.
    """
    hips = 0.5 * (positions[joints["left_thigh"]] + positions[joints["right_thigh"]])
    feet = 0.5 * (positions[joints["left_foot"]] + positions[joints["right_foot"]])
    head, leg = positions[joints["head"]], np.linalg.norm(feet - hips)
    axis = int(np.abs(head - feet).argmax())
    up = np.eye(3)[axis] * np.sign((head - feet)[axis])
    if min((head - hips) @ up, (hips - feet) @ up) < UPRIGHT * leg:
        return None
    left = positions[joints["left_thigh"]] - positions[joints["right_thigh"]]
    left = left - up * (left @ up)
    if snap:
        left = np.eye(3)[np.abs(left).argmax()] * np.sign(left[np.abs(left).argmax()])
    if np.linalg.norm(left) < 1e-6:
        return None
    left = left / np.linalg.norm(left)
    return np.stack([left, -np.cross(left, up), up])  # rows: the rig's X, Y (backwards), Z in the file's axes
