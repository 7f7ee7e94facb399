"""An avatar's surface in a Mitsuba scene of the user's: lamps and objects come from an XML file, the person is put among them.

What the surface does with light is one of two things:

- `baked`: it *emits* its texture, the radiance that cameras saw, and reflects nothing. It looks as it was captured, whatever the scene's
  lamps do; it shines on the objects around it and stands in the way of their light. The texture is that of one camera, also for light
  that leaves towards objects.
- `relit`: it reflects diffusely, its texture is albedo, and the scene's lamps light it. Gloss is not modelled.

The mesh is split at texture seams, because Mitsuba interpolates texture coordinates per vertex; normals come from the welded mesh, so
that shading crosses seams. The scene is built once and updated (rebuilding one leaks memory). An integrator that the file names is
left aside: `rendering.path_tracing` brings its own.
"""

import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mitsuba_avatar.body.mesh import vertex_normals
from mitsuba_avatar.body.rig import Topology
from mitsuba_avatar.body.split_mesh import split_at_seams
from mitsuba_avatar.rendering.backend import loaded_mitsuba

Light = Literal["baked", "relit"]
_TEXTURE_KEYS = {"baked": "avatar.emitter.radiance.data", "relit": "avatar.bsdf.brdf_0.reflectance.data"}
_LEFT_ASIDE = ("integrator", "sensor")


class LitScene:
    """Lamps and objects of a scene file around one topology.

    Args:
        file: Mitsuba scene, XML, world Z up, metres.
        topology: of the avatar.
        texture_size: texels of the sides of the texture.
        light: "baked" or "relit", see the module.

    Attributes:
        scene, avatar: Mitsuba's scene and the mesh in it; has_objects: whether the file brings shapes, which may be anywhere in a picture.

    Raises:
        ValueError: the file is no Mitsuba scene, or relighting is asked of a scene without a lamp.
    """

    def __init__(self, file: Path, topology: Topology, texture_size: int, light: Light):
        mi = loaded_mitsuba()
        self.topology, self.light = topology, light
        loaded = load_scene_parts(file)
        shapes = {f"object_{i}": shape for i, shape in enumerate(loaded.shapes())}
        lamps = {f"lamp_{i}": lamp for i, lamp in enumerate(loaded.emitters()) if lamp.get_shape() is None}  # others come with shapes
        if light == "relit" and not loaded.emitters():
            raise ValueError(f"LitScene(): expected a scene with a lamp to relight by; got none in {file}. Add an emitter, or use baked.")
        self.has_objects = bool(shapes)
        self._welded, mesh = _split_mesh(topology, texture_size, light)
        self.scene = mi.load_dict({"type": "scene", **shapes, **lamps, "avatar": mesh})
        (self.avatar,) = [shape for shape in self.scene.shapes() if shape.id() == "avatar"]
        self._parameters = mi.traverse(self.scene)
        self._faces = torch.from_numpy(topology.faces)

    def place(self, vertices: Float[Tensor, "V 3"], texture: Float[Tensor, "3 T T"]) -> None:
        """Put the avatar into a pose.

        Args:
            vertices: [V, 3] metres, world axes.
            texture: [3, T, T] linear radiance (baked) or albedo (relit), row 0 at v = 1; what is negative counts as zero.

        Raises:
            ValueError: values that are not finite.
        """
        mi = loaded_mitsuba()
        vertices, texture = vertices.detach().cpu(), texture.detach().cpu()
        if not bool(torch.isfinite(vertices).all() and torch.isfinite(texture).all()):
            raise ValueError("place(): vertices and texture must be finite; got NaN or infinity. Check the pose that they come from.")
        normals = vertex_normals(vertices[None], self._faces)[0]
        pixels = np.ascontiguousarray(texture.clamp(min=0).permute(1, 2, 0).numpy())
        self._parameters[_TEXTURE_KEYS[self.light]] = mi.TensorXf(pixels)
        # Twice: an update tells lamps far away how large the scene is before it measures the scene. After one alone, shadow rays
        # would be as long as the last pose needed; for the first pose that is nothing, and the person would throw no shadow.
        for _ in range(2):
            self._parameters["avatar.vertex_positions"] = vertices.numpy()[self._welded].ravel()
            self._parameters["avatar.vertex_normals"] = normals.numpy()[self._welded].ravel()
            self._parameters.update()


def load_scene_parts(file: Path):
    """A scene file loaded by Mitsuba without its integrator and sensors; names of files inside it are relative to it.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if Mitsuba refuses it.
    """
    mi = loaded_mitsuba()
    if not file.is_file():
        raise FileNotFoundError(f"load_scene_parts(): expected a Mitsuba scene at {file}; there is none. Name an .xml file.")
    try:
        root = ElementTree.parse(file).getroot()
        for part in [part for part in root if part.tag in _LEFT_ASIDE]:
            root.remove(part)
        for part in root.iter():
            key = "value" if part.tag == "string" and part.get("name") == "filename" else "filename" if part.tag == "include" else None
            beside = file.parent.resolve() / part.get(key, "") if key else None
            if key and beside is not None and beside.is_file():
                part.set(key, str(beside))
        return mi.load_string(ElementTree.tostring(root, encoding="unicode"))
    except (ElementTree.ParseError, RuntimeError) as error:
        reason = str(error).strip().splitlines()[-1]
        raise ValueError(f"load_scene_parts(): expected a Mitsuba scene in {file}; got: {reason} Open the file and mend it.") from error


def far_radiance(file: Path, height: int = 64) -> Float[Tensor, "3 height width"]:
    """Light from far away in a scene file, as the image that `EnvironmentMap` takes: [3, h, 2 h] linear radiance.

    Raises:
        ValueError: the scene has no such light, or also lamps that stand in it: their light depends on the place.
    """
    mi = loaded_mitsuba()
    scene = load_scene_parts(file)
    environment = scene.environment()
    if environment is None or len(scene.emitters()) != 1:
        raise ValueError(
            f"far_radiance(): expected one environment map or constant emitter in {file}; got {len(scene.emitters())} emitters. "
            "Use uniform as the captured light."
        )
    width = 2 * height
    polar, azimuth = np.meshgrid((np.arange(height) + 0.5) * np.pi / height, (np.arange(width) + 0.5) * 2 * np.pi / width, indexing="ij")
    direction = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)]).reshape(3, -1)
    hit = mi.SurfaceInteraction3f()
    hit.wi = mi.Vector3f(-direction.astype(np.float32))
    radiance = np.array(environment.eval(hit)).reshape(3, height, width)
    return torch.from_numpy(radiance.astype(np.float32))


def _split_mesh(topology: Topology, texture_size: int, light: Light) -> tuple[np.ndarray, object]:
    """The welded vertex of each split one [S], and Mitsuba's mesh without positions yet."""
    mi = loaded_mitsuba()
    split = split_at_seams(topology)
    bitmap = mi.Bitmap(np.zeros((texture_size, texture_size, 3), np.float32))
    texture = {"type": "bitmap", "bitmap": bitmap, "raw": True, "wrap_mode": "clamp"}
    properties = mi.Properties()
    if light == "baked":
        properties["bsdf"] = mi.load_dict({"type": "diffuse", "reflectance": 0.0})
        properties["emitter"] = mi.load_dict({"type": "area", "radiance": texture})
    else:
        properties["bsdf"] = mi.load_dict({"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": texture}})
    mesh = mi.Mesh("avatar", len(split.uv), len(split.faces), has_vertex_normals=True, has_vertex_texcoords=True, props=properties)
    parameters = mi.traverse(mesh)
    parameters["faces"] = split.faces.astype(np.uint32).ravel()
    parameters["vertex_texcoords"] = split.image_uv.ravel()
    parameters.update()
    return split.welded, mesh
