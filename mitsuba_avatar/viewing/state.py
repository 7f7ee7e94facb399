"""What a viewer shows, as values: the state that controls change and pictures are drawn from. Nothing here draws or knows a browser."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from jaxtyping import Float

Surface = Literal["texture", "shape", "normals", "ambient occlusion", "shadow gain", "uncertainty"]
SURFACES: tuple[Surface, ...] = get_args(Surface)

_LIMBS = {
    "eyes": ("eye",),
    "arm": ("clavicle", "shoulder", "upper_arm", "elbow", "forearm"),
    "hand": ("wrist", "thumb", "index", "middle", "ring", "little"),
    "leg": ("hip", "thigh", "knee", "shank", "ankle", "big_toe"),
}
_MIDLINE = {"trunk": ("spine",), "neck and head": ("neck", "head")}
OTHERS = "body"  # of a rig whose names say nothing


@dataclass(frozen=True, eq=False)  # arrays have no truth value to compare by
class ViewState:
    """Everything but the camera that a picture depends on.

    Attributes:
        theta: [D] pose angles, radians. root: [4, 4]. face: [F] before `face_shift`.
        frame: row of the timeline that the state was last taken from; imputations that need a sequence read z there.
        face_shift, latent_shift: standard deviations along the principal directions of face signal and latent code.
        imputation: name of where z comes from before `latent_shift`.
        surface: what the body's surface shows.
        has_shadow: multiply the texture by the quasi-shadow.
        has_wireframe: draw the mesh's edges over it.
        is_in_place: keep the root of the timeline's first frame.
        has_map: show the map of poses.
    """

    theta: Float[np.ndarray, "D"]  # noqa: F821
    root: Float[np.ndarray, "4 4"]
    face: Float[np.ndarray, "F"]  # noqa: F821
    frame: int = 0
    face_shift: tuple[float, ...] = ()
    latent_shift: tuple[float, ...] = ()
    imputation: str = "zero"
    surface: Surface = "texture"
    has_shadow: bool = True
    has_wireframe: bool = False
    is_in_place: bool = False
    has_map: bool = True

    def with_angle(self, index: int, radians: float) -> "ViewState":
        """The state with one pose angle changed."""
        return replace(self, theta=_changed(self.theta, index, radians))

    def with_face_entry(self, index: int, value: float) -> "ViewState":
        """The state with one entry of the face signal changed."""
        return replace(self, face=_changed(self.face, index, value))

    def with_face_shift(self, index: int, deviations: float) -> "ViewState":
        """The state moved along one principal direction of the face signal."""
        return replace(self, face_shift=_replaced(self.face_shift, index, deviations))

    def with_latent_shift(self, index: int, deviations: float) -> "ViewState":
        """The state moved along one principal direction of the latent code."""
        return replace(self, latent_shift=_replaced(self.latent_shift, index, deviations))


def limb_groups(angle_names: Sequence[str]) -> dict[str, list[int]]:
    """Pose angles by limb: name of the group -> indices, in the order of the names; what belongs to no limb comes last."""
    groups: dict[str, list[int]] = {}
    for index, name in enumerate(angle_names):
        groups.setdefault(_limb(name), []).append(index)
    if OTHERS in groups:
        groups[OTHERS] = groups.pop(OTHERS)
    return groups


def _limb(name: str) -> str:
    for side in ("left", "right"):
        if name.startswith(f"{side}_"):
            part = name.removeprefix(f"{side}_")
            for limb, words in _LIMBS.items():
                if part.startswith(words):
                    return f"{side} {limb}" if limb != "eyes" else limb
    for limb, words in _MIDLINE.items():
        if name.startswith(words):
            return limb
    return OTHERS


def _changed(values: Float[np.ndarray, "C"], index: int, value: float) -> Float[np.ndarray, "C"]:  # noqa: F821
    values = values.copy()
    values[index] = value
    return values


def _replaced(values: tuple[float, ...], index: int, value: float) -> tuple[float, ...]:
    return (*values[:index], value, *values[index + 1 :])
