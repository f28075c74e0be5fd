# SPDX-License-Identifier: Apache-2.0
"""The tool `check_driver`: does the driver of a real arm keep its contract?"""

from __future__ import annotations

from argparse import Namespace

from musculoskeletal_ae.nodes.running import ROS_HELP, run_tool
from musculoskeletal_ae.options import Parser, names, number, numbers, positive
from musculoskeletal_ae.start import load


def _check(options: Namespace, arguments: list[str]) -> int:
    status: int = load('musculoskeletal_ae.nodes.driver_check').check(options, arguments)
    return status


def _parse(arguments: list[str]) -> Namespace:
    parser = Parser(
        'check_driver',
        'Listens to the driver of a real arm and says of each muscle whether it keeps the contract '
        'of doc/your_robot.md: what was seen, and what to change. Move the arm gently by hand '
        'meanwhile, if you can. Exit status 0: it does, 1: it does not.',
        ROS_HELP,
    )
    parser.add_robot()
    add = parser.add_argument
    add('--seconds', type=positive, default=30.0, metavar='S', help='how long to listen [s]')
    add('--rate', type=number(1.0, 1000.0), default=100.0, metavar='HZ', help='of muscle_states')
    add(
        '--posture',
        type=numbers,
        metavar='θ,…',
        help='where the arm is held, without sensors [rad]',
    )
    add('--move', action='store_true', help='then wind each muscle in a little, one at a time')
    add('--muscles', type=names, metavar='NAME,…', help='with --move: only these')
    text = 'with --move: the highest tension asked for [N] (default: 40 above T_bias)'
    add('--tension', type=positive, metavar='N', help=text)
    add('--wait', action='store_true', help='wait for a driver, and until it has no fault')
    options = parser.parse_args(arguments)
    if (options.muscles or options.tension) and not options.move:
        parser.error('--muscles and --tension go with --move')
    return options


def main(argv: list[str] | None = None) -> int:
    """Judge a driver."""
    return run_tool('check_driver', _parse, _check, argv)
