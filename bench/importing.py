# SPDX-License-Identifier: Apache-2.0
"""Imports public robot models, and compares their muscle lengths with the source.

    python -m bench importing FILE… [--out DIR]

The files are public models that you have downloaded; none is part of this repository. The bench
prints one row for each file:

- the numbers of joints, muscles, and wrapping muscles,
- the largest and the median length error over 1000 postures (nan: the source has no lengths).
  MuJoCo computes the lengths of the source: of an MJCF file as it is, and of a cardsflow.xml from
  its model.urdf with a site at each via point. Muscles of a cardsflow.xml that wrap are left out,
- the largest moment arm error over 200 postures, and the number of muscles with a wrong sign there,
- the verdict of `check_robot` over 100 postures.
"""

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import mujoco
import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.design.checks import check_robot
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.files import read_text
from musculoskeletal_ae.importing.cardsflow import ROUND
from musculoskeletal_ae.importing.convert import check_verdict, import_robot, read_source
from musculoskeletal_ae.importing.source import Comparison, Source, compare
from musculoskeletal_ae.options import Parser
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.urdf import parse_xml

#: leave these elements of a link out, because they do not affect muscle lengths
DRAWN = 'visual', 'collision'
HEAD = (
    'model', 'joints', 'muscles', 'wrap', 'max error [mm]', 'median [mm]', 'moment arm [mm]',
    'wrong signs', 'check_robot',
)  # fmt: skip


def lengths_of_cardsflow(file: Path, source: Source) -> Callable[[dict[str, Array]], Any]:
    """Return a function by which MuJoCo computes the muscle lengths of a cardsflow.xml.

    The function takes joint positions by name [rad or m], each (N,), and returns muscle lengths by
    name [m], each (N,). Muscles that wrap are left out.
    """
    urdf = file.with_name('model.urdf')
    tree, root = (parse_xml(each, read_text(each)) for each in (urdf, file))
    settings = ET.SubElement(ET.SubElement(tree, 'mujoco'), 'compiler')
    settings.attrib.update(fusestatic='false', discardvisual='true')
    centres = {}
    for link in tree.findall('link'):
        for part in [part for part in link if part.tag in DRAWN]:
            link.remove(part)
        at = link.find('inertial/origin')
        text = '0 0 0' if at is None else at.get('xyz', '0 0 0')
        centres[link.get('name', '')] = [*map(float, text.split())]
        # State the same mass for each link: it affects no muscle length, but MuJoCo needs one.
        for part in link.findall('inertial'):
            link.remove(part)
        weight = ET.SubElement(link, 'inertial')
        ET.SubElement(weight, 'mass', value='1')
        moments = {'ixx': '1', 'iyy': '1', 'izz': '1', 'ixy': '0', 'ixz': '0', 'iyz': '0'}
        ET.SubElement(weight, 'inertia', moments)
    spec = mujoco.MjSpec.from_string(ET.tostring(tree, encoding='unicode'))
    bodies = {body.name: body for body in spec.bodies}
    points = [
        [(part.get('name', ''), via) for part in muscle.iter('link') for via in part]
        for muscle in root.iter('myoMuscle')
    ]
    straight = [[via.get('type') not in ROUND for _, via in own] for own in points]
    imported = [i for i, own in enumerate(straight) if sum(own) > 1]
    measured = []
    for name, m in zip(source.routes, imported, strict=True):
        own = points[m]
        if not all(straight[m]):
            continue
        tendon = spec.add_tendon(name=name)
        for i, (owner, via) in enumerate(own):
            place = np.add(centres.get(owner, [0.0] * 3), [*map(float, (via.text or '').split())])
            body = bodies.get(owner, spec.worldbody)
            tendon.wrap_site(body.add_site(name=f'{name} {i}', pos=place).name)
        measured.append(name)
    model = spec.compile()
    data = mujoco.MjData(model)

    def lengths(values: dict[str, Array]) -> dict[str, Array]:
        rows = np.empty((len(next(iter(values.values()))), model.ntendon))
        for n in range(len(rows)):
            for joint, angles in values.items():
                data.joint(joint).qpos[0] = angles[n]
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_tendon(model, data)
            rows[n] = data.ten_length
        return dict(zip(measured, rows.T, strict=True))

    return lengths


def compared(file: Path, robot: Robot, source: Source) -> Comparison | None:
    """Compare the muscle lengths of a robot with those of its source.

    For a cardsflow.xml with a model.urdf beside it, MuJoCo computes the lengths of the source.
    """
    if file.name == 'cardsflow.xml' and file.with_name('model.urdf').exists():
        source = read_source(file)
        source.lengths = lengths_of_cardsflow(file, source)
    return compare(source, robot)


def row(file: Path, out: Path) -> list[str]:
    """Import one file, and return the row of the table that describes the result."""
    name = f'{file.parent.name}/{file.name}'
    try:
        robot, source = import_robot(file, out)
        comparison = compared(file, robot, source)
    except MusculoskeletalError as error:
        return [name, str(error)[-160:]]
    parts = comparison if comparison and comparison.lengths else ({'': np.nan},) * 3
    lengths, arms, flips = (np.array(list(part.values())) for part in parts)
    errors = [f'{1e3 * lengths.max():.3f}', f'{1e3 * np.median(lengths):.3f}']
    errors += [f'{1e3 * arms.max():.3f}', f'{(flips > 0.0).sum()}']
    check = check_verdict(check_robot(robot, 100)).removeprefix('check_robot: ')
    wraps = len(set(robot.routes.muscle[robot.routes.wrapping].tolist()))
    counts = (robot.joint_count, robot.muscle_count, wraps)
    return [name, *map(str, counts), *errors, f'{check} ({len(set(source.notes))} notes)']


def main(argv: list[str]) -> None:
    """Import the files that the command line names, and print a row for each."""
    parser = Parser('importing', 'Imports public models that you have downloaded.')
    parser.add_argument(
        'files', nargs='+', type=Path, metavar='FILE', help='model to import as a robot'
    )
    parser.add_out('DIR', 'folder that keeps the robot directories', is_optional=True)
    args = parser.parse_args(argv)

    print(f'| {" | ".join(HEAD)} |\n{"|---" * len(HEAD)}|')
    with tempfile.TemporaryDirectory() as folder:
        for i, file in enumerate(args.files):
            out = (args.out or Path(folder)) / f'{i}_{file.resolve().parent.name}_{file.stem}'
            cells = row(file, out)
            cells += [''] * (len(HEAD) - len(cells))
            print(f'| {" | ".join(cells)} |', flush=True)
