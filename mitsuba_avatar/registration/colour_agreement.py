"""Colours on which cameras agree: a correction for each camera, so that it records of a surface what the others record of it.

Corrections act on linear radiance: `corrected = matrix[:, :3] @ recorded + matrix[:, 3]`. One camera, the reference, stays as it is.
Gains come from ratios of two views, not from a regression of one on the other: errors of either would shrink them. The affine map turns
gains into a full matrix and an offset as far as the data insist, under a prior that says gains will do. Held-out cameras are solved
one by one against the others after those are settled, so that they have no say in them.

Cameras in front of a person and behind may see no point in common. What is left to tell them apart is a weak prior: the white balance
is such that the person has the same hue from all sides, and the brightness stays what it was, because light differs more than that.

How well it works is measured on blocks of frames that the corrections were not solved from.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64

from mitsuba_avatar.captures.colour import encode
from mitsuba_avatar.registration.colour_samples import SharedColours
from mitsuba_avatar.registration.settings import ColourCorrection

CANDIDATES = ("none", "gains", "affine")  # from the plainest
WORTH = 0.97  # a less plain correction must bring disagreement below this share of a plainer one's
TOLERANCE = 6.0  # levels of 255; larger differences count by their size, not its square
ROUNDS = 15  # of reweighting
PRIOR_SAMPLES = 10.0  # as many samples as the prior is worth
FRESH_SHARE = 0.02  # of samples that tell something new: neighbours and blocks are alike, and more freedom flattens contrast
MATRIX_DEVIATION = 0.1  # of the affine map's entries from gains
OFFSET_DEVIATION = 0.01  # of its offset, linear radiance
FEWEST_FOR_CONTRAST = 30  # samples of a pair
DARKEST = 0.002  # linear value below which ratios mean nothing


@dataclass(frozen=True, eq=False)
class ColourAgreement:
    """Corrections and what they do.

    Attributes:
        correction: what was taken: "none", "gains", "affine", or "chart" for corrections that a colour chart gave.
        reference: camera that stays as it is; empty with a chart.
        matrices: camera -> [3, 4].
        candidates: mean disagreement over the cameras that train, levels of 255 on frames left out, by kind; NaN if they share nothing.
        before, after: camera -> its mean disagreement with the others, the same way; NaN if it shares nothing with them.
        samples: camera -> how many points it shares with others, a block of frames at a time.
    """

    correction: str
    reference: str
    matrices: dict[str, Float64[np.ndarray, "3 4"]]
    candidates: dict[str, float]
    before: dict[str, float]
    after: dict[str, float]
    samples: dict[str, int]


def agree(
    shared: SharedColours,
    held_out: Sequence[str],
    correction: ColourCorrection = "auto",
    reference: str = "",
    chart: Mapping[str, Float64[np.ndarray, "3 4"]] | None = None,
) -> ColourAgreement:
    """Choose, solve and measure corrections.

    Args:
        shared: samples of all pairs of cameras.
        held_out: cameras without a say.
        correction: "auto" takes the plainest that no other beats clearly on frames left out.
        reference: camera that stays as it is; empty: the one that shares most with the others.
        chart: corrections that a colour chart gave; they are taken, and only measured here.
    """
    names = shared.cameras
    is_held = np.isin(names, list(held_out))
    known = shared.where(~is_held[shared.pair].all(axis=1))  # two held-out cameras have nothing to say to each other
    trained = known.where(~is_held[known.pair].any(axis=1))
    pinned = names.index(reference) if reference else _widest(trained, is_held)
    errors = {kind: _errors_left_out(known, kind, pinned, is_held) for kind in CANDIDATES}
    says = ~is_held[known.pair].any(axis=1)
    candidates = {kind: _mean(errors[kind], known.weight, says) for kind in CANDIDATES}
    taken = correction if correction != "auto" else _plainest(candidates)
    if chart is not None:
        taken, matrices = "chart", np.stack([chart[name] for name in names])
        errors["chart"] = _errors(known, matrices)
    else:
        matrices = solve_corrections(known, taken, pinned, is_held)
    touches = {name: (known.pair == index).any(axis=1) for index, name in enumerate(names)}
    return ColourAgreement(
        correction=taken,
        reference="" if chart is not None else names[pinned],
        matrices=dict(zip(names, matrices, strict=True)),
        candidates=candidates,
        before={name: _mean(errors["none"], known.weight, touched) for name, touched in touches.items()},
        after={name: _mean(errors[taken], known.weight, touched) for name, touched in touches.items()},
        samples={name: int(touched.sum()) for name, touched in touches.items()},
    )


def solve_corrections(shared: SharedColours, kind: str, pinned: int, is_held: Bool[np.ndarray, "C"]) -> Float64[np.ndarray, "C 3 4"]:
    """Corrections of all cameras; identity for the pinned one.

    Args:
        shared: samples.
        kind: "none", "gains" or "affine".
        pinned: index of the camera that stays.
        is_held: which cameras are solved after the others, each alone.
    """
    matrices = np.tile(np.eye(3, 4), (len(is_held), 1, 1))
    if kind == "none":
        return matrices
    trained = shared.where(~is_held[shared.pair].any(axis=1))
    free = [index for index in np.flatnonzero(~is_held).tolist() if index != pinned]
    _solve(trained, kind, free, [pinned], matrices)
    settled = np.flatnonzero(~is_held).tolist()
    for index in np.flatnonzero(is_held).tolist():
        own = shared.where((shared.pair == index).any(axis=1) & (is_held[shared.pair].sum(axis=1) == 1))
        _solve(own, kind, [index], settled, matrices)
    return matrices


def corrected(shared: SharedColours, matrices: Float64[np.ndarray, "C 3 4"]) -> Float64[np.ndarray, "S 2 3"]:
    """Colours of samples after correction."""
    chosen = matrices[shared.pair]
    return np.einsum("spij,spj->spi", chosen[..., :3], shared.colours) + chosen[..., 3]


def _solve(shared: SharedColours, kind: str, free: list[int], settled: list[int], matrices: Float64[np.ndarray, "C 3 4"]) -> None:
    """Settle the free cameras, whose matrices are identity so far."""
    expected = _log_gains_of_hue(shared, free, settled, matrices)
    for index, gains in zip(free, np.exp(_log_gains(shared, free, matrices, expected)), strict=True):
        matrices[index, :, :3] = np.diag(gains)
    if kind == "affine" and len(shared):
        turns = _affine_turns(shared, free, matrices)
        for index, turn in zip(free, turns, strict=True):
            matrices[index] = np.concatenate([np.eye(3) + turn[:, :3], turn[:, 3:]], axis=1) @ _square(matrices[index])


def _log_gains_of_hue(
    shared: SharedColours, free: list[int], settled: list[int], matrices: Float64[np.ndarray, "C 3 4"]
) -> Float64[np.ndarray, "F 3"]:
    """Logarithms of gains, of mean 0, that give the person the hue that settled cameras record; 0 where somebody saw nothing."""
    typical = np.einsum("cij,cj->ci", matrices[..., :3], shared.typical) + matrices[..., 3]
    logs = np.log(typical.clip(DARKEST, None))
    gains = logs[settled].mean(axis=0) - logs[free]
    return np.nan_to_num(gains - gains.mean(axis=1, keepdims=True))


def _log_gains(
    shared: SharedColours, free: list[int], matrices: Float64[np.ndarray, "C 3 4"], expected: Float64[np.ndarray, "F 3"]
) -> Float64[np.ndarray, "F 3"]:
    """Logarithms of gains, channel by channel: robust least squares of log ratios, in levels of the encoded images."""
    colours = corrected(shared, matrices)
    is_bright = (colours > DARKEST).all(axis=1)  # [S, 3]
    logs = np.log(colours.clip(DARKEST, None))
    signs = _signs(shared, free)
    gains = expected.copy()
    for channel in range(3):
        ratio, weight = logs[:, 1, channel] - logs[:, 0, channel], shared.weight * is_bright[:, channel]
        if not weight.any():
            continue
        weight = weight / weight[weight > 0].mean()
        mean = np.exp(logs[:, :, channel].mean(axis=1))
        levels = mean * _slope(mean)  # of the encoded image, for a ratio of e
        prior = PRIOR_SAMPLES * np.average(levels**2, weights=weight) * np.eye(len(free))
        for _ in range(ROUNDS):
            error = levels * (signs @ gains[:, channel] - ratio)
            total = weight * levels**2 * _trust(error)
            normal = signs.T @ (total[:, None] * signs) + prior
            gains[:, channel] = np.linalg.solve(normal, signs.T @ (total * ratio) + prior @ expected[:, channel])
    return gains


def _affine_turns(shared: SharedColours, free: list[int], matrices: Float64[np.ndarray, "C 3 4"]) -> Float64[np.ndarray, "F 3 4"]:
    """What is added to identity after the gains, [3, 3] and an offset: a maximum a posteriori estimate, in levels."""
    colours = corrected(shared, matrices)
    signs = _signs(shared, free)
    first, second = (np.concatenate([colours[:, side], np.ones((len(colours), 1))], axis=1) for side in range(2))
    features = np.where(signs[..., None] > 0, first[:, None], second[:, None]) * signs[..., None]  # [S, F, 4]
    deviation = np.array([MATRIX_DEVIATION] * 3 + [OFFSET_DEVIATION])
    design = (features * deviation).reshape(len(colours), -1)
    weight = FRESH_SHARE * shared.weight / shared.weight.mean()
    turns = np.zeros((len(free), 3, 4))
    for channel in range(3):
        difference = colours[:, 0, channel] - colours[:, 1, channel]
        slope = _slope(colours[:, :, channel].mean(axis=1))
        solved = np.zeros(design.shape[1])
        for _ in range(ROUNDS):
            error = slope * (difference + design @ solved)
            total = weight * (slope / TOLERANCE) ** 2 * _trust(error)
            normal = design.T @ (total[:, None] * design) + np.eye(len(solved))
            solved = np.linalg.solve(normal, -design.T @ (total * difference))
        turns[:, channel] = solved.reshape(len(free), 4) * deviation
    return turns


def _signs(shared: SharedColours, free: list[int]) -> Float64[np.ndarray, "S F"]:
    """1 where a free camera is a sample's first, -1 where it is its second."""
    return (shared.pair[:, :1] == np.array(free)).astype(np.float64) - (shared.pair[:, 1:] == np.array(free))


def _trust(error: Float[np.ndarray, "S"]) -> Float64[np.ndarray, "S"]:
    """Weights that turn least squares into Huber's loss."""
    return TOLERANCE / np.maximum(np.abs(error), TOLERANCE)


def _slope(linear: Float[np.ndarray, "S"]) -> Float64[np.ndarray, "S"]:
    """Levels of 255 per linear unit of the encoding, at a value."""
    step = 1e-4
    below = linear.clip(0.0, 1.0)
    return 255.0 * (encode(below + step, "srgb") - encode(below, "srgb")) / step


def _square(matrix: Float64[np.ndarray, "3 4"]) -> Float64[np.ndarray, "4 4"]:
    return np.concatenate([matrix, [[0.0, 0.0, 0.0, 1.0]]])


def _widest(trained: SharedColours, is_held: Bool[np.ndarray, "C"]) -> int:
    """The training camera that shares most with other training cameras."""
    shares = [trained.weight[(trained.pair == index).any(axis=1)].sum() for index in range(len(is_held))]
    return int(np.argmax(np.where(is_held, -1.0, shares)))


def _plainest(candidates: Mapping[str, float]) -> str:
    """The candidate that none that is less plain beats clearly; gains where nothing can be measured."""
    if np.isnan(candidates["none"]):
        return "gains"
    taken = CANDIDATES[0]
    for kind in CANDIDATES[1:]:
        if candidates[kind] < WORTH * candidates[taken]:
            taken = kind
    return taken


def _errors_left_out(shared: SharedColours, kind: str, pinned: int, is_held: Bool[np.ndarray, "C"]) -> Float64[np.ndarray, "S"]:
    """Disagreement of each sample, corrected by what the other blocks of frames say."""
    errors = np.zeros(len(shared))
    blocks = np.unique(shared.block)
    for block in blocks:
        is_left_out = shared.block == block
        rest = shared.where(~is_left_out) if len(blocks) > 1 else shared
        errors[is_left_out] = _errors(shared.where(is_left_out), solve_corrections(rest, kind, pinned, is_held))
    return errors


def _errors(shared: SharedColours, matrices: Float64[np.ndarray, "C 3 4"]) -> Float64[np.ndarray, "S"]:
    """Difference of two views, mean over channels, in levels of 255 at the contrast of the recorded images.

    A correction that darkens or flattens both views would lower the plain difference, and agree on nothing.
    """
    levels = 255.0 * encode(corrected(shared, matrices).clip(0.0, 1.0), "srgb")
    recorded = 255.0 * encode(shared.colours.clip(0.0, 1.0), "srgb")
    errors = np.abs(levels[:, 0] - levels[:, 1]).mean(axis=1)
    for pair in np.unique(shared.pair, axis=0):
        chosen = (shared.pair == pair).all(axis=1)
        if chosen.sum() >= FEWEST_FOR_CONTRAST:
            errors[chosen] *= _contrast(recorded[chosen]) / max(_contrast(levels[chosen]), 1e-3)
    return errors


def _contrast(levels: Float64[np.ndarray, "S 2 3"]) -> float:
    """Standard deviation over samples of what both views say."""
    return float(np.sqrt(levels.mean(axis=1).var(axis=0).mean()))


def _mean(errors: Float64[np.ndarray, "S"], weight: Float64[np.ndarray, "S"], chosen: Bool[np.ndarray, "S"]) -> float:
    """Weighted mean of some samples, NaN where there are none."""
    return float(np.average(errors[chosen], weights=weight[chosen])) if chosen.any() else float("nan")


def stored_agreement(agreement: ColourAgreement) -> dict[str, np.ndarray]:
    """As arrays, for a stage's file."""
    by_camera = (agreement.before, agreement.after, agreement.samples)
    return {
        "correction": np.array(agreement.correction),
        "reference": np.array(agreement.reference),
        "cameras": np.array(list(agreement.matrices)),
        "matrices": np.stack(list(agreement.matrices.values())),
        "candidates": np.array([agreement.candidates[kind] for kind in CANDIDATES]),
        "figures": np.array([list(values.values()) for values in by_camera], np.float64),
    }


def read_agreement(stored: Mapping[str, np.ndarray]) -> ColourAgreement:
    """The inverse of `stored_agreement`."""
    names = stored["cameras"].tolist()
    before, after, samples = (dict(zip(names, values, strict=True)) for values in stored["figures"].tolist())
    return ColourAgreement(
        correction=str(stored["correction"]),
        reference=str(stored["reference"]),
        matrices=dict(zip(names, stored["matrices"], strict=True)),
        candidates=dict(zip(CANDIDATES, stored["candidates"].tolist(), strict=True)),
        before=before,
        after=after,
        samples={name: int(count) for name, count in samples.items()},
    )
