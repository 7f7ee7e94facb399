"""The cloth solver's inner loops, compiled by NVIDIA Warp for one processor core; `filming.cloth_simulation` drives them.

Position-based dynamics with compliance (XPBD) in small time steps: constraints are projected one after the other, in a fixed order, by
a single thread. That converges faster per sweep than parallel colouring, and gives the same bits every time. Metres, seconds; all
vertices of a garment weigh the same, pinned ones are moved by the skeleton.

Source: Macklin, Mueller, Chentanez, "XPBD", 2016; Macklin et al., "Small steps in physics simulation", 2019.
"""

from typing import no_type_check  # of the tests' type checker, which cannot read Warp's types

import warp as wp

wp.config.log_level = wp.LOG_ERROR  # a command's output is its own; Warp greets on stdout

wp.set_module_options({"enable_backward": False, "fast_math": False})


@wp.struct
@no_type_check
class Step:
    """Constants of one simulation step; times in seconds, lengths in metres. A *give* is a compliance over the squared time step."""

    time_step: wp.float32
    gravity: wp.float32
    damping: wp.float32  # 1/s, of movement relative to the skin beneath
    gap: wp.float32  # between skin and cloth that lies on it
    friction: wp.float32  # Coulomb's coefficient
    largest_move: wp.float32  # that a vertex may make in one step


@wp.struct
@no_type_check
class JointTree:
    """The skeleton at rest: a parent stands before its children; `starts` delimits each joint's rows of `dofs`."""

    parents: wp.array(dtype=wp.int32)
    centres: wp.array(dtype=wp.vec3)
    starts: wp.array(dtype=wp.int32)
    dofs: wp.array(dtype=wp.int32)
    axes: wp.array(dtype=wp.vec3)


@wp.struct
@no_type_check
class Transforms:
    """Rotation and translation of some frames of reference."""

    turns: wp.array(dtype=wp.mat33)
    places: wp.array(dtype=wp.vec3)


@wp.struct
@no_type_check
class Skin:
    """How points hang on joints: `starts` delimits each point's rows of `joints` and `weights`."""

    starts: wp.array(dtype=wp.int32)
    joints: wp.array(dtype=wp.int32)
    weights: wp.array(dtype=wp.float32)


@wp.struct
@no_type_check
class Body:
    """The surface that stops cloth, now and one step before."""

    faces: wp.array(dtype=wp.int32, ndim=2)
    points: wp.array(dtype=wp.vec3)
    points_before: wp.array(dtype=wp.vec3)
    normals: wp.array(dtype=wp.vec3)


@wp.struct
@no_type_check
class Cloth:
    """The garment's vertices; pinned ones have an inverse mass of 0, the others of 1."""

    positions: wp.array(dtype=wp.vec3)
    before: wp.array(dtype=wp.vec3)
    velocities: wp.array(dtype=wp.vec3)
    inverse_mass: wp.array(dtype=wp.float32)


@wp.struct
@no_type_check
class Contacts:
    """The body's triangle that is closest to each cloth vertex (-1: none within reach), the barycentric place on it, how far it is."""

    face: wp.array(dtype=wp.int32)
    place: wp.array(dtype=wp.vec2)
    distance: wp.array(dtype=wp.float32)


@wp.kernel
@no_type_check
def pose_joints(tree: JointTree, angles: wp.array(dtype=wp.float32, ndim=2), roots: Transforms, row: int, joints: Transforms):
    """Forward kinematics of one row of angles, as `body.skeleton` does it; one thread."""
    for joint in range(tree.parents.shape[0]):
        local = wp.quat_identity()
        for entry in range(tree.starts[joint], tree.starts[joint + 1]):
            dof = tree.dofs[entry]
            local = local * wp.quat_from_axis_angle(tree.axes[dof], angles[row, dof])
        turn = wp.quat_to_matrix(local)
        centre = tree.centres[joint]
        place = centre - turn * centre
        parent = tree.parents[joint]
        if parent < 0:
            joints.turns[joint] = roots.turns[row] * turn
            joints.places[joint] = roots.turns[row] * place + roots.places[row]
        else:
            joints.turns[joint] = joints.turns[parent] * turn
            joints.places[joint] = joints.turns[parent] * place + joints.places[parent]


@wp.kernel
@no_type_check
def pose_points(
    rest_before: wp.array(dtype=wp.vec3),
    rest_after: wp.array(dtype=wp.vec3),
    share: float,
    transforms: Transforms,
    skin: Skin,
    posed: wp.array(dtype=wp.vec3),
):
    """Linear blend skinning of rest points `share` of the way between two frames."""
    point = wp.tid()
    rest = rest_before[point] + share * (rest_after[point] - rest_before[point])
    result = wp.vec3(0.0, 0.0, 0.0)
    for row in range(skin.starts[point], skin.starts[point + 1]):
        joint = skin.joints[row]
        result += skin.weights[row] * (transforms.turns[joint] * rest + transforms.places[joint])
    posed[point] = result


@wp.kernel
@no_type_check
def find_normals(body: Body):
    """Unit vertex normals, weighted by area; one thread."""
    for point in range(body.points.shape[0]):
        body.normals[point] = wp.vec3(0.0, 0.0, 0.0)
    for face in range(body.faces.shape[0]):
        a, b, c = body.faces[face, 0], body.faces[face, 1], body.faces[face, 2]
        normal = wp.cross(body.points[b] - body.points[a], body.points[c] - body.points[a])
        body.normals[a] += normal
        body.normals[b] += normal
        body.normals[c] += normal
    for point in range(body.points.shape[0]):
        body.normals[point] = wp.normalize(body.normals[point])


@wp.kernel
@no_type_check
def find_contacts(mesh: wp.uint64, positions: wp.array(dtype=wp.vec3), reach: float, contacts: Contacts):
    """The body's closest triangle to every cloth vertex."""
    vertex = wp.tid()
    # Cloth moves little between queries: a search that begins near the last distance visits far fewer triangles.
    query = wp.mesh_query_point_no_sign(mesh, positions[vertex], wp.min(reach, contacts.distance[vertex] + 0.01))
    if not query.result:
        query = wp.mesh_query_point_no_sign(mesh, positions[vertex], reach)
    if query.result:
        contacts.distance[vertex] = wp.length(positions[vertex] - wp.mesh_eval_position(mesh, query.face, query.u, query.v))
        contacts.face[vertex] = query.face
        contacts.place[vertex] = wp.vec2(query.u, query.v)
    else:
        contacts.distance[vertex] = reach
        contacts.face[vertex] = -1


@wp.func
@no_type_check
def on_face(face: int, place: wp.vec2, faces: wp.array(dtype=wp.int32, ndim=2), values: wp.array(dtype=wp.vec3)):
    """A vertex attribute interpolated at a barycentric place."""
    return place[0] * values[faces[face, 0]] + place[1] * values[faces[face, 1]] + (1.0 - place[0] - place[1]) * values[faces[face, 2]]


@wp.func
@no_type_check
def project_distance(
    a: int, b: int, length: float, give: float, positions: wp.array(dtype=wp.vec3), inverse_mass: wp.array(dtype=wp.float32)
):
    """Move two vertices towards their rest distance; `give` is compliance over the squared time step."""
    offset = positions[a] - positions[b]
    distance = wp.length(offset)
    total = inverse_mass[a] + inverse_mass[b]
    if total > 0.0 and distance > 1.0e-9:
        correction = (length - distance) / (total + give) / distance * offset
        positions[a] = positions[a] + inverse_mass[a] * correction
        positions[b] = positions[b] - inverse_mass[b] * correction


@wp.kernel
@no_type_check
def advance(step: Step, cloth: Cloth, pins: wp.array(dtype=wp.int32), pin_targets: wp.array(dtype=wp.vec3), body: Body, contacts: Contacts):
    """Begin a step: gravity, damping towards the skin's velocity, free flight; pinned vertices go where the skeleton has them."""
    keep = wp.exp(-step.damping * step.time_step)
    for vertex in range(cloth.positions.shape[0]):
        cloth.before[vertex] = cloth.positions[vertex]
        if cloth.inverse_mass[vertex] > 0.0:
            carried = wp.vec3(0.0, 0.0, 0.0)
            face = contacts.face[vertex]
            if face >= 0:
                place = contacts.place[vertex]
                carried = (
                    on_face(face, place, body.faces, body.points) - on_face(face, place, body.faces, body.points_before)
                ) / step.time_step
            velocity = carried + keep * (cloth.velocities[vertex] - carried)
            velocity = velocity + wp.vec3(0.0, 0.0, -step.gravity * step.time_step)
            move = step.time_step * velocity
            length = wp.length(move)
            if length > step.largest_move:
                move = step.largest_move / length * move
            cloth.positions[vertex] = cloth.positions[vertex] + move
    for pin in range(pins.shape[0]):
        cloth.positions[pins[pin]] = pin_targets[pin]


@wp.kernel
@no_type_check
def project_distances(
    pairs: wp.array(dtype=wp.int32, ndim=2),
    lengths: wp.array(dtype=wp.float32),
    give: float,
    is_reversed: int,
    positions: wp.array(dtype=wp.vec3),
    inverse_mass: wp.array(dtype=wp.float32),
):
    """One Gauss-Seidel sweep over distance constraints, forwards or backwards; one thread."""
    count = pairs.shape[0]
    for order in range(count):
        row = order
        if is_reversed != 0:
            row = count - 1 - order
        project_distance(pairs[row, 0], pairs[row, 1], lengths[row], give, positions, inverse_mass)


@wp.kernel
@no_type_check
def flatten_hinges(
    hinges: wp.array(dtype=wp.int32, ndim=2),
    hinge_weights: wp.array(dtype=wp.vec4),
    give: float,
    positions: wp.array(dtype=wp.vec3),
    inverse_mass: wp.array(dtype=wp.float32),
):
    """One sweep over pairs of triangles: the weighted sum of their four corners, zero where they are flat, shrinks; one thread."""
    for row in range(hinges.shape[0]):
        a, b, c, d = hinges[row, 0], hinges[row, 1], hinges[row, 2], hinges[row, 3]
        k = hinge_weights[row]
        fold = k[0] * positions[a] + k[1] * positions[b] + k[2] * positions[c] + k[3] * positions[d]
        total = (
            k[0] * k[0] * inverse_mass[a] + k[1] * k[1] * inverse_mass[b] + k[2] * k[2] * inverse_mass[c] + k[3] * k[3] * inverse_mass[d]
        )
        correction = -1.0 / (total + give) * fold
        positions[a] = positions[a] + k[0] * inverse_mass[a] * correction
        positions[b] = positions[b] + k[1] * inverse_mass[b] * correction
        positions[c] = positions[c] + k[2] * inverse_mass[c] * correction
        positions[d] = positions[d] + k[3] * inverse_mass[d] * correction


@wp.kernel
@no_type_check
def hold_tethers(
    tethers: wp.array(dtype=wp.int32, ndim=2),
    lengths: wp.array(dtype=wp.float32),
    positions: wp.array(dtype=wp.vec3),
    inverse_mass: wp.array(dtype=wp.float32),
):
    """Bring vertices back within reach of the pin that they hang from; one thread."""
    for row in range(tethers.shape[0]):
        vertex, pin = tethers[row, 0], tethers[row, 1]
        if wp.length(positions[vertex] - positions[pin]) > lengths[row]:
            project_distance(vertex, pin, lengths[row], 0.0, positions, inverse_mass)


@wp.kernel
@no_type_check
def collide(step: Step, cloth: Cloth, body: Body, contacts: Contacts):
    """Push cloth out of the plane of the body's closest triangle and let it rub on the moving skin."""
    for vertex in range(cloth.positions.shape[0]):
        face = contacts.face[vertex]
        if face >= 0 and cloth.inverse_mass[vertex] > 0.0:
            place = contacts.place[vertex]
            ground = on_face(face, place, body.faces, body.points)
            normal = wp.normalize(on_face(face, place, body.faces, body.normals))
            depth = step.gap - wp.dot(cloth.positions[vertex] - ground, normal)
            if depth > 0.0:
                cloth.positions[vertex] = cloth.positions[vertex] + wp.min(depth, step.largest_move) * normal
                carried = ground - on_face(face, place, body.faces, body.points_before)
                slip = cloth.positions[vertex] - cloth.before[vertex] - carried
                slip = slip - wp.dot(slip, normal) * normal
                length = wp.length(slip)
                limit = step.friction * depth
                if length > limit:
                    slip = limit / length * slip
                cloth.positions[vertex] = cloth.positions[vertex] - slip


@wp.kernel
@no_type_check
def separate(
    grid: wp.uint64,
    distance: float,
    rest: wp.array(dtype=wp.vec3),
    positions: wp.array(dtype=wp.vec3),
    inverse_mass: wp.array(dtype=wp.float32),
):
    """Keep vertices of different folds apart; vertices that are neighbours at rest do not count. One thread."""
    near = 2.0 * distance
    for vertex in range(positions.shape[0]):
        query = wp.hash_grid_query(grid, positions[vertex], distance)
        other = int(0)  # noqa: UP018 - Warp takes a bare 0 for a constant
        while wp.hash_grid_query_next(query, other):
            if other > vertex and wp.length(rest[vertex] - rest[other]) > near:
                offset = positions[vertex] - positions[other]
                if wp.length(offset) < distance:
                    project_distance(vertex, other, distance, 0.0, positions, inverse_mass)


@wp.kernel
@no_type_check
def finish(step: Step, cloth: Cloth):
    """End a step: velocities from how far vertices came."""
    vertex = wp.tid()
    cloth.velocities[vertex] = (cloth.positions[vertex] - cloth.before[vertex]) / step.time_step
