"""A character as one binary glTF 2.0 file: skeleton, skin, shapes, texture, animation. Container and schema are pygltflib's.

glTF is Y up, and a person faces +Z: (x, y, z) becomes (x, z, -y), for positions, joints and motion alike, so that nothing in the file
is turned by a node. Texture coordinates run downwards there: v becomes 1 - v. Joints rest in world axes; a joint's local transform is

    T(p_joint - p_parent) R_joint,    at the root    root T(p_0) R_0,

which equals our skeleton's M_j T(p_j), and its inverse bind matrix is T(-p_joint).
"""

from pathlib import Path
from typing import Any

import numpy as np
import pygltflib
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from mitsuba_avatar.body.mesh import vertex_normals
from mitsuba_avatar.body.split_mesh import SplitMesh, split_at_seams
from mitsuba_avatar.exporting.character import Character
from mitsuba_avatar.files import atomic_path

GLTF_FROM_OURS = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]], np.float32)
_COMPONENTS = {
    np.dtype(np.float32): pygltflib.FLOAT,
    np.dtype(np.uint32): pygltflib.UNSIGNED_INT,
    np.dtype(np.uint8): pygltflib.UNSIGNED_BYTE,
}
_COMPONENTS |= {np.dtype(np.uint16): pygltflib.UNSIGNED_SHORT}
_TYPES = {1: pygltflib.SCALAR, 2: pygltflib.VEC2, 3: pygltflib.VEC3, 4: pygltflib.VEC4, 16: pygltflib.MAT4}


def to_gltf(vectors: Float[np.ndarray, "*N 3"]) -> Float[np.ndarray, "*N 3"]:
    """Positions or directions in glTF's axes; exact."""
    return np.stack([vectors[..., 0], vectors[..., 2], -vectors[..., 1]], axis=-1)


def from_gltf(vectors: Float[np.ndarray, "*N 3"]) -> Float[np.ndarray, "*N 3"]:
    """The inverse of `to_gltf`."""
    return np.stack([vectors[..., 0], -vectors[..., 2], vectors[..., 1]], axis=-1)


def write_glb(path: Path | str, character: Character, texture_png: bytes, is_lit: bool = False) -> None:
    """Write a character, whole or not at all.

    Args:
        path: file to write, ending in `.glb`.
        character: what to write.
        texture_png: the base colour, sRGB-encoded, as a PNG file's bytes.
        is_lit: the texture is albedo and viewers shall light it; else it is radiance and shown as it is (KHR_materials_unlit).
    """
    packer = _Packer()
    split = split_at_seams(character.rig.topology)
    joints = _add_skeleton(packer, character)
    mesh = _add_mesh(packer, character, split)
    _add_material(packer, texture_png, is_lit)
    packer.gltf.nodes.append(pygltflib.Node(name="avatar", mesh=mesh, skin=0))
    body = len(packer.gltf.nodes) - 1
    _add_animation(packer, character, joints, body)
    packer.gltf.scenes = [pygltflib.Scene(name=character.rig.name, nodes=[joints[0], body])]
    packer.gltf.scene = 0
    packer.gltf.asset = pygltflib.Asset(version="2.0", generator="mitsuba_avatar")
    with atomic_path(path) as temporary:
        packer.finish().save_binary(str(temporary))


class _Packer:
    """Collects arrays in one buffer, with their views and accessors."""

    def __init__(self) -> None:
        self.gltf = pygltflib.GLTF2()
        self._blob = bytearray()

    def view(self, data: bytes, target: int | None = None) -> int:
        """Append bytes; returns the buffer view."""
        self._blob += b"\x00" * (-len(self._blob) % 4)  # accessors start at multiples of their component's size
        self.gltf.bufferViews.append(pygltflib.BufferView(buffer=0, byteOffset=len(self._blob), byteLength=len(data), target=target))
        self._blob += data
        return len(self.gltf.bufferViews) - 1

    def accessor(self, values: np.ndarray, target: int | None = None, has_bounds: bool = False) -> int:
        """Append an array [N] or [N, C]; returns the accessor."""
        columns = values.reshape(len(values), -1)
        bounds: dict[str, Any] = {}
        if has_bounds:
            bounds = {"min": columns.min(axis=0).tolist(), "max": columns.max(axis=0).tolist()}
        self.gltf.accessors.append(
            pygltflib.Accessor(
                bufferView=self.view(np.ascontiguousarray(values).tobytes(), target),
                componentType=_COMPONENTS[values.dtype],
                count=len(values),
                type=_TYPES[columns.shape[1]],
                **bounds,
            )
        )
        return len(self.gltf.accessors) - 1

    def finish(self) -> pygltflib.GLTF2:
        """The document with its buffer."""
        self.gltf.buffers = [pygltflib.Buffer(byteLength=len(self._blob))]
        self.gltf.set_binary_blob(bytes(self._blob))
        return self.gltf


def _add_skeleton(packer: _Packer, character: Character) -> list[int]:
    """A node per joint, in the rest pose, and the skin; returns the nodes."""
    rig = character.rig
    positions = to_gltf(rig.joint_positions)
    parents = rig.joint_parents
    for joint, name in enumerate(rig.joint_names):
        parent = int(parents[joint])
        offset = positions[joint] - (positions[parent] if parent >= 0 else 0)
        children = np.flatnonzero(parents == joint).tolist()
        packer.gltf.nodes.append(pygltflib.Node(name=name, translation=offset.astype(float).tolist(), children=children))
    inverse_bind = np.tile(np.eye(4, dtype=np.float32), (len(positions), 1, 1))
    inverse_bind[:, :3, 3] = -positions
    columns_first = np.ascontiguousarray(inverse_bind.transpose(0, 2, 1)).reshape(-1, 16)
    joints = list(range(len(positions)))
    packer.gltf.skins.append(pygltflib.Skin(inverseBindMatrices=packer.accessor(columns_first), joints=joints, skeleton=0))
    return joints


def _add_mesh(packer: _Packer, character: Character, split: SplitMesh) -> int:
    """The split mesh with skin and shapes; returns the mesh."""
    base, target = character.base_vertices, pygltflib.ARRAY_BUFFER
    normals = vertex_normals(torch.from_numpy(base)[None], torch.from_numpy(character.rig.topology.faces))[0].numpy()
    normals = to_gltf(normals)[split.welded]
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    normals[np.linalg.norm(normals, axis=1) < 0.5] = (0, 1, 0)  # vertices of faces without area have no normal, but the format wants one
    attributes = pygltflib.Attributes(
        POSITION=packer.accessor(to_gltf(base)[split.welded], target, has_bounds=True),
        NORMAL=packer.accessor(normals.astype(np.float32), target),
        TEXCOORD_0=packer.accessor(split.image_uv, target),
    )
    joint_type = np.uint8 if len(character.rig.joint_names) <= 256 else np.uint16
    for part in range(character.influences.joints.shape[1] // 4):
        some = slice(4 * part, 4 * part + 4)
        joints = character.influences.joints[split.welded][:, some].astype(joint_type)
        setattr(attributes, f"JOINTS_{part}", packer.accessor(joints, target))
        setattr(attributes, f"WEIGHTS_{part}", packer.accessor(character.influences.weights[split.welded][:, some], target))
    shapes = character.shapes
    targets = [
        {"POSITION": packer.accessor(to_gltf(displacement)[split.welded], target, has_bounds=True)} for displacement in shapes.displacements
    ]
    primitive = pygltflib.Primitive(
        attributes=attributes,
        indices=packer.accessor(split.faces.astype(np.uint32).reshape(-1), pygltflib.ELEMENT_ARRAY_BUFFER),
        material=0,
        targets=targets,
    )
    mesh = pygltflib.Mesh(name="avatar", primitives=[primitive])
    if shapes.names:
        mesh.weights = [0.0] * len(shapes.names)
        mesh.extras = {"targetNames": list(shapes.names)}  # not of the standard, but where every program looks for names
    packer.gltf.meshes.append(mesh)
    return len(packer.gltf.meshes) - 1


def _add_material(packer: _Packer, texture_png: bytes, is_lit: bool) -> None:
    """Material 0: the texture, lit or as it is."""
    gltf = packer.gltf
    gltf.images.append(pygltflib.Image(name="texture", mimeType="image/png", bufferView=packer.view(texture_png)))
    clamp, linear, trilinear = pygltflib.CLAMP_TO_EDGE, pygltflib.LINEAR, pygltflib.LINEAR_MIPMAP_LINEAR
    gltf.samplers.append(pygltflib.Sampler(magFilter=linear, minFilter=trilinear, wrapS=clamp, wrapT=clamp))
    gltf.textures.append(pygltflib.Texture(source=0, sampler=0))
    surface = pygltflib.PbrMetallicRoughness(
        baseColorTexture=pygltflib.TextureInfo(index=0), metallicFactor=0.0, roughnessFactor=1.0 if is_lit else 0.9
    )
    material = pygltflib.Material(name="albedo" if is_lit else "captured radiance", pbrMetallicRoughness=surface, doubleSided=True)
    material.alphaCutoff = None
    if not is_lit:
        material.extensions = {"KHR_materials_unlit": {}}
        gltf.extensionsUsed.append("KHR_materials_unlit")
    gltf.materials.append(material)


def _add_animation(packer: _Packer, character: Character, joints: list[int], body: int) -> None:
    """Rotations of the joints that turn, the root's path, strengths of the shapes."""
    motion, rig = character.motion, character.rig
    count = len(motion.root)
    time = packer.accessor((np.arange(count) / motion.fps).astype(np.float32), has_bounds=True)
    animation = pygltflib.Animation(name="motion")

    def add(values: np.ndarray, node: int, path: str) -> None:
        animation.samplers.append(pygltflib.AnimationSampler(input=time, output=packer.accessor(values.astype(np.float32))))
        target = pygltflib.AnimationChannelTarget(node=node, path=path)
        animation.channels.append(pygltflib.AnimationChannel(sampler=len(animation.samplers) - 1, target=target))

    turn = motion.root[:, :3, :3].astype(np.float64)
    add(to_gltf(turn @ rig.joint_positions[0] + motion.root[:, :3, 3]), joints[0], "translation")
    for joint in range(len(rig.joint_names)):
        if joint != 0 and joint not in rig.dofs.joints:
            continue
        local = motion.joint_rotations[:, joint].astype(np.float64)
        local = turn @ local if joint == 0 else local
        add(_quaternions(GLTF_FROM_OURS @ local @ GLTF_FROM_OURS.T), joints[joint], "rotation")
    if character.shapes.names:
        add(character.strengths.reshape(-1), body, "weights")
    packer.gltf.animations.append(animation)


def _quaternions(rotations: Float[np.ndarray, "N 3 3"]) -> Float[np.ndarray, "N 4"]:
    """x, y, z, w, each on the same side as the one before, so that programs which interpolate plainly take the short way."""
    values = Rotation.from_matrix(rotations).as_quat()
    for i in range(1, len(values)):
        if values[i] @ values[i - 1] < 0:
            values[i] *= -1
    return values
