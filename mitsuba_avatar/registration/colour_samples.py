"""What several cameras see of the same points of the registered mesh: the data that colour agreement is solved from.

A point counts for a camera where it faces it, nothing of the body is in front of it or just beside it, and the pixels around it lie
inside the mask and are neither clipped nor black. Colours of a point are averaged over a block of frames before views are compared:
what a mesh that is off by a pixel mixes into one frame averages out, and cannot pass for a difference between cameras.

Symbols: C cameras, P points on the surface, S samples; a sample is a point, seen by two cameras over a block of frames.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64, Int, Int64, UInt8
from torch import Tensor
from torch.nn import functional

from mitsuba_avatar.body.mesh import vertex_normals
from mitsuba_avatar.body.rig import Rig
from mitsuba_avatar.captures.cameras import Camera
from mitsuba_avatar.captures.colour import decode_bytes
from mitsuba_avatar.rendering.cameras import CameraBatch
from mitsuba_avatar.rendering.surface import SurfaceRenderer
from mitsuba_avatar.rendering.texture_projection import project

POINTS = 4000  # on the surface, spread evenly by area
BLOCKS = 5  # of frames that follow each other; one at a time is left out to measure by
LEAST_COSINE = 0.35  # of the angle between normal and view: flatter ones mirror the lights, and are off by pixels
BORDER = 0.006  # of the image's height, from a mask's border and from what hides a point
SOLID = 0.99  # coverage of a pixel that belongs to the person alone
WHITE_LEVEL, BLACK_LEVEL = 248, 4  # of 255; sensors clip, and codecs crush, beyond them
HIDING_FOOTPRINTS = 4.0  # pixels' widths on the surface that a point may lie behind what was drawn there
BESIDE_FOOTPRINTS = 12.0  # the same within BORDER around it
NOTHING = np.full(3, np.nan)
LEAST_WEIGHT = 0.5  # of a sample, in squared cosines summed over its frames


@dataclass(frozen=True, eq=False)
class SharedColours:
    """Points that two cameras saw.

    Attributes:
        cameras: C names.
        pair: [S, 2] indices of the two cameras.
        colours: [S, 2, 3] linear radiance that each recorded.
        weight: [S] squared cosine of the flatter view, summed over frames.
        block: [S] of frames, 0..BLOCKS-1.
        typical: [C, 3] linear radiance in the median over all that a camera saw of the person; NaN if it saw nothing.
    """

    cameras: tuple[str, ...]
    pair: Int64[np.ndarray, "S 2"]
    colours: Float64[np.ndarray, "S 2 3"]
    weight: Float64[np.ndarray, "S"]
    block: Int64[np.ndarray, "S"]
    typical: Float64[np.ndarray, "C 3"]

    def __len__(self) -> int:
        return len(self.weight)

    def where(self, chosen: Bool[np.ndarray, "S"]) -> "SharedColours":
        """Some of the samples."""
        return replace(self, pair=self.pair[chosen], colours=self.colours[chosen], weight=self.weight[chosen], block=self.block[chosen])


class ColourSampler:
    """Looks at points of the surface through all cameras, frame by frame.

    Args:
        rig: whose rest shape says how large faces are.
        cameras: undistorted, all of one size.
    """

    def __init__(self, rig: Rig, cameras: dict[str, Camera]):
        first = next(iter(cameras.values()))
        self.names, self.cameras = tuple(cameras), CameraBatch.from_cameras(list(cameras.values()))
        self.renderer = SurfaceRenderer(rig.topology, first.width, first.height)
        self.faces = torch.from_numpy(rig.topology.faces)
        corners = rig.rest_vertices[rig.topology.faces].astype(np.float64)
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        rng = np.random.default_rng(0)
        self.chosen = torch.from_numpy(rng.choice(len(area), POINTS, p=area / area.sum()))
        self.shares = torch.from_numpy(rng.dirichlet(np.ones(3), POINTS).astype(np.float32))
        self.border = max(1, round(BORDER * first.height))

    def look(
        self, vertices: Float[Tensor, "V 3"], images: UInt8[np.ndarray, "C H W 3"], masks: Float32[np.ndarray, "C H W"]
    ) -> tuple[Float32[np.ndarray, "C P 3"], Float32[np.ndarray, "C P"]]:
        """One frame: the linear radiance that cameras recorded of each point, and the cosine of its angle, 0 where it does not count."""
        corners = self.faces[self.chosen]
        points = (vertices[corners] * self.shares[..., None]).sum(1)
        normals = vertex_normals(vertices[None], self.faces)[0]
        normals = functional.normalize((normals[corners] * self.shares[..., None]).sum(1), dim=1)
        to_camera = functional.normalize(self.cameras.centers[:, None] - points, dim=2)
        cosine = (to_camera * normals).sum(2)
        pixels, depth = project(self.cameras, points)
        size = torch.tensor([images.shape[2], images.shape[1]])
        grid = (2 * pixels / size - 1)[:, None]
        usable, radiance = self._usable(images, masks)
        # Each usable pixel stands for the mean of the usable ones around it: half a pixel of misregistration is then no matter.
        spread = functional.avg_pool2d(torch.cat([radiance * usable, usable], dim=1), 3, stride=1, padding=1)
        colours = spread[:, :3] / spread[:, 3:].clamp(min=1e-6)
        sampled = functional.grid_sample(torch.cat([colours, usable], dim=1), grid, align_corners=False)[:, :, 0]
        counts = (cosine > LEAST_COSINE) & (depth > 0) & (sampled[:, 3] > SOLID) & self._is_in_sight(vertices, grid, depth)
        return sampled[:, :3].permute(0, 2, 1).numpy(), (cosine * counts).numpy()

    def _usable(
        self, images: UInt8[np.ndarray, "C H W 3"], masks: Float32[np.ndarray, "C H W"]
    ) -> tuple[Float[Tensor, "C 1 H W"], Float[Tensor, "C 3 H W"]]:
        """Pixels well inside the mask with no clipped one beside them, and linear radiance."""
        window = 2 * self.border + 1
        inside = -functional.max_pool2d(-torch.from_numpy(masks)[:, None], window, stride=1, padding=self.border) > SOLID
        clipped = torch.from_numpy((images.max(-1) >= WHITE_LEVEL) | (images.max(-1) <= BLACK_LEVEL))[:, None].float()
        near_clipped = functional.max_pool2d(clipped, 3, stride=1, padding=1) > 0
        radiance = torch.from_numpy(decode_bytes(images, "srgb")).permute(0, 3, 1, 2)
        return (inside & ~near_clipped).float(), radiance

    def _is_in_sight(
        self, vertices: Float[Tensor, "V 3"], grid: Float[Tensor, "C 1 P 2"], depth: Float[Tensor, "C P"]
    ) -> Bool[Tensor, "C P"]:
        """Whether nothing of the mesh lies before a point, nor close beside it and far before it: there the mesh may be off."""
        with torch.no_grad():
            layers = self.renderer.render_layers(vertices[None].contiguous(), torch.zeros(len(self.names), 3, 1, 1), self.cameras)
        drawn = torch.where(layers.mask > 0, layers.depth, 1e6)
        nearest = -functional.max_pool2d(-drawn, 2 * self.border + 1, stride=1, padding=self.border)
        found = functional.grid_sample(torch.cat([drawn, nearest], dim=1), grid, mode="nearest", align_corners=False)[:, :, 0]
        footprint = depth / self.cameras.intrinsics[:, :1]
        return (found[:, 0] > depth - HIDING_FOOTPRINTS * footprint) & (found[:, 1] > depth - BESIDE_FOOTPRINTS * footprint)


# Linear radiance [C, P, 3] and cosines [C, P] of a frame.
Look = Callable[[int], tuple[Float32[np.ndarray, "C P 3"], Float32[np.ndarray, "C P"]]]


def shared_colours(cameras: Sequence[str], frames: Sequence[int], look: Look, progress: Callable[[int, int], None]) -> SharedColours:
    """Samples of all pairs of cameras over blocks of frames.

    Args:
        cameras: C names.
        frames: in order; neighbours fall into the same block.
        look: `ColourSampler.look` of a frame.
        progress: called as progress(done, total).
    """
    pairs = list(combinations(range(len(cameras)), 2))
    blocks = _blocks(len(frames))
    parts, medians = [], []
    for block in range(blocks.max() + 1):
        sums = weights = None
        for done in np.flatnonzero(blocks == block).tolist():
            colours, cosine = look(frames[done])
            medians.append([_median(seen[angle > 0]) for seen, angle in zip(colours, cosine, strict=True)])
            if sums is None:
                sums, weights = np.zeros((len(pairs), 2, len(cosine[0]), 3)), np.zeros((len(pairs), len(cosine[0])))
            for index, pair in enumerate(pairs):
                weight = np.minimum(cosine[pair[0]], cosine[pair[1]]).astype(np.float64) ** 2
                weights[index] += weight
                sums[index] += weight[None, :, None] * colours[list(pair)]
            progress(done + 1, len(frames))
        for index, pair in enumerate(pairs):
            seen = weights[index] >= LEAST_WEIGHT
            mean = (sums[index][:, seen] / weights[index][seen][:, None]).transpose(1, 0, 2)
            parts.append((np.tile(np.array(pair), (int(seen.sum()), 1)), mean, weights[index][seen], np.full(int(seen.sum()), block)))
    pair, colours, weight, block = (np.concatenate(column) for column in zip(*parts, strict=True))
    seen = np.array(medians, np.float64)
    typical = np.stack([_median(seen[:, index]) for index in range(len(cameras))])
    return SharedColours(tuple(cameras), pair, colours, weight, block, typical)


def _median(values: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "3"]:
    """Median of the rows that hold values; NaN where none does."""
    known = values[np.isfinite(values[:, 0])]
    return np.median(known, axis=0) if len(known) else NOTHING


def _blocks(count: int) -> Int[np.ndarray, "N"]:
    """Block of each frame."""
    return np.arange(count) * min(BLOCKS, count) // count
