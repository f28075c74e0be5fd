# SPDX-License-Identifier: Apache-2.0
"""How far the lengths of sound arms are from their model: what `check_driver` has to allow.

python -m bench driver_margins

Individuals 0–9 of both shipped arms, each led through random postures ten times. It prints the
largest offset of l, the range of slopes of l over the model's l, and the largest error of a muscle
that another muscle's model fits 2.5 times better. Then each is checked as `check_driver --move`
does, which must find no fault.
"""

import sys
from itertools import pairwise
from pathlib import Path

import numpy as np

from musculoskeletal_ae.driver.listening import MOVED, ZERO_TOLERANCE
from musculoskeletal_ae.emulator.individual import Individual
from musculoskeletal_ae.options import Parser
from musculoskeletal_ae.robot.robot import Robot

SEEDS, WAYS, POSTURES, STEPS = range(10), 10, 4, 30


def margins(robot: Robot) -> tuple[float, float, float, float]:
    """Return offset [m], least and greatest slope, and error of a doubtful muscle [m]."""
    offsets, slopes, doubtful = [0.0], [1.0], [0.0]
    share = np.linspace(0.0, 1.0, STEPS)[:, None]
    tension = np.full((STEPS * (POSTURES - 1), robot.muscle_count), robot.tension.bias)
    for seed in SEEDS:
        body, rng = Individual(robot, seed), np.random.default_rng(seed)
        for _ in range(WAYS):
            via = robot.random_postures(POSTURES, rng)
            theta = np.concatenate([a + (b - a) * share for a, b in pairwise(via)])
            length = body.muscle_lengths(theta, tension)
            model = robot.muscle_lengths(theta, tension)
            offsets.append(float(np.abs(np.median(length - model, axis=0)).max()))
            for m in np.flatnonzero(np.ptp(model, axis=0) > MOVED):
                slopes.append(np.cov(length[:, m], model[:, m])[0, 1] / model[:, m].var(ddof=1))
                errors = (length[:, [m]] - model).std(axis=0)
                if errors[m] > 2.5 * np.delete(errors, m).min():
                    doubtful.append(float(errors[m]))
    return max(offsets), min(slopes), max(slopes), max(doubtful)


def main(argv: list[str]) -> int:
    """Print the margins; exit status 1 if a sound arm is found wanting."""
    Parser('driver_margins', 'How far sound arms are from their model.').parse_args(argv)
    sys.path.insert(0, str(Path(__file__).resolve().parents[1] / 'test'))
    from driver.scripted import Driver

    wrong = 0
    for name in ('arm26', 'musashi_left_arm'):
        robot = Robot.load(name)
        offset, least, greatest, doubtful = margins(robot)
        print(
            f'{name}: offset of l {1e3 * offset:.0f} mm (allowed {1e3 * ZERO_TOLERANCE:.0f}), '
            f'slope {least:.2f} to {greatest:.2f}, {1e3 * doubtful:.1f} mm off where another fits'
        )
        for seed in SEEDS:
            driver = Driver(robot, seed)
            for verdict in (driver.listen(), driver.listen(8.0, moved=True), driver.wind()):
                wrong += len(verdict.faults)
                for fault in verdict.faults:
                    print(f'  individual {seed}: {fault}')
    print(f'{wrong} faults found in {2 * len(SEEDS)} sound arms')
    return 1 if wrong else 0
