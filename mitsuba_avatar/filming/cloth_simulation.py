"""Simulated clothing: a garment falls onto the body and is carried through a motion; its shape remembers how a pose was reached.

The body is posed anew at every substep, from pose angles interpolated between frames; cloth is stopped by the plane of the closest
triangle there and rubs on the skin as it moves. Every segment starts afresh: the garment is put on in the rest pose and the person moves
into the segment's first pose before its first frame. Segments can therefore be simulated apart, in any order. One processor core, no
randomness: the same inputs give the same bits.

Symbols: N frames, V body vertices, D pose angles, S substeps, G vertices of the garment's mesh. Metres, radians, seconds, world axes.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from jaxtyping import Bool, Float, Float32, Int32
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation, RotationSpline

from mitsuba_avatar.body.rig import Rig
from mitsuba_avatar.filming import cloth_kernels as kernels
from mitsuba_avatar.filming.settings import ClothingSettings
from mitsuba_avatar.filming.wardrobe import Outfit

DEVICE = "cpu"  # a Gauss-Seidel sweep is sequential: a GPU would be slower
GRAVITY = 9.81
QUERIES_PER_SECOND = 50  # at which the body's closest triangles are searched anew
LARGEST_SPEED = 6.0  # metres per second of a cloth vertex
SETTLE_SHARE = 0.7  # of the settling time until the first pose is reached; then the person holds still
FARTHEST = 0.3  # metres from the body: cloth beyond is not carried by it, and a sign of an explosion
LARGEST_STRETCH, STRETCH_SLACK = 3.0, 0.03  # factor and metres on top by which a thread may be longer than at rest
DEEPEST, SHARE_DEEP = 0.04, 0.02  # metres inside the body at which cloth counts as lost, and the share of vertices that may be


@dataclass(frozen=True, eq=False)  # arrays have no truth value to compare by
class BodyMotion:
    """How the body beneath the cloth moves.

    Attributes:
        theta: [N, D] radians.
        root: [N, 4, 4] rigid world_from_root.
        fps: frames per second.
        rest_vertices: [V, 3], or [N, V, 3] where what is worn beneath changes its rest shape: the surface that stops cloth, before
            skinning. Metres.
    """

    theta: Float32[np.ndarray, "N D"]
    root: Float32[np.ndarray, "N 4 4"]
    fps: float
    rest_vertices: Float32[np.ndarray, "*frames V 3"]

    def rest_at(self, frame: int) -> Float32[np.ndarray, "V 3"]:
        """The rest surface of a frame."""
        return self.rest_vertices[frame] if self.rest_vertices.ndim == 3 else self.rest_vertices

    def curves(self) -> tuple[Callable[[np.ndarray], np.ndarray], Callable[[np.ndarray], np.ndarray]]:
        """Smooth pose angles and root between frames: functions of time, counted in frames.

        At 10 frames a second, vertices on straight lines between frames would cut through the arcs that limbs describe.
        """
        times = np.arange(len(self.theta), dtype=np.float64)
        if len(times) == 1:
            return lambda at: np.repeat(self.theta, len(at), axis=0), lambda at: np.repeat(self.root, len(at), axis=0)
        values = np.concatenate([self.theta, self.root[:, :3, 3]], axis=1).astype(np.float64)
        spline = CubicHermiteSpline(times, values, np.gradient(values, axis=0))
        turns = RotationSpline(times, Rotation.from_matrix(self.root[:, :3, :3].astype(np.float64)))

        def root_at(at: np.ndarray) -> np.ndarray:
            root = np.tile(np.eye(4), (len(at), 1, 1))
            root[:, :3, :3], root[:, :3, 3] = turns(at).as_matrix(), spline(at)[:, -3:]
            return root

        return lambda at: spline(at)[:, :-3], root_at


@dataclass(frozen=True, eq=False)  # arrays have no truth value to compare by
class ClothState:
    """A simulated garment at a frame of its segment, and all that a simulation needs to go on from there to the same bits.

    Attributes:
        frame: of the segment, counted from 0.
        vertices: [G, 3] the garment; velocities: [G, 3] metres per second.
        steps: how many were taken, settling included.
        contact_faces, contact_places, contact_distances: of each vertex, the body's triangle closest to it at the last search.
        body_points: [O, 3] the surface that stops cloth, as posed.
        searched_at: [G, 3] where vertices were at that search; empty where folds do not keep apart.
    """

    frame: int
    vertices: Float32[np.ndarray, "G 3"]
    velocities: Float32[np.ndarray, "G 3"]
    steps: int
    contact_faces: Int32[np.ndarray, "G"]  # noqa: F821
    contact_places: Float32[np.ndarray, "G 2"]
    contact_distances: Float32[np.ndarray, "G"]  # noqa: F821
    body_points: Float32[np.ndarray, "O 3"]
    searched_at: Float32[np.ndarray, "_ 3"]


class ClothSimulator:
    """One garment on one body; the constants of a simulation, and its steps."""

    def __init__(self, rig: Rig, outfit: Outfit, settings: ClothingSettings):
        """Upload what does not change. The first simulator of a machine compiles the kernels, in about ten seconds."""
        self.mesh, self.fabric, self.settings = outfit.mesh, outfit.fabric, settings
        faces = rig.topology.faces[outfit.is_obstacle[rig.topology.faces].all(axis=1)]
        self.body_vertices, corners = np.unique(faces, return_inverse=True)
        self.skin = _Skinned(rig.skinning_weights[self.body_vertices])
        self.skeleton = _Skeleton(rig)
        self.faces, self.corners = _integers(corners.reshape(-1, 3)), _integers(corners.reshape(-1))
        pins = np.flatnonzero(self.mesh.pinned)
        self.pins, self.pin_vertices = _Skinned(self.mesh.skinning_weights[pins]), _integers(pins)
        self.pin_rest = _vectors(self.mesh.rest_vertices[pins])
        self.edges, self.edge_lengths = _integers(self.mesh.edges), _floats(self.mesh.edge_lengths)
        self.hinges = _integers(self.mesh.hinges)
        self.hinge_weights = wp.array(self.mesh.hinge_weights, dtype=wp.vec4, device=DEVICE)
        self.tethers, self.tether_lengths = _integers(self.mesh.tethers), _floats(self.mesh.tether_lengths)
        self.inverse_mass, self.rest = _floats(1.0 - self.mesh.pinned), _vectors(self.mesh.rest_vertices)

    def states(self, motion: BodyMotion, segment: str, seed: int = 0, after: ClothState | None = None) -> Iterator[ClothState]:
        """Simulate one segment frame by frame.

        Args:
            motion: of the body in the whole segment.
            segment: its name, for messages.
            seed: of the start noise; without such noise it has no effect.
            after: a state of this simulation, to go on from; None starts with the garment put on. Both give the same bits.

        Raises:
            ValueError: if the cloth explodes; the message names frame, segment and the setting to change.
        """
        per_frame = max(1, int(np.ceil(self.settings.substeps_per_second / motion.fps - 1e-9)))
        time_step = 1 / motion.fps / per_frame
        run = _Run(self, motion, time_step, seed)
        if after is None:
            settle = max(1, round(self.settings.settle_time / time_step))
            ramp = np.clip(np.arange(1, settle + 1) / (SETTLE_SHARE * settle), 0, 1)
            ramp = ramp * ramp * (3 - 2 * ramp)
            run.go(ramp[:, None] * motion.theta[:1], np.repeat(motion.root[:1], settle, axis=0))
        else:
            run.restore(after, motion)
        theta_at, root_at = motion.curves()
        for frame in range(0 if after is None else after.frame + 1, len(motion.theta)):
            if frame > 0:
                run.aim_at(motion.rest_at(frame)[self.body_vertices])
                times = frame - 1 + np.arange(1, per_frame + 1) / per_frame
                run.go(theta_at(times), root_at(times))
            state = run.state(frame)
            self._check(state.vertices, run, f"frame {frame} of segment {segment!r}")
            yield state

    def _check(self, vertices: Float32[np.ndarray, "G 3"], run: "_Run", where: str) -> None:
        """Refuse cloth that has exploded."""
        remedy = (
            f"Raise clothing.substeps_per_second (now {self.settings.substeps_per_second}), move more slowly, "
            "or keep the limbs farther from the trunk."
        )
        if not np.isfinite(vertices).all():
            raise ValueError(f"states(): expected finite cloth; got NaN or infinity at {where}. {remedy}")
        ends = vertices[self.mesh.edges]
        excess = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1) - LARGEST_STRETCH * self.mesh.edge_lengths - STRETCH_SLACK
        if excess.max() > 0:
            raise ValueError(
                f"states(): expected cloth that holds together; got a thread {excess.max():.3f} m beyond "
                f"{LARGEST_STRETCH:g} times its length at {where}. {remedy}"
            )
        depth, is_near = run.depth()
        if np.mean(~is_near) > SHARE_DEEP:
            raise ValueError(
                f"states(): expected cloth within {FARTHEST} m of the body; {100 * np.mean(~is_near):.0f} % are farther "
                f"at {where}. {remedy}"
            )
        if np.mean(depth > DEEPEST) > SHARE_DEEP:
            raise ValueError(
                f"states(): expected cloth outside the body; {100 * np.mean(depth > DEEPEST):.0f} % lie more than {DEEPEST} m "
                f"inside at {where}. {remedy}"
            )


class _Run:
    """The state of one segment's simulation."""

    def __init__(self, simulator: ClothSimulator, motion: BodyMotion, time_step: float, seed: int):
        self.simulator, self.time_step = simulator, time_step
        mesh, fabric, root = simulator.mesh, simulator.fabric, motion.root[0].astype(np.float64)
        self.query_every = max(1, round(1 / time_step / QUERIES_PER_SECOND))
        self.step = step = kernels.Step()
        step.time_step, step.gravity, step.largest_move = time_step, GRAVITY, LARGEST_SPEED * time_step
        step.damping, step.gap, step.friction = fabric.damping, fabric.gap, fabric.friction
        start = mesh.rest_vertices @ root[:3, :3].T + root[:3, 3]
        noise = np.random.default_rng(seed).normal(size=start.shape) / np.sqrt(3)
        self.positions = _vectors(start + simulator.settings.start_noise * noise)
        self.cloth = cloth = kernels.Cloth()
        cloth.positions, cloth.before, cloth.velocities = self.positions, wp.zeros_like(self.positions), wp.zeros_like(self.positions)
        cloth.inverse_mass = simulator.inverse_mass
        self.rest_before = self.rest_after = _vectors(motion.rest_at(0)[simulator.body_vertices])
        self.body = body = kernels.Body()
        body.faces = simulator.faces
        body.points, body.points_before, body.normals = (wp.zeros_like(self.rest_before) for _ in range(3))
        self.contacts = contacts = kernels.Contacts()
        contacts.face = wp.full(len(start), -1, dtype=wp.int32, device=DEVICE)
        contacts.place = wp.zeros(len(start), dtype=wp.vec2, device=DEVICE)
        contacts.distance = wp.full(len(start), FARTHEST, dtype=wp.float32, device=DEVICE)
        self.pin_targets = wp.zeros_like(simulator.pin_rest)
        self.steps = 0
        simulator.skeleton.upload(np.zeros((1, motion.theta.shape[1])), motion.root[:1])
        self._pose(0, 0.0)
        self.tree = wp.Mesh(points=self.body.points, indices=simulator.corners)
        self.grid = wp.HashGrid(64, 64, 64, device=DEVICE) if simulator.settings.self_distance > 0 else None
        self.searched_at = _vectors(np.zeros((0, 3)))

    def aim_at(self, rest_vertices: Float32[np.ndarray, "O 3"]) -> None:
        """Set the rest surface that the next steps lead to."""
        self.rest_before, self.rest_after = self.rest_after, _vectors(rest_vertices)

    def go(self, theta: Float[np.ndarray, "S D"], root: Float[np.ndarray, "S 4 4"]) -> None:
        """Take one step to each of these poses."""
        self.simulator.skeleton.upload(theta, root)
        for row in range(len(theta)):
            wp.copy(self.body.points_before, self.body.points)
            self._pose(row, (row + 1) / len(theta))
            self._advance()

    def state(self, frame: int) -> ClothState:
        """Copies of what the next steps depend on."""
        contacts = (self.contacts.face, self.contacts.place, self.contacts.distance)
        copies = [array.numpy().copy() for array in (self.positions, self.cloth.velocities, *contacts, self.body.points, self.searched_at)]
        return ClothState(frame, copies[0], copies[1], self.steps, *copies[2:])

    def restore(self, state: ClothState, motion: BodyMotion) -> None:
        """Be where a run was when `state` was taken of it."""
        self.steps = state.steps
        self.positions.assign(state.vertices)
        self.cloth.velocities.assign(state.velocities)
        self.contacts.face.assign(state.contact_faces)
        self.contacts.place.assign(state.contact_places)
        self.contacts.distance.assign(state.contact_distances)
        self.body.points.assign(state.body_points)
        self.rest_before = self.rest_after = _vectors(motion.rest_at(state.frame)[self.simulator.body_vertices])
        if self.grid is not None:
            self.searched_at = _vectors(state.searched_at)
            self.grid.build(self.searched_at, self.simulator.settings.self_distance)

    def depth(self) -> tuple[Float32[np.ndarray, "G"], Bool[np.ndarray, "G"]]:
        """Metres that each vertex lies inside the plane of its closest triangle, and whether it has one."""
        face, place = self.contacts.face.numpy(), self.contacts.place.numpy()
        corners = self.simulator.faces.numpy()[np.maximum(face, 0)]  # [G, 3]
        shares = np.stack([place[:, 0], place[:, 1], 1 - place.sum(axis=1)], axis=1)
        ground, normals = ((shares[..., None] * values.numpy()[corners]).sum(axis=1) for values in (self.body.points, self.body.normals))
        return np.where(face >= 0, ((ground - self.positions.numpy()) * normals).sum(axis=1), np.float32(0)), face >= 0

    def _pose(self, row: int, share: float) -> None:
        """Body, its normals and pins at an uploaded pose."""
        simulator = self.simulator
        transforms = simulator.skeleton.pose(row)
        simulator.skin.pose((self.rest_before, self.rest_after), share, transforms, self.body.points)
        simulator.pins.pose((simulator.pin_rest, simulator.pin_rest), 0.0, transforms, self.pin_targets)
        _launch(kernels.find_normals, 1, [self.body])

    def _advance(self) -> None:
        """One step of the cloth."""
        simulator, settings, x = self.simulator, self.simulator.settings, self.positions
        if self.steps % self.query_every == 0:
            self.tree.refit()
            _launch(kernels.find_contacts, len(x), [self.tree.id, x, FARTHEST, self.contacts])
            if self.grid is not None:
                self.searched_at = wp.clone(x)
                self.grid.build(self.searched_at, settings.self_distance)
        free = [x, simulator.inverse_mass]
        bend_give, stretch_give = ((time / self.time_step) ** 2 for time in (simulator.fabric.bend_time, simulator.fabric.stretch_time))
        _launch(kernels.advance, 1, [self.step, self.cloth, simulator.pin_vertices, self.pin_targets, self.body, self.contacts])
        _launch(kernels.hold_tethers, 1, [simulator.tethers, simulator.tether_lengths, *free])
        _launch(kernels.flatten_hinges, 1, [simulator.hinges, simulator.hinge_weights, bend_give, *free])
        # To and fro in every step. Changing direction from step to step would shake the cloth: what a sweep leaves over depends on its
        # direction, and the difference would become velocity.
        for is_reversed in (0, 1):
            _launch(kernels.project_distances, 1, [simulator.edges, simulator.edge_lengths, stretch_give, is_reversed, *free])
        _launch(kernels.hold_tethers, 1, [simulator.tethers, simulator.tether_lengths, *free])
        if self.grid is not None:
            _launch(kernels.separate, 1, [self.grid.id, settings.self_distance, simulator.rest, *free])
        _launch(kernels.collide, 1, [self.step, self.cloth, self.body, self.contacts])
        _launch(kernels.finish, len(x), [self.step, self.cloth])
        self.steps += 1


class _Skeleton:
    """Forward kinematics next to the cloth: a substep's 104 joints take microseconds here and milliseconds as batched matrices."""

    def __init__(self, rig: Rig):
        order = np.argsort(rig.dofs.joints, kind="stable")  # angles of one joint keep the table's order
        joints = len(rig.joint_names)
        self.tree = tree = kernels.JointTree()
        tree.parents, tree.centres = _integers(rig.joint_parents), _vectors(rig.joint_positions)
        tree.starts = _integers(np.searchsorted(rig.dofs.joints[order], np.arange(joints + 1)))
        tree.dofs, tree.axes = _integers(order), _vectors(rig.dofs.axes)
        self.transforms = kernels.Transforms()
        self.transforms.turns = wp.zeros(joints, dtype=wp.mat33, device=DEVICE)
        self.transforms.places = wp.zeros(joints, dtype=wp.vec3, device=DEVICE)
        self.roots = kernels.Transforms()

    def upload(self, theta: Float[np.ndarray, "S D"], root: Float[np.ndarray, "S 4 4"]) -> None:
        """Take poses over."""
        self.angles = _floats(theta)
        self.roots.turns = wp.array(np.ascontiguousarray(root[:, :3, :3], dtype=np.float32), dtype=wp.mat33, device=DEVICE)
        self.roots.places = _vectors(root[:, :3, 3])

    def pose(self, row: int) -> Any:
        """`kernels.Transforms` of all joints in one of the poses; the next call overwrites them."""
        _launch(kernels.pose_joints, 1, [self.tree, self.angles, self.roots, row, self.transforms])
        return self.transforms


class _Skinned:
    """Points carried by joints: the joints and weights of each, without zeros."""

    def __init__(self, weights: Float32[np.ndarray, "P J"]):
        rows, joints = np.nonzero(weights)
        self.count = len(weights)
        self.skin = kernels.Skin()
        self.skin.starts, self.skin.joints = _integers(np.searchsorted(rows, np.arange(len(weights) + 1))), _integers(joints)
        self.skin.weights = _floats(weights[rows, joints])

    def pose(self, rest: tuple[wp.array, wp.array], share: float, transforms: Any, posed: wp.array) -> None:
        """Skin the rest points `share` of the way from the first to the second."""
        _launch(kernels.pose_points, self.count, [*rest, share, transforms, self.skin, posed])


def _launch(kernel: wp.Kernel, threads: int, arguments: list) -> None:
    wp.launch(kernel, dim=threads, inputs=arguments, device=DEVICE)


def _vectors(values: Float[np.ndarray, "P 3"]) -> wp.array:
    return wp.array(np.ascontiguousarray(values, dtype=np.float32), dtype=wp.vec3, device=DEVICE)


def _floats(values: np.ndarray) -> wp.array:
    return wp.array(np.ascontiguousarray(values, dtype=np.float32), dtype=wp.float32, device=DEVICE)


def _integers(values: np.ndarray) -> wp.array:
    return wp.array(np.ascontiguousarray(values, dtype=np.int32), dtype=wp.int32, device=DEVICE)
