"""The stage in Mitsuba: the dome and what stands in it, built once; each frame moves the vertices and every camera takes an image.

What stands there comes in *layers* (the person, a garment, a headset), each a mesh with paint of its own. A layer's mesh is split at
texture seams, because Mitsuba interpolates texture coordinates per vertex; normals are computed on the welded mesh and copied, so that
shading crosses seams. (Differentiable rendering must not do this; filming takes no gradients.)
A scene is never rebuilt: rebuilding leaks memory (mitsuba3 issue 1890).
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np
import torch
from jaxtyping import Bool, Float, Float32

from mitsuba_avatar.body.mesh import vertex_normals
from mitsuba_avatar.body.rig import Topology
from mitsuba_avatar.body.split_mesh import split_at_seams
from mitsuba_avatar.captures.cameras import Camera
from mitsuba_avatar.filming.appearance import Appearance
from mitsuba_avatar.filming.exposure import Exposure, PendingImages, visible_pixels
from mitsuba_avatar.filming.settings import StudioSettings
from mitsuba_avatar.rendering.camera_rays import LARGEST_LAUNCH
from mitsuba_avatar.resources import find_resource

SPECULAR_SAMPLES = 0.12  # share of samples for the specular lobe; the default of a half doubles the noise of the diffuse one


@dataclass(frozen=True, eq=False)  # arrays have no truth value to compare by
class Layer:
    """One mesh on the stage.

    Attributes:
        name: unique on its stage; letters, digits and '_'.
        topology: triangles and texture atlas.
        appearance: textures over that atlas.
        is_two_sided: whether the inner side is seen and painted like the outer one; cloth is, closed surfaces need not be.
        hidden_faces: [F] faces left out of the images (skin under a garment that would poke through); None shows all. Normals are
            those of the whole mesh.
    """

    name: str
    topology: Topology
    appearance: Appearance
    is_two_sided: bool = False
    hidden_faces: Bool[np.ndarray, "F"] | None = None

    def __post_init__(self) -> None:
        count = len(self.topology.faces)
        if self.hidden_faces is not None and (len(self.hidden_faces) != count or self.hidden_faces.all()):
            raise ValueError(
                f"Layer(): hidden_faces of {self.name!r} must be one flag for each of {count} faces, not all set; got "
                f"{len(self.hidden_faces)} flags, {int(self.hidden_faces.sum())} set. Leave out a layer that is not seen at all."
            )


class Stage:
    """A Mitsuba scene with a person in it, seen by the cameras of a capture. Call `rendering.backend.select_variant` before."""

    def __init__(self, layers: Sequence[Layer], cameras: Sequence[Camera], settings: StudioSettings, together: int = 0):
        """Load the settings' scene file and put the layers into it.

        Args:
            layers: what is seen.
            cameras: of one size.
            settings: scene, light and samples.
            together: cameras of which one launch traces all; 0 for as many as memory allows, but half of them at most.

        Raises:
            FileNotFoundError: if there is no such scene.
            ValueError: if two layers have one name, or cameras differ in size or have distortion.
        """
        # Registers `split_path`. Here, because its base class exists only once a variant is chosen.
        import mitsuba_avatar.filming.path_integrator  # noqa: F401

        _check(layers, cameras)
        self.cameras = tuple(cameras)
        self._meshes = [_StagedMesh(layer) for layer in layers]
        file = find_resource("scenes", settings.light.scene, ".xml")
        parts = _parts_of(file, settings)
        self._has_objects = any(isinstance(part, mi.Shape) for part in parts.values())  # these may be anywhere in the image
        meshes = {mesh.layer.name: mesh.shape for mesh in self._meshes}
        self._exposure = Exposure(mi.load_dict({"type": "scene", **parts, **meshes}), settings.light.samples_per_pixel)
        self._parameters = mi.traverse(self._exposure.scene)
        self._together = together or _as_many_as_fit(self.cameras, self._exposure.samples)

    def shoot(
        self, vertices: Sequence[Float32[np.ndarray, "_ 3"]], seed: int, cameras: Sequence[int] | None = None
    ) -> tuple[Float32[np.ndarray, "C H W 3"], Float32[np.ndarray, "C H W"]]:
        """Path-trace one frame.

        Args:
            vertices: [V, 3] posed surface of each layer, in the layers' order, metres, world axes.
            seed: of the frame; another seed gives other noise. A camera's image depends on the seed and the camera's place among the
                stage's cameras alone: any frames, cameras and order of them, in any process, give the same bits.
            cameras: indices of the cameras to shoot; None means all.

        Returns:
            radiance [C, H, W, 3] linear, black where no layer is seen (premultiplied), and coverage by all layers [C, H, W] in 0..1.

        Raises:
            ValueError: if the vertices are not those of the layers.
        """
        chosen = range(len(self.cameras)) if cameras is None else cameras
        radiance, coverage = zip(*self.images(vertices, seed, chosen), strict=True)
        return np.stack(radiance), np.stack(coverage)

    def images(
        self, vertices: Sequence[Float32[np.ndarray, "_ 3"]], seed: int, cameras: Sequence[int]
    ) -> Iterator[tuple[Float32[np.ndarray, "H W 3"], Float32[np.ndarray, "H W"]]]:
        """Radiance and coverage camera by camera, as `shoot` returns them together: at the paper's size, all of a frame fill a memory.

        Cameras are traced in groups of neighbours, whole groups always, or an image's bits would depend on which others are asked for.
        One group is traced while the caller sees to the one before; the stage is busy until the last image was taken.
        """
        self._move(vertices)
        groups = [index // self._together for index in cameras]
        order, left = list(dict.fromkeys(groups)), Counter(groups)
        begun: dict[int, PendingImages] = {}
        made: dict[int, Float32[np.ndarray, "c H W 4"]] = {}
        for index, group in zip(cameras, groups, strict=True):
            if group not in made:
                # One group is traced while Python prepares the next; more at once would only need memory.
                for other in order[order.index(group) :][:2]:
                    if other not in begun:
                        begun[other] = self._begin(other, vertices, seed)
                made[group] = begun[group].finish()
            yield _parted(made[group][index - group * self._together])
            left[group] -= 1
            if not left[group]:
                del made[group], begun[group]

    def _begin(self, group: int, vertices: Sequence[np.ndarray], seed: int) -> PendingImages:
        """Start tracing the images of a group of cameras."""
        places = range(group * self._together, min((group + 1) * self._together, len(self.cameras)))
        pixels = np.stack([self._pixels(place, vertices) for place in places])
        return self._exposure.begin([self.cameras[place] for place in places], pixels, (seed, group))

    def _move(self, vertices: Sequence[np.ndarray]) -> None:
        """Carry every mesh to its place in a frame."""
        expected = [mesh.layer.topology.num_vertices for mesh in self._meshes]
        if [len(surface) for surface in vertices] != expected:
            raise ValueError(
                f"shoot(): expected vertices of {len(expected)} layers, {expected} of them; got {[len(surface) for surface in vertices]}. "
                "Give the layers' surfaces in the order of the layers."
            )
        for mesh, surface in zip(self._meshes, vertices, strict=True):
            normals = vertex_normals(torch.from_numpy(surface)[None], mesh.welded_faces)[0].numpy()
            self._parameters[f"{mesh.layer.name}.vertex_positions"] = surface[mesh.welded].ravel()
            self._parameters[f"{mesh.layer.name}.vertex_normals"] = normals[mesh.welded].ravel()
        self._parameters.update()

    def _pixels(self, index: int, vertices: Sequence[np.ndarray]) -> Bool[np.ndarray, "H W"]:
        """Pixels that may see something."""
        camera = self.cameras[index]
        if self._has_objects:
            return np.ones((camera.height, camera.width), dtype=bool)
        pixels = np.zeros((camera.height, camera.width), dtype=bool)
        for mesh, surface in zip(self._meshes, vertices, strict=True):
            pixels |= visible_pixels(camera, surface, mesh.shown_faces)
        return pixels


class _StagedMesh:
    """A layer as a Mitsuba mesh, split at seams, without positions yet.

    Attributes:
        layer: what it shows.
        welded: [S] welded vertex of each split one.
        welded_faces: all faces, for normals; shown_faces: [F', 3] the visible ones.
        shape: Mitsuba's mesh.
    """

    def __init__(self, layer: Layer):
        topology = layer.topology
        shown = np.ones(len(topology.faces), dtype=bool) if layer.hidden_faces is None else ~layer.hidden_faces
        split = split_at_seams(topology, shown)
        self.layer = layer
        self.welded = split.welded
        self.welded_faces = torch.from_numpy(topology.faces)
        self.shown_faces = topology.faces[shown]

        properties = mi.Properties()
        properties["bsdf"] = mi.load_dict(_surface(layer))
        mesh = mi.Mesh(layer.name, len(split.uv), len(split.faces), has_vertex_normals=True, has_vertex_texcoords=True, props=properties)
        parameters = mi.traverse(mesh)
        parameters["faces"] = split.faces.astype(np.uint32).ravel()
        parameters["vertex_texcoords"] = split.image_uv.ravel()
        parameters.update()
        self.shape = mesh


def _as_many_as_fit(cameras: Sequence[Camera], samples: int) -> int:
    """Cameras of a group: all their pixels fit into a launch; two groups at least, so that one is traced while Python prepares another."""
    count = max(1, LARGEST_LAUNCH // (cameras[0].width * cameras[0].height * samples))
    groups = max(2, -(-len(cameras) // count))
    return -(-len(cameras) // groups)


def _parted(image: Float32[np.ndarray, "H W 4"]) -> tuple[Float32[np.ndarray, "H W 3"], Float32[np.ndarray, "H W"]]:
    """Radiance and coverage."""
    return np.ascontiguousarray(image[..., :3]), np.ascontiguousarray(image[..., 3])


def _check(layers: Sequence[Layer], cameras: Sequence[Camera]) -> None:
    """Layers must be told apart, images stacked."""
    names = [layer.name for layer in layers]
    if not names or len(set(names)) != len(names):
        raise ValueError(f"Stage(): expected layers of different names; got {names}. Rename one.")
    width, height = cameras[0].width, cameras[0].height
    if any((camera.width, camera.height) != (width, height) or camera.is_distorted for camera in cameras):
        raise ValueError(
            "Stage(): expected cameras of one size and without distortion; got others. Give all cameras the size of the first."
        )


def _parts_of(file: Path, settings: StudioSettings) -> dict[str, object]:
    """Integrator, objects and lights of an XML scene, by invented names."""
    # Mitsuba refuses parameters that a file does not declare.
    known = {"max_depth": str(settings.light.max_depth), "splits": str(settings.light.light_samples)}
    text = file.read_text(encoding="utf-8")
    given = {name: value for name, value in known.items() if f"${name}" in text}
    scene = mi.load_file(str(file), **given)
    parts: dict[str, object] = {f"object_{index}": shape for index, shape in enumerate(scene.shapes())}
    # A lamp that is a surface comes with its shape.
    parts |= {f"emitter_{index}": emitter for index, emitter in enumerate(scene.emitters()) if emitter.get_shape() is None}
    return parts | {"integrator": scene.integrator()}


def _surface(layer: Layer) -> dict[str, object]:
    """How a layer scatters light."""

    def texture(pixels: Float[np.ndarray, "S S C"]) -> dict[str, object]:
        return {"type": "bitmap", "bitmap": mi.Bitmap(np.ascontiguousarray(pixels)), "raw": True, "wrap_mode": "clamp"}

    principled = {
        "type": "principled",
        "base_color": texture(layer.appearance.base_colour),
        "roughness": texture(layer.appearance.roughness[..., None]),
        "specular": layer.appearance.specular,
        "main_specular_sampling_rate": SPECULAR_SAMPLES,
    }
    return {"type": "twosided", "bsdf": principled} if layer.is_two_sided else principled
