# SPDX-License-Identifier: Apache-2.0
"""Limits of plausible sensor values, and checks that use them.

The limits lie beyond the extremes of five healthy arms by a margin. The arms explored for a minute,
with and without an unknown payload of 3.6 kg, under the initial network of preset `default`.
Lengths changed by up to 0.9 mm in 10 ms, estimates exceeded a joint's range by up to 0.13 of the
range, and tensions reached 343 N.
"""

import math
from typing import NamedTuple, TypeVar

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.exceptions import MessageError
from musculoskeletal_ae.report import distinct
from musculoskeletal_ae.robot.robot import Robot

Tension = TypeVar('Tension', float, Array)


class Limits(NamedTuple):
    """Limits of plausible values of sensors and estimates, and of their changes.

    Nodes and tools that process muscle states or estimates all use these limits.
    """

    #: reject a measured angle that exceeds the joint's range by more than this fraction of the
    #: range
    joint_outside: float = 0.1
    #: treat an estimate as implausible if an angle exceeds the joint's range by more than this
    #: fraction of the range
    estimate_outside: float = 0.5
    lowest_tension: float = -0.1  # reject a tension below this fraction of `tension.max`
    highest_tension: float = 1.1  # reject a tension above this fraction of `tension.max`
    #: reject a motor current that, converted to a tension, is below this fraction of `tension.max`;
    #: it may be negative, because a part of the current overcomes the friction of motor and gear
    lowest_current: float = -1.0
    #: reject a motor current that, converted to a tension, is above this fraction of `tension.max`;
    #: the fraction exceeds 1, because the scale of currents is uncertain
    highest_current: float = 3.0
    #: reject a temperature of a muscle module below this [°C]
    lowest_temperature: float = -40.0
    #: reject a temperature of a muscle module above this [°C]
    highest_temperature: float = 200.0
    # A module's temperature changes by at most `temperature_step + temperature_rate · dt` in the
    # time dt since the last accepted temperature. The first temperature is accepted after later
    # readings have differed from it by at most `temperature_step` for the time `glitch`.
    #: reject a temperature that changes by more than this plus a part that grows with time [°C]
    temperature_step: float = 5.0
    temperature_rate: float = 50.0  # let this permitted change grow at this rate [°C/s]
    #: reject a length if |l| exceeds by more than this [m] the largest |l| that the model has with
    #: joints up to `joint_outside` beyond their ranges; a healthy |l| exceeds it if the tendon
    #: wraps, is slack and has been wound in, or is attached elsewhere than modelled
    length_margin: float = 0.1
    #: permit a slack tendon to be shorter by this much [m] than `length_margin` permits, because a
    #: ruptured tendon can be wound in further than any posture requires
    slack_length_margin: float = 1.0
    # Between two messages, a length changes by at most `step + speed · dt`. dt is the time between
    # the messages, limited to `longest_step`. A length that has jumped is accepted after it has
    # stayed at the new level for `settled`.
    #: reject a length that changes by more than this plus a part that grows with time [m]
    step: float = 0.02
    speed: float = 1.0  # let this permitted change grow at this rate [m/s]
    longest_step: float = 0.05  # let it grow no further after this time [s]
    settled: float = 1.0  # accept a length that has jumped once it has stayed for this time [s]
    #: report implausible messages as a fault, not as a glitch, once they have lasted for this time
    #: [s]
    glitch: float = 0.1
    #: after a pause of the messages that is longer than this [s], do not compare readings with
    #: earlier ones
    pause: float = 0.5


LIMITS = Limits()  # the limits that all nodes and tools use
#: treat a tendon as slack below this fraction of T_bias or of the demanded tension
SLACK_SHARE = 0.2
POSTURES = 500  # search this many random postures for the shortest and longest muscle lengths

#: reason, for users, under which rejected messages with a jump of a length are counted
LENGTH_JUMPED = 'length jumped'


def slack_tension(of: Tension) -> Tension:
    """Return the tension below which a tendon is slack [N].

    Args:
        of: T_bias or the demanded tension of one muscle or of several [N].
    """
    return SLACK_SHARE * of


def reading_range(robot: Robot) -> tuple[Array, Array]:
    """Return the lowest and the highest plausible tension reading [N] of every muscle, (M,) each.

    The reading is that of the tension sensor, or the motor current converted to newtons.
    """
    most, low, high = robot.description.tension.max, LIMITS.lowest_tension, LIMITS.highest_tension
    if robot.tension_source.is_current:
        low, high = LIMITS.lowest_current, LIMITS.highest_current
    return low * most, high * most


def length_range(robot: Robot, outside: float = 0.0) -> tuple[Array, Array]:
    """Return the smallest and the largest length of every muscle within the joint ranges.

    They are found among POSTURES random postures, with no tension and with tension.max.

    Args:
        robot: The nominal body.
        outside: How far joints may exceed their ranges, as a fraction of the range.

    Returns:
        Smallest and largest l [m], (M,) each.
    """
    theta = robot.random_postures(POSTURES, np.random.default_rng(0), outside)
    slack = np.zeros((POSTURES, robot.muscle_count))
    length = [robot.muscle_lengths(theta, slack + tension) for tension in (0.0, robot.tension.max)]
    return np.min(length, axis=(0, 1)), np.max(length, axis=(0, 1))


def longest_lengths(robot: Robot) -> Array:
    """Return the largest plausible |l| [m] of every muscle, (M,)."""
    low, high = length_range(robot, LIMITS.joint_outside)
    longest: Array = np.maximum(-low, high) + LIMITS.length_margin
    return longest


def share_outside(robot: Robot, theta: Array) -> Array:
    """Return how far each joint exceeds its range, as a fraction of the range, (D,).

    The fraction is negative for a joint within its range.
    """
    low, high = robot.lower, robot.upper
    share: Array = np.maximum(theta - high, low - theta) / (high - low)
    return share


def check_posture(robot: Robot, theta: Array, outside: float) -> None:
    """Check that no joint exceeds its range by more than a fraction `outside` of the range.

    Joints with NaN are ignored.

    Raises:
        MessageError: If a joint exceeds its range by more; the text names the joint, its angle and
            the legal angles.
    """
    share = share_outside(robot, theta)
    if not (share > outside).any():
        return
    j = int(np.nanargmax(share))
    margin, unit = outside * (robot.upper - robot.lower)[j], robot.units[j].position
    values = np.array([theta[j], robot.lower[j] - margin, robot.upper[j] + margin])
    value, least, most = distinct(*robot.units.to_position(values, j))
    raise MessageError(
        'θ far outside the joint limits',
        f'{robot.joints[j]} is {value} {unit}; legal: {least} to {most} {unit}',
    )


class Persistence:
    """Distinguishes a lasting fault from a glitch. Times come from a steady clock [s].

    A fault lasts from its first message to its newest one, and at most half of `LIMITS.glitch`
    longer if no message follows. A pause of this process therefore does not turn a glitch into a
    lasting fault.
    """

    def __init__(self) -> None:
        self._problem, self._since, self._newest = '', math.inf, math.inf

    def note(self, problem: str, now: float) -> None:
        """Note the problem of the message received at `now` [s], as a text; '' if it has none."""
        self._since = min(self._since, now) if problem else math.inf
        self._problem, self._newest = problem, now

    def lasting(self, now: float) -> str:
        """Return the newest fault if faults have lasted longer than `LIMITS.glitch`, else ''."""
        until = min(now, self._newest + 0.5 * LIMITS.glitch)
        return self._problem if until - self._since > LIMITS.glitch else ''
