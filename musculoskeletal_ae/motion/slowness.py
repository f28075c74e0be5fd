# SPDX-License-Identifier: Apache-2.0
"""Slows trajectories that are too fast for the muscle modules.

Two properties of the modules limit the speed: how fast they turn (`slowness`), and how much tension
they may exert (`slowed_to_exert`).
"""

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.settings import Settings
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.motion.holdable_paths import NOTABLE, USED, PathLimits
from musculoskeletal_ae.motion.trajectory import Setpoint, Slowdown, Trajectory
from musculoskeletal_ae.robot.robot import Robot

#: let the motion of the arm use this fraction of the rate limit of the lengths; the remaining
#: fraction is for changes of tension and for feedback
SHARE = 0.7
#: evaluate the network at no more instants of a trajectory than this, so that no command is late;
#: each piece between two points still contains an instant, even of a trajectory of 10 000 points
MOST_MOMENTS = 12_500

#: slow a motion, where necessary, by the smallest of these factors with which tensions suffice
SLOWER = tuple(1.1**k for k in range(17))
#: slow the motion of an arm with isolated muscles by one of these factors instead: it may fall
#: where other arms only deviate from the trajectory, and coarse factors leave it a reserve
SLOWER_ISOLATED = (1.0, 1.3, 1.7, 2.2, 2.8, 3.6, 4.6)
#: assume at least this lag λ in plans [s], because λ is measured only after the motion has begun
LEAST_LAG = 0.02
MOMENT_SPACING = 0.06  # compute tensions at instants that are at least this motion apart [rad]
#: compute tensions at no more instants than this; 500 instants take about 30 ms, and longer if the
#: muscles lack torque at many of them
MOST_EXERTIONS = 500
#: begin to slow a motion this long before the muscles would lack torque, and end this long
#: afterwards [s]; a sudden change would itself cost torque
EASING = 0.07
EASING_STEP = 0.01  # state the factor at instants that are this far apart [s]
#: increase the factor by at most this per second at the beginning of a motion that starts from
#: another one; a moving arm cannot slow down at once
BRAKING = 2.0


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


def slowed_to_exert(robot: Robot, mae: Mae, trajectory: Trajectory, lag: float) -> Trajectory:
    """Return a motion, slowed where the muscles could not exert its torque otherwise.

        τ(s) = τ_hold(θ) + (τ(θ, θ̇, θ̈) − τ_hold(θ))/s²
        T_low(s) = (T_bias + K_stiff λ max(dl/dt, 0)/s)/loss

    At each instant, the factor s is the smallest of `SLOWER` with which the muscles lack at most
    `NOTABLE` more torque than a very slow motion lacks at its worst instant. If a motion lacks
    torque at one instant however slow it is, it is therefore not slowed because of a smaller lack
    at another instant. If no factor suffices, s is the largest of `SLOWER`. The factor changes
    gradually along the way (`_eased`). If the muscle modules provide no tensions, the motion is not
    slowed.

    An arm without isolated muscles may use all tensions up to T_limit. An arm with isolated muscles
    is slowed as much on the whole way. Its factors are those of `SLOWER_ISOLATED`, and the highest
    tension is that of `PathLimits`, which keeps a reserve. `loss` is defined there, too.

    Args:
        robot: The robot; isolated muscles have no tension.
        mae: The network in use.
        trajectory: The motion.
        lag: λ, time by which the muscle modules lag behind their commands [s].
    """
    time, theta = trajectory.path
    is_still = (theta == theta[0]).all()
    if not robot.tension_source.is_known or is_still:
        return trajectory
    is_whole = bool(robot.used.all())
    factors, used = (SLOWER, 1.0) if is_whole else (SLOWER_ISOLATED, USED)
    limits, bias, lag = PathLimits(robot, mae, used), robot.tension.bias, max(lag, LEAST_LAG)
    travelled = np.linalg.norm(np.diff(theta, axis=0), axis=1).cumsum()
    spacing = max(MOMENT_SPACING, travelled[-1] / MOST_EXERTIONS)
    marks = np.arange(0.0, travelled[-1], spacing)
    instants = time[np.unique(np.searchsorted(travelled, marks)) + 1]
    moments = trajectory.sample(instants)
    jacobians = mae.muscle_jacobian(moments.theta, np.tile(bias, (len(moments.theta), 1)))
    every = [*zip(jacobians, map(Setpoint._make, zip(*moments)))]
    lacking = {  # the instants at which the muscles lack torque if the motion is not slowed
        n: moment
        for n, moment in enumerate(every)
        if limits.missing_in_motion(*moment, lag, factors[0]) > NOTABLE
    }
    if not lacking:
        return trajectory
    very_slow = [limits.missing_in_motion(*moment, lag, np.inf) for moment in lacking.values()]
    legal = max(very_slow) + NOTABLE

    def suffices(moment: tuple[Array, Setpoint], number: int) -> bool:
        return limits.missing_in_motion(*moment, lag, factors[number]) <= legal

    slower, number = np.ones(len(instants)), 0
    for n, moment in lacking.items():
        # Neighbouring instants need similar factors: search from the last one.
        if suffices(moment, number):
            while number > 0 and suffices(moment, number - 1):
                number -= 1
        else:
            while number < len(factors) - 1 and not suffices(moment, number):
                number += 1
        slower[n] = factors[number]
    if not is_whole:
        slower[:] = slower.max()
    if slower.max() == 1.0:
        return trajectory
    starts_moving = bool(trajectory.start.velocity.any())
    return trajectory.eased(_eased(instants, slower, trajectory.duration, starts_moving))


def _eased(instants: Array, slower: Array, duration: float, starts_moving: bool) -> Slowdown:
    """Return a slowdown that changes gradually, and is nowhere less than `slower`.

    Only if the arm moves at the beginning, the slowdown is less there: it begins with a factor of 1
    and grows by BRAKING, because the arm cannot change its velocity at once.

    Args:
        instants: Instants of the motion [s], (N,).
        slower: Factors by which the motion has to be slowed at them, (N,).
        duration: Duration of the motion [s].
        starts_moving: Whether the arm moves at the beginning.
    """
    count = int(np.clip(duration / EASING_STEP, 1, MOST_MOMENTS))
    time = np.linspace(0.0, duration, count + 1)
    # Between two instants, the larger of their factors applies.
    after = np.searchsorted(instants, time)
    factor = np.maximum(*(slower[np.clip(k, 0, len(slower) - 1)] for k in (after, after - 1)))
    reached = np.searchsorted(time, instants)
    for k in (reached, np.maximum(reached - 1, 0)):
        np.maximum.at(factor, k, slower)
    reach = max(1, round(EASING / time[1]))
    for summary in (np.max, np.mean):
        padded = np.pad(factor, reach, mode='edge')
        factor = summary(sliding_window_view(padded, 2 * reach + 1), axis=1)
    if starts_moving:
        factor = np.minimum(factor, 1.0 + BRAKING * time)
    return Slowdown.by(time, factor)
