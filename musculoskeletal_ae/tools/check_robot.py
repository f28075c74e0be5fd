# SPDX-License-Identifier: Apache-2.0
"""`check_robot`: says whether a robot description is sound, and where it is not."""

from __future__ import annotations

import sys

from musculoskeletal_ae.options import Parser, exit_status, whole
from musculoskeletal_ae.start import load


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

    return exit_status(lambda: load('musculoskeletal_ae.tools.robot_report').check(args))


if __name__ == '__main__':
    sys.exit(main())
