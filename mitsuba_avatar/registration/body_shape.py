"""How the Anny person's rest shape changes with its phenotype: tangents that a fit can follow.

Anny makes a body from a few numbers (gender, muscle, weight, ...). Its blend shapes are piecewise linear in them, so a tangent taken by
finite differences about the present shape serves for small steps; the rig is rebuilt after larger ones.

Symbols: V vertices, J joints, S shape parameters. Metres.
"""

from dataclasses import dataclass, fields

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor

from mitsuba_avatar.body.anny_files import load_anny
from mitsuba_avatar.body.anny_rig import AnnyPhenotype
from mitsuba_avatar.body.rig import Rig

PARAMETERS = tuple(field.name for field in fields(AnnyPhenotype))
STEP = 0.04  # of a phenotype's 0..1 in finite differences: wide enough to look beyond a kink of the piecewise linear blend
DIGITS = 3  # to which phenotypes are rounded, so that a rebuilt rig is found in the cache


@dataclass(frozen=True, eq=False)
class ShapeTangent:
    """A rest shape and its derivatives by phenotype, with respect to which a change `delta` [S] is meant.

    Attributes:
        phenotype: [S] where the tangent touches.
        vertices, joints: [V, 3], [J, 3] of the rig there.
        vertices_by_parameter, joints_by_parameter: [S, V, 3], [S, J, 3] metres per unit.
    """

    phenotype: Float32[Tensor, "S"]
    vertices: Float32[Tensor, "V 3"]
    joints: Float32[Tensor, "J 3"]
    vertices_by_parameter: Float32[Tensor, "S V 3"]
    joints_by_parameter: Float32[Tensor, "S J 3"]

    def rest(self, delta: Float[Tensor, "S"]) -> tuple[Float[Tensor, "V 3"], Float[Tensor, "J 3"]]:
        """Vertices and joints after a change of the phenotype. Gradients: to delta."""
        vertices = self.vertices + torch.tensordot(delta, self.vertices_by_parameter, dims=1)
        return vertices, self.joints + torch.tensordot(delta, self.joints_by_parameter, dims=1)

    def moved(self, delta: Float[Tensor, "S"]) -> AnnyPhenotype:
        """The phenotype after a change, within 0..1."""
        values = (self.phenotype + delta.detach()).clamp(0, 1).tolist()
        return AnnyPhenotype(**{name: round(value, DIGITS) for name, value in zip(PARAMETERS, values, strict=True)})


def frozen_shape(rig: Rig, phenotype: AnnyPhenotype) -> ShapeTangent:
    """The shape of a rig, with derivatives of zero: for everything that moves a body without changing its phenotype."""
    parameters = torch.tensor([getattr(phenotype, name) for name in PARAMETERS])
    vertices, joints = torch.from_numpy(rig.rest_vertices), torch.from_numpy(rig.joint_positions)
    still = torch.zeros(len(PARAMETERS), 1, 1)
    return ShapeTangent(
        parameters,
        vertices,
        joints,
        still.expand(-1, *vertices.shape),
        still.expand(-1, *joints.shape),
    )


class AnnyShapes:
    """Evaluates Anny's rest shape; loading takes a few seconds."""

    def __init__(self) -> None:
        self._anny = load_anny("none")

    def tangent(self, phenotype: AnnyPhenotype) -> ShapeTangent:
        """Value and derivatives at a phenotype: central differences, one-sided at the ends of 0..1."""
        values = np.array([getattr(phenotype, name) for name in PARAMETERS])
        vertices, joints = self._rest(values)
        by_vertex, by_joint = [], []
        for index in range(len(PARAMETERS)):
            low, high = values.copy(), values.copy()
            low[index], high[index] = max(0.0, values[index] - STEP), min(1.0, values[index] + STEP)
            (low_vertices, low_joints), (high_vertices, high_joints) = self._rest(low), self._rest(high)
            by_vertex.append((high_vertices - low_vertices) / (high[index] - low[index]))
            by_joint.append((high_joints - low_joints) / (high[index] - low[index]))
        return ShapeTangent(torch.from_numpy(values).float(), vertices, joints, torch.stack(by_vertex), torch.stack(by_joint))

    def _rest(self, values: Float[np.ndarray, "S"]) -> tuple[Float32[Tensor, "V 3"], Float32[Tensor, "J 3"]]:
        """Rest vertices and joints, feet on z = 0 as the rig has them."""
        with torch.no_grad():
            rest = self._anny(phenotype_kwargs=dict(zip(PARAMETERS, values.tolist(), strict=True)))
        vertices, joints = rest["rest_vertices"][0].double(), rest["rest_bone_heads"][0].double()
        ground = vertices.new_tensor([0, 0, float(vertices[:, 2].min())])
        return (vertices - ground).float(), (joints - ground).float()
