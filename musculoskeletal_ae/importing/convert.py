# SPDX-License-Identifier: Apache-2.0
"""Convert a file of another format to a robot directory, and report the result (`import_robot`)."""

import re
from argparse import Namespace
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree as ET

from musculoskeletal_ae.design.checks import RobotCheck, check_robot
from musculoskeletal_ae.design.prospects import prospects
from musculoskeletal_ae.exceptions import RobotDescriptionError
from musculoskeletal_ae.files import file_error, new_directory, read_text
from musculoskeletal_ae.importing.cardsflow import read_cardsflow, read_urdf_skeleton
from musculoskeletal_ae.importing.held_range import held_ranges
from musculoskeletal_ae.importing.mjcf import read_mjcf
from musculoskeletal_ae.importing.source import (
    ARM_POSTURES,
    POSTURES,
    Comparison,
    Source,
    compare,
    cut,
    write,
)
from musculoskeletal_ae.options import chain_of
from musculoskeletal_ae.robot.joint_tree import resolved
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.robot.urdf import parse_xml

LARGEST = 20_000_000  # refuse a larger file [bytes]
OPENSIM = (
    'OpenSim models are not read; convert this model to MJCF with MyoConverter '
    '(https://github.com/MyoHub/myoconverter) and import the .xml file that it writes'
)
#: reader of each format, by the root element of its files
READERS = {
    'mujoco': read_mjcf,
    'cardsflow': read_cardsflow,
    'robot': read_urdf_skeleton,
}


class Imported(NamedTuple):
    """An imported robot, with the source from which it was made."""

    robot: Robot
    #: its notes state everything that the import chose, dropped, held fixed, renamed or
    #: approximated; `compare` compares the robot with it
    source: Source


def read_source(file: Path) -> Source:
    """Read the robot of a file of any supported format, which the root element identifies.

    Raises:
        MusculoskeletalError: If the file is not valid; the message names the file, the problem and
            the legal values.
        RobotDescriptionError: If the file cannot be read as XML, or if a URDF is not valid.
    """
    text = read_text(file, largest=LARGEST)
    # Look for OpenSim before parsing, because some of its files are not valid XML.
    if '<OpenSimDocument' in text:
        raise file_error(file, OPENSIM)
    try:
        root = parse_xml(file, text)
    except RobotDescriptionError as error:
        # Let MuJoCo read invalid XML, too: it accepts, for example, attributes without a space.
        loose = isinstance(error.__cause__, ET.ParseError)
        if not (loose and re.match(r'(\s|<\?.*?\?>|<!--.*?-->)*<mujoco[\s/>]', text, re.DOTALL)):
            raise
        root = ET.Element('mujoco')
    if root.tag not in READERS:
        problem = f'the root element {root.tag[:60]!r} is unknown; legal: {", ".join(READERS)}'
        remedy = 'to import an SDF, pass the path of the cardsflow.xml in its directory instead'
        raise file_error(file, f'{problem}; {remedy}')
    try:
        source = READERS[root.tag](file, root)
        source.couplings = resolved(source.couplings)
    except (ArithmeticError, AttributeError, LookupError, RuntimeError, TypeError, ValueError) as e:
        problem = str(e) if isinstance(e, ValueError) else repr(e)
        raise file_error(file, f'cannot be imported: {problem}') from e
    if not source.routes:
        raise file_error(file, '; '.join(['has no muscle with a route', *source.lost()[-3:]]))
    return source


def import_robot(file: Path, out: Path, **chain: Any) -> Imported:
    """Import a file as a robot directory.

    Args:
        file: Path of the file to import.
        out: A new or empty directory.
        chain: Options of `cut`.

    Raises:
        MusculoskeletalError: If the file cannot be imported.
        RobotDescriptionError: If the result is not a valid robot, for example because an inertia is
            not physical.
    """
    source = read_source(file)
    cut(source, **chain)
    if not source.routes:
        raise file_error(file, '; '.join(['no muscle remains', *source.lost()[-3:]]))
    with new_directory(out):
        notes = list(source.notes)
        write(source, out)
        robot = Robot.load(out)
        if held := held_ranges(robot):
            # Discard the notes of the first `write`, because the second one repeats them.
            source.notes = notes
            for joint, low, high in held:
                source.reduce_range(joint, low, high)
            write(source, out)
            robot = Robot.load(out)
    return Imported(robot, source)


def run(args: Namespace) -> int:
    """Run an import, print the report, and return the exit status."""
    robot, source = import_robot(args.file, args.out, **chain_of(args))
    print(*prospects(robot).lines(), sep='\n', flush=True)
    comparison = compare(source, robot)  # slow: what makes the robot useless is printed before
    for note, count in Counter(source.notes).items():
        print(note + (f' ({count} times)' if count > 1 else ''))
    for note in robot.description.notes:
        print(note)
    for text in robot.description.warnings:
        print(f'warning: {text}')
    print(length_verdict(comparison))
    if comparison is not None and comparison.lengths:
        print(arm_verdict(comparison))
    check = check_robot(robot)
    for warning in check.warnings:
        if warning.kind == 'jumping_muscle':  # its remedies change the source or the import
            print(f'warning: {warning.text}; {warning.remedy}')
    print(f'{args.out}: {robot.joint_count} joints, {robot.muscle_count} muscles')
    print(check_verdict(check))
    return 0


def length_verdict(comparison: Comparison | None) -> str:
    """Return a text about the largest length errors relative to the engine of the source format.

    `comparison` is None if there is no such engine; the text then says so.
    """
    errors = comparison.lengths if comparison else None
    if not errors:
        return 'lengths: not compared, because no engine of the source format computes lengths'
    worst = sorted(errors.items(), key=lambda item: -item[1])[:5]
    named = ', '.join(f'{name} {1e3 * error:.2f}' for name, error in worst if error > 1e-3)
    verdict = f'largest length error over {POSTURES} postures: {1e3 * worst[0][1]:.3f} mm'
    verdict += f', {sum(e <= 1e-3 for e in errors.values())} of {len(errors)} muscles within 1 mm'
    return verdict + (f'; worst [mm]: {named}' if named else '')


def arm_verdict(comparison: Comparison) -> str:
    """Return a text about the largest moment arm errors relative to the engine of the source.

    The text also names the muscles whose moment arm has the wrong sign in some postures.
    """
    worst = sorted(comparison.arms.items(), key=lambda item: -item[1])[:5]
    named = ', '.join(f'{name} {1e3 * error:.2f}' for name, error in worst if error > 1e-3)
    verdict = f'largest moment arm error over {ARM_POSTURES} postures: {1e3 * worst[0][1]:.3f} mm'
    verdict += f'; worst [mm]: {named}' if named else ''
    wrong = {name: share for name, share in comparison.flips.items() if share > 0.0}
    flips = ', '.join(f'{name} in {100 * share:.0f} % of postures' for name, share in wrong.items())
    return f'{verdict}; {f"wrong sign: {flips}" if wrong else "all signs agree"}'


def check_verdict(check: RobotCheck) -> str:
    """Return a line with the verdict of `check_robot`."""
    held, stiff = (f'{100 * share.mean():.0f} %' for share in (check.held, check.stiff))
    shares = (
        f'the muscles can hold the arm in {held} of postures, and it is stiff enough in {stiff}'
    )
    kinds = Counter(fault.kind for fault in check.faults)
    faults = ', '.join(f'{kind} ({count})' for kind, count in kinds.items())
    return f'check_robot: {f"faults: {faults}" if faults else "no faults"}; {shares}'
