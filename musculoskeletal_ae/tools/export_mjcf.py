# SPDX-License-Identifier: Apache-2.0
"""`export_mjcf`: writes a learned body as a MuJoCo model."""

from argparse import Namespace
from pathlib import Path

from musculoskeletal_ae.options import Parser, exit_status
from musculoskeletal_ae.process_signals import import_heavy


def main(argv: list[str] | None = None) -> int:
    """Export one checkpoint; exit status 0 if the model was written and loads."""
    parser = Parser(
        'export_mjcf',
        'Writes the body model of a checkpoint as an MJCF model. Links, joints, limits and masses '
        'are those of the robot; series elastic elements and friction are learned, and so are the '
        'route points of each muscle of which there are enough samples. '
        'A report compares lengths and moment arms with those of the network, and the torques of '
        'weight and springs with those of the robot. With --into, a copy of your MJCF file gets '
        'the learned attachment points instead, and everything else in it stays as it is.',
    )
    parser.add_argument('checkpoint', type=Path, metavar='CHECKPOINT', help='.safetensors file')
    parser.add_robot(default=None)
    parser.add_out('DIR', 'new or empty directory, for model.xml and report.txt')
    text = 'MJCF file of the robot; a copy of it with the learned attachment points is written'
    parser.add_argument('--into', type=Path, metavar='FILE', help=text)
    args = parser.parse_args(argv)
    return exit_status(lambda: _run(args), out=args.out)


def _run(args: Namespace) -> int:
    checkpoint = import_heavy('musculoskeletal_ae.mae.checkpoint')
    exporting = import_heavy('musculoskeletal_ae.exporting.exported_mjcf')
    robot = import_heavy('musculoskeletal_ae.robot.robot').Robot.load(args.robot)
    mae = checkpoint.load(args.checkpoint, robot)
    if args.into is not None:
        print(exporting.export_into(robot, mae, args.into, args.out), end='')
        print(f'model: {args.out / args.into.name}')
        return 0
    exporting.export(robot, mae, args.out)
    print((args.out / 'report.txt').read_text(encoding='utf-8'), end='')
    print(f'model: {args.out / "model.xml"}')
    return 0
