# SPDX-License-Identifier: Apache-2.0
"""Measures arms that share one machine and one ROS graph: start, processor time, memory, losses.

    python -m bench fleet [--arms 1,2,5,10] [--rate 20] [--seconds 30] [--robot arm26]

For each number of arms, the bench starts `./bringup.sh --namespace armN --seed N` for each arm, as
doc/howto/several_arms.md does. The arms explore and learn, each from the same initial network.

    start      time until every controller sends commands, or the number of arms that do
    start CPU  processor time of all processes until then
    join       time in which a new node then receives commands of all arms
    CPU        of all processes [% of a core]; below it, the share of each node, for one arm
    late       messages of the first arm without a command within two periods
    missed     messages of the first arm that did not arrive
    memory     of all processes, in which a page that several share counts once
    load       of the machine before the start: an idle machine has a load of 0
"""

import os
import signal
import subprocess
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

from bench.processes import children, cpu, end_processes, family, memory_share, thread_count
from bench.wire import WARM_UP, Listener, delays
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.initial_training import initial_mae
from musculoskeletal_ae.options import Parser, number, seeds
from musculoskeletal_ae.process_signals import STOP, Reaction
from musculoskeletal_ae.robot.robot import Robot

BRINGUP = Path(__file__).resolve().parents[1] / 'bringup.sh'
STARTING = 60.0  # wait for the first commands at most this long × (1 + number of arms) [s]
LOOK = 0.1  # check a condition at this interval [s]
HEAD = (
    'arms  processes  threads  start [s]  start CPU [s]  join [s]  CPU [%]  median, p99 [ms]  '
    'late [%]  missed [%]  memory [MB]  load'
)


class Fleet(NamedTuple):
    """Results for one number of arms."""

    arms: int
    processes: int
    threads: int
    started: int  # number of arms whose controllers send commands
    start: float  # time until every controller sent commands [s]
    start_cpu: float  # processor time of all processes until then [s]
    join: float  # time in which a new node received commands of all these arms [s]
    cpu: dict[str, float]  # processor time of all arms, by executable [% of a core]
    losses: tuple[tuple[float, ...], float, float]  # latency [ms], late and missed [%]
    memory: float  # memory of all processes [MB]
    load: float

    def __str__(self) -> str:
        """Return one line of the table, and one with the shares of the nodes."""
        (half, most, _), late, missed = self.losses
        start = f'{self.start:.0f}'
        if self.started < self.arms:
            start = f'{self.started} of {self.arms}'
        shares = ', '.join(f'{name} {used / self.arms:.1f}' for name, used in self.cpu.items())
        return (
            f'{self.arms:4d}{self.processes:11d}{self.threads:9d}{start:>11}{self.start_cpu:15.0f}'
            f'{self.join:10.1f}{sum(self.cpu.values()):9.0f}{half:11.1f},{most:6.1f}{late:10.2f}'
            f'{missed:12.2f}{self.memory:13.0f}{self.load:6.1f}\n      for one arm: {shares}'
        )


def topic(arm: int, name: str) -> str:
    """Return the full name of a topic of an arm."""
    return f'/arm{arm}/{name}'


def wait(condition: Callable[[], bool], seconds: float) -> float:
    """Wait until a condition holds, at most `seconds` [s]; return the time that this took [s]."""
    start = time.monotonic()
    while not condition() and time.monotonic() < start + seconds:
        time.sleep(LOOK)
    return time.monotonic() - start


@contextmanager
def running(
    count: int, robot: str, network: Path, rate: float
) -> Iterator[list[subprocess.Popen[bytes]]]:
    """Run `count` arms, each in a namespace of its own; end them after the block."""
    parameters = network.with_name('rate.yaml')
    parameters.write_text(f'/**: {{ros__parameters: {{rate: {rate}}}}}\n')
    files = ['--checkpoint', str(network), '--params-file', str(parameters)]
    common = ['--robot', robot, *files]
    runs: list[subprocess.Popen[bytes]] = []
    try:
        with STOP.reacting(Reaction.REMEMBER):
            for arm in range(1, count + 1):
                own = ['--namespace', f'arm{arm}', '--seed', str(arm)]
                command = [str(BRINGUP), *own, *common]
                runs.append(subprocess.Popen(command, stdout=subprocess.DEVNULL))
        STOP.raise_if_received()
        yield runs
    finally:
        with STOP.reacting(Reaction.REMEMBER):
            end_processes(runs, signal.SIGINT)


def listening(count: int) -> Listener:
    """Return a new node that listens to the commands of all arms, and to the first arm's states."""
    commands = [topic(arm, 'muscle_length_command') for arm in range(1, count + 1)]
    return Listener([*commands, topic(1, 'muscle_states')])


def heard(listener: Listener, count: int) -> int:
    """Return for how many of the `count` arms a length command has been received."""
    commands = (topic(arm, 'muscle_length_command') for arm in range(1, count + 1))
    return sum(bool(listener.stamps[name]) for name in commands)


def used(runs: list[subprocess.Popen[bytes]]) -> dict[str, float]:
    """Return the CPU time by executable [s]."""
    times: dict[str, float] = defaultdict(float)
    for run in runs:
        for child in children(run.pid):
            with suppress(FileNotFoundError):  # the process has ended
                words = Path(f'/proc/{child}/cmdline').read_text('utf-8').split('\0')
                times[Path(words[1]).name] += cpu(child)  # the first word is the interpreter
    return times


def resident(runs: list[subprocess.Popen[bytes]]) -> tuple[int, int, float]:
    """Return the numbers of processes and threads, and the memory of all processes [MB]."""
    threads, memory = [], []
    for run in runs:
        for pid in family(run.pid):
            with suppress(FileNotFoundError, ProcessLookupError):  # the process has ended
                memory.append(memory_share(pid))
                threads.append(thread_count(pid))
    return len(threads), sum(threads), sum(memory)


def measure(count: int, robot: str, network: Path, rate: float, seconds: float) -> Fleet:
    """Start `count` arms, and measure them for `seconds` [s].

    Raises:
        MusculoskeletalError: If a bringup.sh ends, or if the first arm sends nothing.
    """
    load = os.getloadavg()[0]
    listener = listening(count)
    try:
        with running(count, robot, network, rate) as runs:
            start = wait(lambda: heard(listener, count) == count, STARTING * (1 + count))
            started = heard(listener, count)
            start_cpu = sum(cpu(run.pid) for run in runs)
            visitor = listening(count)
            join = wait(lambda: heard(visitor, count) >= started, STARTING)
            visitor.end()
            time.sleep(WARM_UP)
            listener.stamps.clear()
            before, begun = used(runs), time.monotonic()
            time.sleep(seconds)
            passed = time.monotonic() - begun
            shares = {
                name: 100.0 * (now - before.get(name, 0.0)) / passed
                for name, now in used(runs).items()
            }
            states, commands = (
                listener.stamps[topic(1, name)]
                for name in ('muscle_states', 'muscle_length_command')
            )
            losses = delays(states, commands, rate, passed)
            processes, threads, memory = resident(runs)
            if ended := [arm for arm, run in enumerate(runs, 1) if run.poll() is not None]:
                raise MusculoskeletalError(f'bringup.sh of arms {ended} has ended; see its logs')
    finally:
        listener.end()
    return Fleet(
        count, processes, threads, started, start, start_cpu, join, shares, losses, memory, load
    )


def main(argv: list[str]) -> None:
    """Measure each number of arms, and print a table."""
    parser = Parser('fleet', (__doc__ or '').partition('\n')[0])
    parser.add_robot(default='arm26')
    parser.add_argument('--arms', type=seeds, default='1,2,5,10', help='numbers of arms to measure')
    parser.add_argument(
        '--rate', type=number(1.0, 1000.0), default=20.0, help='message rate of each arm [Hz]'
    )
    parser.add_argument(
        '--seconds', type=number(1.0, 3600.0), default=30.0, help='time of each measurement [s]'
    )
    args = parser.parse_args(argv)
    if 0 in args.arms:
        parser.error('--arms: expected numbers of at least 1')
    print(HEAD, flush=True)
    with tempfile.TemporaryDirectory() as folder:
        network = Path(folder) / 'network.safetensors'
        checkpoint.save(initial_mae(Robot.load(args.robot)), network)
        for count in args.arms:
            fleet = measure(count, args.robot, network, args.rate, args.seconds)
            print(fleet, flush=True)
