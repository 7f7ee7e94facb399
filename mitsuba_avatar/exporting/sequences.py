"""Posed surfaces as files that every mesh program reads: a PLY or OBJ a frame, or one USD point cache.

World axes as ours, Z up, metres. PLY holds the welded mesh; OBJ the mesh cut at texture seams, with texture; USD the welded mesh with
texture coordinates at face corners, which it alone of the three can hold.
"""

from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float32
from PIL import Image

from mitsuba_avatar.body.rig import Topology
from mitsuba_avatar.body.split_mesh import split_at_seams
from mitsuba_avatar.files import atomic_path

DIGITS = 7  # decimals in OBJ files: a tenth of a micrometre


def write_ply(path: Path | str, vertices: Float32[np.ndarray, "V 3"], topology: Topology) -> None:
    """One frame, binary."""
    with atomic_path(path) as temporary:
        trimesh.Trimesh(vertices, topology.faces, process=False).export(temporary)


class ObjSequence:
    """OBJ files of one topology in a folder, with one material and one texture for all.

    Args:
        folder: to write into.
        topology: of all frames.
        texture: [T, T, 3] uint8, sRGB-encoded.
    """

    def __init__(self, folder: Path | str, topology: Topology, texture: np.ndarray):
        self._folder, self._split = Path(folder), split_at_seams(topology)
        white, black = (255, 255, 255, 255), (0, 0, 0, 255)
        material = trimesh.visual.material.SimpleMaterial(Image.fromarray(texture), diffuse=white, ambient=black, specular=black)
        material.name = "avatar"
        self._visual = trimesh.visual.TextureVisuals(uv=self._split.uv, material=material)
        self._has_material = False

    def write(self, name: str, vertices: Float32[np.ndarray, "V 3"]) -> None:
        """One frame; `name` ends in `.obj`."""
        mesh = trimesh.Trimesh(vertices[self._split.welded], self._split.faces, visual=self._visual, process=False)
        text, others = trimesh.exchange.obj.export_obj(
            mesh, include_normals=False, return_texture=True, digits=DIGITS, mtl_name="avatar.mtl"
        )
        if not self._has_material:
            for other, data in others.items():
                with atomic_path(self._folder / other) as temporary:
                    temporary.write_bytes(data if isinstance(data, bytes) else data.encode())
            self._has_material = True
        with atomic_path(self._folder / name) as temporary:
            temporary.write_text(text, encoding="utf-8")


def write_usd(
    path: Path | str, vertices: Float32[np.ndarray, "N V 3"], topology: Topology, fps: float, texture: str, is_lit: bool = False
) -> None:
    """A point cache: one mesh whose points have a sample per frame, with a preview material.

    Args:
        path: file to write, `.usdc` or `.usda`.
        vertices: [N, V, 3] metres, world axes.
        topology: of all frames.
        fps: frames per second.
        texture: PNG that the material shows, relative to the file.
        is_lit: the texture is albedo and lamps shall light it; else it is radiance and emitted as it is.

    Raises:
        ModuleNotFoundError: without the extra `usd`.
    """
    try:
        from pxr import Sdf, Usd, UsdGeom, UsdShade, Vt
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError("write_usd(): expected usd-core; it is missing. pip install 'mitsuba-avatar[usd]'.") from error
    with atomic_path(path) as temporary:
        stage = Usd.Stage.CreateNew(str(temporary))
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        stage.SetTimeCodesPerSecond(fps)
        stage.SetStartTimeCode(0)
        stage.SetEndTimeCode(len(vertices) - 1)
        root = UsdGeom.Xform.Define(stage, "/avatar")
        stage.SetDefaultPrim(root.GetPrim())
        mesh = UsdGeom.Mesh.Define(stage, "/avatar/surface")
        mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        mesh.CreateDoubleSidedAttr(True)
        mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(topology.faces), 3, np.int32)))
        mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(topology.faces.astype(np.int32).reshape(-1)))
        uv = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.faceVarying)
        uv.Set(Vt.Vec2fArray.FromNumpy(topology.uv))
        uv.SetIndices(Vt.IntArray.FromNumpy(topology.uv_faces.astype(np.int32).reshape(-1)))
        points, extent = mesh.CreatePointsAttr(), mesh.CreateExtentAttr()
        for time, surface in enumerate(vertices):
            points.Set(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(surface)), time)
            extent.Set(Vt.Vec3fArray.FromNumpy(np.stack([surface.min(axis=0), surface.max(axis=0)])), time)
        UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(_usd_material(stage, texture, is_lit))
        stage.GetRootLayer().Save()


def _usd_material(stage: Any, texture: str, is_lit: bool) -> Any:  # Usd.Stage -> UsdShade.Material, types of an optional package
    """A preview surface that reflects the texture diffusely, or emits it."""
    from pxr import Sdf, UsdShade

    material = UsdShade.Material.Define(stage, "/avatar/material")
    surface = UsdShade.Shader.Define(stage, "/avatar/material/surface")
    surface.CreateIdAttr("UsdPreviewSurface")
    surface.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(1.0)
    reader = UsdShade.Shader.Define(stage, "/avatar/material/uv")
    reader.CreateIdAttr("UsdPrimvarReader_float2")
    reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("st")
    image = UsdShade.Shader.Define(stage, "/avatar/material/texture")
    image.CreateIdAttr("UsdUVTexture")
    image.CreateInput("file", Sdf.ValueTypeNames.Asset).Set(texture)
    image.CreateInput("sourceColorSpace", Sdf.ValueTypeNames.Token).Set("sRGB")
    coordinates = reader.CreateOutput("result", Sdf.ValueTypeNames.Float2)
    image.CreateInput("st", Sdf.ValueTypeNames.Float2).ConnectToSource(coordinates)
    colour = image.CreateOutput("rgb", Sdf.ValueTypeNames.Float3)
    shown, black = ("diffuseColor", "emissiveColor") if is_lit else ("emissiveColor", "diffuseColor")
    surface.CreateInput(shown, Sdf.ValueTypeNames.Color3f).ConnectToSource(colour)
    surface.CreateInput(black, Sdf.ValueTypeNames.Color3f).Set((0.0, 0.0, 0.0))
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", Sdf.ValueTypeNames.Token))
    return material
