"""Files of momentum body models: the pickled assets of Goliath releases, model JSON with configuration text, and our own npz.

A pickle can run anything when it is opened. Only tensors, arrays and plain containers are let in here; whoever trusts a file with more
in it says so.
"""

import json
import re
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32, Int64

from mitsuba_avatar.captures.formats.decoding import parse_json, require_file
from mitsuba_avatar.captures.formats.momentum import CHANNELS, MomentumModel, momentum_from_arrays
from mitsuba_avatar.captures.formats.safe_pickle import NUMPY_GLOBALS

NO_PARENT = 4294967295  # what release files write for the root: -1 as 32 bits without sign
TERM = re.compile(r"^(?:([-+0-9.eE]+)\s*\*\s*)?(.+)$")


def load_momentum(path: Path | str, is_trusted: bool = False) -> MomentumModel:
    """Read a body model.

    Args:
        path: static_assets_body.pt of a Goliath release, an npz that `save_momentum` wrote, or model JSON with its .cfg beside it.
        is_trusted: open a .pt that holds other things than tensors and arrays; it may then run code.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: for another format, or parts that do not fit each other.
    """
    path = require_file(Path(path), "Name the body model's file (--assets).")
    if path.suffix == ".json":
        config = require_file(path.with_suffix(".cfg"), "Put the model's configuration text beside it.").read_text(encoding="utf-8-sig")
        document = parse_json(path.read_bytes(), str(path))
        return momentum_from_assets({"lbs_model_json": document, "lbs_config_text": config}, path)
    if path.suffix == ".npz":
        try:
            with np.load(path, allow_pickle=False) as stored:
                return momentum_from_arrays({key: stored[key] for key in stored.files}, path)
        except (zipfile.BadZipFile, EOFError, OSError) as error:
            raise ValueError(f"load_momentum(): expected a body model at {path}; got: {error}. Copy it again.") from error
    try:
        with torch.serialization.safe_globals(list(NUMPY_GLOBALS)):
            assets = torch.load(path, map_location="cpu", weights_only=not is_trusted)
    except (UnpicklingError, RuntimeError, EOFError, zipfile.BadZipFile) as error:
        raise ValueError(
            f"load_momentum(): expected tensors, arrays and plain containers in {path}; got: {str(error).splitlines()[0]} "
            "Copy it again, or, if you trust where it comes from, convert it with load_momentum(path, is_trusted=True) and save_momentum()."
        ) from error
    if not isinstance(assets, Mapping):
        raise ValueError(
            f"load_momentum(): expected a dictionary of assets in {path}; got {type(assets).__name__}. Name the body's assets."
        )
    return momentum_from_assets(assets, path)


def momentum_from_assets(assets: Mapping[str, Any], where: Path) -> MomentumModel:
    """A model from a dictionary of release assets: lbs_model_json, lbs_config_dict (or lbs_config_text), topology, global_scaling.

    Raises:
        ValueError: for a dictionary of another schema.
    """
    document = assets.get("lbs_model_json")
    document = json.loads(document) if isinstance(document, str) else document
    try:
        bones, skin = document["Skeleton"]["Bones"], document["SkinnedModel"]
        names = tuple(str(bone["Name"]) for bone in bones)
        config = assets.get("lbs_config_dict") or parse_configuration(assets["lbs_config_text"], names)
        vertices = np.asarray(skin["RestPositions"], dtype=np.float32).reshape(-1, 3)
        topology = assets.get("topology") or {
            "vi": np.reshape(skin["Faces"]["Indices"], (-1, 3)),
            "vt": np.reshape(skin["TextureCoordinates"], (-1, 2)),
            "vti": np.reshape(skin["Faces"]["TextureIndices"], (-1, 3)),
        }
        parents = np.array([bone["Parent"] if 0 <= bone["Parent"] < len(bones) else -1 for bone in bones], dtype=np.int64)
        faces, uv, uv_faces = (np.asarray(topology[key]) for key in ("vi", "vt", "vti"))
        num_scales = int(config["nr_scaling_params"])
        transform = np.asarray(config["transform"], dtype=np.float64)
        order = _row_order(names, tuple(map(str, config["joint_names"])), where)
        return MomentumModel(
            joint_names=names,
            joint_parents=parents,
            pre_rotations=np.array([bone["PreRotation"] for bone in bones], dtype=np.float64),
            translation_offsets=np.array([bone["TranslationOffset"] for bone in bones], dtype=np.float64),
            parameter_names=_parameter_names(config, transform[order], names),
            num_scales=num_scales,
            transform=transform[order],
            transform_offsets=np.asarray(config["transform_offsets"], dtype=np.float64).reshape(-1)[order],
            limits=_limits(config),
            rest_vertices=vertices,
            skinning_weights=_weights(skin, len(vertices), len(bones)),
            faces=faces.astype(np.int64),
            uv=uv.astype(np.float32),
            uv_faces=uv_faces.astype(np.int64),
            global_scaling=np.asarray(assets.get("global_scaling", (10.0, 10.0, 10.0)), dtype=np.float64).reshape(3),
            face_weights=_face_weights(assets, len(vertices), uv, uv_faces, faces),
        )
    except (KeyError, TypeError, IndexError) as error:
        raise ValueError(
            f"momentum_from_assets(): expected a skeleton, a skinned mesh and their parameter transform in {where}; got "
            f"{type(error).__name__}: {error}. Name the assets of a body (static_assets_body.pt)."
        ) from error


def parse_configuration(text: str, joint_names: Sequence[str]) -> dict[str, Any]:
    """Read configuration text: `joint.channel = 1.0 * parameter + 0.5 * other`, `limit parameter minmax [low, high] weight`.

    Comments start with '#'; `parameterset` lines are not needed. Parameters whose names start with "scale" are scale parameters and
    come last, as the pose files leave them out.

    Returns:
        joint_names, channel_names, parameter_names, transform, transform_offsets, limits, nr_scaling_params, nr_position_params.

    Raises:
        ValueError: for a line of another form, an unknown joint or an unknown channel.
    """
    rows: list[tuple[int, float, str]] = []
    offsets = np.zeros(7 * len(joint_names))
    limits: list[dict[str, Any]] = []
    for number, raw in enumerate(text.splitlines(), start=1):
        line = raw.partition("#")[0].strip()
        if not line or line.startswith("parameterset"):
            continue
        if line.startswith("limit "):
            limits += _parsed_limit(line)
            continue
        target, equals, formula = line.partition("=")
        joint, dot, channel = target.strip().rpartition(".")
        if not equals or not dot or joint not in joint_names or channel not in CHANNELS:
            raise ValueError(
                f"parse_configuration(): expected 'joint.channel = factor * parameter + ...' of a known joint in line {number}; got "
                f"{raw.strip()!r}. Take configuration and model of one release."
            )
        row = 7 * list(joint_names).index(joint) + CHANNELS.index(channel)
        for factor, parameter in _terms(formula, number):
            if parameter:
                rows.append((row, factor, parameter))
            else:
                offsets[row] += factor
    seen = list(dict.fromkeys(parameter for _, _, parameter in rows))
    pose = [name for name in seen if not name.startswith("scale")]
    scales = [name for name in seen if name.startswith("scale")]
    transform = np.zeros((7 * len(joint_names), len(seen)))
    for row, factor, parameter in rows:
        transform[row, (pose + scales).index(parameter)] += factor
    return {
        "joint_names": list(joint_names),
        "channel_names": list(CHANNELS),
        "parameter_names": pose + scales,
        "limits": limits,
        "transform": transform,
        "transform_offsets": offsets[None],
        "nr_scaling_params": len(scales),
        "nr_position_params": len(pose),
    }


def model_document(model: MomentumModel) -> dict[str, Any]:
    """The model as `lbs_model_json`: what `momentum_from_assets` reads."""
    parents = np.where(model.joint_parents < 0, NO_PARENT, model.joint_parents)
    bones = [
        {"Name": name, "Parent": int(parent), "PreRotation": rotation.tolist(), "TranslationOffset": offset.tolist()}
        for name, parent, rotation, offset in zip(model.joint_names, parents, model.pre_rotations, model.translation_offsets, strict=True)
    ]
    rows, joints = np.nonzero(model.skinning_weights)
    weights = model.skinning_weights[rows, joints]
    counts = np.bincount(rows, minlength=len(model.rest_vertices))
    return {
        "Skeleton": {"Bones": bones},
        "SkinnedModel": {
            "RestPositions": model.rest_vertices.astype(float).tolist(),
            "RestVertexNormals": _normals(model).tolist(),
            "SkinningWeights": [[int(joint), float(weight)] for joint, weight in zip(joints, weights, strict=True)],
            "SkinningOffsets": [0, *np.cumsum(counts).tolist()],
            "Faces": {"Indices": model.faces.ravel().tolist(), "TextureIndices": model.uv_faces.ravel().tolist()},
            "TextureCoordinates": model.uv.astype(float).ravel().tolist(),
        },
    }


def configuration_text(model: MomentumModel) -> str:
    """The parameter transform as text; every line ends, also the last, because readers cut lines at their end."""
    lines = ["# parameter transform of the body model"]
    for row in np.flatnonzero(np.abs(model.transform).sum(axis=1) + np.abs(model.transform_offsets)):
        terms = [f"{model.transform[row, p]!r} * {model.parameter_names[p]}" for p in np.flatnonzero(model.transform[row])]
        terms = [term.replace("np.float64(", "").replace(")", "") for term in terms]
        if model.transform_offsets[row]:
            terms.append(repr(float(model.transform_offsets[row])))
        lines.append(f"{model.joint_names[row // 7]}.{CHANNELS[row % 7]} = {' + '.join(terms)}")
    lines += [f"limit {name} minmax [{low!r}, {high!r}] 1.0" for name, (low, high) in model.limits.items()]
    return "\n".join(lines) + "\n"


def _terms(formula: str, number: int) -> list[tuple[float, str]]:
    """Factors and parameters of a sum; a number alone has the parameter ''."""
    terms = []
    for part in re.split(r"\s\+\s", formula.strip()):
        match = TERM.match(part.strip())
        try:
            if match is None:
                raise ValueError(part)
            factor, parameter = match.groups()
            if factor is None and re.fullmatch(r"[-+]?[0-9.]+(?:[eE][-+]?[0-9]+)?", parameter):
                terms.append((float(parameter), ""))
            else:
                terms.append((1.0 if factor is None else float(factor), parameter.strip()))
        except ValueError as error:
            raise ValueError(
                f"parse_configuration(): expected 'factor * parameter' in line {number}; got {part!r}. Copy the configuration again."
            ) from error
    return terms


def _parsed_limit(line: str) -> list[dict[str, Any]]:
    """A limit of one parameter; other kinds of limits tie parameters together and are left out."""
    match = re.match(r"limit\s+(\S+)\s+(minmax|minmax_passive)\s*\[\s*([^,\]]+),\s*([^\]]+)\]\s*(\S*)", line)
    if match is None:
        return []
    name, kind, low, high, weight = match.groups()
    return [{"name": name, "type": kind, "range": (float(low), float(high)), "weight": float(weight or 1.0)}]


def _limits(config: Mapping[str, Any]) -> dict[str, tuple[float, float]]:
    """Ranges of parameters, from entries in the form that `parse_configuration` makes; others are left out."""
    entries = [entry for entry in config.get("limits") or () if isinstance(entry, Mapping) and {"name", "range"} <= set(entry)]
    return {str(entry["name"]): (float(entry["range"][0]), float(entry["range"][1])) for entry in entries}


def _row_order(names: tuple[str, ...], config_names: tuple[str, ...], where: Path) -> Int64[np.ndarray, "C"]:
    """Rows of the transform in the order of the bones."""
    if sorted(names) != sorted(config_names):
        raise ValueError(
            f"momentum_from_assets(): expected the same joints in skeleton and configuration of {where}; got {len(names)} and "
            f"{len(config_names)} of which {len(set(names) & set(config_names))} are shared. Take both from one release."
        )
    index = np.array([config_names.index(name) for name in names], dtype=np.int64)
    return (7 * index[:, None] + np.arange(7)).ravel()


def _parameter_names(config: Mapping[str, Any], transform: np.ndarray, names: tuple[str, ...]) -> tuple[str, ...]:
    """Names of the columns; releases do not keep them, so a parameter is called by the first channel that it moves."""
    if config.get("parameter_names"):
        return tuple(map(str, config["parameter_names"]))
    found = []
    for column in transform.T:
        rows = np.flatnonzero(column)
        name = f"{names[rows[0] // 7]}.{CHANNELS[rows[0] % 7]}" if len(rows) else "unused"
        found.append(name if name not in found else f"{name}_{len(found)}")
    return tuple(found)


def _weights(skin: Mapping[str, Any], vertices: int, joints: int) -> Float32[np.ndarray, "V J"]:
    """Skinning weights from the sparse rows of the model, normalized."""
    pairs = np.asarray(skin["SkinningWeights"], dtype=np.float64).reshape(-1, 2)
    offsets = np.asarray(skin["SkinningOffsets"], dtype=np.int64)
    if len(offsets) != vertices + 1 or offsets[-1] != len(pairs):
        raise KeyError(f"SkinningOffsets of {vertices} vertices and {len(pairs)} weights")
    weights = np.zeros((vertices, joints))
    np.add.at(weights, (np.repeat(np.arange(vertices), np.diff(offsets)), pairs[:, 0].astype(np.int64)), pairs[:, 1])
    return (weights / weights.sum(axis=1, keepdims=True)).astype(np.float32)


def _face_weights(assets: Mapping[str, Any], vertices: int, uv: np.ndarray, uv_faces: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """[V] where facial movement displaces the surface, from whichever mask the assets have."""
    for key in ("mouth_eyes_mask_geom", "full_head_mask_geom"):
        mask = assets.get(key)
        if mask is not None and np.size(mask) == vertices:
            return np.asarray(mask, dtype=np.float32).reshape(vertices).clip(0, 1)
    mask = assets.get("face_mask")
    weights = np.zeros(vertices, np.float32)
    if mask is not None:
        image = np.asarray(mask, dtype=np.float32).reshape(np.shape(mask)[-2:])
        height, width = image.shape
        column = (uv[:, 0] * width).astype(np.int64).clip(0, width - 1)
        row = ((1 - uv[:, 1]) * height).astype(np.int64).clip(0, height - 1)
        np.maximum.at(weights, np.asarray(faces).ravel(), image[row, column][np.asarray(uv_faces).ravel()].clip(0, 1))
    return weights


def _normals(model: MomentumModel) -> np.ndarray:
    """[V, 3] area-weighted vertex normals of the rest surface."""
    corners = model.rest_vertices[model.faces].astype(np.float64)
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros((len(model.rest_vertices), 3))
    np.add.at(normals, model.faces.ravel(), np.repeat(across, 3, axis=0))
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
