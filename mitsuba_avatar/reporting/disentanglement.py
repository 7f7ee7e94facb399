"""How far latent code and driving signal of a trained avatar are apart: the measures behind the claim, as functions of plain tensors.

None of them reads a file or draws a picture. Pairs of frames are made by the caller (`other_frames` makes a fair choice), so that a measure
can be repeated on the same ones for another avatar. Distances in millimetres, information in nats.

Symbols: N frames, Z latent size, D entries of the driving signal, V vertices, T entries of a target state.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mitsuba_avatar.driving.signals import DrivingSignals
from mitsuba_avatar.model.avatar import Avatar
from mitsuba_avatar.model.disentanglement import StatisticsNetwork, corrected_objective, mismatched, mutual_information_bound
from mitsuba_avatar.model.encoder import Posterior
from mitsuba_avatar.model.keypoints import DrivenKeypoints
from mitsuba_avatar.ridge import ridge_prediction

MILLIMETRES = 1000.0  # in a metre
SMALLEST_DEVIATION = 0.01  # of an entry of z that a probe reads, relative to the largest one: noise is not blown up to unit size
ACTIVE_VARIANCE = 0.01  # of an entry's posterior mean over the frames; below it the entry says nothing (Burda et al., arXiv:1509.00519)

WIDTH, PAIRS, MISMATCHES, RATE = 128, 256, 2, 0.05  # of a fresh estimator: hidden features, mini-batch, shuffles of it, moving average
LEARNING_RATE = 1e-3
CHECK_EVERY = 25  # steps between looks at the validation frames
JUDGED_MISMATCHES = 32  # shuffles of the frames that an estimator is judged on
DECODED_AT_ONCE = 8  # frames
DRAWS = 4  # codes of every frame that its information is averaged over
BLOCK_FRAMES = 4  # of an estimator's train, stop and judge groups


@dataclass(frozen=True)
class LatentUse:
    """How much an encoder says: nats per frame, and how many entries of z say anything.

    Attributes:
        kl_nats: divergence of the posterior from the prior; it counts what a narrow or shifted posterior costs, whether or not it tells
            frames apart.
        frame_information_nats: mutual information between a drawn z and *which* of the frames it is of. An upper bound on what z tells of
            anything about these frames, their driving signals included; at most the logarithm of their number.
        active_entries: entries whose posterior mean varies between frames.
        offset_nats: part of the divergence that is paid because the mean of all posterior means is not zero. It tells nothing, and z = 0
            is as far from the codes as that mean is.
    """

    kl_nats: float
    frame_information_nats: float
    active_entries: int
    offset_nats: float


@dataclass(frozen=True)
class SwapDistances:
    """How far a swap of latent codes, or of driving signals, moves the surface from where it should be, mean in millimetres.

    Attributes:
        body_keypoints_mm: joints as the skin around them shows them.
        face_landmarks_mm: None where the face signal does not list landmarks.
        vertices_mm: name of a group of vertices ("all", "shirt") -> mean over it.
    """

    body_keypoints_mm: float
    face_landmarks_mm: float | None
    vertices_mm: dict[str, float]


def latent_use(posterior: Posterior, seed: int = 0) -> LatentUse:
    """What an encoder says about its frames, means over them.

    Args:
        posterior: of N frames.
        seed: of the codes drawn for `frame_information_nats`.
    """
    mu, logvar = posterior.mu.double(), posterior.logvar.double()
    nats = Posterior(mu, logvar).divergence().mean()
    active = (mu.var(0, correction=0) > ACTIVE_VARIANCE).sum()
    offset = mu.mean(0).square().sum() / 2
    return LatentUse(float(nats), _frame_information(mu, logvar, seed), int(active), float(offset))


def fresh_mutual_information(
    posterior: Posterior, driving: Float[Tensor, "N D"], block_frames: int = BLOCK_FRAMES, steps: int = 600, seed: int = 0
) -> float:
    """Mutual information between z ~ posterior and the driving signal, nats, by estimators trained from nothing.

    The frames are cut into short runs, dealt out in turn: one quarter of the runs judges, one decides when training stops, the rest trains;
    each quarter judges once, and the mean is reported. Judged on frames that it has not seen, the bound cannot be raised by memorising
    single frames, and it is low where frames are few. But a judge's neighbours in time are in the training runs: what is asked is what
    z tells about the driving signal among poses like those of training. (With runs of eighty frames of a capture whose takes move one limb
    each, the question becomes what one limb's take says about another's, and the answer was 0 for every code.)

    Args:
        posterior: of N frames in order of time; a fresh z is drawn from it at every step.
        driving: [N, D] standardised (`Avatar.standardized_driving`).
        block_frames: frames of a run.
        steps: of each of the four trainings.
        seed: of initial weights and draws.

    Raises:
        ValueError: fewer than four runs, or one of no frame.
    """
    count = len(driving)
    if block_frames < 1 or count < 4 * block_frames:
        raise ValueError(
            f"fresh_mutual_information(): expected block_frames of at least 1 and four runs of as many frames; got {block_frames} and "
            f"{count} frames. Use more frames or shorter runs."
        )
    quarter = (torch.arange(count) // block_frames) % 4
    bounds = []
    for judge in range(4):
        is_judge, is_stop = quarter == judge, quarter == (judge + 1) % 4
        groups = [torch.nonzero(group)[:, 0] for group in (~(is_judge | is_stop), is_stop, is_judge)]
        bounds.append(_judged_bound(posterior, driving, groups, steps, 4 * seed + judge))
    return max(float(np.mean(bounds)), 0.0)


def linear_probe(
    z: Float[np.ndarray, "N Z"],
    target: Float[np.ndarray, "N T"],
    held_out_z: Float[np.ndarray, "M Z"],
    held_out_target: Float[np.ndarray, "M T"],
) -> float:
    """How much of a state a ridge regression reads off z: R^2 on held-out frames; 1 all of it, 0 no more than the training mean.

    Args:
        z, target: of frames in order of time, N > 1.
        held_out_z, held_out_target: of frames that judge.

    Returns:
        1 - squared error / squared deviation of the held-out target from the training mean, over all its entries; can be negative.
        For a target that is what pose leaves over, this is the partial R^2 of z given the pose.

    Raises:
        ValueError: if the held-out target does not differ from the training mean.
    """
    mean, deviation, target_mean = z.mean(0), z.std(0), target.mean(0)
    deviation = np.maximum(deviation, SMALLEST_DEVIATION * max(float(deviation.max()), np.finfo(np.float64).tiny))
    codes, asked = (((rows - mean) / deviation).astype(np.float64) for rows in (z, held_out_z))
    total = float(np.square(held_out_target - target_mean).sum())
    if total == 0:
        raise ValueError("linear_probe(): expected held-out targets that differ from the training mean; got none. Choose other frames.")
    error = held_out_target - target_mean - ridge_prediction(codes, target - target_mean, asked)
    return 1 - float(np.square(error).sum()) / total


def other_frames(driving: Float[Tensor, "N D"], seed: int = 0, farther_than: float = 0.5) -> Int[Tensor, "N"]:
    """For each frame another one at random, whose driving signal is at least as far away as the share `farther_than` of all frames.

    Neighbours in time have nearly the same pose and code: swapping them would prove nothing.
    """
    distance = torch.cdist(driving.double(), driving.double())
    cut = torch.quantile(distance, farther_than, dim=1, keepdim=True)
    is_far = (distance >= cut) & ~torch.eye(len(driving), dtype=torch.bool)
    return torch.multinomial(is_far.double().cpu(), 1, generator=torch.Generator().manual_seed(seed))[:, 0]


def latent_swap(
    avatar: Avatar,
    keypoints: DrivenKeypoints,
    drive: DrivingSignals,
    z: Float[Tensor, "N Z"],
    other_z: Float[Tensor, "N Z"],
    vertex_groups: Mapping[str, Bool[np.ndarray, "V"]] | None = None,
) -> SwapDistances:
    """Same driving signal, other latent code: how far the surface moves.

    Keypoints should not move, since the driving signal fixes them; clothes should, since the latent code is theirs.

    Args:
        avatar: with a latent code.
        keypoints: of its rig.
        drive: N frames.
        z: their codes. other_z: codes of other frames, or draws from the prior.
        vertex_groups: masks to report apart from "all".
    """
    distances = []
    with torch.no_grad():
        for rows in _portions(len(z)):
            part = drive.chosen(range(*rows.indices(len(z))))
            both = [avatar.decode_rest_vertices(part.theta, part.face, codes[rows]) for codes in (z, other_z)]
            shown = [keypoints.from_surface(rest, part.theta, part.root) for rest in both]
            # A pose turns both surfaces alike but for blended joints: distances in rest space are those in the world.
            distances.append(((shown[1] - shown[0]).norm(dim=-1), (both[1] - both[0]).norm(dim=-1)))
    return _swap_distances(distances, keypoints, vertex_groups)


def drive_swap(
    avatar: Avatar,
    keypoints: DrivenKeypoints,
    other_drive: DrivingSignals,
    z: Float[Tensor, "N Z"],
    vertex_groups: Mapping[str, Bool[np.ndarray, "V"]] | None = None,
) -> SwapDistances:
    """Same latent code, other driving signal: how far the surface is from what that signal asks for.

    Keypoints are compared with those of the driving signal itself, vertices with the surface under the most likely code z = 0. A code that
    carries its own frame's pose drags both towards that pose.

    Args:
        avatar: with a latent code.
        keypoints: of its rig.
        other_drive: N frames.
        z: codes of N others (`other_frames`).
        vertex_groups: masks to report apart from "all".
    """
    distances = []
    with torch.no_grad():
        for rows in _portions(len(z)):
            part = other_drive.chosen(range(*rows.indices(len(z))))
            rest = avatar.decode_rest_vertices(part.theta, part.face, z[rows])
            neutral = avatar.decode_rest_vertices(part.theta, part.face, None)
            asked = keypoints.from_driving(part.theta, part.root, part.face)
            shown = keypoints.from_surface(rest, part.theta, part.root)
            distances.append(((shown - asked).norm(dim=-1), (rest - neutral).norm(dim=-1)))
    return _swap_distances(distances, keypoints, vertex_groups)


def _frame_information(mu: Float[Tensor, "N Z"], logvar: Float[Tensor, "N Z"], seed: int) -> float:
    """E[log q(z | frame) - log mean over frames of q(z | frame)], over draws of z."""
    generator = torch.Generator().manual_seed(seed)
    precision, total = (-logvar).exp(), 0.0
    for _ in range(DRAWS):
        z = mu + (0.5 * logvar).exp() * torch.randn(mu.shape, generator=generator, dtype=mu.dtype).to(mu.device)
        # Squared distances in each frame's own deviations, multiplied out: [N, N] without [N, N, Z] in between.
        squares = z.square() @ precision.T - 2 * z @ (mu * precision).T + (mu.square() * precision).sum(1)
        log_density = -0.5 * (squares + logvar.sum(1))  # [draw of frame i, density under frame j]
        total += float((log_density.diagonal() - torch.logsumexp(log_density, 1)).mean()) + math.log(len(mu))
    return total / DRAWS


def _judged_bound(posterior: Posterior, driving: Tensor, groups: list[Tensor], steps: int, seed: int) -> float:
    """The bound on the judging frames of an estimator that was trained, and stopped, on others."""
    train, stop, judge = groups
    generator = torch.Generator().manual_seed(seed)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = StatisticsNetwork(posterior.mu.shape[1], driving.shape[1], WIDTH)
    network.to(driving.device).standardize_by(_draw(posterior, train, generator), driving[train])
    optimizer = torch.optim.Adam(network.parameters(), lr=LEARNING_RATE, fused=True)
    mean_exp, best, judged = 1.0, 0.0, 0.0  # the untrained network's bound is 0, on every frame
    for step in range(1, steps + 1):
        rows = train[torch.randint(len(train), (min(PAIRS, len(train)),), generator=generator)]
        z = _draw(posterior, rows, generator)
        joint, product = network(z, driving[rows]), network(z[None], mismatched(driving[rows], MISMATCHES, generator))
        mean_exp = (1 - RATE) * mean_exp + RATE * float(product.detach().exp().mean())
        optimizer.zero_grad(set_to_none=True)
        (-corrected_objective(joint, product, mean_exp)).backward()
        optimizer.step()
        if step % CHECK_EVERY == 0:
            bound = _bound(network, posterior, driving, stop, generator)
            if bound > best:
                best, judged = bound, _bound(network, posterior, driving, judge, generator)
    return judged


def _bound(network: StatisticsNetwork, posterior: Posterior, driving: Tensor, rows: Tensor, generator: torch.Generator) -> float:
    with torch.no_grad():
        z = _draw(posterior, rows, generator)
        others = mismatched(driving[rows], min(JUDGED_MISMATCHES, len(rows) - 1), generator)
        return float(mutual_information_bound(network(z, driving[rows]), network(z[None], others)))


def _draw(posterior: Posterior, rows: Tensor, generator: torch.Generator) -> Tensor:
    """z of some frames."""
    mu, logvar = posterior.mu[rows], posterior.logvar[rows]
    return Posterior(mu, logvar).sample(torch.randn(mu.shape, generator=generator).to(mu))


def _portions(count: int) -> list[slice]:
    return [slice(start, start + DECODED_AT_ONCE) for start in range(0, count, DECODED_AT_ONCE)]


def _swap_distances(
    distances: list[tuple[Tensor, Tensor]], keypoints: DrivenKeypoints, vertex_groups: Mapping[str, np.ndarray] | None
) -> SwapDistances:
    """Means of (keypoint, vertex) distances in metres, by group."""
    of_keypoints = MILLIMETRES * torch.cat([pair[0] for pair in distances]).double()  # [N, K]
    of_vertices = MILLIMETRES * torch.cat([pair[1] for pair in distances]).double().mean(0)  # [V]
    groups = {name: torch.from_numpy(mask).to(of_vertices.device) for name, mask in (vertex_groups or {}).items()}
    return SwapDistances(
        body_keypoints_mm=float(of_keypoints[:, : keypoints.num_body].mean()),
        face_landmarks_mm=float(of_keypoints[:, keypoints.num_body :].mean()) if keypoints.with_face else None,
        vertices_mm={"all": float(of_vertices.mean())} | {name: float(of_vertices[mask].mean()) for name, mask in groups.items()},
    )
