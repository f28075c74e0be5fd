# SPDX-License-Identifier: Apache-2.0
"""Control by each method: 5 random θ_eval, each from 5 random starts, on one individual.

`geometric` is the model's, the others run on the learnt networks, `proposed_paper` on that of
preset paper. Beside each method the least ‖T‖ with which the true body could hold θ_eval (QP
bound), and the least with which it could hold the posture that the method reached: an arm that
sags needs less.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.methods import proposed
from musculoskeletal_ae.control.settings import Settings
from musculoskeletal_ae.emulator.arm import EmulatedArm
from musculoskeletal_ae.exceptions import InfeasibleError
from musculoskeletal_ae.experiments.control import (
    PROTOCOL,
    approach,
)
from musculoskeletal_ae.experiments.holdable import holdable_postures, least_holding_tension
from musculoskeletal_ae.experiments.suite.scenario import frictionless
from musculoskeletal_ae.experiments.suite.study import Measured, Progress, Study
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.robot import Robot


def measure(study: Study, seed: int, progress: Progress) -> Measured:
    """Return the numbers and traces of one individual."""
    robot = study.body()
    networks = {preset: study.learnt(robot, seed, preset) for preset in ('default', 'paper')}
    networks['default'] = study.learnt(robot, seed)
    arm = EmulatedArm(robot, seed)
    rng = np.random.default_rng([seed, 0xC0])
    evaluated = holdable_postures(robot, arm.individual, study.approaches, rng)
    shape = len(PROTOCOL), study.approaches, study.approaches
    errors, tensions, reached = np.empty(shape), np.empty(shape), np.full(shape, np.nan)
    missed = np.empty((*shape, robot.joint_count))
    for p, (theta, _) in enumerate(evaluated):
        for s, start in enumerate(robot.random_postures(study.approaches, rng)):
            for m, (method, preset) in enumerate(PROTOCOL.values()):
                settings = Settings(method=method, preset=preset)
                came = approach(arm, networks[preset], settings, start, theta)
                errors[m, p, s], tensions[m, p, s] = came.error, came.tension
                missed[m, p, s] = arm.theta - theta
                reached[m, p, s] = _bound(robot, arm)
            progress(1.0 / study.approaches**2)
    bounds = np.array([np.linalg.norm(least) for _, least in evaluated])
    numbers: dict[str, Any] = {'qp_bound_n': float(bounds.mean())}
    for m, name in enumerate(PROTOCOL):
        held = np.isfinite(reached[m])
        offset = missed[m].mean(axis=1, keepdims=True)  # over starts
        numbers[name] = {
            'error_rad': float(errors[m].mean()),
            # Around each θ_eval's own mean: the scatter that hysteresis leaves, as in the paper.
            'error_var': float(errors[m].var(axis=1).mean()),
            # What every start has in common is the model's, what differs is hysteresis.
            'common_rad': float(np.linalg.norm(offset, axis=-1).mean()),
            'scatter_rad': float(np.linalg.norm(missed[m] - offset, axis=-1).mean()),
            'tension_n': float(tensions[m].mean()),
            'tension_var': float(tensions[m].var(axis=1).mean()),
            'tension_to_bound': float((tensions[m] / bounds[:, None]).mean()),
            'bound_reached_n': float(reached[m][held].mean()) if held.any() else 0.0,
            'reached_holdable_share': float(held.mean()),
        }
    targets = np.array([theta for theta, _ in evaluated])
    numbers['proposed_causes'] = _causes(robot, networks['default'], seed, targets, bounds)
    traces = {'errors': errors, 'tensions': tensions, 'bounds': bounds}
    return Measured(numbers, traces)


def _causes(robot: Robot, mae: Mae, seed: int, targets: Array, bounds: Array) -> dict[str, float]:
    """Return what `proposed` plans, and what comes of it on the same body without friction.

    The plan's ‖T‖ beside the bound is the learnt body's error; what the frictionless arm has beyond
    it comes from the tensions' being commanded as lengths, and the rest is friction.
    """
    arm = frictionless(robot, seed)
    planned, errors, tensions = [], [], []
    for theta in targets:
        torque = robot.kinematics.holding_torque(theta)
        none = np.full(robot.muscle_count, robot.tension.bias)
        plan = proposed(robot, mae, theta, torque, none, robot.tension.limit)
        planned.append(float(np.linalg.norm(plan.tension)))
        start = 0.5 * (robot.lower + robot.upper)
        came = approach(arm, mae, Settings(method='proposed'), start, theta)
        errors.append(came.error)
        tensions.append(came.tension)
    return {
        'planned_to_bound': float((np.array(planned) / bounds).mean()),
        'frictionless_to_bound': float((np.array(tensions) / bounds).mean()),
        'frictionless_rad': float(np.mean(errors)),
    }


def _bound(robot: Robot, arm: EmulatedArm) -> float:
    """Return the least ‖T‖ [N] that holds the true body where it is; nan if none does.

    A joint that leans on its stop, or friction, can rest where no tension could hold it.
    """
    jacobian = arm.individual.muscle_jacobian(arm.theta[None])[0]
    try:
        return float(np.linalg.norm(least_holding_tension(robot, jacobian, arm.theta)))
    except InfeasibleError:
        return float('nan')
