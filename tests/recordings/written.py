"""A recorded person for tests, written as BVH in any of the ways in which programs write it: the same movement each time.

Symbols: N frames, J joints. Metres, rig axes (facing -Y, left +X, up +Z) until written.
"""

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

_LEFT = {  # part: (parent, position in a T-pose)
    "Shoulder": ("Spine1", (0.03, 0.0, 1.40)),
    "Arm": ("Shoulder", (0.19, 0.0, 1.42)),
    "ForeArm": ("Arm", (0.47, 0.0, 1.42)),
    "Hand": ("ForeArm", (0.71, 0.0, 1.42)),
    "HandMiddle1": ("Hand", (0.80, 0.0, 1.42)),
    "UpLeg": ("Hips", (0.09, 0.0, 0.92)),
    "Leg": ("UpLeg", (0.09, -0.01, 0.50)),
    "Foot": ("Leg", (0.09, 0.02, 0.08)),
    "ToeBase": ("Foot", (0.09, -0.11, 0.02)),
}
_MIDDLE = {
    "Hips": ("", (0.0, 0.0, 0.98)),
    "Spine": ("Hips", (0.0, 0.0, 1.10)),
    "Spine1": ("Spine", (0.0, 0.0, 1.25)),
    "Neck": ("Spine1", (0.0, 0.0, 1.46)),
    "Head": ("Neck", (0.0, -0.02, 1.55)),
}
TABLE = {
    **_MIDDLE,
    **{f"{side}{name}": (parent if parent in _MIDDLE else f"{side}{parent}", (sign * place[0], *place[1:]))
       for side, sign in (("Left", 1), ("Right", -1)) for name, (parent, place) in _LEFT.items()},
}  # fmt: skip
NAMES = tuple(TABLE)
PARENTS = [NAMES.index(parent) if parent else -1 for parent, _ in TABLE.values()]
Y_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # file axes from rig axes, person facing +Z
Z_UP_FACING_X = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])


@dataclass(frozen=True)
class Encoding:
    """How a file is written.

    Attributes:
        unit: metres per unit.
        axes: [3, 3] file axes from rig axes.
        order: of the rotation channels.
        arms_down: radians by which the arms of the zero pose hang lower than in a T-pose.
        legs_up: the legs of the zero pose point up.
        prefix: of names.
    """

    unit: float = 0.01
    axes: np.ndarray = field(default_factory=lambda: Y_UP)
    order: str = "ZXY"
    arms_down: float = 0.0
    legs_up: bool = False
    prefix: str = ""
    frame_time: float = 1 / 30


def movement(count: int = 31, speed: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """World rotations [N, J, 3, 3] since the T-pose and hip positions [N, 3] of someone who waves, bends and sways; feet stay put."""
    time = np.arange(count) / 30 * speed
    turns = np.tile(np.eye(3), (count, len(NAMES), 1, 1))

    def turn(name: str, axis: tuple[float, float, float], angles: np.ndarray) -> None:
        world = Rotation.from_rotvec(angles[:, None] * np.array(axis)).as_matrix()
        for joint in _below(NAMES.index(name)):
            turns[:, joint] = world @ turns[:, joint]

    turn("LeftForeArm", (0, 0, -1), 0.7 + 0.4 * np.sin(3 * time))
    turn("RightForeArm", (0, 0, 1), 0.5 + 0.3 * np.sin(2 * time))
    turn("LeftArm", (0, 1, 0), 0.5 + 0.4 * np.sin(2 * time))
    turn("RightArm", (0, -1, 0), 0.7 + 0.2 * np.sin(2.5 * time))
    turn("RightArm", (0, 0, 1), 0.4 + 0.2 * np.sin(2 * time))
    turn("Spine", (0, 0, 1), 0.2 * np.sin(2 * time))
    turn("Head", (1, 0, 0), 0.2 * np.sin(3 * time))
    bend = 0.3 - 0.2 * np.cos(2 * time)
    for side in ("Left", "Right"):  # hip, knee and ankle: the foot stays flat under the hip
        turn(f"{side}UpLeg", (1, 0, 0), -bend)
        turn(f"{side}Leg", (1, 0, 0), 2 * bend)
        turn(f"{side}Foot", (1, 0, 0), -bend)
    hips = np.tile(np.array(TABLE["Hips"][1]), (count, 1))
    ankle = positions(turns, hips)[:, NAMES.index("LeftFoot")]
    return turns, hips + ankle[0] - ankle


def positions(turns: np.ndarray, hips: np.ndarray) -> np.ndarray:
    """[N, J, 3] joints."""
    places = np.empty((*turns.shape[:2], 3))
    for joint, parent in enumerate(PARENTS):
        places[:, joint] = hips if parent < 0 else places[:, parent] + turns[:, parent] @ _offset(joint)
    return places


def bvh_text(turns: np.ndarray, hips: np.ndarray, encoding: Encoding = Encoding()) -> str:  # noqa: B008 - frozen
    """The movement as the text of a BVH file."""
    rest = np.tile(np.eye(3), (len(NAMES), 1, 1))  # of the file's zero pose, since the T-pose
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        lowered = Rotation.from_rotvec([0, sign * encoding.arms_down, 0]).as_matrix()
        for joint in _below(NAMES.index(f"{side}Arm")):
            rest[joint] = lowered
        for joint in _below(NAMES.index(f"{side}UpLeg")) if encoding.legs_up else []:
            rest[joint] = np.diag([1.0, -1.0, -1.0])
    world = encoding.axes @ turns @ rest.transpose(0, 2, 1) @ encoding.axes.T
    lines: list[str] = ["HIERARCHY"]

    def write(joint: int, depth: int) -> None:
        tab = "\t" * depth
        parent = PARENTS[joint]
        offset = np.zeros(3) if parent < 0 else encoding.axes @ rest[parent] @ _offset(joint) / encoding.unit
        rotations = " ".join(f"{axis}rotation" for axis in encoding.order)
        channels = f"6 Xposition Yposition Zposition {rotations}" if parent < 0 else f"3 {rotations}"
        lines.append(f"{tab}{'ROOT' if parent < 0 else 'JOINT'} {encoding.prefix}{NAMES[joint]}")
        lines.extend([f"{tab}{{", f"{tab}\tOFFSET {' '.join(f'{x:.6f}' for x in offset)}", f"{tab}\tCHANNELS {channels}"])
        children = [other for other, above in enumerate(PARENTS) if above == joint]
        for child in children:
            write(child, depth + 1)
        if not children:
            tip = encoding.axes @ rest[joint] @ np.array([0.0, 0.0, 0.1 if NAMES[joint] == "Head" else 0.0]) / encoding.unit
            lines.extend([f"{tab}\tEnd Site", f"{tab}\t{{", f"{tab}\t\tOFFSET {' '.join(f'{x:.6f}' for x in tip)}", f"{tab}\t}}"])
        lines.append(f"{tab}}}")

    write(0, 0)
    lines += ["MOTION", f"Frames: {len(turns)}", f"Frame Time: {encoding.frame_time:.7f}"]
    order = _written_order()
    for frame in range(len(turns)):
        values = list(encoding.axes @ hips[frame] / encoding.unit)
        for joint in order:
            parent = PARENTS[joint]
            local = world[frame, joint] if parent < 0 else world[frame, parent].T @ world[frame, joint]
            values += list(Rotation.from_matrix(local).as_euler(encoding.order, degrees=True))
        lines.append(" ".join(f"{value:.6f}" for value in values))
    return "\n".join(lines) + "\n"


def _offset(joint: int) -> np.ndarray:
    parent = PARENTS[joint]
    return np.array(TABLE[NAMES[joint]][1]) - np.array(TABLE[NAMES[parent]][1])


def _below(joint: int) -> list[int]:
    found = [joint]
    for other in range(len(NAMES)):
        if PARENTS[other] in found:
            found.append(other)
    return found


def _written_order() -> list[int]:
    """Joints as a depth-first walk meets them."""
    order: list[int] = []

    def visit(joint: int) -> None:
        order.append(joint)
        for other, above in enumerate(PARENTS):
            if above == joint:
                visit(other)

    visit(0)
    return order
