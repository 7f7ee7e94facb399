"""Registration refined by inverse rendering: silhouettes of the body, drawn by the project's own renderer, are brought onto the masks.

First root, pose and shape, on images of half the size, whose gradients reach farther; then smooth offsets of the vertices at full size:
one that all frames share (clothing, the person's own shape) and a small one for each frame. Keypoints and priors hold throughout.
The paper registers to scans (arXiv:2105.10441, section 4.1); here masks stand in for them.

Symbols: N frames, M of them in a step, C cameras, V vertices. Metres, pixels of the capture.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int
from torch import Tensor

from mitsuba_avatar.body.anny_rig import build_anny_rig
from mitsuba_avatar.body.rig import Rig, Topology
from mitsuba_avatar.captures.cameras import Camera
from mitsuba_avatar.registration.body_sequence import BodySequence
from mitsuba_avatar.registration.body_shape import PARAMETERS, AnnyShapes, ShapeTangent, frozen_shape
from mitsuba_avatar.registration.keypoint_fit import FittedBody, KeypointEnergy, fitted_body
from mitsuba_avatar.registration.settings import BodySettings, RefinementSettings
from mitsuba_avatar.registration.smooth_offsets import SmoothOffsets, UniformAdam
from mitsuba_avatar.rendering.cameras import CameraBatch
from mitsuba_avatar.rendering.surface import SurfaceRenderer

POSE_SCALE = 0.5  # of the images, while root and pose are sought
BLUR = 8  # pixels over which silhouettes are also compared, so that limbs beside their mask are drawn towards it
FEWEST_PIXELS = 40.0  # of a mask: views that see less of the person count as if they saw that much
OFFSET_WEIGHT = 0.03  # of offsets of one standard deviation everywhere, beside the share of wrong pixels
MEASURING_SAMPLES = 9  # a pixel: with one, jitter alone costs several per cent of overlap on small images
POSE_SHARE = 0.3  # of the pose's learning rate, while offsets move too

# Coverage [C, H, W] of a frame by the cameras of a problem, in their order.
MaskReader = Callable[[int], Float32[np.ndarray, "C H W"]]


@dataclass(frozen=True, eq=False)
class RegisteredBody:
    """A body on its masks: pose and shape, and what the phenotype cannot express.

    Attributes:
        fitted: phenotype, pose, root, landmark offsets.
        shared_offset: [V, 3] metres, at rest, of all frames.
        frame_offsets: [N, V, 3] the same of each frame.
    """

    fitted: FittedBody
    shared_offset: Float32[np.ndarray, "V 3"]
    frame_offsets: Float32[np.ndarray, "N V 3"]

    def rig(self) -> Rig:
        """The person's own rig: Anny at the phenotype, with the shared offset in its rest shape."""
        rig = build_anny_rig(self.fitted.phenotype)
        return replace(rig, rest_vertices=rig.rest_vertices + self.shared_offset)


class SilhouetteProblem:
    """Masks of some cameras, and how far a body's silhouettes are from them.

    Args:
        topology: of the body.
        cameras: that are compared, undistorted, all of one size.
        masks: coverage by those cameras, at their size.
        scale: of the images that are compared; 1 or a half.
    """

    def __init__(self, topology: Topology, cameras: Mapping[str, Camera], masks: MaskReader, scale: float = 1.0):
        scaled = [camera.resized(scale) for camera in cameras.values()]
        self.num_cameras, self.masks = len(scaled), masks
        self.size = (scaled[0].height, scaled[0].width)
        self.cameras = CameraBatch.from_cameras(scaled)
        self.renderer = SurfaceRenderer(topology, scaled[0].width, scaled[0].height)
        self._fine: SurfaceRenderer | None = None
        self._seed = 0

    def silhouettes(self, vertices: Float[Tensor, "M V 3"]) -> Float[Tensor, "M C H W"]:
        """Coverage by the body, with the noise of one sample a pixel. Gradients: to vertices."""
        return self._draw(self.renderer, vertices)

    def covered(self, vertices: Float[Tensor, "M V 3"]) -> Bool[Tensor, "M C H W"]:
        """Pixels that the body covers by more than half, from enough samples to measure by."""
        if self._fine is None:
            self._fine = SurfaceRenderer(self.renderer.topology, self.size[1], self.size[0], samples_per_pixel=MEASURING_SAMPLES)
        with torch.no_grad():
            return self._draw(self._fine, vertices) > 0.5

    def _draw(self, renderer: SurfaceRenderer, vertices: Float[Tensor, "M V 3"]) -> Float[Tensor, "M C H W"]:
        count = len(vertices) * self.num_cameras
        cameras = CameraBatch(self.cameras.intrinsics.repeat(len(vertices), 1), self.cameras.camera_from_world.repeat(len(vertices), 1, 1))
        self._seed += 1
        _, mask = renderer.render(vertices.contiguous(), torch.zeros(count, 3, 1, 1), cameras, seed=self._seed)
        return mask.view(len(vertices), self.num_cameras, *self.size)

    def targets(self, frames: list[int]) -> Float[Tensor, "M C H W"]:
        """Masks of frames at the compared size."""
        masks = torch.from_numpy(np.stack([self.masks(frame) for frame in frames]))
        return masks if masks.shape[2:] == self.size else torch.nn.functional.interpolate(masks, size=self.size, mode="area")

    def loss(self, vertices: Float[Tensor, "M V 3"], frames: list[int]) -> Tensor:
        """Squared difference of coverage per pixel of the person, sharp plus blurred, mean over views. Gradients: to vertices."""
        drawn, wanted = self.silhouettes(vertices), self.targets(frames)
        pixels = wanted.sum(dim=(2, 3)).clamp(min=FEWEST_PIXELS)
        sharp = (drawn - wanted).square().sum(dim=(2, 3))
        blurred = torch.nn.functional.avg_pool2d(drawn - wanted, BLUR, stride=BLUR // 2).square().sum(dim=(2, 3)) * (BLUR // 2) ** 2
        return ((sharp + blurred) / pixels).mean()

    def overlaps(self, vertices: Float[Tensor, "M V 3"], frames: list[int]) -> Float32[np.ndarray, "M C"]:
        """Intersection over union of silhouettes and masks; NaN where neither shows anything."""
        drawn, wanted = self.covered(vertices), self.targets(frames) > 0.5
        both, either = (drawn & wanted).sum(dim=(2, 3)), (drawn | wanted).sum(dim=(2, 3))
        return torch.where(either > 0, both / either, torch.nan).numpy()


def refine_pose(
    fitted: FittedBody,
    problem: SilhouetteProblem,
    energy: KeypointEnergy,
    settings: RefinementSettings,
    body: BodySettings,
    progress: Callable[[int, int], None],
) -> FittedBody:
    """Root, pose and phenotype by silhouettes and keypoints; everything else as fitted."""
    sequence = sequence_of(fitted, AnnyShapes().tangent(fitted.phenotype))
    rate = settings.learning_rate
    optimizer = torch.optim.Adam([*_groups(sequence, rate), {"params": [sequence.shape, sequence.landmark_offsets], "lr": 0.1 * rate}])
    batches = _shuffled(len(fitted.theta), settings.frames_per_step, settings.passes)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, len(batches), eta_min=0.05 * rate)
    is_fixed = torch.tensor([name in body.fixed for name in PARAMETERS])
    for step, frames in enumerate(batches):
        optimizer.zero_grad()
        vertices, joints = sequence.rest()
        transforms = sequence.transforms(joints)
        landmarks = sequence.landmarks(vertices, joints, transforms)
        posed = sequence.posed(vertices.expand(len(frames), -1, -1), transforms[frames])
        silhouette = settings.silhouette_weight * problem.loss(posed, frames)
        (energy.data(landmarks) + energy.priors(sequence, landmarks) + silhouette).backward()
        sequence.shape.grad[is_fixed] = 0
        optimizer.step()
        schedule.step()
        sequence.project_to_limits()
        progress(step + 1, len(batches))
    return fitted_body(sequence)


def refine_offsets(
    start: RegisteredBody,
    problem: SilhouetteProblem,
    energy: KeypointEnergy,
    settings: RefinementSettings,
    progress: Callable[[int, int], None],
) -> RegisteredBody:
    """Smooth offsets of the vertices, shared and of each frame, with pose and root still free; the phenotype stays."""
    fitted, rig = start.fitted, build_anny_rig(start.fitted.phenotype)
    sequence = sequence_of(fitted)
    smooth = SmoothOffsets(rig.rest_vertices, rig.topology.faces, settings.smoothness)
    shared = torch.zeros(1, rig.topology.num_vertices, 3, requires_grad=True)
    own = torch.zeros(len(fitted.theta), rig.topology.num_vertices, 3, requires_grad=True)
    before = torch.from_numpy(start.shared_offset)
    optimizer = torch.optim.Adam(_groups(sequence, POSE_SHARE * settings.learning_rate))
    movers = [UniformAdam(shared, settings.offset_learning_rate), UniformAdam(own, settings.offset_learning_rate)]
    batches = _windows(len(fitted.theta), settings.frames_per_step, settings.offset_passes)
    for step, frames in enumerate(batches):
        optimizer.zero_grad()
        vertices, joints = sequence.rest()
        transforms = sequence.transforms(joints)
        landmarks = sequence.landmarks(vertices, joints, transforms)
        common, single = before + smooth(shared)[0], smooth(own[frames])
        posed = sequence.posed(vertices + common + single, transforms[frames])
        bound = (common / settings.offset_deviation).square().mean() + (single / settings.frame_offset_deviation).square().mean()
        jumps = (single[1:] - single[:-1]) / settings.frame_offset_deviation if len(frames) > 1 else single.new_zeros(1)
        silhouette = settings.silhouette_weight * (problem.loss(posed, frames) + OFFSET_WEIGHT * (bound + 4 * jumps.square().mean()))
        (energy.data(landmarks) + energy.priors(sequence, landmarks) + silhouette).backward()
        optimizer.step()
        factor = 0.5 * (1 + float(np.cos(np.pi * step / len(batches))))
        for mover in movers:
            mover.step(factor)
        sequence.project_to_limits()
        progress(step + 1, len(batches))
    with torch.no_grad():
        offsets = [smooth.solve(own[index : index + 1])[0].numpy() for index in range(len(own))]
        common = before + smooth.solve(shared)[0]
    return RegisteredBody(fitted_body(sequence), common.numpy(), np.stack(offsets))


def sequence_of(fitted: FittedBody, tangent: ShapeTangent | None = None) -> BodySequence:
    """The unknowns, standing where a fit ended; without a tangent the phenotype cannot change."""
    rig = build_anny_rig(fitted.phenotype)
    sequence = BodySequence(rig, tangent or frozen_shape(rig, fitted.phenotype), fitted.theta, fitted.root)
    sequence.landmark_offsets.data.copy_(torch.from_numpy(fitted.landmark_offsets))
    return sequence


def posed_vertices(body: RegisteredBody, sequence: BodySequence, frames: list[int] | Int[np.ndarray, "M"]) -> Float32[Tensor, "M V 3"]:
    """The registered mesh of some frames, metres; `sequence` is `sequence_of(body.fitted)`."""
    with torch.no_grad():
        vertices, joints = sequence.rest()
        chosen = torch.as_tensor(frames)
        rest = vertices + torch.from_numpy(body.shared_offset + body.frame_offsets[np.asarray(frames)])
        return sequence.posed(rest, sequence.transforms(joints, chosen))


def _groups(sequence: BodySequence, rate: float) -> list[dict]:
    return [{"params": [sequence.theta, sequence.turn], "lr": rate}, {"params": [sequence.place], "lr": 0.3 * rate}]


def _shuffled(count: int, size: int, passes: int) -> list[list[int]]:
    """Batches of frames that together are so many passes, in an order of chance that is the same every time."""
    generator = np.random.default_rng(0)
    batches = []
    for _ in range(passes):
        order = generator.permutation(count).tolist()
        batches += [order[start : start + size] for start in range(0, count, size)]
    return batches


def _windows(count: int, size: int, passes: int) -> list[list[int]]:
    """The same with consecutive frames, whose offsets can be compared."""
    generator = np.random.default_rng(1)
    batches = []
    for _ in range(passes):
        first = int(generator.integers(size))
        windows = [list(range(max(0, start), min(count, start + size))) for start in range(first - size, count, size)]
        windows = [window for window in windows if window]
        batches += [windows[index] for index in generator.permutation(len(windows))]
    return batches
