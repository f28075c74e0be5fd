# SPDX-License-Identifier: Apache-2.0
"""`train`: initial training, or learning from recordings or from an emulated MuJoCo model."""

from pathlib import Path

from musculoskeletal_ae.options import Parser, exit_status
from musculoskeletal_ae.parameters import DEVICES
from musculoskeletal_ae.process_signals import import_heavy
from musculoskeletal_ae.robot.directories import shipped_robots


def main(argv: list[str] | None = None) -> int:
    """Train one network; exit status 1 if a robot or file is unusable, 2 for invalid options."""
    parser = Parser(
        'train',
        'Trains the Musculoskeletal AutoEncoder on the geometric model of a robot and writes a '
        'checkpoint. Prints the error of each of the nine (mask, output) pairs on held-out data. '
        'Exit status 1: the robot or a file is unusable, or nothing was learned from recordings; '
        '2: invalid options.',
    )
    either = parser.add_mutually_exclusive_group(required=True)
    text = f'a directory, or one of: {", ".join(sorted(shipped_robots()))}'
    either.add_argument('--robot', metavar='NAME|DIR', help=text)
    text = 'a MuJoCo model: import it, let an emulated arm of it explore, and learn, without ROS'
    either.add_argument('--mujoco', type=Path, metavar='FILE', help=text)
    parser.add_minutes('with --mujoco: duration of the exploration', 10.0)
    parser.add_chain()
    parser.add_out('FILE.safetensors', 'the checkpoint')
    parser.add_preset('paper: network and training as in the paper; default: the best measured')
    parser.add_seed('of data and weights')
    parser.add_plot('loss and errors')
    for flag, text in (
        ('--from-bag', 'learn the arm from recordings: bag directories, mcap or sqlite3 files'),
        ('--hold-out', 'with --from-bag: recordings for measuring the error before and after'),
    ):
        parser.add_argument(flag, nargs='+', type=Path, default=[], metavar='BAG', help=text)
    text = (
        'with --from-bag: network to start from (default: the initial network of bringup.sh from '
        'its cache, or train it)'
    )
    parser.add_argument('--checkpoint', type=Path, metavar='FILE', help=text)
    text = 'with --from-bag: namespace of the arm if the bags have several'
    parser.add_argument('--from-namespace', metavar='NS', help=text)
    text = 'device for training; it must be one that torch can use'
    parser.add_argument('--device', choices=DEVICES, default='cpu', help=text)
    parser.add_quick('a tenth of the training, for a first try')
    args = parser.parse_args(argv)
    of_bags = args.hold_out, args.checkpoint, args.from_namespace
    if not args.from_bag and any(of_bags):
        options = '--hold-out, --checkpoint and --from-namespace'
        parser.error(f'use {options} with --from-bag only')
    if args.checkpoint and args.quick:
        parser.error('--quick shortens the initial training; do not use it with --checkpoint')
    learned = {path.resolve() for path in args.from_bag}
    if both := [str(path) for path in args.hold_out if path.resolve() in learned]:
        parser.error(f'{both[0]} is both in --from-bag and in --hold-out; name it only once')
    out, read = args.out.resolve(), learned | {path.resolve() for path in args.hold_out}
    if read & {out, *out.parents}:
        parser.error(f'--out {args.out} would overwrite a recording; name another file')
    if args.plot and args.plot.resolve() == out:
        parser.error(f'--plot {args.plot} would overwrite the checkpoint; name another file')
    if args.from_bag and args.plot:
        parser.error('--plot shows the initial training; do not use it with --from-bag')
    work = 'bag_learning' if args.from_bag else 'model_training'
    if args.mujoco:
        if args.from_bag or args.plot:
            parser.error('--mujoco learns an emulated arm; remove --from-bag and --plot')
        work = 'mujoco_learning'
    elif any(getattr(args, name) for name in ('joints', 'muscles', 'without', 'base', 'end')):
        parser.error('--joints, --muscles, --without, --base and --end need --mujoco')
    return exit_status(
        lambda: import_heavy(f'musculoskeletal_ae.tools.{work}').train(args), out=args.out
    )
