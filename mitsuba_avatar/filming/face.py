"""What the face does: strengths of ARKit-style facial actions over time. Blinks, speech, expressions.

Curves are smooth at 10 frames per second; actions that a name list lacks are left out. Symbols: N frames, A actions, strengths 0..1.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

FULL_GAZE = 0.5  # radians by which an eye at full strength of a look has turned
BLINK = 0.32  # seconds from open to open
EXPRESSIONS = (
    {"mouthSmileLeft": 0.8, "mouthSmileRight": 0.8, "cheekSquintLeft": 0.5, "cheekSquintRight": 0.5},
    {"jawOpen": 0.75, "browInnerUp": 0.8, "browOuterUpLeft": 0.7, "browOuterUpRight": 0.7, "eyeWideLeft": 0.6, "eyeWideRight": 0.6},
    {"mouthPucker": 0.8, "browDownLeft": 0.5, "browDownRight": 0.5},
    {"browDownLeft": 0.8, "browDownRight": 0.8, "noseSneerLeft": 0.6, "noseSneerRight": 0.6, "mouthFrownLeft": 0.6, "mouthFrownRight": 0.6},
    {"mouthLeft": 0.6, "mouthSmileLeft": 0.7, "eyeSquintLeft": 0.5, "browOuterUpRight": 0.7},
    {"cheekPuff": 0.8, "mouthClose": 0.1, "browInnerUp": 0.4},
    {"jawRight": 0.5, "mouthRight": 0.6, "jawOpen": 0.25},
)


def resting_face(time: Float[np.ndarray, "N"], names: Sequence[str], rng: np.random.Generator) -> Float[np.ndarray, "N A"]:  # noqa: F821
    """A calm face that blinks, with slow small changes of brows and mouth."""
    actions = np.zeros((len(time), len(names)))
    _add(actions, names, "browInnerUp", 0.2 * _hills(time, 2.5, rng))
    for side in ("Left", "Right"):
        _add(actions, names, f"mouthSmile{side}", 0.15 * _hills(time, 3.0, rng))
    return _with_blinks(actions, time, names, rng)


def conversation_face(time: Float[np.ndarray, "N"], names: Sequence[str], rng: np.random.Generator) -> Float[np.ndarray, "N A"]:  # noqa: F821
    """Speech-like jaw and lips in phrases with pauses, brows that stress, smiles that come and go."""
    actions = np.zeros((len(time), len(names)))
    phrase = np.clip(0.35 + 0.9 * _waves(time, 2.4, rng), 0, 1)
    _add(actions, names, "jawOpen", 0.55 * phrase * _hills(time, 0.55, rng))
    for name, strength, period in (
        ("mouthFunnel", 0.5, 0.7),
        ("mouthPucker", 0.45, 0.8),
        ("mouthRollLower", 0.3, 0.9),
        ("mouthClose", 0.12, 0.6),
    ):
        _add(actions, names, name, strength * phrase * _hills(time, period, rng))
    stress, smile = _hills(time, 1.6, rng), _hills(time, 3.5, rng)
    _add(actions, names, "browInnerUp", 0.5 * stress)
    for side in ("Left", "Right"):
        _add(actions, names, f"mouthStretch{side}", 0.35 * phrase * _hills(time, 0.7, rng))
        _add(actions, names, f"mouthLowerDown{side}", 0.35 * phrase * _hills(time, 0.6, rng))
        _add(actions, names, f"mouthUpperUp{side}", 0.25 * phrase * _hills(time, 0.8, rng))
        _add(actions, names, f"browOuterUp{side}", 0.55 * stress * rng.uniform(0.6, 1.0))
        _add(actions, names, f"mouthSmile{side}", 0.6 * smile * rng.uniform(0.75, 1.0))
        _add(actions, names, f"cheekSquint{side}", 0.35 * smile)
    return _with_blinks(actions, time, names, rng)


def expression_tour(time: Float[np.ndarray, "N"], names: Sequence[str], rng: np.random.Generator) -> Float[np.ndarray, "N A"]:  # noqa: F821
    """One strong expression after another, each rising and falling."""
    actions = np.zeros((len(time), len(names)))
    order = rng.permutation(len(EXPRESSIONS))
    progress = (np.arange(len(time)) + 0.5) / max(len(time), 1) * len(order)
    for place, index in enumerate(order):
        envelope = np.sin(np.pi * np.clip((progress - place + 0.15) / 1.3, 0, 1)) ** 2
        for name, strength in EXPRESSIONS[index].items():
            _add(actions, names, name, strength * envelope)
    return _with_blinks(np.clip(actions, 0, 1), time, names, rng)


def gaze_of_actions(actions: Float[np.ndarray, "N A"], names: Sequence[str]) -> Float[np.ndarray, "N 2 2"]:
    """Where facial actions have the eyes look: [N, left and right eye, elevation and turn to the person's left], radians."""

    def strength(name: str) -> np.ndarray:
        return actions[:, list(names).index(name)] if name in names else np.zeros(len(actions))

    left, right = (
        np.stack(
            [strength(f"eyeLookUp{side}") - strength(f"eyeLookDown{side}"), strength(f"{outer}{side}") - strength(f"{inner}{side}")], 1
        )
        for side, outer, inner in (("Left", "eyeLookOut", "eyeLookIn"), ("Right", "eyeLookIn", "eyeLookOut"))
    )
    return FULL_GAZE * np.stack([left, right], axis=1)


def _with_blinks(actions: np.ndarray, time: np.ndarray, names: Sequence[str], rng: np.random.Generator) -> Float[np.ndarray, "N A"]:
    """Add a blink every two to four seconds."""
    lids = np.zeros(len(time))
    moment = rng.uniform(0.3, 2.0)
    while moment < (time[-1] if len(time) else 0):
        lids = np.maximum(lids, np.cos(np.clip((time - moment) / BLINK, -0.5, 0.5) * np.pi) ** 1.5)
        moment += rng.uniform(2.0, 4.0)
    for side in ("Left", "Right"):
        _add(actions, names, f"eyeBlink{side}", lids)
    return np.clip(actions, 0, 1)


def _add(actions: np.ndarray, names: Sequence[str], name: str, strengths: np.ndarray) -> None:
    """Add to one column, made by the caller; a rig without that action goes without it."""
    if name in names:
        actions[:, list(names).index(name)] += strengths


def _waves(time: np.ndarray, period: float, rng: np.random.Generator) -> Float[np.ndarray, "N"]:  # noqa: F821
    """Smooth curve within -1..1: two sines of periods around `period` seconds."""
    periods, phases = period * np.array([1.0, 1.7]) * rng.uniform(0.85, 1.2, 2), rng.uniform(0, 2 * np.pi, 2)
    return (np.array([0.6, 0.4]) * np.sin(2 * np.pi * time[:, None] / periods + phases)).sum(axis=1)


def _hills(time: np.ndarray, period: float, rng: np.random.Generator) -> Float[np.ndarray, "N"]:  # noqa: F821
    """Smooth curve within 0..1 that is often near 0."""
    return np.clip(0.5 + 0.75 * _waves(time, period, rng) - 0.1, 0, 1) ** 1.5
