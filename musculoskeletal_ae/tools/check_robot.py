# SPDX-License-Identifier: Apache-2.0
"""`check_robot`: says whether a robot description is sound, and where it is not."""

from __future__ import annotations

import sys
from argparse import Namespace
from pathlib import Path

from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.options import Parser, exit_status, whole


def main(argv: list[str] | None = None) -> int:
    """Check one robot; exit status 0 if it is sound, 1 if it is not or cannot be read."""
    parser = Parser(
        'check_robot',
        'Says whether a robot description is sound, and where it is not. '
        'Exit status 0: sound, 1: not sound.',
    )
    parser.add_robot('robot', default=None)
    parser.add_argument('--postures', type=whole(1, 1_000_000), default=200, help='random postures')
    parser.add_seed('of the postures')
    parser.add_plot('picture of moment arms and stiffness', 'check_<robot>.png')
    parser.add_argument('--quiet', action='store_true', help='print the verdict only')
    args = parser.parse_args(argv)
    return exit_status(lambda: check(args))


def check(args: Namespace) -> int:
    """Check a robot and print the report; return the exit status."""
    # Imported here because they take longer than the help of the command.
    from musculoskeletal_ae.robot.checks import check_robot
    from musculoskeletal_ae.robot.robot import Robot
    from musculoskeletal_ae.tools import robot_report

    robot = Robot.load(args.robot)
    name = robot.description.directory.name
    result = check_robot(robot, args.postures, args.seed)
    if not args.quiet:
        print(robot_report.summary(robot, result, args.seed))
        print(robot_report.moment_arm_table(robot, result))
    if not args.no_plot:
        file = args.plot or Path(f'check_{name}.png')
        try:
            robot_report.plot(robot, result, file)
        except (OSError, ValueError) as error:  # a ValueError is an ending of no picture
            raise MusculoskeletalError(f'plot {file} cannot be written: {error}') from error
        print(f'plot: {file}')
    for warning in result.warnings:
        print(f'warning: {warning.message}; {warning.remedy}')
    for fault in result.faults:
        print(f'fault: {fault.message}\n    remedy: {fault.remedy}')
    count = len(result.faults)
    print(f'{name}: not sound, {count} fault{"s" * (count > 1)}' if count else f'{name}: sound')
    return 1 if count else 0


if __name__ == '__main__':
    sys.exit(main())
