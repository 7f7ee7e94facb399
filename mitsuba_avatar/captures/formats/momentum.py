"""The momentum body model of Goliath captures: skeleton, parameter transform, skinned template; its forward kinematics in numpy.

Symbols: J joints, P pose parameters (6 of the root, then the local ones), S scale parameters, V vertices. Lengths are the model's own
(centimetres); `global_scaling` makes them millimetres. Seven channels move a joint: tx ty tz (centimetres), rx ry rz (radians), sc (a
power of two). They are linear in the parameters: channels = transform @ [pose; scales] + offsets. A joint's local transform is

    translation offset + (tx ty tz),   pre-rotation * Rz(rz) Ry(ry) Rx(rx),   2 ** sc.

`body/momentum_rig.py` makes a `Rig` of it; here it is only data and its own definition of posing, which tests compare with.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32, Float64, Int64
from scipy.spatial.transform import Rotation

from mitsuba_avatar.files import atomic_path

CHANNELS = ("tx", "ty", "tz", "rx", "ry", "rz", "sc")
FORMAT_VERSION = 1
_ARRAYS = (
    *("joint_parents", "pre_rotations", "translation_offsets", "transform", "transform_offsets", "rest_vertices", "skinning_weights"),
    *("faces", "uv", "uv_faces", "global_scaling", "face_weights"),
)


@dataclass(frozen=True, eq=False)
class JointStates:
    """Global transforms of joints: x -> scale * rotation @ x + translation.

    Attributes:
        rotations: [..., J, 3, 3].
        translations: [..., J, 3] centimetres.
        scales: [..., J].
    """

    rotations: Float64[np.ndarray, "*batch J 3 3"]
    translations: Float64[np.ndarray, "*batch J 3"]
    scales: Float64[np.ndarray, "*batch J"]


@dataclass(frozen=True, eq=False)
class MomentumModel:
    """A momentum body model.

    Attributes:
        joint_names: J names.
        joint_parents: [J] parent before child, -1 for roots.
        pre_rotations: [J, 4] unit quaternions x, y, z, w.
        translation_offsets: [J, 3] centimetres, from the parent, in its axes.
        parameter_names: P + S names, pose parameters first.
        num_scales: S.
        transform: [7 J, P + S]; row 7 j + c moves channel c of joint j.
        transform_offsets: [7 J].
        limits: parameter name -> (lower, upper); radians.
        rest_vertices: [V, 3] centimetres, in the pose of zero parameters.
        skinning_weights: [V, J], rows sum to 1.
        faces, uv, uv_faces: [F, 3], [T, 2], [F, 3] topology and atlas.
        global_scaling: [3] millimetres a unit.
        face_weights: [V] in [0, 1], 1 where facial movement displaces the surface; zeros if the model does not say.

    Raises:
        ValueError: if the parts do not fit each other.
    """

    joint_names: tuple[str, ...]
    joint_parents: Int64[np.ndarray, "J"]
    pre_rotations: Float64[np.ndarray, "J 4"]
    translation_offsets: Float64[np.ndarray, "J 3"]
    parameter_names: tuple[str, ...]
    num_scales: int
    transform: Float64[np.ndarray, "C PS"]
    transform_offsets: Float64[np.ndarray, "C"]
    rest_vertices: Float32[np.ndarray, "V 3"]
    skinning_weights: Float32[np.ndarray, "V J"]
    faces: Int64[np.ndarray, "F 3"]
    uv: Float32[np.ndarray, "T 2"]
    uv_faces: Int64[np.ndarray, "F 3"]
    global_scaling: Float64[np.ndarray, "3"]
    face_weights: Float32[np.ndarray, "V"]
    limits: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        joints, vertices = len(self.joint_names), len(self.rest_vertices)
        for name, shape in (
            ("joint_parents", (joints,)),
            ("pre_rotations", (joints, 4)),
            ("translation_offsets", (joints, 3)),
            ("transform", (7 * joints, len(self.parameter_names))),
            ("transform_offsets", (7 * joints,)),
            ("skinning_weights", (vertices, joints)),
            ("face_weights", (vertices,)),
        ):
            array = getattr(self, name)
            if array.shape != shape or not np.isfinite(array).all():
                raise ValueError(
                    f"MomentumModel(): expected finite {name} {list(shape)}; got {list(array.shape)}. "
                    "Take skeleton, configuration and mesh of one release."
                )
        if np.any(self.joint_parents >= np.arange(joints)):
            raise ValueError("MomentumModel(): expected parents before children; got another order. Sort the bones from the root outwards.")

    @property
    def num_pose(self) -> int:
        """P: values in a pose file."""
        return len(self.parameter_names) - self.num_scales

    def channels(self, pose: Float[np.ndarray, "*batch P"], scales: Float[np.ndarray, "S"]) -> Float64[np.ndarray, "*batch J 7"]:
        """The seven channels of every joint.

        Raises:
            ValueError: for another number of values than the model's parameters.
        """
        if pose.shape[-1] != self.num_pose or len(scales) != self.num_scales:
            raise ValueError(
                f"MomentumModel.channels(): expected {self.num_pose} pose and {self.num_scales} scale values for this model; got "
                f"{pose.shape[-1]} and {len(scales)}. Take poses and model of one release."
            )
        values = np.concatenate([pose, np.broadcast_to(scales, (*pose.shape[:-1], len(scales)))], axis=-1, dtype=np.float64)
        return (values @ self.transform.T + self.transform_offsets).reshape(*pose.shape[:-1], -1, 7)

    def joint_states(self, pose: Float[np.ndarray, "*batch P"], scales: Float[np.ndarray, "S"]) -> JointStates:
        """Forward kinematics. Raises as `channels`."""
        channels = self.channels(pose, scales)
        batch = channels.shape[:-2]
        turns = Rotation.from_euler("xyz", channels[..., 3:6].reshape(-1, 3)).as_matrix().reshape(*batch, -1, 3, 3)
        local_rotations = Rotation.from_quat(self.pre_rotations).as_matrix() @ turns
        local_translations = self.translation_offsets + channels[..., 0:3]
        local_scales = 2.0 ** channels[..., 6]
        rotations, translations, scalings = np.empty_like(local_rotations), np.empty_like(local_translations), np.empty_like(local_scales)
        for joint, parent in enumerate(self.joint_parents.tolist()):
            if parent < 0:
                rotations[..., joint, :, :], translations[..., joint, :] = (
                    local_rotations[..., joint, :, :],
                    local_translations[..., joint, :],
                )
                scalings[..., joint] = local_scales[..., joint]
                continue
            scaled = scalings[..., parent, None] * local_translations[..., joint, :]
            rotations[..., joint, :, :] = rotations[..., parent, :, :] @ local_rotations[..., joint, :, :]
            translations[..., joint, :] = (rotations[..., parent, :, :] @ scaled[..., None])[..., 0] + translations[..., parent, :]
            scalings[..., joint] = scalings[..., parent] * local_scales[..., joint]
        return JointStates(rotations, translations, scalings)

    def pose_vertices(
        self, template: Float[np.ndarray, "V 3"], pose: Float[np.ndarray, "P"], scales: Float[np.ndarray, "S"]
    ) -> Float64[np.ndarray, "V 3"]:
        """Linear blend skinning of a template [V, 3] in centimetres; the result is in millimetres. Raises as `channels`."""
        posed, bind = self.joint_states(pose, scales), self.joint_states(np.zeros(self.num_pose), np.zeros(self.num_scales))
        scales_from_bind = posed.scales / bind.scales
        linear = scales_from_bind[:, None, None] * posed.rotations @ np.swapaxes(bind.rotations, -1, -2)
        offset = posed.translations - (linear @ bind.translations[..., None])[..., 0]
        weights = self.skinning_weights.astype(np.float64)
        blended = np.tensordot(weights, linear, axes=1)  # [V, 3, 3]
        return ((blended @ template.astype(np.float64)[..., None])[..., 0] + weights @ offset) * self.global_scaling


def save_momentum(path: Path | str, model: MomentumModel) -> None:
    """Write a model as one compressed `.npz`, which opens without running anything; whole or not at all."""
    arrays = {name: getattr(model, name) for name in _ARRAYS}
    arrays |= {name: np.array(getattr(model, name), dtype=np.str_) for name in ("joint_names", "parameter_names")}
    arrays |= {"num_scales": np.array(model.num_scales), "momentum_format_version": np.array(FORMAT_VERSION)}
    arrays |= {"limit_names": np.array(list(model.limits), dtype=np.str_), "limits": np.array(list(model.limits.values())).reshape(-1, 2)}
    with atomic_path(path) as temporary:
        np.savez_compressed(temporary, **arrays)


def momentum_from_arrays(arrays: Mapping[str, np.ndarray], where: Path) -> MomentumModel:
    """A model from the arrays that `save_momentum` wrote.

    Raises:
        ValueError: for another version, or a missing array.
    """
    expected = {*_ARRAYS, "joint_names", "parameter_names", "num_scales", "limit_names", "limits", "momentum_format_version"}
    missing = sorted(expected - set(arrays))
    if missing or int(arrays["momentum_format_version"]) != FORMAT_VERSION:
        raise ValueError(
            f"momentum_from_arrays(): expected a body model of version {FORMAT_VERSION} in {where}; got one without {missing[:5]}. "
            "Make it from static_assets_body.pt again."
        )
    limits = {str(name): (float(low), float(high)) for name, (low, high) in zip(arrays["limit_names"], arrays["limits"], strict=True)}
    return MomentumModel(
        joint_names=tuple(map(str, arrays["joint_names"])),
        parameter_names=tuple(map(str, arrays["parameter_names"])),
        num_scales=int(arrays["num_scales"]),
        limits=limits,
        **{name: arrays[name] for name in _ARRAYS},
    )
