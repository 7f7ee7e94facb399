"""How the clothes move: folds that depend on the angles of nearby joints, and on where those joints were a moment ago.

Each *fold* is a wave on one garment around a place of the body. Its height follows a bend, a weighted sum of pose angles; its phase
slides as the bend grows. The bend that cloth sees lags behind the skeleton's (a first-order low-pass filter), and the shirt rides up
fast when an arm is raised and comes down slowly. So pose explains most of the surface, and the rest is hidden state: the registered
mesh is not the skinned template. A new segment starts at rest, lag zero.

Symbols: N frames, V vertices, D pose angles, P fold patterns. Metres, radians, seconds; displacements live in rest space.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32

from mitsuba_avatar.filming.anatomy import ARM, SIDES, Anatomy, smooth_step
from mitsuba_avatar.filming.clothing import DressedBody

BEND_OF_FULL_FOLD = 0.3  # radians at which a fold is about as high as it gets
LAG = 0.9  # seconds that cloth needs to follow a bend
SHARE_OF_LAG = 0.25  # part of the bend that is seen late
RISE, FALL = 0.4, 2.0  # seconds in which the shirt rides up and comes down
LARGEST_RIDE = 0.005  # metres that the shirt's hem rides up
SMALLEST_GAP = 0.002  # metres kept between cloth and skin
LEFT, FRONT, UP = np.eye(3) * [1, -1, 1]  # of the person, rest world axes


@dataclass(frozen=True)
class Fold:
    """A family of parallel folds.

    Attributes:
        garment: which cloth.
        centre: rest position, metres.
        across: direction across the folds, along which the wave runs; any length.
        wavelength, radius, height: metres between ridges, of the region (standard deviation), of the ridges.
        angles: pose angle name -> gain; their weighted sum is the bend.
    """

    garment: str
    centre: Float[np.ndarray, "3"]
    across: Float[np.ndarray, "3"]
    wavelength: float
    radius: float
    height: float
    angles: dict[str, float]


class KinematicCloth:
    """Displacements of a dressed body's cloth over time."""

    def __init__(self, anatomy: Anatomy, body: DressedBody, seed: int):
        """Lay the folds out; `seed` varies their phases."""
        self.anatomy, self.body = anatomy, body
        self.folds = [fold for fold in _folds(anatomy) if fold.garment in body.coverage]
        self.gap = ((body.vertices - body.skin) * body.normals).sum(axis=1)  # [V] metres of cloth over skin
        rng = np.random.default_rng(seed)
        patterns = [pattern for fold in self.folds for pattern in self._patterns(fold, rng)]
        self.patterns = np.array(patterns, np.float32).reshape(-1, len(body.vertices))  # [2 * folds, V] metres along normals
        self.ride = self._ride()  # [V, 3] metres at full ride

    def states(self, theta: Float32[np.ndarray, "N D"], fps: float, segments: list[slice]) -> Float32[np.ndarray, "N P1"]:
        """State of the cloth, frame by frame: the heights of all P patterns, and how far the shirt has ridden up.

        Args:
            theta: [N, D] radians.
            fps: frames per second, on which the lag depends.
            segments: runs of consecutive frames; each starts without history.
        """
        states = np.zeros((len(theta), len(self.patterns) + 1), dtype=np.float32)
        for segment in segments:
            states[segment, :-1], states[segment, -1] = self._state(theta[segment], fps)
        return states

    def displacements(self, states: Float32[np.ndarray, "N P1"]) -> Float32[np.ndarray, "N V 3"]:
        """Offsets of the rest surface in some frames' states (`states`), metres."""
        heights, rides = states[:, :-1], states[:, -1]
        along_normal = np.maximum(heights @ self.patterns, np.minimum(SMALLEST_GAP - self.gap, 0))  # cloth stays outside the skin
        return along_normal[..., None] * self.body.normals + rides[:, None, None] * self.ride

    def _state(self, theta: Float32[np.ndarray, "N D"], fps: float) -> tuple[Float[np.ndarray, "N P"], Float[np.ndarray, "N"]]:  # noqa: F821
        """Heights of all patterns, and how far the shirt has ridden up (0..1), over one segment."""
        names = self.anatomy.rig.dofs.names
        gains = np.zeros((len(names), len(self.folds)))
        for column, fold in enumerate(self.folds):
            for name, gain in fold.angles.items():
                gains[names.index(name), column] = gain
        bend = theta @ gains  # [N, folds]
        seen = (1 - SHARE_OF_LAG) * bend + SHARE_OF_LAG * low_pass(bend, LAG, LAG, fps)
        strength = np.tanh(np.abs(seen) / BEND_OF_FULL_FOLD)
        phase = 1.6 * seen
        heights = np.stack([strength * np.cos(phase), strength * np.sin(phase)], axis=2).reshape(len(theta), -1)
        raising = [names.index(f"{side}_shoulder_{part}") for side in ("left", "right") for part in ("abduction", "flexion")]
        raised = theta[:, raising].clip(0, None).sum(axis=1)
        return heights, low_pass(np.tanh(raised / 1.2)[:, None], RISE, FALL, fps)[:, 0]

    def _patterns(self, fold: Fold, rng: np.random.Generator) -> list[Float[np.ndarray, "V"]]:  # noqa: F821
        """The fold's wave at two phases a quarter apart, metres along normals."""
        vertices = self.body.vertices.astype(np.float64)
        cover = self.body.coverage[fold.garment].astype(np.float64)
        window = self.anatomy.smooth(cover[:, None], 2)[:, 0] * cover  # lower at hems
        offset = vertices - fold.centre
        window = window * np.exp(-(offset**2).sum(axis=1) / (2 * fold.radius**2))
        bow = 0.6 * np.sin(2 * np.pi * offset @ rng.normal(size=3) / 0.35 + rng.uniform(0, 2 * np.pi))  # folds are not straight
        along_wave = offset @ fold.across / np.linalg.norm(fold.across)
        phase = 2 * np.pi * along_wave / fold.wavelength + bow + rng.uniform(0, 2 * np.pi)
        return [fold.height * window * np.cos(phase), fold.height * window * np.sin(phase)]

    def _ride(self) -> Float32[np.ndarray, "V 3"]:
        """Displacement of the shirt at full ride: upwards along the surface, most at the hem."""
        vertices, normals = self.body.vertices.astype(np.float64), self.body.normals.astype(np.float64)
        base, neck = self.anatomy.joint("spine05")[2] - 0.05, self.anatomy.joint("neck01")[2]
        shirt = self.body.coverage.get("shirt", np.zeros(len(vertices), dtype=np.float32))
        torso = shirt * (self.anatomy.weight(ARM) < 0.5)
        share = torso * smooth_step(vertices[:, 2], base + 0.75 * (neck - base), base)
        upwards = np.array([0, 0, 1.0]) - normals[:, 2:] * normals
        bulge = 0.25 * np.sin(np.pi * np.clip((vertices[:, 2] - base) / 0.3, 0, 1))[:, None] * normals  # what is pushed up bunches
        return (LARGEST_RIDE * share[:, None] * (upwards + bulge)).astype(np.float32)


def low_pass(signal: Float[np.ndarray, "N C"], rise: float, fall: float, fps: float) -> Float[np.ndarray, "N C"]:
    """First-order low-pass filter that starts at the first value; time constants in seconds, for growing and shrinking magnitude."""
    filtered = np.empty_like(signal, dtype=np.float64)
    state = signal[0].astype(np.float64)
    for index, value in enumerate(signal):
        constant = np.where(np.abs(value) > np.abs(state), rise, fall)
        state = state + (1 - np.exp(-1 / (fps * constant))) * (value - state)
        filtered[index] = state
    return filtered


def _folds(anatomy: Anatomy) -> list[Fold]:
    """Where cloth folds on a person in a T-shirt and trousers."""
    folds = _trunk_folds(anatomy)
    for side, word in zip(SIDES, ("left", "right"), strict=True):
        folds += _shoulder_folds(anatomy, side, word) + _leg_folds(anatomy, side, word)
    return folds


def _trunk_folds(anatomy: Anatomy) -> list[Fold]:
    """Level folds where the trunk bends, oblique ones where it turns."""
    middle = anatomy.joint("spine03")

    def trunk(angle: str) -> dict[str, float]:
        return {f"spine0{number}_{angle}": 1.0 for number in (5, 4, 3, 2)}

    return [
        Fold("shirt", middle + 0.12 * FRONT - 0.06 * UP, UP, 0.085, 0.16, 0.013, trunk("flexion")),
        Fold("shirt", middle + 0.13 * LEFT, UP, 0.08, 0.13, 0.013, trunk("bend")),
        Fold("shirt", middle - 0.13 * LEFT, UP, 0.08, 0.13, 0.013, trunk("bend")),
        Fold("shirt", middle + 0.12 * FRONT, UP + 0.8 * LEFT, 0.10, 0.22, 0.011, trunk("turn")),
        Fold("shirt", middle - 0.14 * FRONT, UP - 0.8 * LEFT, 0.10, 0.22, 0.011, trunk("turn")),
    ]


def _shoulder_folds(anatomy: Anatomy, side: str, word: str) -> list[Fold]:
    """On the shoulder, under the arm, across the chest, round the sleeve."""
    shoulder, arm, length = anatomy.axis(f"upperarm01.{side}", f"lowerarm01.{side}")
    outwards = LEFT if side == "L" else -LEFT
    raising = {f"{word}_shoulder_abduction": 0.8, f"{word}_clavicle_elevation": 0.6}
    reaching = {f"{word}_shoulder_flexion": 0.7, f"{word}_clavicle_protraction": 0.6}
    twisting = {f"{word}_shoulder_inward_rotation": 0.9, f"{word}_upper_arm_twist": 0.9}
    return [
        Fold("shirt", shoulder + 0.02 * UP, arm, 0.07, 0.09, 0.013, raising),
        Fold("shirt", shoulder - 0.05 * outwards - 0.09 * UP, UP + outwards, 0.075, 0.10, 0.011, raising),
        Fold("shirt", shoulder - 0.06 * outwards + 0.07 * FRONT, outwards - 0.4 * UP, 0.075, 0.095, 0.011, reaching),
        Fold("shirt", shoulder + 0.55 * length * arm, arm + 0.7 * UP, 0.065, 0.08, 0.009, twisting),
    ]


def _leg_folds(anatomy: Anatomy, side: str, word: str) -> list[Fold]:
    """In the groin, inside the thigh, behind the knee, down the shin."""
    hip = anatomy.joint(f"upperleg01.{side}")
    knee, shin, _ = anatomy.axis(f"lowerleg01.{side}", f"foot.{side}")
    outwards = LEFT if side == "L" else -LEFT
    spreading = {f"{word}_hip_abduction": 1.2, f"{word}_hip_inward_rotation": 0.8}
    stepping = {f"{word}_ankle_dorsiflexion": 1.0, f"{word}_knee_flexion": 0.5}
    return [
        Fold("trousers", hip + 0.07 * FRONT - 0.02 * UP, UP + 0.5 * outwards, 0.075, 0.11, 0.013, {f"{word}_hip_flexion": 1.0}),
        Fold("trousers", hip - 0.03 * outwards - 0.09 * UP, UP, 0.08, 0.10, 0.009, spreading),
        Fold("trousers", knee - 0.05 * FRONT, -shin, 0.065, 0.11, 0.014, {f"{word}_knee_flexion": 1.0}),
        Fold("trousers", knee + 0.28 * shin, -shin, 0.075, 0.115, 0.009, stepping),
    ]
