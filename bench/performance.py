# SPDX-License-Identifier: Apache-2.0
"""Writes doc/performance.md: core steps, the running system, start-up, memory and learning times.

    python -m bench performance [--seconds 20] [--late 600] [--flames] --out doc

The times are those of the machine and the day that the page names. The machine should be idle
otherwise. `--flames` draws a flame graph of each node at 200 Hz by py-spy, as OUT/flames/NODE.svg.
"""

import os
import platform
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterable
from datetime import date
from pathlib import Path

from bench import timings
from bench.processes import cpu
from bench.scaling import update_time
from bench.wire import KINDS, System, Wire, systems
from musculoskeletal_ae.emulator.kin.arm import EmulatedArm
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.experiments.recording import EXPLORATION_STREAM, record
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.initial_training import initial_mae
from musculoskeletal_ae.options import Parser, number
from musculoskeletal_ae.presets.preset import DEFAULT
from musculoskeletal_ae.robot.robot import Robot

ARM = 'musashi_left_arm'
LARGE = 'musashi_upper_body'
RATES, SIZES = (100.0, 200.0, 500.0), ('arm26', ARM, LARGE)
EXPLORING = 60.0  # explore for this time, to fill the sample store before an update is timed [s]
#: publish muscle_states at this rate [Hz] to measure start-up, memory, late messages and profiles
FLAME_RATE = 200.0
STARTING = 60.0  # wait at most this long for the first command [s]
SETTLING = 15.0  # let the nodes run for this time before memory or a profile is measured [s]

#: CPU times [µs] of the first version that was measured (commit be0daee), by row of the table; the
#: machine had two cores and was idle otherwise
BEFORE_CORE = {
    'estimate: θ, T, l from ②': 19.0,
    'plan of a held posture, method proposed, preset default': 380.0,
    'plan of a held posture, method proposed, preset paper': 530.0, 'simulation step': 150.0,
    f'simulation step, time per arm in a batch of {timings.MANY}': 6.7,
}  # fmt: skip
TORCH_BEFORE = 118.0  # time of the first row of BEFORE_CORE in eager torch on that machine [µs]
#: results of the first version that was measured, by rate [Hz]: latency as median / 99th percentile
#: / maximum [ms], and CPU time of all nodes [% of a core]. The learner ran at 100 and 200 Hz, but
#: not at 500 Hz.
BEFORE_WIRE = {100.0: ('3.4 / 9.4 / 19', 138), 200.0: ('2.4 / 8.6 / 17', 172),
               500.0: ('0.6 / 6.1 / 12', 166)}  # fmt: skip
BEFORE_MEMORY = {'hardware_emulator': 271, 'estimator': 140, 'sim': 146, 'controller': 145,
                 'learner': 338}  # fmt: skip
PAGE = """# Performance

In short, on two idle cores and for the arm of ten muscles: the four nodes and the driver take
{at_100:.0f} % of one core at 100 Hz while they learn, and {at_500:.0f} % at 500 Hz, where
{missed:.1f} % of the messages are missed. A command follows its message within {latency:.1f} ms at
100 Hz (99 %).

Choose 100 to 200 Hz for an arm. 500 Hz is possible with about ten muscles on two cores that do
nothing else, but not with a larger body.

This page was written by `python -m bench performance {options}--out doc` on {day}, on
{machine}. The columns "before" show the first version that was measured (commit
be0daee), on an idle machine of two cores.

## Goals

The goals hold for two idle cores, and for `{arm}` unless another robot is named.

{goals}

## One call of the core

The table shows CPU times, measured by `bench timings` for `{arm}`. Two of its columns need an
explanation:

- *torch eager*: the same algorithm with the network in torch
- *bound*: the time of the network's multiply-adds alone, at the speed of matrix products of that
  size on this machine

The rows `mujoco.rollout` show what MuJoCo takes for the exported model of the same arm, at its own
step and at that of our simulator. The last rows show the whole core of each node for one message of
an exploring arm; detectors and learning skip some of these messages. `notes/wire.md` divides them
into parts.

The times "before" were measured on another machine, on which an estimate in torch took
{torch_before:.0f} µs; on this machine it takes {slower:.1f} times as long. Therefore do not compare
the two columns directly. Compare the ratio of each time to that of torch in this table, or to that
of "messages alone" in the next table.

{core}

## At the wire

The table was measured by `python -m bench wire`; run it on your own computer. Terms in it:

- *latency*: time from the publishing of `muscle_states` to that of the next command
- *late*: commands that came after more than two periods
- *missed*: messages that did not arrive
- *CPU*: processor time of all nodes, including the training process of the learner, as a share of
  one core
- *combined*: estimator and controller in one process (`bringup.sh --combined`)
- *plain node*: a minimal rclpy node with uncompiled PyTorch, without safety checks or control
- *messages alone*: five nodes that exchange the same messages without any computation

{wire}

## Starting, and memory

The table shows the CPU time from the start of a node until the first command, with compiled code,
and the resident memory. {shared:.0f} MB of the estimator's memory are libraries that all processes
share. "Messages alone" is a node that has loaded numpy and pinocchio and computes nothing: the
minimum for a Python node that uses them.

{start}

## Learning

These times were measured on one core. The updates were made with a full store of samples.

| | before | now |
|---|---|---|
| `{arm}`, initial training [CPU s] | 28 | {training:.0f} |
| one update [CPU s] | 0.5–1 | {update:.2f} |
| `{large}`, one update [CPU s] | | {large_update:.2f} |
{flames}"""
FLAMES = '\n## Where a node’s time goes\n\nFlame graphs, recorded by py-spy at 200 Hz: {}.\n'


def rows(head: str, lines: Iterable[Iterable[object]]) -> str:
    """Return a table in Markdown with the heading `head` and the cells of each line."""
    columns = head.count('|') + 1
    cells = (f'| {" | ".join(map(str, line))} |' for line in lines)
    return '\n'.join((f'| {head} |', '|---' * columns + '|', *cells))


def core(measured: Iterable[timings.Timed]) -> str:
    """Return the table of the CPU times that one call of each core step takes."""
    cells = []
    for row in measured:
        ratio = f'{row.torch_eager / row.ours:.1f}' if row.torch_eager else ''
        numbers = (f'{v:.1f}' if v else '' for v in (row.ours, row.torch_eager, row.bound))
        cells.append((row.name, BEFORE_CORE.get(row.name, ''), *numbers, ratio))
    head = '| before [µs] | now [µs] | torch eager [µs] | bound [µs] | times faster'
    return rows(head, cells)


def wire(seconds: float) -> dict[tuple[str, float, str], Wire]:
    """Measure the running system; return the results by robot, rate [Hz] and set of nodes."""
    return {
        (robot, rate, kind): result
        for robot in SIZES
        for rate, kind, result in systems(
            robot, RATES, KINDS if robot == ARM else ('nodes', 'with learner'), seconds
        )
    }


def wire_table(measured: dict[tuple[str, float, str], Wire]) -> str:
    """Return the table of latencies and CPU times of the running system."""
    cells = []
    for (robot, rate, kind), result in measured.items():
        latency = ' / '.join(f'{value:.1f}' for value in result.latency)
        # The values of BEFORE_WIRE were measured with the learner, except those at 500 Hz.
        same = 'nodes' if rate == max(RATES) else 'with learner'
        known = BEFORE_WIRE[rate] if (robot, kind) == (ARM, same) else ('', '')
        lost = f'{result.late:.1f}', f'{result.missed:.1f}'
        cost = known[1], f'{sum(result.cpu.values()):.0f}'
        cells.append((robot, f'{rate:.0f}', kind, known[0], latency, *lost, *cost))
    head = (
        'robot | rate [Hz] | nodes | latency before: 50 % / 99 % / largest [ms] | '
        'latency now [ms] | late [%] | missed [%] | CPU before [%] | CPU now [%]'
    )
    return rows(head, cells)


def goals(numbers: dict[str, tuple[float, str, float]]) -> str:
    """Return the table of goals.

    `numbers` has for each goal the measured value, the sign ≤ or ≥, and the limit.
    """
    cells = []
    for name, (value, sign, limit) in numbers.items():
        met = value <= limit if sign == '≤' else value >= limit
        cells.append((name, f'{sign} {limit:g}', f'{value:.3g}', 'met' if met else '**missed**'))
    return rows('| goal | now |', cells)


def resident(pid: int) -> tuple[float, float]:
    """Return the resident memory of a process, and its file-backed part [MB]."""
    text = Path(f'/proc/{pid}/status').read_text('ascii')
    sizes = dict(line.split(':', 1) for line in text.splitlines())
    whole, files = (int(sizes[key].split()[0]) * 1024 / 1e6 for key in ('VmRSS', 'RssFile'))
    return whole, files


def started(network: Path) -> tuple[dict[str, float], dict[str, tuple[float, float]]]:
    """Start the system, and return the CPU time [s] and the memory [MB] of each node by name.

    The CPU time is that until the first command. The memory, with its file-backed part, is measured
    after the start.
    """
    system = System(ARM, network, FLAME_RATE, KINDS['with learner'])
    try:
        deadline = time.monotonic() + STARTING
        while not system.stamps['muscle_length_command']:
            if time.monotonic() > deadline:
                raise MusculoskeletalError(
                    f'the controller sent no command within {STARTING:g} s; check that the '
                    'machine is idle, and repeat'
                )
            time.sleep(0.1)
        used = {name: cpu(process.pid) for name, process in system.nodes.items()}
        time.sleep(SETTLING)
        return used, {name: resident(process.pid) for name, process in system.nodes.items()}
    finally:
        system.end()


def starting(used: dict[str, float], held: dict[str, tuple[float, float]], network: Path) -> str:
    """Return the table of the CPU time until the first command, and of the memory, of each node.

    Args:
        used: CPU time of each node [s].
        held: Resident memory of each node, and its file-backed part [MB].
        network: Checkpoint for the nodes of the last row, which only exchange messages.
    """
    cells = (
        (name, f'{used[name]:.1f}', BEFORE_MEMORY[name], f'{held[name][0]:.0f}') for name in held
    )
    system = System(ARM, network, FLAME_RATE, KINDS['messages alone'])
    try:
        time.sleep(SETTLING)
        floor, _ = resident(system.nodes['bare_estimator'].pid)
    finally:
        system.end()
    head = 'node | CPU until the first command [s] | memory before [MB] | now [MB]'
    return rows(head, (*cells, ('messages alone', '', '', f'{floor:.0f}')))


def flames(network: Path, seconds: float, out: Path) -> str:
    """Draw a flame graph of each node, and return the text of the page with links to the graphs.

    Each node is recorded for `seconds` [s], and the graphs are written to `out`.
    """
    out.mkdir(parents=True, exist_ok=True)
    system = System(ARM, network, FLAME_RATE, KINDS['with learner'])
    try:
        time.sleep(SETTLING)
        for name, process in system.nodes.items():
            command = f'py-spy record --pid {process.pid} --duration {seconds:.0f} --output'.split()
            # The title of the graph is this command, and must not contain a path of this computer.
            subprocess.run([*command, f'{name}.svg'], cwd=out, stdout=subprocess.DEVNULL)
    finally:
        system.end()
    return FLAMES.format(', '.join(f'[{name}](flames/{name}.svg)' for name in system.nodes))


def learning(name: str, folder: Path) -> tuple[float, float, Path]:
    """Return the times of initial training and of an update [s], and the network file."""
    robot, network = Robot.load(name), folder / f'{name}.safetensors'
    begun = time.process_time()
    mae = initial_mae(robot)
    training = time.process_time() - begun
    checkpoint.save(mae, network)
    exploring = record(EmulatedArm(robot, 0), mae, EXPLORATION_STREAM, EXPLORING)
    return training, update_time(robot, mae, exploring), network


def machine() -> str:
    """Return the number of cores and the processor of this machine as text."""
    text = Path('/proc/cpuinfo').read_text('utf-8')
    names = {line.partition(':')[2].strip() for line in text.splitlines() if 'model name' in line}
    return f'{os.cpu_count()} cores of {", ".join(sorted(names)) or platform.machine()}'


def main(argv: list[str]) -> None:
    """Measure all times that the page shows, and write the page."""
    parser = Parser('performance', 'Writes doc/performance.md.')
    parser.add_argument(
        '--seconds', type=number(1.0, 3600.0), default=20.0, help='duration of each measurement [s]'
    )
    parser.add_argument(
        '--late',
        type=number(1.0, 3600.0),
        default=600.0,
        help='duration of the test for late messages [s]',
    )
    parser.add_argument('--flames', action='store_true', help='draw flame graphs; requires py-spy')
    parser.add_out('DIR', 'folder for performance.md and flames/')
    args = parser.parse_args(argv)
    if args.flames and shutil.which('py-spy') is None:
        parser.error('--flames requires py-spy: pip install py-spy')

    with tempfile.TemporaryDirectory() as folder:
        training, update, network = learning(ARM, Path(folder))
        _, large_update, _ = learning(LARGE, Path(folder))
        started(network)  # its times do not count, because this first start may compile kernels
        used, held = started(network)
        steps = timings.measure(Robot.load(ARM), DEFAULT)
        moved = wire(args.seconds)
        ((_, _, long),) = systems(ARM, (FLAME_RATE,), ('with learner',), args.late)
        ratio = {row.name: row.torch_eager / row.ours for row in steps}
        step, batch = (
            'simulation step',
            f'simulation step, time per arm in a batch of {timings.MANY}',
        )
        arms = f'one of {timings.MANY} arms'
        node = max(held[name][0] for name in ('estimator', 'controller', 'sim'))
        whole_system = sum(moved[ARM, 200.0, 'with learner'].cpu.values())
        numbers = {
            '99 % of commands at 100 Hz, with learner [ms]': (
                moved[ARM, 100.0, 'with learner'].latency[1], '≤', 5.0,
            ),
            '99 % of commands at 500 Hz, without learner [ms]': (
                moved[ARM, 500.0, 'nodes'].latency[1], '≤', 2.0,
            ),
            'the four nodes and the driver at 200 Hz [% of a core]': (whole_system, '≤', 100.0),
            f'late messages in {args.late:.0f} s at 200 Hz, with learner [%]': (
                long.late, '≤', 0.0,
            ),
            'simulation step, speed-up over a network in torch': (ratio[step], '≥', 6.0),
            f'{arms}, speed-up over a network in torch': (ratio[batch], '≥', 3.0),
            'start of the slowest node [CPU s]': (max(used.values()), '≤', 1.5),
            'memory of estimator, controller or sim [MB]': (node, '≤', 100.0),
            'online update [s]': (update, '≤', 0.3),
            f'online update, {LARGE} [s]': (large_update, '≤', 2.0),
            'initial training [s]': (training, '≤', 20.0),
        }  # fmt: skip
        slow, fast = (moved[ARM, rate, 'with learner'] for rate in (min(RATES), max(RATES)))
        options = ''.join(f'{word} ' for word in argv if word not in ('--out', str(args.out)))
        page = PAGE.format(
            at_100=sum(slow.cpu.values()), at_500=sum(fast.cpu.values()), missed=fast.missed,
            latency=slow.latency[1], options=options,
            day=date.today().isoformat(), machine=machine(), arm=ARM, large=LARGE,  # noqa: DTZ011
            goals=goals(numbers), core=core(steps), wire=wire_table(moved),
            torch_before=TORCH_BEFORE, slower=steps[0].torch_eager / TORCH_BEFORE,
            start=starting(used, held, network), shared=held['estimator'][1],
            training=training, update=update, large_update=large_update,
            flames=flames(network, args.seconds, args.out / 'flames') if args.flames else '',
        )  # fmt: skip
    args.out.mkdir(parents=True, exist_ok=True)
    (args.out / 'performance.md').write_text(page, encoding='utf-8')
