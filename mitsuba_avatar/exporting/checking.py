"""Whether an exported GLB says what was meant: read back by trimesh and posed by glTF's own rules, and judged by Khronos' validator."""

import json
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pygltflib
import trimesh
from jaxtyping import Float, Float32
from scipy.spatial.transform import Rotation

from mitsuba_avatar.body.split_mesh import split_at_seams
from mitsuba_avatar.exporting.character import Character
from mitsuba_avatar.exporting.glb import from_gltf

_DTYPES = {
    pygltflib.FLOAT: np.float32,
    pygltflib.UNSIGNED_INT: np.uint32,
    pygltflib.UNSIGNED_SHORT: np.uint16,
    pygltflib.UNSIGNED_BYTE: np.uint8,
}
_COLUMNS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
_VALIDATOR = (
    "const validator = require('gltf-validator'), fs = require('fs');"
    "validator.validateBytes(new Uint8Array(fs.readFileSync(process.argv[1]))).then(r => console.log(JSON.stringify(r.issues)));"
)


@dataclass(frozen=True)
class ValidatorReport:
    """What the Khronos glTF validator found: counts, and messages as "CODE pointer: text"."""

    errors: int
    warnings: int
    infos: int
    hints: int
    messages: tuple[str, ...]


def validate_gltf(path: Path | str) -> ValidatorReport:
    """Run the Khronos glTF validator (npm package `gltf-validator`), found by node as any package is.

    Raises:
        FileNotFoundError: node or the package is not there.
    """
    node = shutil.which("node")
    remedy = "Install Node.js, then `npm install gltf-validator` in the current folder or one that NODE_PATH names."
    if node is None:
        raise FileNotFoundError(f"validate_gltf(): expected node on the PATH; found none. {remedy}")
    finished = subprocess.run([node, "-e", _VALIDATOR, str(Path(path).resolve())], capture_output=True, text=True, check=False)
    if finished.returncode != 0:
        reason = next((line for line in finished.stderr.splitlines() if "Error" in line), "no reason given")
        raise FileNotFoundError(f"validate_gltf(): expected the npm package gltf-validator; node says: {reason} {remedy}")
    issues = json.loads(finished.stdout)
    messages = tuple(f"{issue['code']} {issue.get('pointer', '')}: {issue['message']}" for issue in issues["messages"])
    return ValidatorReport(issues["numErrors"], issues["numWarnings"], issues["numInfos"], issues["numHints"], messages)


def check_reread(path: Path | str, character: Character) -> None:
    """Read a GLB with trimesh and compare it with the character: every corner's position and texture coordinate.

    Raises:
        ValueError: a difference; the message says which and how large.
    """
    (mesh,) = trimesh.load(str(path), process=False).geometry.values()
    split = split_at_seams(character.rig.topology)
    if not np.array_equal(mesh.faces, split.faces):
        raise ValueError(
            f"check_reread(): expected the {len(split.faces)} faces that were written in {path}; got {len(mesh.faces)} others."
        )
    corners = from_gltf(np.asarray(mesh.vertices, np.float32))[mesh.faces]
    worst = float(np.abs(corners - character.base_vertices[character.rig.topology.faces]).max())
    worst_uv = float(np.abs(mesh.visual.uv[mesh.faces] - character.rig.topology.uv[character.rig.topology.uv_faces]).max())
    if worst > 0 or worst_uv > 1e-6:  # positions are exact; v is turned over twice, which rounds
        raise ValueError(f"check_reread(): expected positions and texture coordinates as written in {path}; got {worst} m, {worst_uv} off.")


def posing_error_mm(path: Path | str, character: Character) -> Float32[np.ndarray, "N S"]:
    """How far the GLB's animation, played by glTF's rules, is from the avatar's own surfaces: [N, S] millimetres."""
    file = _GltfFile(path)
    truth = character.motion.vertices[:, split_at_seams(character.rig.topology).welded]
    return np.stack([1000 * np.linalg.norm(from_gltf(file.posed(key)) - truth[key], axis=1) for key in range(len(truth))]).astype(
        np.float32
    )


class _GltfFile:
    """A GLB with one skinned mesh and one animation, as any viewer reads it."""

    def __init__(self, path: Path | str):
        self.gltf = pygltflib.GLTF2().load(str(path))
        self._blob = self.gltf.binary_blob()
        self._targets = [self._array(target["POSITION"]) for target in self.gltf.meshes[0].primitives[0].targets]
        self._channels = [
            (channel.target, self._array(self.gltf.animations[0].samplers[channel.sampler].output))
            for channel in self.gltf.animations[0].channels
        ]

    def posed(self, key: int) -> Float[np.ndarray, "S 3"]:
        """Skinned positions at one key of the animation, glTF axes, metres."""
        attributes = self.gltf.meshes[0].primitives[0].attributes
        nodes = [[np.array(node.translation or (0, 0, 0), float), np.array((0, 0, 0, 1.0))] for node in self.gltf.nodes]
        position = self._array(attributes.POSITION).astype(np.float64)
        for target, values in self._channels:
            if target.path == "weights":
                strengths = values.reshape(-1, len(self._targets))[key]
                position = position + np.tensordot(strengths, np.stack(self._targets), axes=1)
            else:
                nodes[target.node][target.path == "rotation"] = values[key].astype(np.float64)
        skin = self.gltf.skins[0]
        world = self._world(nodes)
        inverse_bind = self._array(skin.inverseBindMatrices).reshape(-1, 4, 4).transpose(0, 2, 1)
        matrices = np.stack([world[joint] for joint in skin.joints]) @ inverse_bind
        blended = np.zeros((len(position), 4, 4))
        for part in (0, 1):
            accessor = getattr(attributes, f"JOINTS_{part}", None)
            if accessor is not None:
                weights = self._array(getattr(attributes, f"WEIGHTS_{part}"))
                blended += (weights[:, :, None, None] * matrices[self._array(accessor)]).sum(axis=1)
        return (blended[:, :3, :3] @ position[:, :, None])[:, :, 0] + blended[:, :3, 3]

    def _world(self, nodes: list) -> dict[int, np.ndarray]:
        """Global transform of every node that the scene reaches."""
        world, open_nodes = {}, [(node, np.eye(4)) for node in self.gltf.scenes[0].nodes]
        while open_nodes:
            node, above = open_nodes.pop()
            local = np.eye(4)
            local[:3, :3], local[:3, 3] = Rotation.from_quat(nodes[node][1]).as_matrix(), nodes[node][0]
            world[node] = above @ local
            open_nodes += [(child, world[node]) for child in self.gltf.nodes[node].children or ()]
        return world

    def _array(self, index: int) -> np.ndarray:
        accessor = self.gltf.accessors[index]
        view, columns = self.gltf.bufferViews[accessor.bufferView], _COLUMNS[accessor.type]
        values = np.frombuffer(self._blob, _DTYPES[accessor.componentType], accessor.count * columns, view.byteOffset)
        return values if columns == 1 else values.reshape(-1, columns)
