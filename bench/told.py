# SPDX-License-Identifier: Apache-2.0
"""What `proposed` reaches after learning, and what it would if it were told what no arm can know.

python -m bench told [--robot …] [--reality foreign] [--seeds 0,1,2,3,4] [--quick]

Targets, starts and networks are those of `experiment control`. What is told replaces what was
estimated at every message: the true θ, then the true G of where the network is asked, and the true
T_end as well. `harder` lets the feedback at rest correct four times as fast and three times as far.
Stuck: more than 0.4 rad off; ‖T‖ is beside the least that holds the target with the true G. Where θ
is told, what the estimate is off by is still that of the estimate nobody asked.
"""

from dataclasses import fields
from typing import Any, NamedTuple

import numpy as np

from bench.paper_control import learned, studied
from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.exploration import TRIES, holdable_postures
from musculoskeletal_ae.control.posture import Pull
from musculoskeletal_ae.control.settings import Settings
from musculoskeletal_ae.emulator.faults import Readings
from musculoskeletal_ae.emulator.modules import Arm
from musculoskeletal_ae.experiments.control import APPROACHES, DURATION, STARTING
from musculoskeletal_ae.experiments.recording import ClosedLoop
from musculoskeletal_ae.experiments.study import Study
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.options import Parser

STUCK = 0.4  # [rad]
FASTER, FARTHER = 4.0, 3.0  # feedback at rest of `harder`


class Told(NamedTuple):
    """What a controller is told, and how hard it corrects."""

    posture: bool = False
    body: bool = False  # G and T_end
    harder: bool = False


ROWS = {
    'nothing': Told(),
    'θ': Told(posture=True),
    'θ, G and T_end': Told(posture=True, body=True),
    'θ, G and T_end; harder': Told(posture=True, body=True, harder=True),
    'nothing; harder': Told(harder=True),
}


class ToldLoop(ClosedLoop):
    """A closed loop whose controller is told the truth in the place of estimates."""

    told = Told()
    off = 0.0  # of the estimate [rad]

    def tell(self, told: Told, mae: Mae) -> None:
        """Tell it so much from now on; the network is the one that was learned."""
        self.told = told
        if told.body:
            true = self.arm.individual.muscle_jacobian

            class Body(Mae):
                def muscle_jacobian(self, theta: Array, tension: Array) -> Array:  # noqa: ARG002
                    found = true(np.atleast_2d(theta))
                    return found if theta.ndim > 1 else found[0]

            known = {part.name: getattr(mae, part.name) for part in fields(Mae) if part.init}
            mae = Body(**known)
        self.use(mae)
        gain = Settings().feedback_gain * (FASTER if told.harder else 1.0)
        self.core.configure(Settings(feedback_gain=gain))
        if told.harder:
            feedback = self.core.motion._feedback
            feedback.most = FARTHER * feedback.most

    def estimate(self, read: Readings, now: float) -> Array:
        """Return θ [rad] (D,), estimated or true; the tensions were taken before."""
        arm, core, found = self.arm, self.core, super().estimate(read, now)
        self.off = float(np.linalg.norm(found - arm.theta))
        if self.told.body:
            pull, lost = core._pull.motor, arm.end_tension / np.maximum(arm.tension, 1e-3)
            core._pull = Pull(pull, pull * lost)
        return arm.theta if self.told.posture else found


def approaches(arm: Arm, mae: Mae, seed: int, count: int, told: Told) -> Array:
    """Return distance from the target, of the estimate [rad], ‖T‖ beside its bound, (count², 3)."""
    robot, rng = arm.robot, np.random.default_rng([seed, 0xC0])
    postures, ends = robot.random_postures(TRIES, rng), list[tuple[Any, ...]]()
    for theta, least in holdable_postures(robot, postures, count, arm.individual.muscle_jacobian):
        for start in robot.random_postures(count, rng):
            loop = ToldLoop(arm, mae)
            loop.approach(start, STARTING)
            if loop.core.safety.cause:  # the start is then where it stopped
                loop = ToldLoop(arm, mae)
            loop.tell(told, mae)
            loop.approach(theta, DURATION)
            beside = np.linalg.norm(arm.tension) / np.linalg.norm(least)
            ends.append((np.linalg.norm(arm.theta - theta), loop.off, beside))
    return np.array(ends)


def individual(study: Study, seed: int) -> dict[str, Array]:
    """Return what `approaches` does, by what is told, after an individual was learned."""
    mae, count = learned(study, seed), 1 if study.quick else APPROACHES
    return {
        name: approaches(study.arm(seed), mae, seed, count, told) for name, told in ROWS.items()
    }


def table(rows: list[dict[str, Array]]) -> str:
    """Return the median of each individual, and means over all approaches that are not stuck."""
    lines = [
        '| told | medians [rad] | stuck | others [rad] | their estimate [rad] | ‖T‖ / bound |',
        '|---|---|---|---|---|---|',
    ]
    for name in ROWS:
        medians = ', '.join(f'{np.median(row[name][:, 0]):.3f}' for row in rows)
        ends = np.concatenate([row[name] for row in rows])
        free = ends[:, 0] < STUCK
        error, off, tension = ends[free].mean(axis=0) if free.any() else [np.nan] * 3
        stuck = f'{(~free).sum()} of {len(ends)}'
        lines.append(f'| {name} | {medians} | {stuck} | {error:.3f} | {off:.3f} | {tension:.2f} |')
    return '\n'.join(lines)


def main(argv: list[str]) -> None:
    """Print the table."""
    parser = Parser('told', 'What `proposed` reaches, and would if it were told the truth.')
    parser.add_robot()
    parser.add_seeds((0, 1, 2, 3, 4))
    parser.add_reality()
    parser.add_minutes('duration of the exploration', 10.0)
    parser.add_quick('one target and start')
    args = parser.parse_args(argv)

    rows = list[dict[str, Array]]()
    with studied(args, 'default') as study:
        for seed in args.seeds:
            rows.append(individual(study, seed))
            print(f'individual {seed}\n{table(rows[-1:])}\n', flush=True)
    print(f'individuals {", ".join(map(str, args.seeds))}\n{table(rows)}')
