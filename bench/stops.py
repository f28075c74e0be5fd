# SPDX-License-Identifier: Apache-2.0
"""Stops nodes with SIGINT or SIGTERM at random moments of the first 3 s of their start.

    python -m bench stops [--count 70] [--seed 0]

Python reaches the first line of the package about 0.1 s after the start, or later on a busy
machine. The bench passes if every node that gets the signal later ends with status 0 and without
a traceback. An earlier signal ends the process at once, and Python may print a traceback. The bench
counts these cases, but they do not affect its result.
"""

import os
import random
import signal
import subprocess
import tempfile
import time
from collections import Counter
from pathlib import Path

from musculoskeletal_ae.nodes.parameters import COMBINED, PARAMETERS
from musculoskeletal_ae.options import Parser, whole

LATEST = 3.0  # longest time from the start of the process to the signal [s]
LONGEST_END = 60.0  # longest legal time from the signal to the end of the process [s]
ENDED_BY_SIGNAL = (-signal.SIGINT, -signal.SIGTERM)
#: path of the package in a traceback; it shows that the signal came while the package ran
PACKAGE = 'site-packages/musculoskeletal_ae'
SIGNS_OF_A_CRASH = ('Traceback', 'Exception ignored', 'error', 'Fatal')


def stop(name: str, number: signal.Signals, moment: float, state: Path) -> tuple[int, float, str]:
    """Start a node, and send it a signal `moment` seconds later.

    Returns:
        The exit status of the node, the time from the signal to its end [s], and its output.
    """
    folder = Path(os.environ['AMENT_PREFIX_PATH'].split(':')[0]) / 'lib/musculoskeletal_ae'
    process = subprocess.Popen(
        [str(folder / name), '--ros-args', '-p', 'robot:=arm26'],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        env={**os.environ, 'XDG_STATE_HOME': str(state)},
    )  # fmt: skip
    try:
        time.sleep(moment)
        process.send_signal(number)
        begun = time.monotonic()
        output, _ = process.communicate(timeout=LONGEST_END)
        return process.returncode, time.monotonic() - begun, output
    except subprocess.TimeoutExpired:
        return 0, LONGEST_END, f'error: the process still ran {LONGEST_END:g} s after the signal'
    finally:
        process.kill()
        process.wait()


def main(argv: list[str]) -> int:
    """Run the bench; return the exit status, 1 if a node ended wrongly."""
    parser = Parser('stops', (__doc__ or '').partition('\n')[0])
    parser.add_argument('--count', type=whole(1, 10_000), default=70, help='number of stops')
    parser.add_seed('of nodes, signals and moments')
    args = parser.parse_args(argv)
    rng = random.Random(args.seed)  # noqa: S311 - must be repeatable
    ends, early, failures, longest = Counter[str](), 0, 0, 0.0
    names = [*PARAMETERS, *COMBINED]
    with tempfile.TemporaryDirectory() as state:
        for count in range(args.count):
            name, number = names[count % len(names)], rng.choice((signal.SIGINT, signal.SIGTERM))
            moment = rng.uniform(0.0, LATEST)
            status, took, output = stop(name, number, moment, Path(state))
            longest = max(longest, took)
            if status in ENDED_BY_SIGNAL and PACKAGE not in output:
                early += 1
                continue
            ends[f'{name}: status {status}'] += 1
            if status != 0 or any(sign in output for sign in SIGNS_OF_A_CRASH):
                failures += 1
                print(f'{name}, {number.name} after {moment:.2f} s: status {status}\n{output}')
    print('\n'.join(f'{end} × {count}' for end, count in sorted(ends.items())))
    print(
        f'{early} signals came before the package was loaded; the slowest process took '
        f'{longest:.1f} s to end; {failures} failures'
    )
    return 1 if failures else 0
