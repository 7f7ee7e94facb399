"""A cloth over a ball, where the right answers are known: a rig of one joint whose skin is a sphere, and a square of cloth above it."""

import numpy as np
import trimesh

from mitsuba_avatar.body.mesh import unique_edges
from mitsuba_avatar.body.rig import DofTable, Rig, Topology
from mitsuba_avatar.filming.clothing import Garment
from mitsuba_avatar.filming.garment_mesh import GarmentMesh, find_hinges, flat_weights, hang_from
from mitsuba_avatar.filming.wardrobe import Fabric, Outfit

RADIUS = 0.15
CENTRE = np.array([0.0, 0.0, 0.5])
COTTON = Fabric(fit=1.0, stretch_time=5e-4, bend_time=0.02, damping=4.0, friction=0.4, gap=0.004)


def ball_rig() -> Rig:
    """A sphere on one joint at its centre, which turns about Z and, by a second angle, about X."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=RADIUS)
    vertices = (ball.vertices + CENTRE).astype(np.float32)
    count = len(vertices)
    return Rig(
        name="ball",
        topology=Topology(count, ball.faces.astype(np.int64), np.zeros((3, 2), np.float32), np.tile(np.arange(3), (len(ball.faces), 1))),
        rest_vertices=vertices,
        joint_names=("centre",),
        joint_parents=np.array([-1]),
        joint_positions=CENTRE[None].astype(np.float32),
        skinning_weights=np.ones((count, 1), np.float32),
        dofs=DofTable(
            names=("turn", "tilt"),
            joints=np.array([0, 0]),
            axes=np.array([[0, 0, 1], [1, 0, 0]], np.float32),
            lower=np.array([-9, -9], np.float32),
            upper=np.array([9, 9], np.float32),
        ),
        face_region=np.zeros(count, np.float32),
        face_keypoint_names=(),
        face_keypoint_vertices=np.zeros(0, np.int64),
        keypoint_names=(),
    )


def square_outfit(rig: Rig, size: float, height: float, fabric: Fabric = COTTON, pinned_edge: bool = False, cells: int = 16) -> Outfit:
    """A level square of cloth, `size` metres wide (half as deep), its middle `height` metres above the ball's centre."""
    columns, rows = np.meshgrid(np.linspace(-0.5, 0.5, cells + 1), np.linspace(-0.25, 0.25, cells // 2 + 1))
    vertices = np.stack([columns.ravel() * size, rows.ravel() * size, np.full(columns.size, CENTRE[2] + height)], axis=1)
    index = np.arange(columns.size).reshape(columns.shape)
    a, b, c, d = index[:-1, :-1].ravel(), index[:-1, 1:].ravel(), index[1:, 1:].ravel(), index[1:, :-1].ravel()
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    edges, hinges = unique_edges(faces), find_hinges(faces)
    pinned = np.isclose(vertices[:, 0], vertices[:, 0].min()) & pinned_edge
    tethers, tether_lengths = hang_from(vertices, np.concatenate([edges, hinges[:, 2:]]), pinned)
    count = len(vertices)
    mesh = GarmentMesh(
        name="square",
        topology=Topology(count, faces, np.zeros((3, 2), np.float32), np.tile(np.arange(3), (len(faces), 1))),
        rest_vertices=vertices.astype(np.float32),
        body_vertices=np.arange(5),
        skinning_weights=np.ones((count, 1), np.float32),
        edges=edges,
        edge_lengths=np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1).astype(np.float32),
        hinges=hinges,
        hinge_weights=flat_weights(vertices[hinges]).astype(np.float32),
        pinned=pinned,
        tethers=tethers,
        tether_lengths=tether_lengths.astype(np.float32),
    )
    everywhere = np.ones(rig.topology.num_vertices, dtype=bool)
    nothing = Garment("square", ~everywhere, (), np.zeros(len(everywhere), np.float32), ~everywhere, 0)
    return Outfit(nothing, mesh, fabric, (), rig.rest_vertices, everywhere)
