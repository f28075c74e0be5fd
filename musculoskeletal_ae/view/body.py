# SPDX-License-Identifier: Apache-2.0
"""An arm as solids: links by the URDF's meshes or as capsules, muscles as tubes.

A muscle is blue at T_bias and orange at T_limit, which everybody can tell apart, and thicker the
harder it pulls. A cut one is black and dashed, an isolated one grey and dashed, a suspect one
magenta and thick.
"""

from __future__ import annotations

import io
import os
from enum import IntEnum
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree as ET

import numpy as np
import pinocchio as pin
import trimesh
from scipy.spatial.transform import Rotation

from musculoskeletal_ae.arrays import Array, Ints
from musculoskeletal_ae.exceptions import RobotDescriptionError
from musculoskeletal_ae.files import read_bytes
from musculoskeletal_ae.robot.drawing import BONE_WIDTH, MUSCLE_WIDTH, SHORTEST_BONE
from musculoskeletal_ae.robot.kinematics import Kinematics
from musculoskeletal_ae.robot.robot import Robot

LARGEST_MESH = 50_000_000  # [bytes]
FORMATS = ('.stl', '.obj', '.ply', '.glb')
DASHES = 5  # of a straight segment of a muscle; whole muscles show no gaps
#: red, green, blue at T_bias and at T_limit
ENDS = LOOSE, TIGHT = np.array([0.0, 114.0, 178.0]), np.array([230.0, 97.0, 0.0])


class Kind(IntEnum):
    """What is known of a muscle."""

    SOUND = 0
    SUSPECT = 1
    ISOLATED = 2
    CUT = 3


MARKS = {Kind.SOUND: '', Kind.SUSPECT: '? ', Kind.ISOLATED: '⊘ ', Kind.CUT: '✂ '}
#: red, green, blue of those that are not coloured by tension
COLOURS = {Kind.SUSPECT: (200, 0, 130), Kind.ISOLATED: (140, 140, 140), Kind.CUT: (0, 0, 0)}


def tension_share(robot: Robot, tension: Array) -> Array:
    """Return how far T [N] (M,) is on the way from T_bias to T_limit, within [0, 1]."""
    limits = robot.tension
    return np.clip((tension - limits.bias) / (limits.limit - limits.bias), 0.0, 1.0)


def colours(share: Array, kinds: Ints) -> Array:
    """Return red, green and blue (M, 3) in [0, 255] of muscles."""
    rgb = LOOSE + share[:, None] * (TIGHT - LOOSE)
    for kind, colour in COLOURS.items():
        rgb[kinds == kind] = colour
    return rgb


class Solid(NamedTuple):
    """A mesh that moves with a joint."""

    joint: int  # of pinocchio's tree
    mesh: trimesh.Trimesh  # in its frame [m]


def link_solids(robot: Robot) -> tuple[list[Solid], list[str]]:
    """Return the meshes of a URDF's visuals, capsules along the bones if there are none.

    And why any mesh was left out.
    """
    solids, notes = [], []
    root = ET.fromstring(robot.description.urdf)  # noqa: S314 - checked when it was loaded
    for link in root.iter('link'):
        for visual in link.iterfind('visual'):
            element = visual.find('geometry/mesh')
            if element is None:
                continue
            try:
                mesh = _read_mesh(robot.description.directory, element)
            except (RobotDescriptionError, ValueError, TypeError, KeyError, IndexError) as error:
                notes.append(f'{element.get("filename")}: {error}')
                continue
            origin = visual.find('origin')
            numbers = {'xyz': '0 0 0', 'rpy': '0 0 0'} | ({} if origin is None else origin.attrib)
            xyz, rpy = (np.array(numbers[key].split(), dtype=float) for key in ('xyz', 'rpy'))
            placed = pin.SE3(pin.rpy.rpyToMatrix(rpy), xyz)
            kin = robot.kinematics
            frame = kin.model.frames[kin.model.getFrameId(link.get('name'), pin.FrameType.BODY)]
            mesh.apply_transform((frame.placement * placed).homogeneous)
            solids.append(Solid(frame.parentJoint, mesh))
    return solids or _capsules(robot), notes


def _read_mesh(directory: Path, element: ET.Element) -> trimesh.Trimesh:
    """Read the file of a <mesh>: package://, file:// or relative to the robot's directory."""
    name = element.get('filename', '')
    file = directory / name.removeprefix('file://')
    if name.startswith('package://'):
        package, _, rest = name.removeprefix('package://').partition('/')
        prefixes = filter(None, os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep))
        places = [Path(prefix) / 'share' / package for prefix in prefixes]
        places += [parent for parent in directory.parents if parent.name == package]
        file = next((place / rest for place in places if (place / rest).exists()), directory / rest)

    def refuse(path: Path, why: str) -> Exception:
        return RobotDescriptionError(f'{path} {why}')

    if file.suffix.lower() not in FORMATS:
        raise refuse(file, f'cannot be drawn; legal: {", ".join(FORMATS)}')
    data = io.BytesIO(read_bytes(file, refuse, LARGEST_MESH))
    mesh = trimesh.load(data, file_type=file.suffix.lower()[1:], force='mesh')
    if not len(mesh.faces) or not np.isfinite(mesh.vertices).all():
        raise refuse(file, 'has no faces, or vertices that are not finite')
    mesh.apply_scale([float(word) for word in element.get('scale', '1 1 1').split()])
    return mesh


def _capsules(robot: Robot) -> list[Solid]:
    """Return a capsule from every joint to the next, and one to the end effector."""
    kin = robot.kinematics
    tip = kin.model.frames[kin.end_effector_frame]
    bones = [*zip(kin.parent[1:], kin.placement_translation[1:])]
    bones.append((tip.parentJoint, tip.placement.translation))
    solids = []
    for joint, end in bones:
        length = float(np.linalg.norm(end))
        if length > SHORTEST_BONE:
            mesh = trimesh.creation.capsule(length, 0.8 * BONE_WIDTH, count=[12, 12])
            mesh.apply_translation([0.0, 0.0, 0.5 * length] - mesh.bounds.mean(axis=0))
            mesh.apply_transform(trimesh.geometry.align_vectors([0.0, 0.0, 1.0], end / length))
            solids.append(Solid(int(joint), mesh))
    return solids


class JointChain:
    """Where joints are in their parents."""

    def __init__(self, kin: Kinematics) -> None:
        """Take the fixed placements of the joints of a tree."""
        self._kin = kin
        turn = Rotation.from_matrix(kin.placement_rotation)
        self._turn = turn.as_quat(scalar_first=True)
        self._axis = turn.apply(kin.local_axis)  # in the parent's frame

    def poses(self, theta: Array) -> tuple[Array, Array]:
        """Return positions [m] (J, 3) and turns, quaternions wxyz (J, 4), at θ [rad] (D,)."""
        kin = self._kin
        angle = np.append(0.0, theta[kin.theta_index[1:]])
        slide = self._axis * np.where(kin.prismatic, angle, 0.0)[:, None]
        half = 0.5 * np.where(kin.prismatic, 0.0, angle)[:, None]
        # The turn about the axis, after the placement: a product of two quaternions.
        w, v = np.cos(half), np.sin(half) * self._axis
        first, rest = self._turn[:, :1], self._turn[:, 1:]
        scalar = w * first - (v * rest).sum(axis=1, keepdims=True)
        turn = np.hstack([scalar, w * rest + first * v + np.cross(v, rest)])
        return kin.placement_translation + slide, turn


class Tubes(NamedTuple):
    """Muscles as instances of a tube of radius 1 from −½ to ½ along z, DASHES a segment."""

    positions: Array  # [m], (N, 3)
    turns: Array  # quaternions wxyz, (N, 4)
    scales: Array  # (N, 3)
    colours: Array  # (N, 3)
    middles: Array  # [m], (M, 3): where names are written


def muscle_tubes(robot: Robot, theta: Array, tension: Array, kinds: Ints) -> Tubes:
    """Return the muscles at θ [rad] (D,) and T [N] (M,)."""
    routes, share = robot.routes, tension_share(robot, tension)
    points = routes.points(theta[None])[0]
    first, line = points[routes.first], points[routes.second] - points[routes.first]
    length = np.linalg.norm(line, axis=1)
    along = line / np.maximum(length, 1e-9)[:, None]
    # The shortest turn from z: the half-way vector as quaternion; straight down, about x.
    turn = np.stack([1.0 + along[:, 2], -along[:, 1], along[:, 0], 0.0 * length], axis=1)
    turn[turn[:, 0] < 1e-9] = 0.0, 1.0, 0.0, 0.0
    turn /= np.linalg.norm(turn, axis=1, keepdims=True)
    middle = (np.arange(DASHES) + 0.5) / DASHES
    position = first[:, None] + middle[:, None] * line[:, None]
    radius = 0.5 * MUSCLE_WIDTH * (1.0 + 1.5 * share)
    radius = np.where(kinds == Kind.SUSPECT, MUSCLE_WIDTH * 1.5, radius)
    # A whole muscle's dashes overlap a little, so that none of its joints can be seen.
    dash = np.where(kinds >= Kind.ISOLATED, 0.55, 1.02)
    owner = routes.muscle
    scale = np.stack([radius[owner], radius[owner], dash[owner] * length / DASHES], axis=1)
    longest = [np.flatnonzero(owner == m)[length[owner == m].argmax()] for m in range(len(share))]
    return Tubes(
        position.reshape(-1, 3),
        np.repeat(turn, DASHES, axis=0),
        np.repeat(scale, DASHES, axis=0),
        np.repeat(colours(share, kinds)[owner], DASHES, axis=0),
        (first + 0.5 * line)[longest],
    )
