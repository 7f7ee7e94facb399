"""USD: a character with skeleton, skin and shapes (UsdSkel), or a point cache of posed surfaces. Schema and container are usd-core's.

World axes as ours, Z up, metres. The mesh is the welded one, with texture coordinates at face corners. A character's joints rest in world
axes, as in `exporting.glb`: a joint's local transform is

    T(p_joint - p_parent) R_joint,    at the root    root T(p_0) R_0,

and its bind transform is T(p_joint). `usd_posing_error_mm` lets USD itself pose what was written and compares.

Types of the optional package (stage, mesh, material) stand as Any.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32
from scipy.spatial.transform import Rotation

from mitsuba_avatar.body.rig import Topology
from mitsuba_avatar.exporting.character import Character
from mitsuba_avatar.files import atomic_path


def load_usd() -> Any:
    """The package `pxr` of usd-core, with the modules that are used here.

    Raises:
        ModuleNotFoundError: without the extra `usd`.
    """
    try:
        import pxr
        import pxr.Gf
        import pxr.Sdf
        import pxr.Tf
        import pxr.Usd
        import pxr.UsdGeom
        import pxr.UsdShade
        import pxr.UsdSkel
        import pxr.Vt
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError("load_usd(): expected usd-core; it is missing. pip install 'mitsuba-avatar[usd]'.") from error
    return pxr


def write_usd_cache(
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
    pxr = load_usd()
    with atomic_path(path) as temporary:
        stage = _new_stage(pxr, temporary, fps, len(vertices))
        stage.SetDefaultPrim(pxr.UsdGeom.Xform.Define(stage, "/avatar").GetPrim())
        mesh = _define_mesh(pxr, stage, topology, texture, is_lit)
        points, extent = mesh.CreatePointsAttr(), mesh.CreateExtentAttr()
        for time, surface in enumerate(vertices):
            points.Set(_vectors(pxr, surface), time)
            extent.Set(_extent(pxr, surface), time)
        stage.GetRootLayer().Save()


def write_usd_character(path: Path | str, character: Character, texture: str, is_lit: bool = False) -> None:
    """A character: skeleton, skin, shapes, one animation, with a preview material.

    Names of joints and shapes become what USD allows in paths (`pelvis.L` is `pelvis_L`); the rig's own stand in `jointNames`.

    Args:
        path: file to write, `.usdc` or `.usda`.
        character: what to write.
        texture: PNG that the material shows, relative to the file.
        is_lit: as in `write_usd_cache`.

    Raises:
        ModuleNotFoundError: without the extra `usd`.
        ValueError: two joints of one parent, or two shapes, whose names USD cannot tell apart.
    """
    pxr = load_usd()
    with atomic_path(path) as temporary:
        motion = character.motion
        stage = _new_stage(pxr, temporary, motion.fps, len(motion.root))
        root = pxr.UsdSkel.Root.Define(stage, "/avatar")
        stage.SetDefaultPrim(root.GetPrim())
        extent = root.CreateExtentAttr()
        for time, surface in enumerate(motion.vertices):
            extent.Set(_extent(pxr, surface), time)
        mesh = _define_mesh(pxr, stage, character.rig.topology, texture, is_lit)
        mesh.CreatePointsAttr(_vectors(pxr, character.base_vertices))
        mesh.CreateExtentAttr(_extent(pxr, character.base_vertices))
        joints = _joint_paths(pxr, character)
        skeleton = _define_skeleton(pxr, stage, character, joints)
        shapes = _define_shapes(pxr, stage, mesh, character)
        _bind(pxr, mesh, skeleton, character)
        _define_animation(pxr, stage, skeleton, character, joints, shapes)
        stage.GetRootLayer().Save()


def usd_posing_error_mm(path: Path | str, character: Character) -> Float32[np.ndarray, "N V"]:
    """How far a written character, posed by USD's own skinning, is from the avatar's surfaces: [N, V] millimetres.

    Raises:
        ModuleNotFoundError: without the extra `usd`.
        ValueError: USD finds nothing to pose in the file.
    """
    pxr = load_usd()
    stage = pxr.Usd.Stage.Open(pxr.Usd.Stage.Open(str(path)).Flatten())  # a copy in memory, which takes the posed points
    if not pxr.UsdSkel.BakeSkinning(stage.Traverse()):
        raise ValueError(f"usd_posing_error_mm(): expected a skinned mesh in {path}; USD cannot pose it. Export again.")
    points = pxr.UsdGeom.Mesh(stage.GetPrimAtPath("/avatar/surface")).GetPointsAttr()
    differences = [np.array(points.Get(time)) - surface for time, surface in enumerate(character.motion.vertices)]
    return (1000 * np.linalg.norm(np.stack(differences), axis=2)).astype(np.float32)


def _new_stage(pxr: Any, path: Path, fps: float, count: int) -> Any:
    """An empty stage in our units and axes with `count` frames."""
    stage = pxr.Usd.Stage.CreateNew(str(path))
    pxr.UsdGeom.SetStageUpAxis(stage, pxr.UsdGeom.Tokens.z)
    pxr.UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetFramesPerSecond(fps)
    stage.SetTimeCodesPerSecond(fps)
    stage.SetStartTimeCode(0)
    stage.SetEndTimeCode(count - 1)
    return stage


def _define_mesh(pxr: Any, stage: Any, topology: Topology, texture: str, is_lit: bool) -> Any:
    """The mesh `/avatar/surface` without points, textured."""
    faces = topology.faces.astype(np.int32)
    mesh = pxr.UsdGeom.Mesh.Define(stage, "/avatar/surface")
    mesh.CreateSubdivisionSchemeAttr(pxr.UsdGeom.Tokens.none)
    mesh.CreateDoubleSidedAttr(True)
    mesh.CreateFaceVertexCountsAttr(pxr.Vt.IntArray.FromNumpy(np.full(len(faces), 3, np.int32)))
    mesh.CreateFaceVertexIndicesAttr(pxr.Vt.IntArray.FromNumpy(faces.reshape(-1)))
    primvars, types = pxr.UsdGeom.PrimvarsAPI(mesh), pxr.Sdf.ValueTypeNames
    uv = primvars.CreatePrimvar("st", types.TexCoord2fArray, pxr.UsdGeom.Tokens.faceVarying)
    uv.Set(pxr.Vt.Vec2fArray.FromNumpy(topology.uv))
    uv.SetIndices(pxr.Vt.IntArray.FromNumpy(topology.uv_faces.astype(np.int32).reshape(-1)))
    pxr.UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(_define_material(pxr, stage, texture, is_lit))
    return mesh


def _define_material(pxr: Any, stage: Any, texture: str, is_lit: bool) -> Any:
    """A preview surface that reflects the texture diffusely, or emits it."""
    types, shader = pxr.Sdf.ValueTypeNames, pxr.UsdShade.Shader
    material = pxr.UsdShade.Material.Define(stage, "/avatar/material")
    surface = shader.Define(stage, "/avatar/material/surface")
    surface.CreateIdAttr("UsdPreviewSurface")
    surface.CreateInput("roughness", types.Float).Set(1.0)
    reader = shader.Define(stage, "/avatar/material/uv")
    reader.CreateIdAttr("UsdPrimvarReader_float2")
    reader.CreateInput("varname", types.String).Set("st")
    image = shader.Define(stage, "/avatar/material/texture")
    image.CreateIdAttr("UsdUVTexture")
    image.CreateInput("file", types.Asset).Set(texture)
    image.CreateInput("sourceColorSpace", types.Token).Set("sRGB")
    coordinates = reader.CreateOutput("result", types.Float2)
    image.CreateInput("st", types.Float2).ConnectToSource(coordinates)
    colour = image.CreateOutput("rgb", types.Float3)
    shown, black = ("diffuseColor", "emissiveColor") if is_lit else ("emissiveColor", "diffuseColor")
    surface.CreateInput(shown, types.Color3f).ConnectToSource(colour)
    surface.CreateInput(black, types.Color3f).Set((0.0, 0.0, 0.0))
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", types.Token))
    return material


def _define_skeleton(pxr: Any, stage: Any, character: Character, joints: list[str]) -> Any:
    """The skeleton `/avatar/skeleton` in its rest pose."""
    rig = character.rig
    positions = rig.joint_positions.astype(np.float64)
    skeleton = pxr.UsdSkel.Skeleton.Define(stage, "/avatar/skeleton")
    skeleton.CreateJointsAttr(joints)
    skeleton.CreateJointNamesAttr([str(name) for name in rig.joint_names])
    skeleton.CreateBindTransformsAttr(_translations(pxr, positions))
    skeleton.CreateRestTransformsAttr(_translations(pxr, np.concatenate([positions[:1], positions[1:] - positions[rig.joint_parents[1:]]])))
    return skeleton


def _define_shapes(pxr: Any, stage: Any, mesh: Any, character: Character) -> list[str]:
    """A blend shape below the mesh for every shape, with the vertices that it moves; returns their names in USD."""
    names = [pxr.Tf.MakeValidIdentifier(name) for name in character.shapes.names]
    _check_unique(names, character.shapes.names)
    targets = []
    for name, displacements in zip(names, character.shapes.displacements, strict=True):
        moved = np.flatnonzero(displacements.any(axis=1))
        shape = pxr.UsdSkel.BlendShape.Define(stage, mesh.GetPath().AppendChild(name))
        shape.CreateOffsetsAttr(_vectors(pxr, displacements[moved]))
        shape.CreatePointIndicesAttr(pxr.Vt.IntArray.FromNumpy(moved.astype(np.int32)))
        targets.append(shape.GetPath())
    if names:
        binding = pxr.UsdSkel.BindingAPI.Apply(mesh.GetPrim())
        binding.CreateBlendShapesAttr(names)
        binding.CreateBlendShapeTargetsRel().SetTargets(targets)
    return names


def _bind(pxr: Any, mesh: Any, skeleton: Any, character: Character) -> None:
    """Joints and weights of the mesh's points; mesh and skeleton share their space."""
    influences = character.influences
    binding = pxr.UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    binding.CreateSkeletonRel().SetTargets([skeleton.GetPath()])
    binding.CreateGeomBindTransformAttr(pxr.Gf.Matrix4d(1.0))
    width = influences.joints.shape[1]
    joints = binding.CreateJointIndicesPrimvar(constant=False, elementSize=width)
    joints.Set(pxr.Vt.IntArray.FromNumpy(influences.joints.astype(np.int32).reshape(-1)))
    weights = binding.CreateJointWeightsPrimvar(constant=False, elementSize=width)
    weights.Set(pxr.Vt.FloatArray.FromNumpy(influences.weights.reshape(-1)))


def _define_animation(pxr: Any, stage: Any, skeleton: Any, character: Character, joints: list[str], shapes: list[str]) -> None:
    """Local transforms of all joints and strengths of all shapes, a sample a frame."""
    motion, rig = character.motion, character.rig
    positions = rig.joint_positions.astype(np.float64)
    turn, move = motion.root[:, :3, :3].astype(np.float64), motion.root[:, :3, 3].astype(np.float64)
    local = motion.joint_rotations.astype(np.float64)
    local[:, 0] = turn @ local[:, 0]
    offsets = np.tile(positions - positions[rig.joint_parents], (len(local), 1, 1))
    offsets[:, 0] = turn @ positions[0] + move  # the root has no parent
    animation = pxr.UsdSkel.Animation.Define(stage, skeleton.GetPath().AppendChild("motion"))
    animation.CreateJointsAttr(joints)
    animation.CreateScalesAttr(pxr.Vt.Vec3hArray(len(joints), pxr.Gf.Vec3h(1, 1, 1)))
    rotations, translations = animation.CreateRotationsAttr(), animation.CreateTranslationsAttr()
    quaternions = Rotation.from_matrix(local.reshape(-1, 3, 3)).as_quat().reshape(*local.shape[:2], 4)  # x, y, z, w
    for time in range(len(local)):
        rotations.Set([pxr.Gf.Quatf(w, x, y, z) for x, y, z, w in quaternions[time].tolist()], time)
        translations.Set(_vectors(pxr, offsets[time]), time)
    if shapes:
        animation.CreateBlendShapesAttr(shapes)
        strengths = animation.CreateBlendShapeWeightsAttr()
        for time, values in enumerate(character.strengths):
            strengths.Set(pxr.Vt.FloatArray.FromNumpy(np.ascontiguousarray(values)), time)
    pxr.UsdSkel.BindingAPI.Apply(skeleton.GetPrim()).CreateAnimationSourceRel().SetTargets([animation.GetPath()])


def _joint_paths(pxr: Any, character: Character) -> list[str]:
    """A joint's name below its parent's: `base/elbow/wrist`. Parents come before their children."""
    rig = character.rig
    paths: list[str] = []
    for name, parent in zip(rig.joint_names, rig.joint_parents, strict=True):
        own = pxr.Tf.MakeValidIdentifier(str(name))
        paths.append(own if parent < 0 else f"{paths[parent]}/{own}")
    _check_unique(paths, rig.joint_names)
    return paths


def _check_unique(valid: Sequence[str], names: Sequence[str]) -> None:
    """Refuse names that are one name in USD."""
    for i, name in enumerate(valid):
        if name in valid[:i]:
            raise ValueError(
                f"write_usd_character(): expected names that differ in USD; got {names[valid.index(name)]!r} and {names[i]!r}, both "
                f"{name!r} there. Rename one of them in the rig."
            )


def _translations(pxr: Any, offsets: np.ndarray) -> list[Any]:
    return [pxr.Gf.Matrix4d(1.0).SetTranslate(pxr.Gf.Vec3d(*offset)) for offset in offsets.tolist()]


def _vectors(pxr: Any, vectors: np.ndarray) -> Any:
    return pxr.Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(vectors, np.float32))


def _extent(pxr: Any, surface: np.ndarray) -> Any:
    return _vectors(pxr, np.stack([surface.min(axis=0), surface.max(axis=0)]))
