"""The texture atlas: which point of the surface a texel shows, and values carried between vertices and texels.

This module owns the orientation of textures. Texel (row i, column j) of an H x W texture has its centre at

    u = (j + 0.5) / W,    v = 1 - (i + 0.5) / H

so row 0 is the top of the image and v = 1 (OBJ orientation). Continuous texel coordinates are (row, column) with integers at
texel *centres*. Texels are square cells of the unit square; an atlas has as many rows as columns, a map may have any size.

Seams: a welded vertex on a seam has several texture coordinates (copies). Texels whose centre lies outside every chart are *empty*;
bilinear lookups near a chart's border read them, therefore they are filled: from the nearest triangle, continued linearly, where
vertex values are known, from the nearest covered texel otherwise (`inpaint`).
"""

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.ndimage import distance_transform_edt
from torch import Tensor, nn

from mitsuba_avatar.body.rig import Topology
from mitsuba_avatar.body.sparse import SparseLinear

GUTTER = 1.5  # texels around a chart that are continued linearly: a bilinear lookup on the border reaches sqrt(2)
LARGEST_EXTRAPOLATION = 1.0  # barycentric units; slivers would otherwise turn a texel's step into metres
COVER_TOLERANCE = 1e-7  # texels; a centre on a shared edge belongs to a triangle despite rounding
FACES_AT_ONCE = 4096  # bounds the memory of rasterisation


def texel_of_uv(uv: Float[np.ndarray, "N 2"], height: int, width: int) -> Float[np.ndarray, "N 2"]:
    """Continuous (row, column) of texture coordinates; whole numbers are texel centres."""
    return np.stack([(1 - uv[:, 1]) * height - 0.5, uv[:, 0] * width - 0.5], axis=1)


def uv_of_texel(texel: Float[np.ndarray, "N 2"], height: int, width: int) -> Float[np.ndarray, "N 2"]:
    """Texture coordinates of continuous (row, column); the inverse of `texel_of_uv`."""
    return np.stack([(texel[:, 1] + 0.5) / width, 1 - (texel[:, 0] + 0.5) / height], axis=1)


class UvAtlas(nn.Module):
    """A topology's atlas at one resolution, S x S texels.

    Buffers:
        face_index: [S, S] triangle under the texel's centre, -1 where empty.
        barycentric: [S, S, 3] of the centre in that triangle, 0 where empty.
        covered: [S, S] True where not empty.

    Raises:
        ValueError: if the atlas leaves every texel empty.
    """

    def __init__(self, topology: Topology, size: int):
        super().__init__()
        self.size, self.num_vertices = size, topology.num_vertices
        face, barycentric, distance = _rasterise(topology, size)
        covered = distance <= COVER_TOLERANCE
        if not covered.any():
            raise ValueError(f"UvAtlas(): expected charts under some of {size}x{size} texel centres; got none. Use a larger size.")
        nearest = np.stack(distance_transform_edt(~covered, return_distances=False, return_indices=True))  # [2, S, S]
        nearest_flat = nearest[0] * size + nearest[1]
        source = np.where(distance <= GUTTER, np.arange(size * size).reshape(size, size), nearest_flat)
        corners = topology.faces[face.reshape(-1)[source.reshape(-1)]]  # [S * S, 3]
        weights = barycentric.reshape(-1, 3)[source.reshape(-1)]
        texels = np.repeat(np.arange(size * size), 3)
        self.texel_matrix = SparseLinear(texels, corners.reshape(-1), weights.reshape(-1), (size * size, topology.num_vertices))

        pairs = np.unique(np.stack([topology.faces.reshape(-1), topology.uv_faces.reshape(-1)], axis=1), axis=0)  # [P, 2] vertex, uv
        copies = np.bincount(pairs[:, 0], minlength=topology.num_vertices)
        average = 1.0 / copies[pairs[:, 0]]
        self.copy_matrix = SparseLinear(pairs[:, 0], np.arange(len(pairs)), average, (topology.num_vertices, len(pairs)))
        # grid_sample's coordinates: -1..1 across the image, x along columns, y along rows from the top.
        uv = topology.uv[pairs[:, 1]]
        grid = np.stack([2 * uv[:, 0] - 1, 1 - 2 * uv[:, 1]], axis=-1).astype(np.float32)

        self.register_buffer("copy_grid", torch.from_numpy(grid), persistent=False)
        self.register_buffer("face_index", torch.from_numpy(np.where(covered, face, -1)), persistent=False)
        shown = np.where(covered[..., None], barycentric, 0).astype(np.float32)
        self.register_buffer("barycentric", torch.from_numpy(shown), persistent=False)
        self.register_buffer("covered", torch.from_numpy(covered), persistent=False)
        self.register_buffer("empty_texels", torch.from_numpy(np.flatnonzero(~covered)), persistent=False)
        self.register_buffer("nearest_covered", torch.from_numpy(nearest_flat.reshape(-1)[~covered.reshape(-1)]), persistent=False)

    def texels_from_vertices(self, values: Float[Tensor, "B V C"]) -> Float[Tensor, "B C S S"]:
        """Interpolate vertex values at every texel's centre, barycentric; empty texels are filled (see the module).

        Gradients: flow to values.

        Raises:
            ValueError: if the vertex count is not the topology's.
        """
        batch, count, channels = values.shape
        if count != self.num_vertices:
            raise ValueError(
                f"texels_from_vertices(): values must be [B, {self.num_vertices}, C] for this atlas; got {list(values.shape)}. "
                "Use the mesh of the atlas's topology."
            )
        texels = self.texel_matrix(values.transpose(0, 1).reshape(count, batch * channels))
        return texels.t().reshape(batch, channels, self.size, self.size)

    def vertices_from_texels(self, maps: Float[Tensor, "B C H W"]) -> Float[Tensor, "B V C"]:
        """Look maps up at every vertex, bilinear, averaged over the vertex's copies at seams. Vertices of no triangle get zero.

        Maps of any size; fill empty texels first (`inpaint`) where a map means nothing outside the charts.

        Gradients: flow to maps.
        """
        batch, channels = maps.shape[:2]
        grid = self.copy_grid.to(maps.dtype).expand(batch, 1, -1, 2)
        sampled = torch.nn.functional.grid_sample(maps, grid, mode="bilinear", padding_mode="border", align_corners=False)
        values = self.copy_matrix(sampled.reshape(batch * channels, -1).t())  # [V, B * C]
        return values.reshape(-1, batch, channels).transpose(0, 1)

    def inpaint(self, maps: Float[Tensor, "B C S S"]) -> Float[Tensor, "B C S S"]:
        """Copy the nearest covered texel into every empty one.

        Gradients: flow to maps at covered texels; what empty texels held is dropped.

        Raises:
            ValueError: if the map is not of the atlas's size.
        """
        if maps.shape[-1] != self.size or maps.shape[-2] != self.size:
            raise ValueError(
                f"inpaint(): maps must be [B, C, {self.size}, {self.size}] for this atlas; got {list(maps.shape)}. "
                "Build a UvAtlas of that size."
            )
        flat = maps.flatten(2)
        return flat.index_copy(2, self.empty_texels, flat[:, :, self.nearest_covered]).reshape(maps.shape)


def _rasterise(topology: Topology, size: int) -> tuple[Int[np.ndarray, "S S"], Float[np.ndarray, "S S 3"], Float[np.ndarray, "S S"]]:
    """Nearest triangle of every texel centre: its index, barycentric coordinates and distance in texels (0 inside, inf if far).

    Every triangle is tried on the texels of its bounding box, widened by the gutter; the nearest wins, then the lowest index.
    """
    corners = texel_of_uv(topology.uv.astype(np.float64), size, size)[topology.uv_faces]  # [F, 3, 2] row, column
    best_distance = np.full(size * size, np.inf)
    best_face = np.zeros(size * size, dtype=np.int64)
    best_barycentric = np.zeros((size * size, 3))
    for start in range(0, len(corners), FACES_AT_ONCE):
        chunk = corners[start : start + FACES_AT_ONCE]
        face, texel = _candidate_texels(chunk, size)
        if not len(face):
            continue
        centre = np.stack([texel // size, texel % size], axis=1).astype(np.float64)
        barycentric, distance = _locate(centre, chunk[face])
        order = np.lexsort((face, distance, texel))
        first = order[np.unique(texel[order], return_index=True)[1]]
        first = first[distance[first] < best_distance[texel[first]]]
        best_distance[texel[first]] = distance[first]
        best_face[texel[first]] = face[first] + start
        best_barycentric[texel[first]] = barycentric[first]
    best_distance[best_distance > GUTTER] = np.inf
    return best_face.reshape(size, size), best_barycentric.reshape(size, size, 3), best_distance.reshape(size, size)


def _candidate_texels(corners: Float[np.ndarray, "F 3 2"], size: int) -> tuple[Int[np.ndarray, "P"], Int[np.ndarray, "P"]]:
    """All pairs (triangle, flat texel) where the texel lies in the triangle's bounding box widened by the gutter."""
    low = np.clip(np.ceil(corners.min(axis=1) - GUTTER), 0, size).astype(np.int64)  # [F, 2]
    high = np.clip(np.floor(corners.max(axis=1) + GUTTER) + 1, 0, size).astype(np.int64)
    rows, columns = np.maximum(high - low, 0).T
    counts = rows * columns
    face = np.repeat(np.arange(len(corners)), counts)
    within = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    row = low[face, 0] + within // columns[face]
    column = low[face, 1] + within % columns[face]
    return face, row * size + column


def _locate(
    points: Float[np.ndarray, "P 2"], corners: Float[np.ndarray, "P 3 2"]
) -> tuple[Float[np.ndarray, "P 3"], Float[np.ndarray, "P"]]:
    """Barycentric coordinates of each point in its triangle, and its distance to the triangle (0 inside).

    Outside, coordinates continue linearly; beyond `LARGEST_EXTRAPOLATION` they are those of the nearest point of the triangle.
    A triangle without area is infinitely far.
    """
    edges = np.roll(corners, -1, axis=1) - corners  # edge k from corner k to k + 1
    offsets = points[:, None, :] - corners
    area = edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]
    flat = np.abs(area) < 1e-12
    area = np.where(flat, 1.0, area)
    opposite = (edges[..., 0] * offsets[..., 1] - edges[..., 1] * offsets[..., 0]) / area[:, None]  # weight of the corner facing edge k
    barycentric = np.roll(opposite, -1, axis=1)  # edge k faces corner k + 2

    squared = np.maximum((edges**2).sum(-1), 1e-24)
    along = np.clip((offsets * edges).sum(-1) / squared, 0, 1)  # nearest point of each edge
    gaps = np.linalg.norm(offsets - along[..., None] * edges, axis=-1)
    nearest = gaps.argmin(axis=1)
    pick = np.arange(len(points))
    distance = np.where((barycentric >= 0).all(axis=1), 0.0, gaps[pick, nearest])
    clamped = np.zeros_like(barycentric)
    clamped[pick, nearest] = 1 - along[pick, nearest]
    clamped[pick, (nearest + 1) % 3] = along[pick, nearest]
    barycentric = np.where((barycentric < -LARGEST_EXTRAPOLATION).any(axis=1)[:, None], clamped, barycentric)
    return barycentric, np.where(flat, np.inf, distance)
