# SPDX-License-Identifier: Apache-2.0
"""Slows trajectories that are too fast for the muscle modules.

Two properties of the modules limit the speed: how fast they turn (`slowness`), and how much tension
they may exert (`exertion_slowness`).
"""

import numpy as np

from musculoskeletal_ae.control.settings import Settings
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.motion.holdable_paths import NOTABLE, USED, PathLimits
from musculoskeletal_ae.motion.trajectory import Setpoint, Trajectory
from musculoskeletal_ae.robot.robot import Robot

#: let the motion of the arm use this fraction of the rate limit of the lengths; the remaining
#: fraction is for changes of tension and for feedback
SHARE = 0.7
#: evaluate the network at no more instants of a trajectory than this, so that no command is late;
#: each piece between two points still contains an instant, even of a trajectory of 10 000 points
MOST_MOMENTS = 12_500

#: slow a motion by the smallest of these factors with which the tensions suffice
SLOWER = tuple(1.1**k for k in range(17))
#: slow the motion of an arm with isolated muscles by one of these factors instead: it may fall
#: where other arms only deviate from the trajectory, and coarse factors leave it a reserve
SLOWER_ISOLATED = (1.0, 1.3, 1.7, 2.2, 2.8, 3.6, 4.6)
#: assume at least this lag λ in plans [s], because λ is measured only after the motion has begun
LEAST_LAG = 0.02
MOMENT_SPACING = 0.06  # compute tensions at instants that are at least this motion apart [rad]
#: compute tensions at no more instants than this; 500 instants take about 30 ms
MOST_EXERTIONS = 500


def slowness(robot: Robot, mae: Mae, trajectory: Trajectory, settings: Settings) -> float:
    """Return the factor by which to slow a trajectory so that the muscle modules can follow it.

    The factor is computed from the lengths of the muscles at T_bias. Changes of tension also change
    the lengths, but are not considered: near postures that are hard to hold, they are sudden,
    however slow the arm moves. `SHARE` leaves a part of the speed for them. A trajectory that
    starts in motion keeps its initial speed. It may therefore need a larger factor than the
    returned one.
    """
    # Skip instants of very long trajectories, which would otherwise delay a command by 0.1 s.
    time, theta = (part[:: 1 + len(part) // MOST_MOMENTS] for part in trajectory.path)
    length = mae.lengths(theta, np.tile(robot.tension.bias, (len(theta), 1)))
    speed = np.diff(length, axis=0) * robot.used / np.diff(time)[:, None]
    fastest = SHARE * robot.actuation.fastest(settings.rate_limit)
    return float(max(1.0, (np.abs(speed) / fastest).max()))


def exertion_slowness(robot: Robot, mae: Mae, trajectory: Trajectory, lag: float) -> float:
    """Return the factor by which to slow a motion so that the muscles can exert its torque.

        τ(s) = τ_hold(θ) + (τ(θ, θ̇, θ̈) − τ_hold(θ))/s²
        T_low(s) = (T_bias + K_stiff λ max(dl/dt, 0)/s)/loss

    The factor s is the smallest of `SLOWER` for which the largest missing torque of the motion is
    at most `NOTABLE` above that of a very slow motion. If a motion lacks torque at one instant
    however slow it is, it is therefore not slowed because of a smaller lack at another instant. If
    no factor suffices, s is the largest of `SLOWER`. If the muscle modules provide no tensions, s
    is 1. An arm without isolated muscles may use all tensions up to T_limit. For an arm with
    isolated muscles, the factors are those of `SLOWER_ISOLATED`, and the highest tension is that of
    `PathLimits`, which keeps a reserve. `loss` is defined there, too.

    Args:
        robot: The robot; isolated muscles have no tension.
        mae: The network in use.
        trajectory: The motion.
        lag: λ, time by which the muscle modules lag behind their commands [s].
    """
    time, theta = trajectory.path
    is_still = (theta == theta[0]).all()
    if not robot.tension_source.is_known or is_still:
        return 1.0
    factors, used = (SLOWER, 1.0) if robot.used.all() else (SLOWER_ISOLATED, USED)
    limits, bias, lag = PathLimits(robot, mae, used), robot.tension.bias, max(lag, LEAST_LAG)
    travelled = np.linalg.norm(np.diff(theta, axis=0), axis=1).cumsum()
    spacing = max(MOMENT_SPACING, travelled[-1] / MOST_EXERTIONS)
    marks = np.arange(0.0, travelled[-1], spacing)
    moments = trajectory.sample(time[np.unique(np.searchsorted(travelled, marks)) + 1])
    jacobians = mae.muscle_jacobian(moments.theta, np.tile(bias, (len(moments.theta), 1)))
    lacking = [  # the instants at which the muscles lack torque if the motion is not slowed
        (jacobian, at)
        for at, jacobian in zip(map(Setpoint._make, zip(*moments)), jacobians)
        if limits.missing_in_motion(jacobian, at, lag, factors[0]) > NOTABLE
    ]
    very_slow = [limits.missing_in_motion(*moment, lag, np.inf) for moment in lacking]
    legal = max(very_slow, default=0.0) + NOTABLE
    number = 0
    for moment in lacking:
        while limits.missing_in_motion(*moment, lag, factors[number]) > legal:
            number += 1
            if number == len(factors) - 1:
                return factors[number]
    return factors[number]
