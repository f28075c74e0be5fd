# SPDX-License-Identifier: Apache-2.0
"""Reading and checking a robot description: a directory with `robot.urdf` and `muscles.yaml`.

Everything that can be wrong in the two files is refused here, with the file, the entry and the
legal values in the message, so that no later code needs to check again.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.exceptions import RobotDescriptionError
from musculoskeletal_ae.files import read_text
from musculoskeletal_ae.robot import kinematics, series_elastic
from musculoskeletal_ae.robot.entries import EntryReader, listed, refusal
from musculoskeletal_ae.robot.series_elastic import SeriesElastic
from musculoskeletal_ae.robot.urdf import read_urdf

TOP_KEYS = ('joints', 'muscles', 'series_elastic', 'stiffness', 'tension', 'end_effector')
MUSCLE_KEYS = ('name', 'route', 'series_elastic')
POINT_KEYS = ('link', 'xyz')
ELASTIC_DEFAULT = {
    'force': series_elastic.DEFAULT_FORCE,
    'rate': series_elastic.DEFAULT_RATE,
    'wire_stretch': series_elastic.DEFAULT_WIRE_STRETCH,
}
TENSION_DEFAULT = {'bias': 30.0, 'limit': 200.0, 'max': 500.0}
STIFFNESS_DEFAULT = 10000.0


@dataclass(frozen=True)
class TensionRange:
    """Muscle tensions of the robot [N]: what MSC keeps, the highest planned, the highest ever."""

    bias: float
    limit: float
    max: float


@dataclass(frozen=True)
class RobotDescription:
    """What the two files of a robot directory say, checked.

    Attributes:
        directory: Where it was read from.
        urdf: Text of robot.urdf.
        model: Pinocchio model of the whole URDF.
        joints: Names in the order of θ.
        muscles: Names in the order of T and l.
        routes: For each muscle its points (link, xyz in the link's frame [m]).
        series_elastic: Elastic constants of the muscles.
        stiffness: K_stiff of muscle stiffness control [N/m].
        tension: Tension range [N].
        end_effector: Link that grasps, is pushed and carries the marker.
    """

    directory: Path
    urdf: str
    model: pin.Model
    joints: tuple[str, ...]
    muscles: tuple[str, ...]
    routes: tuple[tuple[tuple[str, Array], ...], ...]
    series_elastic: SeriesElastic
    stiffness: float
    tension: TensionRange
    end_effector: str

    @property
    def root_link(self) -> str:
        """Name of the URDF's root link."""
        bodies = [f.name for f in self.model.frames if f.type == pin.FrameType.BODY]
        return str(bodies[0])


def load_description(robot: str | Path) -> RobotDescription:
    """Read and check a robot description.

    Args:
        robot: A shipped name such as 'musashi_left_arm', or a directory.

    Raises:
        RobotDescriptionError: Naming the file, the entry and the legal values.
    """
    directory = find_robot(robot)
    urdf_file, muscle_file = directory / 'robot.urdf', directory / 'muscles.yaml'
    urdf = read_text(urdf_file, refusal)
    model = read_urdf(urdf_file, urdf)
    reader = EntryReader(muscle_file)
    top = reader.mapping(reader.document(), 'top level', TOP_KEYS)
    links = [f.name for f in model.frames if f.type == pin.FrameType.BODY]
    joints = _read_joints(reader, top, model)
    default = _elastic(reader, top.get('series_elastic'), 'series_elastic', ELASTIC_DEFAULT)
    names, routes, elastic = [], [], []
    entries = reader.sequence(reader.required(top, 'muscles', 'top level'), 'muscles', 1, 'muscles')
    for i, raw in enumerate(entries):
        muscle = reader.mapping(raw, f'muscles[{i}]', MUSCLE_KEYS)
        name = reader.name(reader.required(muscle, 'name', f'muscles[{i}]'), f'muscles[{i}].name')
        entry = f'muscle {name!r}'
        names.append(name)
        routes.append(_route(reader, reader.required(muscle, 'route', entry), entry, links))
        elastic.append(
            _elastic(reader, muscle.get('series_elastic'), f'{entry}: series_elastic', default)
        )
    stiffness = top.get('stiffness', STIFFNESS_DEFAULT)
    return RobotDescription(
        directory=directory,
        urdf=urdf,
        model=model,
        joints=joints,
        muscles=reader.unique(names, 'muscles'),
        routes=tuple(routes),
        series_elastic=SeriesElastic(
            **{key: np.array([row[key] for row in elastic]) for key in ELASTIC_DEFAULT}
        ),
        stiffness=reader.number(stiffness, 'stiffness', positive=True),
        tension=_tension(reader, top.get('tension', {})),
        end_effector=_end_effector(reader, top, model, joints, links),
    )


def shipped_robots() -> dict[str, Path]:
    """Return the robots that come with the package, by name."""
    here = Path(__file__).resolve()
    roots = [here.parents[2] / 'config']
    # Installed by colcon: <prefix>/lib/pythonX.Y/site-packages/musculoskeletal_ae/robot/…
    roots += [up / 'share' / 'musculoskeletal_ae' / 'config' for up in here.parents]
    found: dict[str, Path] = {}
    for root in roots:
        for file in sorted(root.glob('*/muscles.yaml')):
            found.setdefault(file.parent.name, file.parent)
    return found


def find_robot(robot: str | Path) -> Path:
    """Return the directory of a shipped robot's name or of a path.

    Raises:
        RobotDescriptionError: If there is neither.
    """
    shipped = shipped_robots()
    if str(robot) in shipped:
        return shipped[str(robot)]
    try:
        directory = Path(robot).expanduser()
        if str(robot) and directory.is_dir():
            return directory.resolve()
    except (RuntimeError, ValueError, OSError):  # no such home, a NUL or a name too long in it
        pass
    raise RobotDescriptionError(
        f'robot {str(robot)!r} is neither a directory nor a shipped robot '
        f'({listed(sorted(shipped))}); give one of these names, or a directory with '
        'robot.urdf and muscles.yaml'
    )


def _read_joints(reader: EntryReader, top: dict[str, Any], model: pin.Model) -> tuple[str, ...]:
    entries = reader.sequence(reader.required(top, 'joints', 'top level'), 'joints', 1, 'names')
    names = [reader.name(value, f'joints[{i}]') for i, value in enumerate(entries)]
    movable = list(model.names)[1:]
    for name in reader.unique(names, 'joints'):
        if name not in movable:
            raise reader.fail(
                'joints',
                f'unknown joint {name!r}; movable joints of robot.urdf: {listed(movable)}',
            )
        joint = model.joints[model.getJointId(name)]
        if joint.shortname() not in kinematics.REVOLUTE + kinematics.PRISMATIC:
            raise reader.fail(
                'joints',
                f'joint {name!r} is a {joint.shortname()}; legal: revolute or prismatic joints '
                'with one degree of freedom and limits (continuous has none)',
            )
        lower = model.lowerPositionLimit[joint.idx_q]
        upper = model.upperPositionLimit[joint.idx_q]
        if not (math.isfinite(lower) and math.isfinite(upper) and lower < upper):
            raise reader.fail(
                'joints',
                f'joint {name!r} has limits [{lower:g}, {upper:g}] in robot.urdf; '
                'expected finite lower < upper',
            )
    return tuple(names)


def _elastic(
    reader: EntryReader, value: object, entry: str, default: dict[str, float]
) -> dict[str, float]:
    if value is None:
        return default
    given = reader.mapping(value, entry, tuple(ELASTIC_DEFAULT))
    result = dict(default)
    for key, raw in given.items():
        result[key] = reader.number(raw, f'{entry}.{key}', positive=key != 'wire_stretch')
        if result[key] < 0.0:
            raise reader.fail(f'{entry}.{key}', f'expected a number >= 0, got {result[key]:g}')
    return result


def _route(
    reader: EntryReader, value: object, entry: str, links: list[str]
) -> tuple[tuple[str, Array], ...]:
    points: list[tuple[str, Array]] = []
    for i, raw in enumerate(reader.sequence(value, f'{entry}: route', 2, 'points')):
        where = f'{entry}: route[{i}]'
        point = reader.mapping(raw, where, POINT_KEYS)
        link = reader.name(reader.required(point, 'link', where), f'{where}.link')
        if link not in links:
            raise reader.fail(where, f'unknown link {link!r}; links of robot.urdf: {listed(links)}')
        xyz = reader.sequence(reader.required(point, 'xyz', where), f'{where}.xyz', 3, 'numbers')
        if len(xyz) != 3:
            raise reader.fail(f'{where}.xyz', f'expected 3 numbers, got {len(xyz)}')
        position = np.array([reader.number(v, f'{where}.xyz[{k}]') for k, v in enumerate(xyz)])
        if points and points[-1][0] == link and np.array_equal(points[-1][1], position):
            raise reader.fail(where, 'is the same point as the one before it')
        points.append((link, position))
    return tuple(points)


def _tension(reader: EntryReader, value: object) -> TensionRange:
    given = reader.mapping(value, 'tension', tuple(TENSION_DEFAULT))
    numbers = {
        key: reader.number(given.get(key, default), f'tension.{key}', positive=True)
        for key, default in TENSION_DEFAULT.items()
    }
    tension = TensionRange(**numbers)
    if not tension.bias < tension.limit <= tension.max:
        raise reader.fail(
            'tension',
            f'expected bias < limit <= max, got {tension.bias:g}, {tension.limit:g}, '
            f'{tension.max:g}',
        )
    return tension


def _end_effector(
    reader: EntryReader,
    top: dict[str, Any],
    model: pin.Model,
    joints: tuple[str, ...],
    links: list[str],
) -> str:
    if top.get('end_effector') is not None:
        name = reader.name(top['end_effector'], 'end_effector')
        if name not in links:
            raise reader.fail(
                'end_effector', f'unknown link {name!r}; links of robot.urdf: {listed(links)}'
            )
        return name
    # The last link of the chain: the one with the most of our joints above it, and of several
    # on the same joint the one listed last.
    depth: dict[int, int] = {0: 0}
    for i in range(1, model.njoints):
        depth[i] = depth[model.parents[i]] + (model.names[i] in joints)
    bodies = [f for f in model.frames if f.type == pin.FrameType.BODY]
    deepest = max(depth[f.parentJoint] for f in bodies)
    return str([f.name for f in bodies if depth[f.parentJoint] == deepest][-1])
