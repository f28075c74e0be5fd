# SPDX-License-Identifier: Apache-2.0
"""`check_robot`: checks whether muscles can hold a robot and make it stiff; names faults."""

from musculoskeletal_ae.options import Parser, exit_status, number, whole
from musculoskeletal_ae.process_signals import import_heavy

REACH = 0.02  # without --reach, let --suggest move a via point by at most this [m]


def main(argv: list[str] | None = None) -> int:
    """Check one robot; exit status 0 if it has no faults, 1 if it has faults or cannot be read."""
    parser = Parser(
        'check_robot',
        'Checks whether a robot description is sound, and names its faults and remedies. '
        'Exit status 0: sound (with --suggest: the arm that it wrote is sound), 1: not sound.',
    )
    parser.add_robot('robot', default=None)
    parser.add_argument(
        '--postures', type=whole(1, 10_000), default=200, help='number of random postures'
    )
    parser.add_seed('of the postures')
    parser.add_plot('moment arms and stiffness')
    parser.add_argument('--quiet', action='store_true', help='print the verdict only')
    text = 'search for the smallest change of via points that makes the robot sound (takes minutes)'
    parser.add_argument('--suggest', action='store_true', help=text)
    text = 'new directory for the arm that --suggest finds and a picture of the changed routes'
    parser.add_out('DIR', text, is_optional=True)
    text = f'how far --suggest may move a via point [m] (default: {REACH:g})'
    parser.add_argument('--reach', type=number(1e-3, 1.0), help=text)
    args = parser.parse_args(argv)
    if args.suggest != bool(args.out):
        parser.error('--suggest needs --out DIR, a new directory, and --out needs --suggest')
    if args.out and args.out.exists():
        parser.error(f'--out {args.out} exists already; name a new directory')
    if args.reach and not args.suggest:
        parser.error('--reach needs --suggest; add it, or remove --reach')
    args.reach = args.reach or REACH
    return exit_status(
        lambda: import_heavy('musculoskeletal_ae.design.robot_report').check(args), out=args.out
    )
