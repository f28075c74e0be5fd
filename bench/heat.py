# SPDX-License-Identifier: Apache-2.0
"""The windings' temperatures, learned from the housings', beside the emulated arm's true ones.

    python -m bench heat [--robot NAME|DIR] [--seeds 0,1,…] [--quick]

An arm with the network of the geometric model explores and holds a weight in turn for 25 minutes.
"""

import tempfile
from pathlib import Path

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.settings import Settings
from musculoskeletal_ae.experiments.recording import SAMPLE_TIME, ClosedLoop
from musculoskeletal_ae.experiments.study import Measured, Study
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.training import initial_mae
from musculoskeletal_ae.options import Parser
from musculoskeletal_ae.robot.robot import Robot

HEAT_STREAM = 8000
LEARNING, JUDGED, HELD = 1200.0, 300.0, 60.0  # [s]
LOAD = 2.0  # [kg]
STRIDE = 100  # messages between two of the traces


def measure(study: Study, seed: int) -> Measured:
    """Let an individual explore and hold a weight in turn; judge after twenty minutes.

    `core_error_k` is the mean of |c₁ estimated − true| over muscles and the five minutes after,
    `core_error_worst_k` the largest, `hottest_winding_c` the highest true temperature, and
    `heat_alarms` the healthy muscles whose constants are said to have changed.
    """
    arm, share = study.arm(seed), 0.02 if study.quick else 1.0
    loop = ClosedLoop(arm, study.network(seed), Settings(), HEAT_STREAM + seed)
    error, inner = list[Array](), list[Array]()
    for n in range(round(share * (LEARNING + JUDGED) / SAMPLE_TIME)):
        if (n * SAMPLE_TIME) // HELD % 2:
            arm.set_payload(LOAD)
            loop.core.explore(False)
            if loop.core.posture.theta is None:
                loop.target(arm.theta)
            loop.core.reset(n * SAMPLE_TIME)
            loop.step()
        else:
            arm.set_payload(0.0)
            loop.explore()
        if n % STRIDE == 0:
            error.append(loop.core.watch.heat.core - arm.winding)
            inner.append(arm.winding)
    errors, core = np.array(error), np.array(inner)
    judged = np.abs(errors[round(share * LEARNING / SAMPLE_TIME / STRIDE) :])
    numbers = {
        'core_error_k': float(judged.mean()),
        'core_error_worst_k': float(judged.max()),
        'hottest_winding_c': float(core.max()),
        'heat_alarms': len(loop.core.watch.heat.changed),
        'stops': loop.stops,
    }
    return Measured(numbers, {'error': errors, 'core': core})


def main(argv: list[str]) -> None:
    """Print the numbers of each individual."""
    parser = Parser('heat', "Prints by how much estimated windings' temperatures are off.")
    parser.add_robot()
    parser.add_seeds((0, 1, 2, 3, 4))
    parser.add_quick('half a minute')
    args = parser.parse_args(argv)

    robot = Robot.load(args.robot)
    mae = initial_mae(robot).mae
    with tempfile.TemporaryDirectory() as folder:
        study = Study(robot, 'default', args.seeds, 0.0, args.quick, Path(folder))
        for seed in args.seeds:
            checkpoint.save(mae, study.network_file('default', seed))
            said = measure(study, seed).numbers
            print(seed, ', '.join(f'{k} {v:.3g}' for k, v in said.items()), flush=True)
