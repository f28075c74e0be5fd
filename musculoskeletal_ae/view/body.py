# SPDX-License-Identifier: Apache-2.0
"""An arm as solids: links as meshes of the URDF or as capsules, muscles as tubes.

A muscle is blue at T_bias and orange at T_limit; colour-blind people can distinguish these colours.
It is thicker at higher tension. Ruptured muscles are black and dashed, isolated ones grey and
dashed, and suspects magenta and thick.
"""

import io
import os
from enum import IntEnum
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pinocchio as pin
import trimesh

from musculoskeletal_ae.arrays import Array, Ints
from musculoskeletal_ae.exceptions import RobotDescriptionError
from musculoskeletal_ae.files import read_bytes
from musculoskeletal_ae.robot import drawing
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.routes import ARC

LARGEST_MESH = 50_000_000  # draw no mesh whose file is larger than this [bytes]
FORMATS = ('.stl', '.obj', '.ply', '.glb')
#: to find the space in which the arm moves, place it in this many postures with arbitrary joint
#: angles, and in as many with all joints at their limits
POSTURES = 50
#: draw each straight piece of a muscle as this many tubes; only dashed muscles have gaps between
#: them
DASHES = 5
#: colours of a muscle at T_bias (LOOSE) and at T_limit (TIGHT): red, green, blue
ENDS = LOOSE, TIGHT = np.array([0, 114, 178]), np.array([230, 97, 0])


class DrawnState(IntEnum):
    """State of a muscle, as far as it is known."""

    SOUND = 0
    SUSPECT = 1
    ISOLATED = 2
    RUPTURED = 3


#: mark that precedes the name of a muscle on the page, by its `DrawnState`
MARKS = ('', '? ', '⊘ ', '✂ ')
#: red, green, blue of muscles that are not coloured by tension
COLOURS = {
    DrawnState.SUSPECT: (200, 0, 130),
    DrawnState.ISOLATED: (140, 140, 140),
    DrawnState.RUPTURED: (0, 0, 0),
}


def colours(robot: Robot, tension: Array, kinds: Ints) -> Array:
    """Return the colours of muscles as red, green and blue, uint8 (M, 3).

    A muscle is coloured by its `tension` [N] (M,), unless its `DrawnState` in `kinds` (M,) has a
    colour of its own.
    """
    rgb = LOOSE + drawing.tension_share(robot, tension)[:, None] * (TIGHT - LOOSE)
    for kind, colour in COLOURS.items():
        rgb[kinds == kind] = colour
    return rgb.astype(np.uint8)


Solid = tuple[int, trimesh.Trimesh]  # joint of pinocchio's tree, and a mesh in its frame [m]


def link_solids(robot: Robot) -> tuple[list[Solid], list[str]]:
    """Return the solids of all links, and a note for each mesh that cannot be drawn.

    Joints without meshes in the URDF get capsules.
    """
    solids, notes = [], []
    root = ET.fromstring(robot.description.urdf)  # noqa: S314 - checked when it was loaded
    for link in root.iterfind('{*}link'):  # deeper <link> elements belong to plugins
        joint, at = robot.kinematics.placement(link.get('name', ''))
        for visual in link.iterfind('{*}visual'):
            if (element := visual.find('{*}geometry/{*}mesh')) is None:
                continue
            try:
                mesh = _read_mesh(robot.description.directory, element)
            except Exception as error:  # noqa: BLE001 - trimesh may raise anything
                notes.append(f'{element.get("filename")}: {error}')
                continue
            origin = visual.find('{*}origin')
            numbers = {'xyz': '0 0 0', 'rpy': '0 0 0'} | ({} if origin is None else origin.attrib)
            xyz, rpy = (np.array(numbers[key].split(), dtype=float) for key in ('xyz', 'rpy'))
            placed = at * pin.SE3(pin.rpy.rpyToMatrix(rpy), xyz)
            solids.append((joint, mesh.apply_transform(placed.homogeneous)))
    drawn = {joint for joint, _ in solids}
    return [*solids, *(bone for bone in _capsules(robot) if bone[0] not in drawn)], notes


def _read_mesh(directory: Path, element: ET.Element) -> trimesh.Trimesh:
    """Return the mesh that a <mesh> element of the URDF names.

    The name begins with package:// or file://, or is a path relative to the robot's directory.

    Raises:
        RobotDescriptionError: If the file cannot be drawn.
    """
    name = element.get('filename', '')
    places, rest = [directory], name.removeprefix('file://')
    if name.startswith('package://'):
        package, _, rest = name.removeprefix('package://').partition('/')
        places += [each for each in directory.parents if each.name == package]
        prefixes = os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep)
        places += [Path(prefix, 'share', package) for prefix in prefixes]
    file = next((place / rest for place in places if (place / rest).exists()), directory / rest)

    def refuse(path: Path, why: str) -> Exception:
        return RobotDescriptionError(f'{path} {why}')

    if file.suffix.lower() not in FORMATS:
        raise refuse(file, f'cannot be drawn; legal: {", ".join(FORMATS)}')
    data = io.BytesIO(read_bytes(file, refuse, LARGEST_MESH))
    mesh = trimesh.load(data, file_type=file.suffix.lower()[1:], force='mesh')
    if not len(mesh.faces) or not np.isfinite(mesh.vertices).all():
        raise refuse(file, 'has no faces, or has vertices that are not finite')
    return mesh.apply_scale([float(word) for word in element.get('scale', '1 1 1').split()])


def _capsules(robot: Robot) -> list[Solid]:
    """Return a capsule from each joint to the next, and one to each end effector."""
    kin, solids = robot.kinematics, []
    bones = [*zip(kin.tree.parent[1:], kin.tree.placement_translation[1:])]
    tips = [kin.placement(link) for link in robot.description.end_effectors]
    for joint, end in [*bones, *((joint, tip.translation) for joint, tip in tips)]:
        length = float(np.linalg.norm(end))
        if length > drawing.SHORTEST_BONE:
            mesh = trimesh.creation.capsule(length, 0.8 * drawing.BONE_WIDTH, count=[12, 12])
            mesh.apply_translation([0.0, 0.0, 0.5 * length] - mesh.bounds.mean(axis=0))
            mesh.apply_transform(trimesh.geometry.align_vectors([0.0, 0.0, 1.0], end / length))
            solids.append((int(joint), mesh))
    return solids


def space(robot: Robot, solids: list[Solid]) -> Array:
    """Return points [m], (N, 3), that span the space in which the arm moves.

    They are the corners of the solids' bounding boxes, the route points and the end effectors, in
    random postures within the joint limits. In half of the postures, every joint is at a limit.
    """
    rng = np.random.default_rng(0)
    shares = rng.uniform(0.0, 1.0, (2 * POSTURES, robot.joint_count))
    shares[POSTURES:] = shares[POSTURES:].round()
    kin, points = robot.kinematics, []
    for theta in robot.lower + shares * (robot.upper - robot.lower):
        points.append(robot.routes.points(theta[None])[0])
        places = kin.tree.transforms(theta[None])[0]
        for joint, mesh in solids:
            corners = trimesh.bounds.corners(mesh.bounds)
            at = places[joint]
            points.append(corners @ at[:3, :3].T + at[:3, 3])
        for link in robot.description.end_effectors:
            joint, tip = kin.placement(link)
            points.append((places[joint] @ tip.homogeneous)[None, :3, 3])
    return np.concatenate(points)


def viewpoint(points: Array, direction: Array, half: tuple[float, float]) -> tuple[Array, Array]:
    """Return the target and the position of the closest camera that sees all points.

    A point at depth s in front of the camera is visible if its distances from the optical axis are
    at most s times `half`.

    Args:
        points: The points [m], (N, 3).
        direction: Unit vector from the target to the camera, (3,); not vertical.
        half: Tangents of the visible half-angles, sideways and upwards.
    """
    side = np.cross([0.0, 0.0, 1.0], direction)
    side /= np.linalg.norm(side)
    near = points @ direction
    target, distance = np.zeros(3), 0.0
    for axis, tangent in zip((side, np.cross(direction, side)), half):
        # A point p is visible if |p·axis − centre| ≤ tangent · (distance − p·direction). All points
        # are visible if high ≤ tangent · distance + centre and low ≤ tangent · distance − centre.
        # Equality in both gives the centre and the smallest distance.
        high = float((points @ axis + tangent * near).max())
        low = float((-points @ axis + tangent * near).max())
        target += 0.5 * (high - low) * axis
        distance = max(distance, 0.5 * (high + low) / tangent)
    depth = 0.5 * float(near.min() + near.max())
    return target + depth * direction, target + distance * direction


def grid_cell(reach: float) -> float:
    """Return the size of the floor's cells [m], a power of ten, for a `reach` of the arm [m]."""
    return float(10.0 ** np.round(np.log10(0.15 * reach)))


def pieces(robot: Robot) -> Ints:
    """Return, for each straight piece that is drawn, the index of its muscle.

    Arcs around objects are drawn as straight pieces as well.
    """
    routes = robot.routes
    return np.sort(np.append(routes.muscle, np.repeat(routes.muscle[routes.wrapping], ARC)))


def muscle_tubes(robot: Robot, theta: Array, tension: Array, kinds: Ints) -> dict[str, Array]:
    """Return the tubes that draw all muscles at θ [rad] (D,) and T [N] (M,).

    Each piece of a muscle has DASHES tubes. Positions [m], quaternions (w, x, y, z) and scales
    place a tube of radius 1 that reaches from −½ to ½ along z.
    """
    owner = pieces(robot)
    # The number of pieces is constant. While a tendon does not touch its object, the pieces of the
    # arc have no length.
    drawn = zip(robot.routes.drawn(theta), robot.routes.pieces_drawn.tolist(), strict=True)
    lines = [
        line[np.linspace(0.0, len(line) - 1.0, n + 1).round().astype(int)] for line, n in drawn
    ]
    first = np.concatenate([line[:-1] for line in lines])
    line = np.concatenate([np.diff(line, axis=0) for line in lines])
    length = np.linalg.norm(line, axis=1)
    along = line / np.maximum(length, 1e-9)[:, None]
    # Shortest rotation from z to the direction: the half-way vector as quaternion. A piece that
    # points straight down turns about x.
    turn = np.stack([1.0 + along[:, 2], -along[:, 1], along[:, 0], 0.0 * length], axis=1)
    turn[turn[:, 0] < 1e-9] = 0.0, 1.0, 0.0, 0.0
    turn /= np.linalg.norm(turn, axis=1, keepdims=True)
    middle = (np.arange(DASHES) + 0.5) / DASHES
    position = first[:, None] + middle[:, None] * line[:, None]
    radius = 0.5 * drawing.MUSCLE_WIDTH * (1.0 + 1.5 * drawing.tension_share(robot, tension))
    radius = np.where(kinds == DrawnState.SUSPECT, drawing.MUSCLE_WIDTH * 1.5, radius)[owner]
    # Tubes of healthy muscles overlap slightly to hide the seams.
    dash = np.where(kinds >= DrawnState.ISOLATED, 0.55, 1.02)[owner] * length / DASHES
    each = {
        'batched_wxyzs': turn,
        'batched_scales': np.stack([radius, radius, dash], axis=1),
        'batched_colors': colours(robot, tension, kinds)[owner],
    }
    repeated = {name: np.repeat(rows, DASHES, axis=0) for name, rows in each.items()}
    return {'batched_positions': position.reshape(-1, 3), **repeated}
