# SPDX-License-Identifier: Apache-2.0
"""From a file of another format to a robot directory: what `import_robot` does and says."""

import os
import re
import time
from argparse import Namespace
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree as ET

from musculoskeletal_ae.exceptions import RobotDescriptionError
from musculoskeletal_ae.files import read_text
from musculoskeletal_ae.importing.cardsflow import read_cardsflow, read_urdf_skeleton
from musculoskeletal_ae.importing.mjcf import read_mjcf
from musculoskeletal_ae.importing.source import (
    ARM_POSTURES,
    POSTURES,
    Comparison,
    Source,
    compare,
    cut,
    refuse,
    write,
)
from musculoskeletal_ae.robot.checks import RobotCheck, check_robot
from musculoskeletal_ae.robot.joint_tree import resolved
from musculoskeletal_ae.robot.jumps import jump_choices
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.urdf import parse_xml

LARGEST = 20_000_000  # [bytes] of a model
WARM_UP, PLAYED = 0.1, 1.0  # [s] of a model
REAL_TIME = 0.5  # [s] of a core for a second, beside the other nodes on two cores
SLOW = 3  # exit status
OPENSIM = (
    'OpenSim models are not read; convert it to MJCF with MyoConverter '
    '(https://github.com/MyoHub/myoconverter) and import the .xml file that it writes'
)
#: reader of each format, by the root element of its files
READERS = {
    'mujoco': read_mjcf,
    'cardsflow': read_cardsflow,
    'robot': read_urdf_skeleton,
}


class Imported(NamedTuple):
    """A robot that was imported."""

    robot: Robot
    notes: tuple[str, ...]  # what had to be chosen, dropped, held fixed, renamed or approximated
    comparison: Comparison | None  # with the source's own engine; None: it has no lengths


def read_source(file: Path) -> Source:
    """Read a file of any of the formats, recognised by its root element.

    A SourceError or RobotDescriptionError names the file, what is wrong and what is legal.
    """
    text = read_text(file, refuse, LARGEST)
    # Before parsing: OpenSim writes tags that are not XML, as HuntCrossleyForce::ContactParameters.
    if '<OpenSimDocument' in text:
        raise refuse(file, OPENSIM)
    try:
        root = parse_xml(file, text)
    except RobotDescriptionError as error:
        # MuJoCo reads some of what is no XML, as attributes without a space between.
        loose = isinstance(error.__cause__, ET.ParseError)
        if not (loose and re.match(r'(\s|<\?.*?\?>|<!--.*?-->)*<mujoco[\s/>]', text, re.DOTALL)):
            raise
        root = ET.Element('mujoco')
    if root.tag not in READERS:
        problem = f'{root.tag[:60]!r} is none of the formats read: {", ".join(READERS)}'
        raise refuse(file, f'{problem}; an SDF is read beside its cardsflow.xml')
    if any('/xacro}' in element.tag for element in root.iter()):
        raise refuse(file, 'this is a xacro, not a URDF: expand it first, by xacro FILE > arm.urdf')
    try:
        source = READERS[root.tag](file, root)
        source.couplings = resolved(source.couplings)
    except (ArithmeticError, AttributeError, LookupError, RuntimeError, TypeError, ValueError) as e:
        problem = str(e) if isinstance(e, ValueError) else repr(e)
        raise refuse(file, f'it cannot be imported: {problem}') from e
    if not source.routes:
        raise refuse(file, '; '.join(['it has no muscle with a route', *source.lost()[-3:]]))
    return source


def import_robot(file: Path, out: Path, **chain: Any) -> Imported:
    """Import a file as a robot directory; `chain`: the options of `cut`.

    A RobotDescriptionError says if what was written is no valid robot, as of wrong inertias.
    """
    source = read_source(file)
    cut(source, **chain)
    if not source.routes:
        raise refuse(file, '; '.join(['no muscle is left', *source.lost()[-3:]]))
    if (there := os.path.lexists(out)) and (not out.is_dir() or any(out.iterdir())):
        raise refuse(out, 'expected a new or empty directory')
    try:
        write(source, out)
        robot = Robot.load(out)
    except BaseException:  # Ctrl-C too leaves nothing that looks like a robot
        for file in out.glob('*'):  # of which none was there
            file.unlink()
        if not there and out.exists():
            out.rmdir()
        raise
    return Imported(robot, tuple(source.notes), compare(source, robot))


def run(args: Namespace) -> int:
    """Import, and print what a person should know; return the exit status."""
    chain = {name: getattr(args, name) for name in ('joints', 'muscles', 'without', 'base', 'end')}
    robot, notes, comparison = import_robot(args.file, args.out, **chain)
    for note, count in Counter(notes).items():
        print(note + (f' ({count} times)' if count > 1 else ''))
    for note in robot.description.joint_notes:
        print(f'coupled: {note}')
    for note in robot.description.spring_notes:
        print(f'spring: {note}')
    for warning in robot.description.warnings:
        print(f'warning: {warning}')
    print(length_verdict(comparison))
    if comparison is not None and comparison.lengths:
        print(arm_verdict(comparison))
    for line in jump_choices(robot):
        print(line)
    print(f'{args.out}: {robot.joint_count} joints, {robot.muscle_count} muscles')
    print(check_verdict(check_robot(robot)))
    return play(robot, args.file) if args.play else 0


def play(robot: Robot, file: Path) -> int:
    """Play the file for a second, say how fast that is, and return 0, or SLOW if it is too slow.

    A MusculoskeletalError says why it cannot be played.
    """
    from musculoskeletal_ae.emulator.reality import make_arm

    arm = make_arm(robot, reality=str(file))
    for warning in arm.warnings:
        print(f'warning: {warning}')
    arm.step(WARM_UP)
    start = time.process_time()
    arm.step(PLAYED)
    needed = (time.process_time() - start) / PLAYED
    message = f'played: a second of the model takes {needed:.2g} s of a core'
    if needed <= REAL_TIME:
        print(f'{message}: it runs in real time')
        return 0
    slower = needed / REAL_TIME
    print(f'{message}: about {slower:.2g} times slower than real time; the nodes run on its clock')
    return SLOW


def length_verdict(comparison: Comparison | None) -> str:
    """Say how far lengths are from the source's own."""
    errors = comparison.lengths if comparison else None
    if not errors:
        return 'lengths: not compared, the source has none of its own here'
    worst = sorted(errors.items(), key=lambda item: -item[1])[:5]
    named = ', '.join(f'{name} {1e3 * error:.2f}' for name, error in worst if error > 1e-3)
    verdict = f'largest length error over {POSTURES} postures: {1e3 * worst[0][1]:.3f} mm'
    verdict += f', {sum(e <= 1e-3 for e in errors.values())} of {len(errors)} muscles within 1 mm'
    return verdict + (f'; worst [mm]: {named}' if named else '')


def arm_verdict(comparison: Comparison) -> str:
    """Say how far moment arms are from the source's own, and whether signs agree."""
    worst = sorted(comparison.arms.items(), key=lambda item: -item[1])[:5]
    named = ', '.join(f'{name} {1e3 * error:.2f}' for name, error in worst if error > 1e-3)
    verdict = f'largest moment arm error over {ARM_POSTURES} postures: {1e3 * worst[0][1]:.3f} mm'
    verdict += f'; worst [mm]: {named}' if named else ''
    wrong = {name: share for name, share in comparison.flips.items() if share > 0.0}
    flips = ', '.join(f'{name} in {100 * share:.0f} % of postures' for name, share in wrong.items())
    return f'{verdict}; {f"wrong sign: {flips}" if wrong else "all signs agree"}'


def check_verdict(check: RobotCheck) -> str:
    """Say in a line what `check_robot` finds."""
    shares = f'held {100 * check.held.mean():.0f} %, stiff {100 * check.stiff.mean():.0f} %'
    kinds = Counter(fault.kind for fault in check.faults)
    faults = ', '.join(f'{kind} ({count})' for kind, count in kinds.items())
    return f'check_robot: {f"not sound: {faults}" if faults else "sound"}; {shares}'
