# SPDX-License-Identifier: Apache-2.0
"""The simulator beside the arm under the same commands, before and after learning.

The arm is the recording of the held-out motion; the simulator starts in the arm's first posture and
is given nothing but the commands. θ is compared with the true one, T with the measured one. The
bound is the true body itself, but without friction, under the same commands: a perfect simulator
that knows no hysteresis.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.experiments.recording import SAMPLE_TIME, Recording
from musculoskeletal_ae.experiments.suite.learning import HELD_OUT
from musculoskeletal_ae.experiments.suite.scenario import frictionless
from musculoskeletal_ae.experiments.suite.study import Measured, Progress, Study
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.simulation.simulation import Simulation


def measure(study: Study, seed: int, progress: Progress) -> Measured:
    """Return the numbers and traces of one individual."""
    robot = study.body()
    arm = study.stream(seed, HELD_OUT)
    numbers: dict[str, Any] = {}
    traces: dict[str, Any] = {'theta': arm.theta, 'tension': arm.tension}
    presets = dict.fromkeys([study.preset, 'paper'])
    for preset in presets:
        prefixes = [p for p, named in (('', study.preset), ('paper_', 'paper')) if named == preset]
        networks = {
            'before': study.initial(robot, preset),
            'after': study.learnt(robot, seed, preset),
        }
        for when, mae in networks.items():
            theta, tension = simulate(robot, mae, preset, arm)
            apart = np.linalg.norm(theta - arm.theta, axis=1)
            tense = np.linalg.norm(tension - arm.tension, axis=1)
            for prefix in prefixes:
                numbers[f'{prefix}{when}_rad'] = float(apart.mean())
                numbers[f'{prefix}{when}_n'] = float(tense.mean())
            if preset == study.preset:
                traces[when] = {'theta': theta, 'tension': tension, 'rad': apart, 'n': tense}
            progress(0.5 / len(presets))
    numbers.update(_frictionless(robot, seed, arm))
    return Measured(numbers, traces)


def _frictionless(robot: Robot, seed: int, arm: Recording) -> dict[str, float]:
    body = frictionless(robot, seed)
    theta, tension = np.empty_like(arm.theta), np.empty_like(arm.tension)
    for n, command in enumerate(arm.command):
        body.command_length(command)
        body.step(SAMPLE_TIME)
        theta[n], tension[n] = body.theta, body.tension
    return {
        'frictionless_rad': float(np.linalg.norm(theta - arm.theta, axis=1).mean()),
        'frictionless_n': float(np.linalg.norm(tension - arm.tension, axis=1).mean()),
    }


def simulate(robot: Robot, mae: Mae, preset: str, arm: Recording) -> tuple[Array, Array]:
    """Return θ [rad] (N, D) and T [N] (N, M) of a simulator given an arm's commands."""
    simulated = Simulation(robot, mae, preset)
    simulated.start_from(arm.theta[:1])
    theta, tension = np.empty_like(arm.theta), np.empty_like(arm.tension)
    for n, command in enumerate(arm.command):
        simulated.command = command[None]
        state = simulated.step(SAMPLE_TIME)
        theta[n], tension[n] = state.theta[0], state.tension[0]
    return theta, tension
