# SPDX-License-Identifier: Apache-2.0
"""`import_robot`: converts a model of another project to a robot directory."""

from pathlib import Path

from musculoskeletal_ae.options import Parser, exit_status, names
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
    for kind in ('joints', 'muscles'):
        text = f'{kind} to keep'
        parser.add_argument(f'--{kind}', type=names, default=[], metavar='NAME,…', help=text)
    text = 'muscles to leave out'
    parser.add_argument('--without', type=names, default=[], metavar='NAME,…', help=text)
    parser.add_argument('--base', metavar='LINK', help='root link of the chain to keep')
    text = 'end effector: a link, a site, or LINK_tip, the far end of a drawn link; '
    text += 'joints outside the chain to it are held fixed'
    parser.add_argument('--end', metavar='NAME', help=text)
    args = parser.parse_args(argv)
    return exit_status(
        lambda: import_heavy('musculoskeletal_ae.importing.convert').run(args), out=args.out
    )
