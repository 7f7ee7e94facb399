"""What the person does: joint angles, place in the room and facial actions of every frame, with training and test takes that differ.

The takes come from a script (`filming.takes`), their curves from `filming.choreography`, or all of it from recordings: BVH for the body,
Live Link Face for the face. Test takes of the study are brought to a set distance at most from the nearest training pose.

Symbols: N frames, D pose angles, A facial actions. Radians, metres, seconds; angles are offsets from the rig's rest pose.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64
from scipy.spatial import cKDTree

from mitsuba_avatar.body.rig import Rig
from mitsuba_avatar.body.skeleton import Skeleton
from mitsuba_avatar.captures.frames import Frame
from mitsuba_avatar.filming import choreography
from mitsuba_avatar.filming.choreography import waves
from mitsuba_avatar.filming.face import conversation_face, expression_tour, gaze_of_actions, resting_face
from mitsuba_avatar.filming.settings import StudioSettings
from mitsuba_avatar.filming.takes import DEFAULT, STUDY, PlannedTake, Take, frames_of, plan_recordings, plan_takes
from mitsuba_avatar.recordings.bvh import read_bvh
from mitsuba_avatar.recordings.humanoid import Humanoid
from mitsuba_avatar.recordings.live_link import read_live_link
from mitsuba_avatar.recordings.retargeting import retarget

FOOT_LIFT = 0.05  # metres that a foot must leave the floor before it clearly no longer carries the person
DISTANCE = np.radians(45.0)  # most that the study's test poses are from the nearest training pose, median of a take; see `pose_distances`
MOST_TRAINING, MOST_TEST = 10_000, 500  # poses that this distance is measured between; more change it by less than a degree
AT_ONCE = 1024  # frames
STILL = ("range", "slow", "held")  # styles in which the person hardly turns
_FACES = {"resting": resting_face, "conversation": conversation_face, "expressions": expression_tour}


@dataclass(frozen=True)
class Motion:
    """Everything that drives the person, frame by frame.

    Attributes:
        frames: N moments with split and segment.
        theta: [N, D] radians.
        root: [N, 4, 4] rigid world_from_root.
        actions: [N, A] strengths of the facial actions, 0..1.
        clearance: [N] metres of air between the floor and the lowest point of the body; zero unless a recording jumps.
        notes: what was assumed and measured on the way, for the user.
    """

    frames: tuple[Frame, ...]
    theta: Float32[np.ndarray, "N D"]
    root: Float32[np.ndarray, "N 4 4"]
    actions: Float32[np.ndarray, "N A"]
    clearance: Float32[np.ndarray, "N"]  # noqa: F821
    notes: tuple[str, ...] = ()

    def segments(self) -> list[slice]:
        """Runs of frames that follow each other in time."""
        names = [frame.segment for frame in self.frames]
        starts = [index for index, name in enumerate(names) if index == 0 or names[index - 1] != name]
        return [slice(start, end) for start, end in zip(starts, [*starts[1:], len(names)], strict=True)]


def perform(rig: Rig, settings: StudioSettings, action_names: Sequence[str]) -> Motion:
    """Plan every frame of a capture. The same settings give the same motion.

    Args:
        rig: names and limits of the pose angles.
        settings: script, numbers of frames, fps, recordings and seed.
        action_names: A facial actions, ARKit's names.

    Raises:
        FileNotFoundError: if a recording does not exist.
        ValueError: if a recording cannot be used, or is too short for the frames asked for.
    """
    if settings.motion.script == "mocap":
        motion = _play(rig, settings, action_names)
    else:
        motion = _act(rig, settings, action_names, {"default": DEFAULT, "study": STUDY}[settings.motion.script])
    if settings.motion.face_recording:
        recording = read_live_link(settings.motion.face_recording, action_names)
        actions = recording.at(np.arange(len(motion.frames)) / settings.motion.fps)
        theta = _with_gaze(rig, motion.theta, gaze_of_actions(actions, action_names))
        motion = replace(motion, actions=actions.astype(np.float32), theta=np.clip(theta, rig.dofs.lower, rig.dofs.upper))
    return motion


def body_angles(rig: Rig) -> Bool[np.ndarray, "D"]:  # noqa: F821
    """Which pose angles are the body's: all but fingers and eyes."""
    fine = (*choreography.FINGERS, "eye")
    return np.array([not name.removeprefix("left_").removeprefix("right_").startswith(fine) for name in rig.dofs.names])


def pose_distances(rig: Rig, motion: Motion) -> Float64[np.ndarray, "N"]:  # noqa: F821
    """[N] radians from each frame to the nearest training pose: Euclidean over the body's angles. Zero for training frames."""
    body = motion.theta[:, body_angles(rig)].astype(np.float64)
    train = np.array([frame.split == "train" for frame in motion.frames])
    return cKDTree(body[train]).query(body)[0]


def plant_feet(rig: Rig, theta: Float32[np.ndarray, "N D"], root: Float32[np.ndarray, "N 4 4"]) -> Float32[np.ndarray, "N 4 4"]:
    """Shift the root in the plane so that the standing foot does not slide over the floor, apart from the drift of `root` itself.

    Which foot stands is weighed smoothly by height. Heights are left alone: the surface, not the skeleton, stands on the floor.
    """
    ankles = [rig.joint_names.index(f"foot.{side}") for side in "LR"]
    skeleton, joints = Skeleton(rig), np.empty((len(theta), 2, 3), np.float32)
    with torch.no_grad():
        for part in parts_of(len(theta)):
            transforms = skeleton(torch.from_numpy(theta[part]), torch.from_numpy(root[part]))
            joints[part] = skeleton.posed_joints(transforms)[:, ankles].numpy()
    clearance = joints[..., 2] - rig.joint_positions[ankles, 2]  # [N, 2] metres above standing height
    standing = np.exp(-(clearance - clearance.min(axis=1, keepdims=True)) / FOOT_LIFT)
    standing /= standing.sum(axis=1, keepdims=True)
    planted = np.einsum("nij,fj->nfi", root[:, :3, :3], rig.joint_positions[ankles]) + root[:, None, :3, 3]
    slip = ((joints - planted) * standing[..., None]).sum(axis=1)  # [N, 3]
    shifted = root.copy()
    shifted[:, :2, 3] -= slip[:, :2]
    return shifted


def parts_of(count: int) -> list[slice]:
    """Runs of frames, one after the other, whose joints' transforms fit into memory together."""
    return [slice(first, min(first + AT_ONCE, count)) for first in range(0, count, AT_ONCE)]


def _act(rig: Rig, settings: StudioSettings, action_names: Sequence[str], takes: tuple[Take, ...]) -> Motion:
    """Perform the takes of a script."""
    planned = plan_takes(takes, settings.motion)
    theta, root, actions, shown = [], [], [], {}
    for order, plan in enumerate(planned):
        rng = np.random.default_rng([settings.seed, order])
        time = np.arange(plan.count) / settings.motion.fps
        angles = _angles(rig, plan.take, time, settings.seed, shown, rng)
        if plan.take.style == "slow":
            shown = choreography.showing(plan.take, plan.count / settings.motion.fps, shown)
        if plan.take.style in ("recomposed", "gestures"):
            angles = _at_distance(rig, angles, _training_poses(planned[:order], theta))
        gaze, face = _face(plan.take, time, action_names, rng)
        theta.append(_with_gaze(rig, angles, gaze))
        root.append(_wander(time, rng, turn=0.12 if plan.take.style in STILL else 0.45))
        actions.append(face)
    limits = rig.dofs.lower, rig.dofs.upper
    all_theta = np.clip(np.concatenate(theta), *limits).astype(np.float32)
    planted = plant_feet(rig, all_theta, np.concatenate(root).astype(np.float32))
    frames = frames_of(planned, settings.motion.fps)
    clearance = np.zeros(len(frames), dtype=np.float32)
    return Motion(frames, all_theta, planted, np.concatenate(actions).astype(np.float32), clearance)


def _play(rig: Rig, settings: StudioSettings, action_names: Sequence[str]) -> Motion:
    """Perform recordings: the body as recorded, fingers and face as in conversation."""
    fps = settings.motion.fps
    people = [Humanoid.of(read_bvh(path, settings.motion.bvh_unit)) for path in settings.motion.bvh]
    lengths = [(person.recording.name, int((person.recording.duration - person.start) * fps + 1e-6) + 1) for person in people]
    planned = plan_recordings(lengths, settings.motion)
    parts, notes = [], []
    for order, (file, first, plan) in enumerate(planned):
        rng = np.random.default_rng([settings.seed, order])
        time = np.arange(plan.count) / fps
        moved = retarget(rig, people[file], people[file].start + first / fps + time)
        gaze, face = _face(plan.take, time, action_names, rng)
        theta = _with_gaze(rig, choreography.move_fingers(rig, moved.theta, time, rng), gaze)
        parts.append((np.clip(theta, rig.dofs.lower, rig.dofs.upper), moved.root, face, moved.clearance))
        notes += [*moved.notes, f"{plan.take.name}: {moved.summary()}"]
    stress = _act(rig, settings, action_names, ()) if settings.motion.stress_frames else None
    if stress is not None:
        parts.append((stress.theta, stress.root, stress.actions, stress.clearance))
    theta, root, actions, clearance = (np.concatenate(part).astype(np.float32) for part in zip(*parts, strict=True))
    frames = frames_of([plan for _, _, plan in planned] + (plan_takes((), settings.motion) if stress else []), fps)
    return Motion(frames, theta, root, actions, clearance, tuple(dict.fromkeys(notes)))


def _angles(
    rig: Rig, take: Take, time: np.ndarray, seed: int, shown: Mapping[str, float], rng: np.random.Generator
) -> Float[np.ndarray, "N D"]:
    """The curves of a take after slow ones that have `shown` some seconds of each limb's course."""
    if take.style == "slow":
        return choreography.slow_limbs(rig, take, time, seed, shown, rng)
    if take.style == "held":
        return choreography.held_poses(rig, take, time, seed, rng)
    if take.style == "recomposed":
        return choreography.recomposed_limbs(rig, take, time, seed, shown, rng)
    styles = {
        "range": choreography.range_of_motion,
        "conversation": choreography.conversation,
        "gestures": choreography.conversation,
        "recombined": choreography.recombined,
        "wild": choreography.wild,
    }
    return styles[take.style](rig, take, time, rng)


def _training_poses(planned: Sequence[PlannedTake], theta: Sequence[np.ndarray]) -> Float[np.ndarray, "T D"]:
    """Poses of the training frames of the takes so far."""
    return np.concatenate([angles[[split == "train" for split in plan.splits()]] for plan, angles in zip(planned, theta, strict=True)])


def _at_distance(rig: Rig, theta: Float[np.ndarray, "N D"], train: Float[np.ndarray, "T D"]) -> Float[np.ndarray, "N D"]:
    """The poses, drawn towards the stance until no more than half of them are `DISTANCE` or more from every training pose.

    Never made larger: reaching arms would enter the trunk.
    """
    body, stance = body_angles(rig), choreography.stance(rig)
    tree = cKDTree(_spread(train, MOST_TRAINING)[:, body])
    judged = _spread(theta, MOST_TEST)

    def scaled(theta: Float[np.ndarray, "N D"], scale: float) -> Float[np.ndarray, "N D"]:
        return np.where(body, stance + scale * (theta - stance), theta)

    smallest, largest = 0.1, 1.0
    for _ in range(20):
        middle = 0.5 * (smallest + largest)
        if np.median(tree.query(scaled(judged, middle)[:, body])[0]) < DISTANCE:
            smallest = middle
        else:
            largest = middle
    return scaled(theta, largest)


def _spread(poses: Float[np.ndarray, "N D"], most: int) -> Float[np.ndarray, "n D"]:
    """Every k-th of some poses: at most `most`."""
    return poses[:: max(1, -(-len(poses) // most))]


def _wander(time: np.ndarray, rng: np.random.Generator, turn: float) -> Float[np.ndarray, "N 4 4"]:
    """Swaying by centimetres and turning by about `turn` radians on the spot."""
    root = np.tile(np.eye(4), (len(time), 1, 1))
    angle = turn * waves(time, 5.0, rng)
    root[:, 0, 0], root[:, 0, 1] = np.cos(angle), -np.sin(angle)
    root[:, 1, 0], root[:, 1, 1] = np.sin(angle), np.cos(angle)
    root[:, 0, 3], root[:, 1, 3] = 0.03 * waves(time, 4.0, rng), 0.03 * waves(time, 4.5, rng)
    return root


def _face(
    take: Take, time: np.ndarray, names: Sequence[str], rng: np.random.Generator
) -> tuple[Float[np.ndarray, "N 2 2"], Float[np.ndarray, "N A"]]:
    """Gaze of both eyes (elevation, turn to the person's left) and facial actions of a take."""
    gaze = np.stack([0.16 * waves(time, 1.4, rng), 0.26 * waves(time, 1.7, rng)], axis=1)
    return np.stack([gaze, gaze], axis=1), _FACES[take.face](time, names, rng)


def _with_gaze(rig: Rig, theta: Float[np.ndarray, "N D"], gaze: Float[np.ndarray, "N 2 2"]) -> Float[np.ndarray, "N D"]:
    """Turn both eyes, left and right; abduction is outwards, so the right eye's has the other sign."""
    theta = theta.copy()
    for eye, (side, sign) in enumerate((("left", 1.0), ("right", -1.0))):
        theta[:, rig.dofs.names.index(f"{side}_eye_elevation")] = gaze[:, eye, 0]
        theta[:, rig.dofs.names.index(f"{side}_eye_abduction")] = sign * gaze[:, eye, 1]
    return theta
