"""Where the Anny rig has the landmarks that detectors find: a place at rest, and the joint that carries it.

Places are means of joints or vertices of the rig, so they follow every change of shape. Vertices are chosen by position on a rig
(the tip of the nose is the foremost vertex of the head), not by number.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int64

from mitsuba_avatar.body.rig import Rig
from mitsuba_avatar.registration.keypoints_2d import LANDMARKS

TOES = {"big_toe": "toe1", "small_toe": "toe5"}
MIDLINE = 4e-3  # metres from the plane of symmetry that still count as the middle


@dataclass(frozen=True, eq=False)
class RigLandmarks:
    """Landmarks of a rig in the order of `LANDMARKS`.

    Attributes:
        carriers: [K] joint that moves each.
        from_joints: [K, J] weights of joint positions in each place, rows sum to 1 or 0.
        from_vertices: per landmark, the vertices whose mean it is (empty where joints make it).
    """

    carriers: Int64[np.ndarray, "K"]
    from_joints: Float[np.ndarray, "K J"]
    from_vertices: tuple[tuple[int, ...], ...]


def rig_landmarks(rig: Rig) -> RigLandmarks:
    """Find the landmarks of an Anny rig.

    Raises:
        ValueError: if the rig lacks a joint that carries one.
    """
    finder = _Finder(rig)
    found = [finder.find(name) for name in LANDMARKS]
    from_joints = np.zeros((len(found), len(rig.joint_names)))
    for row, (_, joints, _) in enumerate(found):
        for joint in joints:
            from_joints[row, finder.joint(joint)] = 1 / len(joints)
    return RigLandmarks(
        carriers=np.array([finder.joint(carrier) for carrier, _, _ in found], dtype=np.int64),
        from_joints=from_joints,
        from_vertices=tuple(vertices for _, _, vertices in found),
    )


class _Finder:
    """Carrier, joints and vertices of a landmark by name."""

    def __init__(self, rig: Rig):
        self.rig = rig
        self.dominant = rig.skinning_weights.argmax(axis=1)

    def joint(self, name: str) -> int:
        if name not in self.rig.joint_names:
            raise ValueError(f"rig_landmarks(): expected the joint {name!r} in the rig; got {self.rig.name!r} without. Use the Anny rig.")
        return self.rig.joint_names.index(name)

    def find(self, landmark: str) -> tuple[str, tuple[str, ...], tuple[int, ...]]:
        side, _, part = landmark.partition("_")
        ending = {"left": "L", "right": "R"}.get(side, "")
        at_joints = {
            "shoulder": "upperarm01",
            "elbow": "lowerarm01",
            "wrist": "wrist",
            "hip": "upperleg01",
            "knee": "lowerleg01",
            "ankle": "foot",
        }
        if ending and part in at_joints:
            joint = f"{at_joints[part]}.{ending}"
            return joint, (joint,), ()
        if ending and part == "eye":
            return "head", (f"eye.{ending}",), ()
        if landmark == "mid_hip":
            return "root", ("upperleg01.L", "upperleg01.R"), ()
        if landmark == "neck":
            return "spine01", ("upperarm01.L", "upperarm01.R"), ()
        if landmark == "upper_neck":
            return "neck03", ("neck03",), ()
        if ending and part in TOES:
            return f"toe1-1.{ending}" if part == "big_toe" else f"foot.{ending}", (), (self._toe_tip(f"{TOES[part]}-", ending),)
        return self._on_surface(landmark, part, ending)

    def _on_surface(self, landmark: str, part: str, ending: str) -> tuple[str, tuple[str, ...], tuple[int, ...]]:
        """Landmarks that are extremes of a body part."""
        rest = self.rig.rest_vertices
        mirror = 1.0 if ending == "L" else -1.0
        if part == "heel":
            foot = np.flatnonzero(self.dominant == self.joint(f"foot.{ending}"))
            low = foot[rest[foot, 2] < rest[foot, 2].min() + 0.03]
            return f"foot.{ending}", (), (int(low[rest[low, 1].argmax()]),)
        head = np.flatnonzero(self.dominant == self.joint("head"))
        if landmark == "head_top":
            return "head", (), (int(head[rest[head, 2].argmax()]),)
        eyes = self.rig.joint_positions[self.joint("eye.L")]
        if landmark == "nose":
            middle = head[(np.abs(rest[head, 0]) < MIDLINE) & (rest[head, 2] < eyes[2]) & (rest[head, 2] > eyes[2] - 0.07)]
            return "head", (), (int(middle[rest[middle, 1].argmin()]),)
        beside = head[np.abs(rest[head, 2] - eyes[2] + 0.01) < 0.03]
        return "head", (), (int(beside[(mirror * rest[beside, 0]).argmax()]),)  # an ear stands out most

    def _toe_tip(self, prefix: str, ending: str) -> int:
        """Foremost vertex of a toe."""
        bones = [index for index, name in enumerate(self.rig.joint_names) if name.startswith(prefix) and name.endswith(f".{ending}")]
        if not bones:
            raise ValueError(f"rig_landmarks(): expected toes {prefix}*.{ending} in the rig; got none. Use the Anny rig.")
        toe = np.flatnonzero(np.isin(self.dominant, bones))
        return int(toe[self.rig.rest_vertices[toe, 1].argmin()])
