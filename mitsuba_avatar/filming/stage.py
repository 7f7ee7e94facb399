"""The stage in Mitsuba: dome, person and all cameras, built once; each frame moves the person's vertices and shoots every camera at once.

The person's mesh is split at texture seams, because Mitsuba interpolates texture coordinates per vertex; normals are computed on the
welded mesh and copied, so that shading crosses seams. (Differentiable rendering must not do this; filming takes no gradients.)
A scene is never rebuilt: rebuilding leaks memory (mitsuba3 issue 1890).
"""

import math
from collections.abc import Sequence
from pathlib import Path

import mitsuba as mi
import numpy as np
import torch
from jaxtyping import Float, Float32

from mitsuba_avatar.body.mesh import vertex_normals
from mitsuba_avatar.body.rig import Topology
from mitsuba_avatar.captures.cameras import Camera
from mitsuba_avatar.filming.appearance import Appearance
from mitsuba_avatar.filming.settings import StudioSettings
from mitsuba_avatar.resources import find_resource

SPECULAR = 0.35  # of the principled BSDF: reflectance 0.028 at normal incidence, as of skin
SPECULAR_SAMPLES = 0.12  # share of samples for the specular lobe; the default of a half doubles the noise of the diffuse one


class Stage:
    """A Mitsuba scene with one person in it, seen by all cameras of a capture. Call `rendering.backend.select_variant` before."""

    def __init__(self, topology: Topology, appearance: Appearance, cameras: Sequence[Camera], settings: StudioSettings):
        """Load the settings' scene file and put person and cameras into it.

        Raises:
            FileNotFoundError: if there is no such scene.
            ValueError: if cameras differ in size or have distortion.
        """
        # Registers `split_path`. Here, because its base class exists only once a variant is chosen.
        import mitsuba_avatar.filming.path_integrator  # noqa: F401

        self.width, self.height, self.count = cameras[0].width, cameras[0].height, len(cameras)
        self.samples_per_pixel = settings.light.samples_per_pixel
        corners = np.stack([topology.faces.reshape(-1), topology.uv_faces.reshape(-1)], axis=1)
        pairs, corner_pair = np.unique(corners, axis=0, return_inverse=True)  # [S, 2] vertex and uv of each split vertex
        self.welded = pairs[:, 0]
        self.faces = torch.from_numpy(topology.faces)

        file = find_resource("scenes", settings.light.scene, ".xml")
        parts = _parts_of(file, settings) | {"person": _mesh(topology, appearance, pairs, corner_pair.reshape(-1, 3))}
        self.scene = mi.load_dict({"type": "scene", **parts})
        self.sensor = mi.load_dict(_batch_sensor(cameras, settings))
        self.parameters = mi.traverse(self.scene)

    def shoot(self, vertices: Float32[np.ndarray, "V 3"], seed: int) -> tuple[Float32[np.ndarray, "C H W 3"], Float32[np.ndarray, "C H W"]]:
        """Path-trace one frame from every camera.

        Args:
            vertices: [V, 3] posed surface, metres, world axes.
            seed: of the sampler; another seed gives other noise.

        Returns:
            radiance [C, H, W, 3] linear, black outside the person (premultiplied), and coverage [C, H, W] in 0..1.
        """
        normals = vertex_normals(torch.from_numpy(vertices)[None], self.faces)[0].numpy()
        self.parameters["person.vertex_positions"] = vertices[self.welded].ravel()
        self.parameters["person.vertex_normals"] = normals[self.welded].ravel()
        self.parameters.update()
        film = np.array(mi.render(self.scene, sensor=self.sensor, spp=self.samples_per_pixel, seed=seed))  # [H, C * W, 4]
        views = film.reshape(self.height, self.count, self.width, 4).transpose(1, 0, 2, 3)
        return np.ascontiguousarray(views[..., :3]), np.ascontiguousarray(views[..., 3]).clip(0, 1)


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


def _mesh(topology: Topology, appearance: Appearance, pairs: np.ndarray, faces: np.ndarray) -> object:
    """The person as a Mitsuba mesh, split at seams, without positions yet."""

    def texture(pixels: Float[np.ndarray, "S S C"]) -> dict[str, object]:
        return {"type": "bitmap", "bitmap": mi.Bitmap(np.ascontiguousarray(pixels)), "raw": True, "wrap_mode": "clamp"}

    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(
        {
            "type": "principled",
            "base_color": texture(appearance.base_colour),
            "roughness": texture(appearance.roughness[..., None]),
            "specular": SPECULAR,
            "main_specular_sampling_rate": SPECULAR_SAMPLES,
        }
    )
    mesh = mi.Mesh("person", len(pairs), len(faces), has_vertex_normals=True, has_vertex_texcoords=True, props=properties)
    uv = topology.uv[pairs[:, 1]] * np.array([1, -1], np.float32) + np.array([0, 1], np.float32)  # Mitsuba's v runs down the image
    parameters = mi.traverse(mesh)
    parameters["faces"] = faces.astype(np.uint32).ravel()
    parameters["vertex_texcoords"] = uv.astype(np.float32).ravel()
    parameters.update()
    return mesh


def _batch_sensor(cameras: Sequence[Camera], settings: StudioSettings) -> dict[str, object]:
    """All cameras side by side on one film: one launch a frame."""
    width, height = cameras[0].width, cameras[0].height
    if any((camera.width, camera.height) != (width, height) or camera.is_distorted for camera in cameras):
        raise ValueError(
            "Stage(): expected cameras of one size and without distortion; got others. Give all cameras the size of the first."
        )
    film = {"type": "hdrfilm", "pixel_format": "rgba", "component_format": "float32", "rfilter": {"type": "box"}}
    sampler = {"type": "multijitter", "sample_count": settings.light.samples_per_pixel}
    sensors = {camera.name: sensor_of(camera) | {"film": film | {"width": width, "height": height}} for camera in cameras}
    return {"type": "batch", "film": film | {"width": width * len(cameras), "height": height}, "sampler": sampler, **sensors}


def sensor_of(camera: Camera) -> dict[str, object]:
    """A Mitsuba perspective sensor with a camera's intrinsics and pose, exact to 1e-4 pixels; film and sampler are the caller's.

    Raises:
        ValueError: for two different focal lengths, which Mitsuba's sensor does not have.
    """
    if abs(camera.fx / camera.fy - 1) > 1e-4:
        raise ValueError(
            f"sensor_of(): expected one focal length; {camera.name!r} has fx={camera.fx:.3f}, fy={camera.fy:.3f}. "
            "Resample to square pixels."
        )
    return {
        "type": "perspective",
        "fov_axis": "x",
        "fov": math.degrees(2 * math.atan(camera.width / (2 * camera.fx))),
        "principal_point_offset_x": 0.5 - camera.cx / camera.width,
        "principal_point_offset_y": 0.5 - camera.cy / camera.height,
        "near_clip": 0.05,
        "far_clip": 100.0,
        "to_world": mi.ScalarTransform4f(camera.world_from_camera @ np.diag([-1.0, -1.0, 1.0, 1.0])),
    }
