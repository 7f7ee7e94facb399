"""Recorded motion from BVH files: the skeleton with its offsets, and how every joint turns and the root moves over time.

Any order of channels, several position channels, end sites and names with spaces or namespaces are read. BVH has no field for the unit of
length; it is taken from how tall the skeleton is, and what was taken is said in the result.

Symbols: N frames, J joints (end sites are joints too, named `<parent>_end`). Seconds; metres after `read_bvh`; axes as in the file.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float64, Int64
from scipy.spatial.transform import Rotation

LengthUnit = Literal["auto", "metres", "feet", "cmu", "inches", "centimetres", "millimetres"]
METRES_PER_UNIT = {
    "metres": 1.0,
    "feet": 0.3048,
    "cmu": 0.0254 / 0.45,  # the CMU database's own unit: its skeleton files give `length 0.45`, a scale in inches
    "inches": 0.0254,
    "centimetres": 0.01,
    "millimetres": 0.001,
}
HEIGHTS = (1.15, 2.25)  # metres, lowest to highest joint of a person: narrow enough that no two units fit the same number
_POSITION = {"xposition": 0, "yposition": 1, "zposition": 2}
_ROTATION = {"xrotation": "X", "yrotation": "Y", "zrotation": "Z"}


@dataclass(frozen=True, eq=False)  # arrays have no truth value to compare by
class BvhRecording:
    """A recording, along the file's axes.

    Attributes:
        name: the file's name without ending.
        joint_names: J names; end sites are called `<parent>_end`.
        parents: [J] parent before child, -1 for the root.
        offsets: [J, 3] metres from the parent, with all rotations zero.
        rotations: [N, J, 3, 3] from a joint's axes to its parent's.
        translations: [N, J, 3] metres from the parent: the offsets, unless the file has position channels.
        frame_time: seconds from one frame to the next.
        unit: of length in the file.
        unit_is_assumed: whether it was guessed from the skeleton's height.
    """

    name: str
    joint_names: tuple[str, ...]
    parents: Int64[np.ndarray, "J"]  # noqa: F821
    offsets: Float64[np.ndarray, "J 3"]
    rotations: Float64[np.ndarray, "N J 3 3"]
    translations: Float64[np.ndarray, "N J 3"]
    frame_time: float
    unit: str
    unit_is_assumed: bool

    @property
    def duration(self) -> float:
        """Seconds from the first frame to the last."""
        return (len(self.rotations) - 1) * self.frame_time


@dataclass
class _Hierarchy:
    """What the reader gathers of the skeleton."""

    names: list[str] = field(default_factory=list)
    parents: list[int] = field(default_factory=list)
    offsets: list[tuple[float, ...]] = field(default_factory=list)
    channels: list[tuple[str, ...]] = field(default_factory=list)


class _Words:
    """The words of a file one by one, with the line for messages."""

    def __init__(self, path: Path, text: str):
        self.path = path
        self.lines = text.splitlines()
        self.line = 0
        self._words = self._walk()
        self._next = next(self._words, (0, ""))

    def _walk(self) -> Iterator[tuple[int, str]]:
        for number, line in enumerate(self.lines, start=1):
            for word in line.replace("{", " { ").replace("}", " } ").split():
                yield number, word

    @property
    def coming(self) -> str:
        """The next word, without taking it; empty at the end."""
        return self._next[1]

    def take(self) -> str:
        """The next word."""
        self.line, word = self._next
        self._next = next(self._words, (self.line, ""))
        return word

    def expect(self, wanted: str) -> None:
        """Take a word that must be `wanted`, whatever its case."""
        word = self.take()
        if word.lower() != wanted.lower():
            raise self.error(f"{wanted!r}", word)

    def number(self, what: str) -> float:
        """Take a finite number."""
        word = self.take()
        try:
            value = float(word)
        except ValueError:
            raise self.error(what, word) from None
        if not math.isfinite(value):
            raise self.error(what, word)
        return value

    def error(self, expected: str, got: str) -> ValueError:
        """The error for a word that does not belong there."""
        shown = repr(got) if got else "the end of the file"
        return ValueError(f"read_bvh(): expected {expected} in line {self.line} of {self.path}; got {shown}. Export the file anew.")


def read_bvh(path: Path | str, unit: LengthUnit = "auto") -> BvhRecording:
    """Read a BVH file.

    Args:
        path: the file.
        unit: of its lengths; "auto" takes the one in which the skeleton is as tall as a person.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the file is malformed (names the line), holds no frame, or no unit, or not the one given, makes a person of it.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"read_bvh(): expected a BVH file at {path}; there is none. Check the path in motion.bvh.")
    try:
        words = _Words(path, path.read_text(encoding="utf-8-sig"))
    except UnicodeDecodeError as error:
        raise ValueError(f"read_bvh(): expected text in {path}; got other bytes ({error}). Give a BVH file.") from error
    words.expect("HIERARCHY")
    words.expect("ROOT")
    hierarchy = _Hierarchy()
    _read_joint(words, hierarchy, parent=-1)
    if words.coming.lower() == "root":
        words.take()
        raise words.error("one skeleton", "a second ROOT")
    values, frame_time = _read_motion(words, sum(map(len, hierarchy.channels)))
    rotations, translations = _transforms(hierarchy, values)
    offsets, parents = np.array(hierarchy.offsets, dtype=np.float64), np.array(hierarchy.parents, dtype=np.int64)
    every = slice(None, None, max(1, len(rotations) // 200))
    chosen = _unit(path, _stature(joint_transforms(parents, rotations[every], translations[every])[1]), unit)
    scale = METRES_PER_UNIT[chosen]
    return BvhRecording(
        name=path.stem,
        joint_names=tuple(hierarchy.names),
        parents=parents,
        offsets=offsets * scale,
        rotations=rotations,
        translations=translations * scale,
        frame_time=frame_time,
        unit=chosen,
        unit_is_assumed=unit == "auto",
    )


def joint_transforms(
    parents: Int64[np.ndarray, "J"],  # noqa: F821
    rotations: Float64[np.ndarray, "N J 3 3"],
    translations: Float64[np.ndarray, "N J 3"],
) -> tuple[Float64[np.ndarray, "N J 3 3"], Float64[np.ndarray, "N J 3"]]:
    """Rotations and positions of all joints along the file's axes, from those relative to the parent; parents come first."""
    world, positions = rotations.copy(), translations.copy()
    for joint, parent in enumerate(parents):
        if parent >= 0:
            world[:, joint] = world[:, parent] @ rotations[:, joint]
            positions[:, joint] = positions[:, parent] + (world[:, parent] @ translations[:, joint, :, None])[..., 0]
    return world, positions


def _read_joint(words: _Words, hierarchy: _Hierarchy, parent: int) -> None:
    """Name, offset, channels and children of a joint; the word ROOT or JOINT is taken already."""
    name = []
    while words.coming not in ("{", ""):
        name.append(words.take())
    joint = len(hierarchy.names)
    hierarchy.names.append(" ".join(name))
    if not hierarchy.names[-1] or hierarchy.names[-1] in hierarchy.names[:-1]:
        raise words.error("a new name of a joint", " ".join(name) or words.coming)
    hierarchy.parents.append(parent)
    words.expect("{")
    words.expect("OFFSET")
    hierarchy.offsets.append(tuple(words.number("three numbers of an offset") for _ in range(3)))
    hierarchy.channels.append(_read_channels(words) if words.coming.lower() == "channels" else ())
    while words.coming.lower() in ("joint", "end"):
        if words.take().lower() == "joint":
            _read_joint(words, hierarchy, joint)
        else:
            _read_end_site(words, hierarchy, joint)
    words.expect("}")


def _read_channels(words: _Words) -> tuple[str, ...]:
    """What a joint's numbers mean, in their order."""
    words.take()
    count = words.number("the number of channels")
    channels = []
    for _ in range(int(count)):
        channel = words.take()
        if channel.lower() not in _POSITION and channel.lower() not in _ROTATION or channel.lower() in channels:
            raise words.error("channels such as Xposition or Zrotation, each once a joint", channel)
        channels.append(channel.lower())
    return tuple(channels)


def _read_end_site(words: _Words, hierarchy: _Hierarchy, parent: int) -> None:
    """The tip of a chain; a joint may have several."""
    words.expect("Site")
    words.expect("{")
    words.expect("OFFSET")
    name = f"{hierarchy.names[parent]}_end"
    copies = sum(other.startswith(name) for other in hierarchy.names)
    hierarchy.names.append(f"{name}{copies + 1}" if copies else name)
    hierarchy.parents.append(parent)
    hierarchy.offsets.append(tuple(words.number("three numbers of an offset") for _ in range(3)))
    hierarchy.channels.append(())
    words.expect("}")


def _read_motion(words: _Words, num_channels: int) -> tuple[Float64[np.ndarray, "N C"], float]:
    """The table of numbers, and seconds per frame."""
    path = words.path
    words.expect("MOTION")
    words.expect("Frames:")
    count = words.number("the number of frames")
    words.expect("Frame")
    words.expect("Time:")
    frame_time = words.number("seconds per frame")
    if count < 1 or count != int(count):
        raise ValueError(f"read_bvh(): expected at least one frame in {path}; got Frames: {count:g}. Export the file with its motion.")
    if frame_time <= 0:
        raise ValueError(f"read_bvh(): expected a frame time above 0 s in {path}; got {frame_time:g}. Write 1 / frames per second.")
    if num_channels == 0:
        raise ValueError(f"read_bvh(): expected joints with channels in {path}; got none. Export the file with its motion.")
    text = " ".join(words.lines[words.line :])
    try:
        values = np.array(text.split(), dtype=np.float64)
    except ValueError as error:
        raise ValueError(f"read_bvh(): expected numbers after the frame time in {path}; {error}. Export the file anew.") from error
    if values.size != int(count) * num_channels or not np.isfinite(values).all():
        raise ValueError(
            f"read_bvh(): expected {int(count)} frames x {num_channels} channels = {int(count) * num_channels} finite numbers in {path}; "
            f"got {values.size}, {int((~np.isfinite(values)).sum())} of them not finite. The file is cut off or was edited: export it anew."
        )
    return values.reshape(int(count), num_channels), frame_time


def _transforms(
    hierarchy: _Hierarchy, values: Float64[np.ndarray, "N C"]
) -> tuple[Float64[np.ndarray, "N J 3 3"], Float64[np.ndarray, "N J 3"]]:
    """Local rotations and translations from the table; a joint's rotations act in the order of its channels, each about turned axes."""
    count, joints = len(values), len(hierarchy.names)
    rotations = np.tile(np.eye(3), (count, joints, 1, 1))
    translations = np.tile(np.array(hierarchy.offsets, dtype=np.float64), (count, 1, 1))
    column = 0
    for joint, channels in enumerate(hierarchy.channels):
        block = values[:, column : column + len(channels)]
        column += len(channels)
        for place, channel in enumerate(channels):
            if channel in _POSITION:
                translations[:, joint, _POSITION[channel]] = block[:, place]
        places = [place for place, channel in enumerate(channels) if channel in _ROTATION]
        if places:
            order = "".join(_ROTATION[channels[place]] for place in places)
            rotations[:, joint] = Rotation.from_euler(order, block[:, places], degrees=True).as_matrix()
    return rotations, translations


def _stature(positions: Float64[np.ndarray, "N J 3"]) -> float:
    """How long the person is: the extent along the longest axis, in the middle frame of all by that.

    Head to toe when standing or lying, about as much from hand to hand with arms out, somewhat less when sitting.
    """
    return float(np.median(np.ptp(positions, axis=1).max(axis=-1)))


def _unit(path: Path, stature: float, unit: LengthUnit) -> str:
    """The unit of length, checked against or guessed from the stature in that unit."""
    fitting = [name for name, metres in METRES_PER_UNIT.items() if HEIGHTS[0] <= stature * metres <= HEIGHTS[1]]
    if unit == "auto":
        if not fitting:
            raise ValueError(
                f"read_bvh(): expected a skeleton of {HEIGHTS[0]} to {HEIGHTS[1]} m in some unit; got {stature:.4g} units in {path}. "
                f"Set motion.bvh_unit to one of {', '.join(METRES_PER_UNIT)}."
            )
        return fitting[0]
    # Small children and giants are allowed to who says so, unless another unit makes a person of usual size.
    smallest, largest = HEIGHTS if fitting else (0.4, 3.5)
    if not smallest <= stature * METRES_PER_UNIT[unit] <= largest:
        raise ValueError(
            f"read_bvh(): expected a person in {path}; got one of {stature * METRES_PER_UNIT[unit]:.4g} m if its unit is {unit}. "
            f"Set motion.bvh_unit to {fitting[0] if fitting else 'auto'}."
        )
    return unit
