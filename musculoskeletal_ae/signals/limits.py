# SPDX-License-Identifier: Apache-2.0
"""What sensors of an arm can read at all: one table of limits, and the checks that use it.

The limits leave room beyond what five healthy arms showed in a minute of exploring each, with and
without an unknown payload of 3.6 kg, under the initial network of preset `default`: lengths that
changed by 0.9 mm in 10 ms, estimates up to 0.13 of a joint's range beyond it, and at most 343 N.
"""

import math
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.exceptions import MessageError
from musculoskeletal_ae.report import distinct
from musculoskeletal_ae.robot.robot import Robot


class Limits(NamedTuple):
    """The table. A value beyond these is not used, whoever reads it."""

    #: how far a joint sensor and an estimate may lie beyond the joint's range, as a share of it
    joint_outside: float = 0.1
    estimate_outside: float = 0.5
    #: lowest and highest tension, as shares of `tension.max`
    lowest_tension: float = -0.1
    highest_tension: float = 1.1
    #: lowest and highest temperature of a muscle module [°C]
    lowest_temperature: float = -40.0
    highest_temperature: float = 200.0
    #: a module's temperature changes by at most `temperature_step + temperature_rate · dt` [°C],
    #: [°C/s] since the last one that was believed; the first is believed once others have agreed
    #: with it to within the step for `glitch` [s]
    temperature_step: float = 5.0
    temperature_rate: float = 50.0
    #: how far a length may lie beyond what the joints allow [m]: tendons wrap, wind up with slack,
    #: or are tied elsewhere; a slack tendon can be wound in further
    length_margin: float = 0.1
    slack_length_margin: float = 1.0
    #: a tendon that pulls with less than this share of T_bias is slack
    slack_share: float = 0.2
    #: a length changes by at most `step + speed · dt` between two messages [m], [m/s], where dt
    #: counts up to `longest_step` [s]; another level is accepted once it has lasted `settled` [s]
    step: float = 0.02
    speed: float = 1.0
    longest_step: float = 0.05
    settled: float = 1.0
    #: how long messages may be implausible before that is a fault and no glitch [s]
    glitch: float = 0.1
    #: a pause in the messages after which the tendons may have slid anywhere [s]
    pause: float = 0.5


LIMITS = Limits()
POSTURES = 500  # random postures that tell how long the muscles can get

TENSION = 'tension beyond the maximum'
LENGTH = 'length beyond what the joints allow'
TEMPERATURE = 'impossible temperature'
LENGTH_JUMPED = 'length jumped'


def length_range(robot: Robot, outside: float = 0.0) -> tuple[Array, Array]:
    """Return the least and the greatest length of every muscle within the joint ranges.

    Args:
        robot: The nominal body.
        outside: By which share of its range a joint may lie beyond it.

    Returns:
        Least and greatest l [m], (M,) each.
    """
    theta = robot.random_postures(POSTURES, np.random.default_rng(0), outside)
    slack = np.zeros((POSTURES, robot.muscle_count))
    length = [robot.muscle_lengths(theta, slack + pull) for pull in (0.0, robot.tension.max)]
    return np.min(length, axis=(0, 1)), np.max(length, axis=(0, 1))


def longest_lengths(robot: Robot) -> Array:
    """Return the largest |l| [m] that is plausible for every muscle, (M,)."""
    low, high = length_range(robot, LIMITS.joint_outside)
    longest: Array = np.maximum(-low, high) + LIMITS.length_margin
    return longest


def share_outside(robot: Robot, theta: Array) -> Array:
    """Return how far each joint lies beyond its range, as a share of the range, (D,)."""
    low, high = robot.lower, robot.upper
    share: Array = np.maximum(theta - high, low - theta) / (high - low)
    return share


def check_posture(robot: Robot, theta: Array, outside: float) -> None:
    """Check that every joint lies within its range or at most a share of it beyond.

    NaN is not judged.

    Raises:
        MessageError: Naming the joint, its angle and its limits.
    """
    beyond = share_outside(robot, theta)
    j = int(np.nanargmax(np.append(beyond, -np.inf)))
    if j < len(theta) and beyond[j] > outside:
        low, high, unit = robot.lower[j], robot.upper[j], robot.units[j].theta
        value, least, most = distinct(theta[j], low, high)
        raise MessageError(
            'θ far outside the joint limits',
            f'{robot.joints[j]} {value} {unit}, limits {least} to {most}',
        )


class Persistence:
    """Tells a fault that lasts from a glitch. Times are of one steady clock [s]."""

    def __init__(self) -> None:
        self._problem, self._since = '', math.inf

    def note(self, problem: str, now: float) -> None:
        """Note what is wrong with the newest message; '' if it can be used."""
        self._since = min(self._since, now) if problem else math.inf
        self._problem = problem

    def lasting(self, now: float) -> str:
        """Return what has been wrong for longer than a glitch, or ''."""
        return self._problem if now - self._since > LIMITS.glitch else ''
