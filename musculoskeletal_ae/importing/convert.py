# SPDX-License-Identifier: Apache-2.0
"""From a file of another format to a robot directory: what `import_robot` does and says."""

from __future__ import annotations

from argparse import Namespace
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.files import read_text
from musculoskeletal_ae.importing import opensim
from musculoskeletal_ae.importing.cardsflow import read_cardsflow, read_urdf_skeleton
from musculoskeletal_ae.importing.mjcf import read_mjcf
from musculoskeletal_ae.importing.source import (
    GOAL,
    POSTURES,
    Source,
    SourceError,
    compare,
    cut,
    refuse,
    write,
)
from musculoskeletal_ae.robot.checks import RobotCheck, check_robot
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.urdf import parse_xml

#: reader of each format, by the root element of its files
READERS = {
    'mujoco': read_mjcf,
    'cardsflow': read_cardsflow,
    'OpenSimDocument': opensim.read_osim,
    'robot': read_urdf_skeleton,
}


class Imported(NamedTuple):
    """A robot that was imported."""

    robot: Robot
    notes: tuple[str, ...]  # what had to be chosen, dropped, held fixed or approximated
    errors: dict[str, float] | None  # largest length error of each muscle [m]; None: not computed


def read_source(file: Path) -> Source:
    """Read a file of any of the formats, told by its root element.

    Raises:
        SourceError: Naming the file, what is wrong and what is legal.
        RobotDescriptionError: If it is not XML, or has a DOCTYPE.
    """
    root = parse_xml(file, read_text(file, refuse, opensim.LARGEST)).tag
    if root not in READERS:
        told = f'{root[:60]!r} is none of the formats read: {", ".join(READERS)}'
        raise refuse(file, f'{told}; an SDF is read beside its cardsflow.xml')
    return READERS[root](file)


def import_robot(
    file: Path,
    out: Path,
    joints: Sequence[str] = (),
    muscles: Sequence[str] = (),
    base: str = '',
    end: str = '',
) -> Imported:
    """Import a file as a robot directory; see `cut` for what is left of it.

    Raises:
        SourceError: Naming what is wrong.
        RobotDescriptionError: If what was written is no valid robot, as of wrong inertias.
    """
    source = read_source(file)
    end_effector = cut(source, joints, muscles, base, end)
    if not source.routes:
        raise SourceError(f'{file}: no muscle is left; {"; ".join(source.notes[-3:])}')
    write(source, out, end_effector)
    robot = Robot.load(out)
    return Imported(robot, tuple(source.notes), compare(source, robot))


def run(args: Namespace) -> int:
    """Import, and print what a person should know; return the exit status."""
    result = import_robot(
        args.file, args.out, args.joints, args.muscles, args.base or '', args.end or ''
    )
    robot = result.robot
    for note, count in Counter(result.notes).items():
        print(note + (f' ({count} times)' if count > 1 else ''))
    for warning in robot.description.warnings:
        print(f'warning: {warning}')
    print(length_verdict(result))
    print(f'{args.out}: {robot.joint_count} joints, {robot.muscle_count} muscles')
    print(check_verdict(check_robot(robot)))
    return 0


def length_verdict(result: Imported) -> str:
    """Say how far lengths are from the source's own."""
    if not result.errors:
        return 'lengths: not compared, the source has none of its own here'
    values = 1e3 * np.array(list(result.errors.values()))
    worst = ', '.join(
        f'{name} {1e3 * error:.2f}'
        for name, error in sorted(result.errors.items(), key=lambda item: -item[1])[:5]
        if error > GOAL
    )
    told = f'largest length error over {POSTURES} postures: {values.max():.3f} mm'
    told += f', {(values <= 1e3 * GOAL).sum()} of {len(values)} muscles within 1 mm'
    return told + (f'; worst [mm]: {worst}' if worst else '')


def check_verdict(check: RobotCheck) -> str:
    """Say in a line what `check_robot` finds."""
    shares = f'held {100 * check.held.mean():.0f} %, stiff {100 * check.stiff.mean():.0f} %'
    if not check.faults:
        return f'check_robot: sound; {shares}'
    kinds = Counter(fault.kind for fault in check.faults)
    told = ', '.join(f'{kind} ({count})' for kind, count in kinds.items())
    return f'check_robot: not sound: {told}; {shares}'
