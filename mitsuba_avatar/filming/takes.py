"""Scripts: which takes a person performs, how many frames each has, and which of them are for training, validation and testing.

`default` is short and moves everything. `study` is made for finding out what the pose does not tell: each limb moves slowly on its own
and some in pairs, arms reach in front of the trunk and shade it, a conversation moves all of the upper body a little (the paper, section
4.1, trains on both), face and fingers move while the body holds still (so that training frames link expressions and poses that have nothing
to do with each other), blocks of training takes are held out for validation, and test takes put limb movements together that training
never showed at once.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from mitsuba_avatar.captures.frames import Frame
from mitsuba_avatar.filming.settings import MotionSettings

Style = Literal["range", "conversation", "recombined", "slow", "held", "recomposed", "gestures", "wild"]
Face = Literal["resting", "conversation", "expressions"]
FIRST_BLOCK, LAST_BLOCK = 0.35, 0.9  # part of a take within which its validation block lies


@dataclass(frozen=True)
class Take:
    """A segment to be: which groups of angles move, and how.

    Attributes:
        groups: of pose angles that move; range of motion visits them one after the other, other takes move all of them at once.
        style: "range" (one group at a time), "conversation" or "recombined" (all at once, wide), "slow" (one limb or a few, slowly), "held"
            (the body holds poses, fingers move), "recomposed" (limbs as in the slow takes, at once, at most a set distance from training),
            "gestures" (conversation at that distance), "wild" (fast and wide).
        share: of the split's frames.
        face: what the face does.
        extent: share of its slow course that each limb of a recomposed take goes; hands that reach would enter a trunk bent all the way.
    """

    name: str
    split: Literal["train", "test"]
    style: Style
    groups: tuple[str, ...]
    share: float
    face: Face = "resting"
    extent: float = 1.0


DEFAULT = (
    Take("range_of_motion_trunk_and_head", "train", "range", ("trunk", "neck", "legs"), 0.3),
    Take("range_of_motion_arms", "train", "range", ("left_arm", "right_arm", "both_arms", "hands"), 0.42, "expressions"),
    Take("conversation", "train", "conversation", ("arms", "trunk", "neck", "hands"), 0.28, "conversation"),
    Take("test_recombined", "test", "recombined", ("left_arm", "right_arm", "trunk", "neck", "legs"), 0.6),
    Take("test_conversation", "test", "conversation", ("arms", "trunk", "neck", "hands"), 0.4, "conversation"),
)
STUDY = (
    Take("slow_trunk", "train", "slow", ("trunk",), 0.04),
    Take("slow_head", "train", "slow", ("neck",), 0.04),
    Take("slow_left_arm", "train", "slow", ("left_arm",), 0.04),
    Take("slow_right_arm", "train", "slow", ("right_arm",), 0.04),
    Take("slow_left_reach", "train", "slow", ("left_reach",), 0.05),
    Take("slow_right_reach", "train", "slow", ("right_reach",), 0.05),
    Take("slow_left_leg", "train", "slow", ("left_leg",), 0.03),
    Take("slow_right_leg", "train", "slow", ("right_leg",), 0.03),
    Take("slow_knee_bends", "train", "slow", ("knee_bends",), 0.03),
    Take("slow_head_and_hands", "train", "slow", ("neck", "hands"), 0.03),
    Take("slow_reaches", "train", "slow", ("left_reach", "right_reach"), 0.09),
    Take("slow_trunk_and_arms", "train", "slow", ("trunk", "left_arm", "right_arm"), 0.12),
    Take("slow_trunk_and_head", "train", "slow", ("trunk", "neck"), 0.04),
    Take("slow_knee_bends_and_arms", "train", "slow", ("knee_bends", "left_arm", "right_arm"), 0.08),
    Take("slow_right_reach_and_left_arm", "train", "slow", ("right_reach", "left_arm"), 0.06),
    Take("conversation", "train", "conversation", ("arms", "trunk", "neck", "hands"), 0.15, "conversation"),
    Take("held_expressions", "train", "held", ("trunk", "left_arm", "right_reach"), 0.04, "expressions"),
    Take("held_speech", "train", "held", ("trunk", "left_reach", "right_arm"), 0.04, "conversation"),
    Take("test_arms", "test", "recomposed", ("left_arm", "right_arm"), 0.15, "expressions"),
    Take("test_reaches", "test", "recomposed", ("left_reach", "right_reach", "neck"), 0.25, "conversation"),
    Take("test_reaches_and_trunk", "test", "recomposed", ("left_reach", "right_reach", "trunk", "neck"), 0.25, "expressions", 0.93),
    Take("test_whole_body", "test", "recomposed", ("left_arm", "right_reach", "neck", "knee_bends"), 0.15, "expressions"),
    Take("test_conversation", "test", "gestures", ("arms", "trunk", "neck", "hands"), 0.20, "conversation"),
)
STRESS = Take("stress_wild", "test", "wild", ("left_arm", "right_arm", "trunk", "neck", "legs"), 1.0, "expressions")


@dataclass(frozen=True)
class PlannedTake:
    """A take and its frames: `count` in all, those in `validation` held out."""

    take: Take
    count: int
    validation: range = range(0)

    def splits(self) -> list[str]:
        """Split of each frame."""
        return ["validation" if index in self.validation else self.take.split for index in range(self.count)]


def plan_takes(takes: tuple[Take, ...], settings: MotionSettings) -> list[PlannedTake]:
    """Number of frames of each take: shares of the split's frames, rounded so that they add up; takes of no frame are left out."""
    held_out = _divide([take for take in takes if take.split == "train"], settings.validation_frames)
    planned = []
    for split, total in (("train", settings.train_frames), ("test", settings.test_frames)):
        chosen = [take for take in takes if take.split == split]
        for place, (take, count) in enumerate(zip(chosen, _divide(chosen, total), strict=True)):
            block = held_out[place] if split == "train" else 0
            planned.append(PlannedTake(take, count + block, _block(count, block, place)))
    if settings.stress_frames:
        planned.append(PlannedTake(STRESS, settings.stress_frames))
    return [take for take in planned if take.count]


def plan_recordings(lengths: list[tuple[str, int]], settings: MotionSettings) -> list[tuple[int, int, PlannedTake]]:
    """What is played of recordings: their beginning for training and validation, their end for testing.

    Args:
        lengths: name and number of frames, at the capture's rate, of each recording.
        settings: how many frames are asked for.

    Returns:
        (recording, its first frame to play, take).

    Raises:
        ValueError: if the recordings are too short.
    """
    train, test = settings.train_frames + settings.validation_frames, settings.test_frames
    ends = np.cumsum([count for _, count in lengths])
    if train + test > ends[-1]:
        raise ValueError(
            f"plan_recordings(): expected {train + test} frames at {settings.fps:g} fps in motion.bvh; got {ends[-1]} "
            f"({', '.join(f'{name} {count}' for name, count in lengths)}). Ask for fewer frames or name more recordings."
        )
    runs = []  # recording, first frame, number of frames, split
    for split, first, last in (("train", 0, train), ("test", ends[-1] - test, ends[-1])):
        for file, (_, count) in enumerate(lengths):
            start, end = max(first, ends[file] - count), min(last, ends[file])
            if end > start:
                runs.append((file, int(start - ends[file] + count), int(end - start), split))
    takes = [
        Take(f"test_{lengths[file][0]}" if split == "test" else lengths[file][0], split, "conversation", (), float(count), "conversation")
        for file, _, count, split in runs
    ]
    blocks = _divide([take for take in takes if take.split == "train"], settings.validation_frames)
    planned = []
    for place, (take, (file, first, count, split)) in enumerate(zip(takes, runs, strict=True)):
        block = blocks[place] if split == "train" else 0
        planned.append((file, first, PlannedTake(take, count, _block(count - block, block, place))))
    return planned


def frames_of(planned: list[PlannedTake], fps: float) -> tuple[Frame, ...]:
    """Every frame of a plan, numbered from 0."""
    rows = [(split, take.take.name) for take in planned for split in take.splits()]
    return tuple(Frame(index, index / fps, split, segment) for index, (split, segment) in enumerate(rows))


def _divide(takes: list[Take], total: int) -> list[int]:
    """Frames of each take by its share, adding up to `total`."""
    if not takes:
        return []
    ends = np.rint(np.cumsum([take.share for take in takes]) / sum(take.share for take in takes) * total).astype(int)
    return [int(count) for count in np.diff(ends, prepend=0)]


def _block(count: int, block: int, place: int) -> range:
    """The validation block of a take with `count` other frames: at another phase of the take than in its neighbours."""
    share = (0.382 + 0.618034 * place) % 1.0  # steps of the golden ratio spread evenly
    start = round((FIRST_BLOCK + (LAST_BLOCK - FIRST_BLOCK) * share) * count)
    return range(start, start + block)
