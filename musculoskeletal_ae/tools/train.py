# SPDX-License-Identifier: Apache-2.0
"""`train`: initial training, or learning from recordings or from an emulated MuJoCo model."""

import argparse
from pathlib import Path

from musculoskeletal_ae.options import Parser, chain_of, exit_status, positive
from musculoskeletal_ae.process_signals import import_heavy
from musculoskeletal_ae.robot.directories import shipped_robots

HELD_OUT = (
    'bags or CSV files for measuring the error before and after; without them, a fifth of the rows '
    'of each CSV file is held out, in blocks of successive rows'
)


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
    for flag, metavar, text in (
        ('--from-bag', 'BAG', 'learn from recordings: bag directories, mcap or sqlite3 files'),
        ('--from-csv', 'FILE', 'learn from CSV files with joint positions, lengths and tensions'),
        ('--hold-out', 'FILE', HELD_OUT),
    ):
        parser.add_argument(flag, nargs='+', type=Path, default=[], metavar=metavar, help=text)
    text = (
        'with --from-csv: headers of columns, where NAME is a joint, length:MUSCLE, '
        'tension:MUSCLE or time; #1 is the first column of a file without headers'
    )
    parser.add_argument(
        '--columns', nargs='+', type=_entry, default=[], metavar='NAME=HEADER', help=text
    )
    text = (
        'with --from-csv: units, where KIND is angle, travel, length, tension or time; a number '
        'is the size of the unit in SI units (default: the unit in the header, or SI)'
    )
    parser.add_argument(
        '--units', nargs='+', type=_entry, default=[], metavar='KIND=UNIT', help=text
    )
    text = (
        'with --from-csv: rows per second; without --rate and without a column of times, each row '
        'is a resting posture'
    )
    parser.add_argument('--rate', type=positive, metavar='HZ', help=text)
    text = 'with --from-csv: estimate the zero of each length from the joint positions'
    parser.add_argument('--estimate-zeros', action='store_true', help=text)
    text = (
        'with --from-bag or --from-csv: network to start from (default: the initial network of '
        'bringup.sh, which is trained unless its cache has it)'
    )
    parser.add_argument('--checkpoint', type=Path, metavar='FILE', help=text)
    text = 'with --from-bag: namespace of the arm if the bags have several'
    parser.add_argument('--from-namespace', metavar='NS', help=text)
    text = 'device for training; it must be one that torch can use'
    parser.add_argument('--device', choices=('cpu', 'cuda'), default='cpu', help=text)
    parser.add_quick('a tenth of the training, for a first try')
    args = parser.parse_args(argv)
    _check_source(parser, args)
    read_files = args.from_bag + args.from_csv
    if args.checkpoint and args.quick:
        parser.error('--quick shortens the initial training; do not use it with --checkpoint')
    learned = {path.resolve() for path in read_files}
    if both := [str(path) for path in args.hold_out if path.resolve() in learned]:
        parser.error(f'{both[0]} is both learned from and in --hold-out; name it only once')
    out, read = args.out.resolve(), learned | {path.resolve() for path in args.hold_out}
    if read & {out, *out.parents}:
        parser.error(f'--out {args.out} would overwrite a recording; name another file')
    if args.plot and args.plot.resolve() == out:
        parser.error(f'--plot {args.plot} would overwrite the checkpoint; name another file')
    if read_files and args.plot:
        parser.error('--plot shows the initial training; do not use it with recordings')
    args.columns, args.units = dict(args.columns), dict(args.units)
    work = 'recording_learning' if read_files else 'model_training'
    if args.mujoco:
        if read_files or args.plot:
            parser.error(
                '--mujoco learns from an emulated arm; remove --from-bag, --from-csv and --plot'
            )
        work = 'mujoco_learning'
    elif any(chain_of(args).values()):
        parser.error('--joints, --muscles, --without, --base and --end need --mujoco')
    return exit_status(
        lambda: import_heavy(f'musculoskeletal_ae.tools.{work}').train(args), out=args.out
    )


def _entry(text: str) -> tuple[str, str]:
    """Return the two parts of an entry such as `elbow=q2`."""
    name, sign, value = text.partition('=')
    if not sign or not name:
        raise argparse.ArgumentTypeError(f'{text!r}: expected an entry such as elbow=q2')
    return name.strip(), value.strip()


def _check_source(parser: Parser, args: argparse.Namespace) -> None:
    """Check that the options suit the recordings; end with an error otherwise."""
    if args.from_bag and args.from_csv:
        parser.error(
            '--from-bag and --from-csv cannot be combined; learn from the bags first, then run '
            'train again with the CSV files and --checkpoint'
        )
    if not (args.from_bag or args.from_csv) and (args.hold_out or args.checkpoint):
        parser.error('use --hold-out and --checkpoint with --from-bag or --from-csv only')
    if args.from_namespace and not args.from_bag:
        parser.error('use --from-namespace with --from-bag only')
    of_csv = args.columns, args.units, args.rate, args.estimate_zeros
    if any(of_csv) and not args.from_csv:
        parser.error('use --columns, --units, --rate and --estimate-zeros with --from-csv only')
