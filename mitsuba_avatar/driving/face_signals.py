"""Face signals of two kinds, and the way from one to the other: 3D landmarks, and strengths of facial actions (action codes).

A head-set or a telephone gives codes; an avatar of a studio capture wants landmarks. On the Anny rig both are tied by what each facial
action does to the rest surface: landmarks = neutral + codes D. The person's own neutral face is found from the training frames, because
hair, lids and skin of a capture are not exactly the rig's.

Symbols: N frames, A facial actions, K landmarks, F entries of a face signal. Metres, strengths 0..1.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Float64
from scipy.optimize import nnls

from mitsuba_avatar.body.anny_rig import facial_action_displacements, is_anny
from mitsuba_avatar.body.driving import face_keypoints
from mitsuba_avatar.body.rig import Rig
from mitsuba_avatar.captures.description import CaptureDescription

NEUTRAL_FRAMES = 48  # training frames that tell the neutral face
NEUTRAL_ROUNDS = 15
# Weight that keeps the sum of all strengths small while the neutral face is sought: faces rest more often than not, and an offset that
# actions could mimic then counts as the person's. On a studio capture it brings the neutral face's error from 0.9 to 0.2 mm.
SPARSITY = 0.3


@dataclass(frozen=True)
class FaceKind:
    """What a face signal holds.

    Attributes:
        signal: landmarks along rest axes from the head, metres; or strengths of facial actions.
        names: of its entries.
    """

    signal: Literal["keypoints", "action_codes"]
    names: tuple[str, ...]

    @staticmethod
    def of_rig(rig: Rig) -> "FaceKind":
        """Landmarks of a rig."""
        return FaceKind("keypoints", tuple(f"{name}_{axis}" for name in rig.face_keypoint_names for axis in "xyz"))

    @staticmethod
    def of_capture(description: CaptureDescription, face_size: int) -> "FaceKind":
        """What a capture's description says; unnamed entries get their numbers for names."""
        names = description.face_names or tuple(str(entry) for entry in range(face_size))
        return FaceKind(description.face_signal, names)


@dataclass(frozen=True, eq=False)  # arrays have no truth value to compare by
class FaceModel:
    """What facial actions do to a rig's landmarks.

    Attributes:
        names: A facial actions.
        neutral: [3 K] landmarks of the face at rest, metres.
        displacements: [A, 3 K] metres at full strength, D.
    """

    names: tuple[str, ...]
    neutral: Float64[np.ndarray, "K3"]  # noqa: F821
    displacements: Float64[np.ndarray, "A K3"]

    @staticmethod
    def of_rig(rig: Rig, training_faces: Float[np.ndarray, "N K3"] | None = None) -> "FaceModel":
        """The model of an Anny rig.

        Args:
            rig: with the Anny topology.
            training_faces: landmarks of the avatar's training frames, from which the person's own neutral face is taken.

        Raises:
            ValueError: the rig has no facial actions that this package knows.
        """
        if not is_anny(rig):
            raise ValueError(
                f"FaceModel.of_rig(): expected the Anny rig, whose facial actions are known; got {rig.name!r}. "
                "Drive with a face signal of the kind that the avatar was trained on."
            )
        names, displacements = facial_action_displacements()
        rest = torch.from_numpy(rig.rest_vertices)[None]
        model = FaceModel(
            names,
            face_keypoints(rig, rest)[0].double().numpy(),
            displacements[:, rig.face_keypoint_vertices].reshape(len(names), -1).astype(np.float64),
        )
        return model if training_faces is None else model.of_person(training_faces)

    def of_person(self, faces: Float[np.ndarray, "N K3"]) -> "FaceModel":
        """The model with the neutral face that, plus few facial actions, explains some faces best."""
        chosen = faces[np.unique(np.linspace(0, len(faces) - 1, NEUTRAL_FRAMES).round().astype(int))].astype(np.float64)
        scale = np.sqrt(np.square(self.displacements).sum(axis=1).mean())
        design = np.concatenate([self.displacements.T, np.full((1, len(self.names)), SPARSITY * scale)])
        neutral = self.neutral
        for _ in range(NEUTRAL_ROUNDS):
            codes = np.stack([nnls(design, np.append(row - neutral, 0.0))[0] for row in chosen])
            neutral = (chosen - codes @ self.displacements).mean(0)
        return FaceModel(self.names, neutral, self.displacements)

    def landmarks(self, codes: Float[np.ndarray, "N A"]) -> Float64[np.ndarray, "N K3"]:
        """Landmarks of facial actions."""
        return self.neutral + codes @ self.displacements

    def codes(self, landmarks: Float[np.ndarray, "N K3"]) -> Float64[np.ndarray, "N A"]:
        """Strengths >= 0 of the facial actions that come nearest to landmarks, cut at 1."""
        return np.stack([np.minimum(nnls(self.displacements.T, row - self.neutral)[0], 1) for row in landmarks])

    def reordered(self, codes: Float[np.ndarray, "N S"], names: Sequence[str]) -> Float64[np.ndarray, "N A"]:
        """Codes of named actions in this model's order; actions that are not among them are at rest.

        Raises:
            ValueError: none of the names is known.
        """
        return reordered(codes, names, self.names)


def converted(
    values: Float[np.ndarray, "N F"], kind: FaceKind, wanted: FaceKind, model_of_avatar: "FaceModel | None", rig: Rig
) -> Float[np.ndarray, "N G"]:
    """A face signal as an avatar wants it.

    Args:
        values: [N, F].
        kind: what they are.
        wanted: what the avatar was trained on.
        model_of_avatar: ties both kinds; None where the rig has none.
        rig: of the avatar, for messages.

    Raises:
        ValueError: no way leads from one to the other.
    """
    if kind.signal == wanted.signal == "action_codes":
        return values if kind.names == wanted.names else reordered(values, kind.names, wanted.names)
    if kind.signal == wanted.signal:
        if values.shape[1] != len(wanted.names):
            raise ValueError(
                f"converted(): expected {len(wanted.names)} numbers of face landmarks a frame; got {values.shape[1]}. "
                "Use landmarks of the rig that the avatar was trained on, or action codes."
            )
        return values
    if model_of_avatar is None:
        raise ValueError(
            f"converted(): expected {wanted.signal}, the face signal that the avatar was trained on; got {kind.signal}, and the rig "
            f"{rig.name!r} has no facial actions that tie the two. Record the signal that the avatar wants."
        )
    if kind.signal == "action_codes":
        return model_of_avatar.landmarks(model_of_avatar.reordered(values, kind.names))
    if values.shape[1] != len(model_of_avatar.neutral):
        raise ValueError(
            f"converted(): expected {len(model_of_avatar.neutral)} numbers of face landmarks a frame; got {values.shape[1]}. "
            "Use landmarks of the avatar's rig."
        )
    return reordered(model_of_avatar.codes(values), model_of_avatar.names, wanted.names)


def reordered(codes: Float[np.ndarray, "N S"], names: Sequence[str], wanted: Sequence[str]) -> Float64[np.ndarray, "N A"]:
    """Columns matched by name, whatever the case; wanted ones that are missing are 0.

    Raises:
        ValueError: no name is wanted, or there is not one name a column.
    """
    places = {name.lower(): place for place, name in enumerate(names)}
    if len(names) != codes.shape[1] or not any(name.lower() in places for name in wanted):
        raise ValueError(
            f"reordered(): expected a name for each of {codes.shape[1]} columns, some of them facial actions such as "
            f"{', '.join(list(wanted)[:3])}; got {', '.join(list(names)[:3])}, ... Name the columns by ARKit's facial actions."
        )
    result = np.zeros((len(codes), len(wanted)))
    for column, name in enumerate(wanted):
        if name.lower() in places:
            result[:, column] = codes[:, places[name.lower()]]
    return result
