# SPDX-License-Identifier: Apache-2.0
"""`import_robot`: converts a model of another project to a robot directory."""

from pathlib import Path

from musculoskeletal_ae.options import Parser, exit_status
from musculoskeletal_ae.process_signals import import_heavy


def main(argv: list[str] | None = None) -> int:
    """Import one model; exit status 0 if the written directory loads."""
    parser = Parser(
        'import_robot',
        'Converts a MuJoCo model (MJCF), a cardsflow.xml beside its model.urdf or model.sdf, or a '
        'URDF (which gives a skeleton to fill in) to a robot directory. Reports what it chose, '
        'dropped, renamed or approximated, and how far lengths and moment arms are from those of '
        "the source's own engine. Convert OpenSim models to MJCF with MyoConverter first. Exit "
        'status 0: the directory loads.',
    )
    parser.add_argument('file', type=Path, metavar='FILE', help='the model')
    parser.add_out('DIR', 'new or empty directory')
    parser.add_chain()
    args = parser.parse_args(argv)
    return exit_status(
        lambda: import_heavy('musculoskeletal_ae.importing.convert').run(args), out=args.out
    )
