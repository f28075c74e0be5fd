# SPDX-License-Identifier: Apache-2.0
"""An hour of the running system under random faults: memory of every node, and does it go on?

    python -m bench endurance [--minutes 60] [--rate 200] [--seed 0]

The nodes of `attack` run on an emulated arm that explores; every few seconds a wire, sensor, motor
or message breaks and is mended again. Printed is the memory of every node after five minutes and at
the end, and the largest change of a command in one tick. Exit status 1 if a node grew by 5 % or
more after the first five minutes, ended, or the arm did not move again.
"""

import tempfile
import time
from pathlib import Path

import numpy as np

from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.training import initial_mae
from musculoskeletal_ae.options import Parser, number
from musculoskeletal_ae.robot.robot import Robot

SETTLED, WINDOW = 300.0, 60.0  # [s] until memory is compared, and over which it is averaged
GROWTH = 1.05
BROKEN, WHOLE = (1.0, 8.0), (5.0, 20.0)  # [s] that a fault lasts, and until the next


def main(argv: list[str]) -> int:
    """Run, print, judge."""
    from bench.attack_graph import LENGTH, Attack

    parser = Parser('endurance', (__doc__ or '').partition('\n')[0])
    parser.add_argument('--minutes', type=number(6.0, 6000.0), default=60.0, help='how long')
    parser.add_argument('--rate', type=number(10.0, 1000.0), default=200.0, help='of messages [Hz]')
    parser.add_seed('of the faults')
    args = parser.parse_args(argv)
    largest = 0.0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        initial = folder / 'initial.safetensors'
        checkpoint.save(initial_mae(Robot.load('arm26'), seed=args.seed).mae, initial)
        with Attack(folder, initial, args.seed, args.rate) as run:
            end = time.monotonic() + 60.0 * args.minutes
            while time.monotonic() < end:
                run.moving()
                run.spin(run.rng.uniform(*WHOLE))
                run.fault()
                run.spin(run.rng.uniform(*BROKEN))
                value = np.array([c.value for c in run.commands if c.topic == LENGTH])
                largest = max(largest, float(np.abs(np.diff(value, axis=0)).max(initial=0.0)))
                run.commands.clear()
                run.loads.clear()
            run.moving()
            processes, findings = run.processes, run.findings
            print(
                f'{run.tried["faults"]} faults; largest change of a command {1e3 * largest:.2f} mm'
            )
    grown = False
    for name, process in processes.items():
        age, size = np.array(process.memory).T
        begin, last = (
            float(np.median(size[(age >= at) & (age < at + WINDOW)]))
            for at in (SETTLED, age[-1] - WINDOW)
        )
        grown |= last >= GROWTH * begin
        print(f'{name:<20}{begin:7.1f} MB after five minutes, {last:7.1f} MB at the end', end='')
        print(f' ({100 * (last / begin - 1):+.1f} %)')
    for promise, cases in findings.items():
        print(f'broken: {promise}: {len(cases)} times, first: {cases[0]}')
    return int(grown or bool(findings))
