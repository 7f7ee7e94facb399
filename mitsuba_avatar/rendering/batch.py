"""What one launch renders: meshes, textures and views as Dr.Jit holds them. Kernels of the renderer read it, none changes it."""

from dataclasses import dataclass

from mitsuba_avatar.rendering.scene import MeshScene
from mitsuba_avatar.rendering.surface_tables import SurfaceTables


@dataclass
class ViewBounds:
    """Where a batch's views can show anything.

    Attributes:
        tiles: [T] indices of pixel tiles among those of all films, row by row, view after view.
        depth_limit: [B] metres; nothing of a view's mesh lies farther away.
    """

    tiles: object
    depth_limit: object


@dataclass
class SurfaceBatch:
    """B views of P meshes.

    Attributes:
        scene: the merged meshes in scene coordinates, for rays.
        vertices: packets [P * V, 4], local coordinates in metres (see `views` for the frames).
        textures: packets [B * h * w, 4], linear radiance, one texture a view.
        views: flat table of camera rows (`views.place`).
        centers: packets [B, 4], local camera centres and the mesh index.
        texture_size: (h, w) texels.
        film: (width, height) pixels.
        seed, seed_gradient: opaque UInt32, decorrelated.
        bounds: filled once the vertices are projected.
    """

    scene: MeshScene
    tables: SurfaceTables
    vertices: object
    textures: object
    views: object
    centers: object
    num_views: int
    texture_size: tuple[int, int]
    film: tuple[int, int]
    samples_per_pixel: int
    seed: object
    seed_gradient: object
    bounds: ViewBounds | None = None

    @property
    def num_vertices(self) -> int:
        """V of one mesh."""
        return self.scene.num_vertices

    @property
    def num_pixels(self) -> int:
        """Pixels of all views together."""
        return self.num_views * self.film[0] * self.film[1]

    @property
    def num_texels(self) -> int:
        """Texels of all textures together."""
        return self.num_views * self.texture_size[0] * self.texture_size[1]
