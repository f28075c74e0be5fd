# SPDX-License-Identifier: Apache-2.0
"""Measures accuracy, time and memory from 2 joints, 6 muscles to 39 joints, 74 muscles.

    python -m bench scaling [--bodies 2x6,5x10,…] [--minutes 10] --out DIR

The bodies are arm26 and those of `bench limbs`. For each, a separate process measures:

- the time of initial training, and the resulting error of the network's estimate on the geometric
  model,
- the times of the core's steps,
- the error of the estimate on the held-out motion, before and after individual 0 has learned for
  ten minutes in updates of 400 steps every 20 s, and the error of the oracle,
- the time of one update of the learner with default settings and a full store,
- the largest memory.

The estimate uses the network's pass from tensions and lengths to joint angles. Errors are divided
by the square root of the number of joints, so that bodies can be compared. Times are those of one
core. The results are a table and a plot. DIR keeps networks and rows; a later run continues from
them.
"""

import json
import multiprocessing
import resource
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np

from bench.learned_arm import initial, learned_arm
from bench.limbs import BODIES, write_body
from bench.timings import microseconds
from musculoskeletal_ae.body_model.observations import Observations
from musculoskeletal_ae.emulator.kin.arm import EmulatedArm
from musculoskeletal_ae.experiments import plots
from musculoskeletal_ae.experiments.least_squares import oracle_errors
from musculoskeletal_ae.experiments.recording import (
    HELD_OUT_STREAM,
    Recording,
    estimation_error,
    record,
)
from musculoskeletal_ae.learning.body_updater import BodyUpdater
from musculoskeletal_ae.learning.detector_calibration import Healthy
from musculoskeletal_ae.learning.samples import CAPACITY
from musculoskeletal_ae.learning.scheduler import STEPS, Job
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.mae.training import one_thread, random_states
from musculoskeletal_ae.motion.tension_plan import plan_at_rest
from musculoskeletal_ae.options import Parser, names
from musculoskeletal_ae.robot.directories import find_robot
from musculoskeletal_ae.robot.robot import Robot

SMALLEST, INDIVIDUAL, UNSEEN = '2x6', 0, 5000
HELD_OUT = 300.0  # measure the error on a held-out motion of this duration [s]
#: heading of each column of the table, by the key of its numbers in a Row
COLUMNS = {
    'nominal': '② nominal [rad a joint]',
    'before': 'before [rad a joint]',
    'after': 'after',
    'oracle': 'trained on the true arm',
    'training': 'training [s]',
    'update': 'update [s]',
    'estimate': 'estimate [µs]',
    'solve': 'control solve [µs]',
    'memory': 'memory [MB]',
    'checkpoint': 'checkpoint [MB]',
}
Row = dict[str, float]


def measure(body: str, folder: Path, minutes: float) -> Row:
    """Measure a body after `minutes` [min] of exploration, and return the results.

    Errors [rad] are divided by √D, for D joints.
    """
    folder.mkdir(parents=True, exist_ok=True)
    robot = Robot.load(find_robot('arm26') if body == SMALLEST else write_body(body, folder / body))
    # Training is timed, so a file that an interrupted run left must not replace it.
    (folder / 'initial.safetensors').unlink(missing_ok=True)
    begun = time.process_time()
    nominal = initial(robot, folder)
    row = {'training': time.process_time() - begun}
    states = random_states(robot, UNSEEN, np.random.default_rng(7), robot.tension.limit)
    joint = np.sqrt(robot.joint_count)
    error = nominal.estimate(states.tension, states.length).theta - states.theta
    row['nominal'] = float(np.linalg.norm(error, axis=1).mean() / joint)
    arm = EmulatedArm(robot, INDIVIDUAL)
    mae, driver, exploring = learned_arm(robot, INDIVIDUAL, folder, minutes)
    held_out = record(arm, driver, HELD_OUT_STREAM, HELD_OUT)
    row['before'] = estimation_error(nominal, held_out) / joint
    row['after'] = estimation_error(mae, held_out) / joint
    row['oracle'] = oracle_errors(arm, INDIVIDUAL, held_out)['oracle_rad'] / joint
    one = held_out.tension[0], held_out.length[0]
    middle = 0.5 * (robot.lower + robot.upper)
    row['estimate'] = microseconds(lambda: mae.estimate(*one))
    row['solve'] = microseconds(lambda: plan_at_rest(robot, mae, middle))
    row['update'] = update_time(robot, mae, exploring)
    row['checkpoint'] = (folder / f'learned_{INDIVIDUAL}.safetensors').stat().st_size / 1e6
    row['memory'] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6
    return row


def update_time(robot: Robot, mae: Mae, exploring: Recording) -> float:
    """Return the time of an update from a full store [s], as the median of five."""
    columns = exploring.tension, exploring.length, np.zeros_like(exploring.length)
    messages = np.concatenate(columns, axis=1)[::10].astype(np.float32)
    updater, count = BodyUpdater(robot, mae), len(exploring.theta)
    kept, rng = np.linspace(0, count - 1, CAPACITY, dtype=int), np.random.default_rng(0)
    times = []
    with one_thread():  # as in the training process of the learner
        for _ in range(6):
            # Replace a sample, because every update of the node has a new one.
            kept = np.append(kept[1:], rng.integers(count))
            part = exploring.part(kept)
            none = np.zeros_like(part.tension)
            observations = Observations(
                part.theta_sensor, part.tension, part.length, none, none == 0.0
            )
            job = Job(observations, Healthy(messages, 600.0, 100), True, STEPS)
            begun = time.process_time()
            updater.update(job)
            times.append(time.process_time() - begun)
    return float(np.median(times[1:]))


def table(rows: dict[str, Row]) -> str:
    """Return the rows as a table in Markdown."""
    lines = [f'| body | {" | ".join(COLUMNS.values())} |', '|---' * (1 + len(COLUMNS)) + '|']
    for body, row in rows.items():
        cells = (f'{row[key]:.4f}' if row[key] < 1.0 else f'{row[key]:.3g}' for key in COLUMNS)
        lines.append(f'| {body.replace("x", " × ")} | {" | ".join(cells)} |')
    return '\n'.join(lines)


def draw(rows: dict[str, Row], file: Path) -> None:
    """Draw accuracy, time and memory over the number of joints."""
    figure, panels = plots.new_figure(13.0, 4.6, 1, 3)
    joints = [int(body.split('x')[0]) for body in rows]
    kinds = (
        ('error of the estimate per joint [rad]', {
            'before': 'before learning', 'after': 'after ten minutes',
            'oracle': 'trained on the true arm', 'nominal': 'on the geometric model',
        }),
        ('time on one core [s]', {'training': 'initial training', 'update': 'update',
                                  'solve': 'control solve', 'estimate': 'estimate'}),
        ('size [MB]', {'memory': 'largest memory of the process', 'checkpoint': 'checkpoint'}),
    )  # fmt: skip
    for panel, (label, curves) in zip(panels, kinds, strict=True):
        for key, name in curves.items():
            scale = 1e-6 if COLUMNS[key].endswith('[µs]') else 1.0
            panel.plot(joints, [scale * row[key] for row in rows.values()], 'o-', label=name)
        panel.set_xscale('log')
        panel.set_yscale('log')
        panel.set_xticks(joints, [body.replace('x', '×') for body in rows], minor=False)
        panel.minorticks_off()
        plots.tidy(panel, 'joints × muscles', label, '', legend='below')
    figure.savefig(file, dpi=plots.DPI)


def run(bodies: list[str], minutes: float, out: Path) -> None:
    """Run the bodies that have no results in `out` yet; print the table and draw the plot.

    `minutes` is the duration of the exploration [min].
    """
    out.mkdir(parents=True, exist_ok=True)
    file = out / 'rows.json'
    rows: dict[str, Row] = json.loads(file.read_text()) if file.exists() else {}
    for body in bodies:
        if body not in rows:
            with ProcessPoolExecutor(1, multiprocessing.get_context('spawn')) as pool:
                rows[body] = pool.submit(measure, body, out / f'{body}_learned', minutes).result()
            print(body, rows[body], flush=True)
            file.write_text(json.dumps(rows, indent=1))
    rows = dict(sorted(rows.items(), key=lambda row: int(row[0].split('x')[0])))
    print(table(rows))
    draw(rows, out / 'scaling.png')


def main(argv: list[str]) -> None:
    """Measure the bodies that the command line names, and print the table."""
    parser = Parser('scaling', 'Measures accuracy, time and memory over the size of the body.')
    text = f'bodies to measure, of {", ".join((SMALLEST, *BODIES))}'
    parser.add_argument('--bodies', type=names, default=[SMALLEST, *BODIES], help=text)
    parser.add_minutes('duration of the exploration', 10.0)
    parser.add_out('DIR', 'folder of networks, rows and plot')
    args = parser.parse_args(argv)
    if unknown := set(args.bodies) - {SMALLEST, *BODIES}:
        parser.error(
            f'--bodies: unknown bodies {", ".join(sorted(unknown))}; legal: '
            f'{", ".join((SMALLEST, *BODIES))}'
        )
    run(args.bodies, args.minutes, args.out)
