# SPDX-License-Identifier: Apache-2.0
"""A robot description: a directory with `robot.urdf` and `muscles.yaml`, read and checked.

Everything that can be wrong in the two files is refused here, with the file, the entry and the
legal values in the message, so that no later code needs to check again.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import pinocchio as pin

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.files import read_text, read_yaml
from musculoskeletal_ae.robot import kinematics, series_elastic
from musculoskeletal_ae.robot.directories import find_robot
from musculoskeletal_ae.robot.entries import Entry, refusal
from musculoskeletal_ae.robot.series_elastic import SeriesElastic
from musculoskeletal_ae.robot.urdf import read_urdf

STIFFNESS_DEFAULT = 10000.0  # [N/m]

#: points (link, xyz in the link's frame [m]), joined by straight lines
Route = tuple[tuple[str, Array], ...]


@dataclass(frozen=True)
class TensionRange:
    """Muscle tensions of the robot [N]."""

    bias: float = 30.0  # what MSC keeps
    limit: float = 200.0  # the highest planned
    max: float = 500.0  # the highest ever


@dataclass(frozen=True)
class RobotDescription:
    """What the two files of a robot directory say, checked."""

    directory: Path
    urdf: str
    model: pin.Model  # of the whole URDF
    joints: tuple[str, ...]  # in the order of θ
    muscles: tuple[str, ...]  # in the order of T and l
    routes: tuple[Route, ...]  # one for each muscle
    series_elastic: SeriesElastic
    stiffness: float  # K_stiff of muscle stiffness control [N/m]
    tension: TensionRange
    end_effector: str  # link that grasps, is pushed and carries the marker

    @property
    def root_link(self) -> str:
        """Name of the URDF's root link, in whose frame poses and markers are given."""
        return str(_links(self.model)[0].name)


def load_description(robot: str | Path) -> RobotDescription:
    """Read and check a robot description, by a shipped name such as 'arm26' or a directory.

    Raises:
        RobotDescriptionError: Naming the file, the entry and the legal values.
    """
    directory = find_robot(robot)
    urdf_file, muscle_file = directory / 'robot.urdf', directory / 'muscles.yaml'
    urdf = read_text(urdf_file, refusal)
    model = read_urdf(urdf_file, urdf)
    top = Entry(muscle_file, read_yaml(muscle_file, refusal), 'top level', '').mapping(
        'joints', 'muscles', 'series_elastic', 'stiffness', 'tension', 'end_effector'
    )
    joints = _read_joints(top['joints'], model)
    default = _read_elastic(top.get('series_elastic'), series_elastic.DEFAULT)
    links = [str(frame.name) for frame in _links(model)]
    names, routes, elastic = [], [], []
    for item in top['muscles'].items(1, 'muscles'):
        entry = item.mapping('name', 'route', 'series_elastic')
        names.append(entry['name'].name())
        muscle = entry.called(f'muscle {names[-1]!r}')
        routes.append(_read_route(muscle['route'], links))
        elastic.append(_read_elastic(muscle.get('series_elastic'), default))
    return RobotDescription(
        directory=directory,
        urdf=urdf,
        model=model,
        joints=joints,
        muscles=top['muscles'].unique(names),
        routes=tuple(routes),
        series_elastic=SeriesElastic(**{k: np.array([row[k] for row in elastic]) for k in default}),
        stiffness=top.get('stiffness', STIFFNESS_DEFAULT).number(above=0.0),
        tension=_read_tension(top.get('tension', {})),
        end_effector=_read_end_effector(top.get('end_effector'), model, joints),
    )


def _links(model: pin.Model) -> list[pin.Frame]:
    return [frame for frame in model.frames if frame.type == pin.FrameType.BODY]


def _read_joints(entry: Entry, model: pin.Model) -> tuple[str, ...]:
    names = [item.name() for item in entry.items(1, 'names')]
    movable = list(model.names)[1:]
    for name in entry.unique(names):
        if name not in movable:
            legal = ', '.join(movable)
            raise entry.fail(f'unknown joint {name!r}; movable joints of robot.urdf: {legal}')
        joint = model.joints[model.getJointId(name)]
        if joint.shortname() not in kinematics.REVOLUTE + kinematics.PRISMATIC:
            raise entry.fail(
                f'joint {name!r} is a {joint.shortname()}; legal: revolute or prismatic joints '
                'with one degree of freedom and limits (continuous has none)'
            )
        lower = model.lowerPositionLimit[joint.idx_q]
        upper = model.upperPositionLimit[joint.idx_q]
        if not -math.inf < lower < upper < math.inf:
            raise entry.fail(
                f'joint {name!r} has limits [{lower:g}, {upper:g}] in robot.urdf; '
                'expected finite lower < upper'
            )
    return tuple(names)


def _read_elastic(entry: Entry, default: dict[str, float]) -> dict[str, float]:
    if entry.value is None:
        return default
    given = entry.mapping(*default)
    force, rate, stretch = (given.get(key, value) for key, value in default.items())
    return {
        'force': force.number(above=0.0),
        'rate': rate.number(above=0.0),
        'wire_stretch': stretch.number(least=0.0),
    }


def _read_route(entry: Entry, links: list[str]) -> Route:
    points: list[tuple[str, Array]] = []
    for item in entry.items(2, 'points'):
        point = item.mapping('link', 'xyz')
        link = _read_link(point['link'], links)
        xyz = point['xyz'].items(3, 'numbers')
        if len(xyz) != 3:
            raise point['xyz'].fail(f'expected 3 numbers, got {len(xyz)}')
        position = np.array([coordinate.number() for coordinate in xyz])
        if points and points[-1][0] == link and np.array_equal(points[-1][1], position):
            raise point.fail('is the same point as the one before it')
        points.append((link, position))
    return tuple(points)


def _read_link(entry: Entry, links: list[str]) -> str:
    name = entry.name()
    if name not in links:
        raise entry.fail(f'unknown link {name!r}; links of robot.urdf: {", ".join(links)}')
    return name


def _read_tension(entry: Entry) -> TensionRange:
    default = asdict(TensionRange())
    given = entry.mapping(*default)
    bias, limit, most = (given.get(key, default[key]).number(above=0.0) for key in default)
    if not bias < limit <= most:
        raise entry.fail(f'expected bias < limit <= max, got {bias:g}, {limit:g}, {most:g}')
    return TensionRange(bias, limit, most)


def _read_end_effector(entry: Entry, model: pin.Model, joints: tuple[str, ...]) -> str:
    if entry.value is not None:
        return _read_link(entry, [frame.name for frame in _links(model)])
    # The last link of the chain: the one with the most of our joints above it, and of several
    # on the same joint the one listed last.
    depth = [0]
    for i in range(1, model.njoints):
        depth.append(depth[model.parents[i]] + (model.names[i] in joints))
    return str(max(reversed(_links(model)), key=lambda link: depth[link.parentJoint]).name)
