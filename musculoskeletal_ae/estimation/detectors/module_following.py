# SPDX-License-Identifier: Apache-2.0
"""Detects a muscle module that does not follow its commands, whatever the arm does.

A module under muscle stiffness control turns its winch until the tension T is the demanded one:

    dl/dt = G (T − T_ref)

T_ref is the tension that the command demands at the measured length l. This law holds for every
module alone: in any posture, in contact, and with any network. A healthy module corrects a
difference of T_limit at the speed CORRECTING or faster, and a smaller difference in proportion. The
rest of the difference is unexplained:

    e = |T − T_ref| − T_limit · max(0, v) / CORRECTING

v is the speed at which the winch turns in the direction that reduces the difference. A jammed or
weak motor, a wrong reading of tension or length, and commands that do not arrive or are reversed
all lead to a large e. Tendons without tension are left to `slack_tendon.py`.

The evidence is a time. It grows while e is above a tolerance and shrinks while e is below it, the
faster the farther e is away from it, but at most by one second per second. A module is reported
after FAULTY seconds of evidence. The constants tolerate slow and badly tuned modules: about twice
as slow as the slowest healthy emulated module, and with an error of 10 % of the commanded tension
because a stiffness or a sensor's gain differs from muscles.yaml. `python -m bench mishaps` shows
how soon faults are reported, and its option `--healthy` that healthy modules are not.

A position-controlled module has no T_ref. Its e is a length:

    e = |l − l_target| − LAG · max(0, v)

The module may stay behind while T > FULL · T_max, because it cannot pull harder.

The readings of a module that does not follow may be consistent with a posture. The residuals of the
network then do not reveal the fault.
"""

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.conditions import ConditionKind
from musculoskeletal_ae.estimation.finding import Detector, Finding, Observation
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.reading_limits import slack_tension

FAULTY = 1.0  # report a module once the evidence against it amounts to this time [s]
#: smooth differences from the command, and winding speeds, with this time constant [s]
SMOOTHING = 0.1
#: reduce the evidence while the winch turns at more than this share of its largest speed, if this
#: speed is known: the winch can hardly correct faster
FULL_SPEED = 0.5
#: expect a healthy module to wind at least this fast [m/s] while |T − T_ref| is T_limit
CORRECTING = 0.2
#: tolerate a difference T − T_ref of this share of T_limit, plus this share of T_ref for errors of
#: the sensor's gain and of the module's stiffness
ALLOWED, ALLOWED_SHARE = 0.04, 0.1
#: let the evidence grow at its fastest rate once the unexplained difference e exceeds the tolerance
#: by this share of T_limit
CLEAR = 0.05
#: tolerate in addition this many standard deviations of a tension that is computed from a motor
#: current; for a tension sensor, the standard deviation is 0
SURE = 2.0
BEHIND = 0.005  # tolerate this distance of a position-controlled module from its target length [m]
#: let the evidence grow at its fastest rate once a position-controlled module is further behind
#: than BEHIND by this [m]
CLEARLY_BEHIND = 0.005
#: expect a healthy position-controlled module to lag behind its command by at most this time [s]
LAG = 0.6
#: reduce the evidence against a position-controlled module while its tension exceeds this share of
#: T_max, because the motor cannot pull harder
FULL = 0.9


class ModuleFollowing(Detector):
    """Reports a module whose tension does not follow the tension that its command demands."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self.reset()

    def reset(self) -> None:
        """Reset the detector: discard all evidence."""
        count = self._robot.muscle_count
        self._evidence: Array = np.zeros(count)  # time of evidence [s]
        self._length: Array | None = None  # length in the previous message [m]
        self._difference: Array | None = None  # smoothed difference from the command [N or m]
        self._speed: Array = np.zeros(count)  # smoothed rate of the length [m/s]

    def step(self, observation: Observation) -> Finding | None:
        """Report the module with the most evidence against it; None if that is less than 1 s."""
        difference = self._differences(observation)
        if difference is None or not observation.lengths_known:
            self.reset()
            return None
        length, dt = observation.sample.length, observation.dt
        if self._length is None or self._difference is None:
            self._length, self._difference = length, difference
            return None
        if dt <= 0.0:
            return None
        share = 1.0 - np.exp(-dt / SMOOTHING)
        self._difference = self._difference + share * (difference - self._difference)
        self._speed = self._speed + share * ((length - self._length) / dt - self._speed)
        self._length = length
        correcting = np.maximum(np.sign(self._difference) * self._speed, 0.0)
        growth = self._growth(observation, np.abs(self._difference), correcting)
        is_full = correcting > FULL_SPEED * self._robot.description.speed
        growth = np.where(is_full | ~observation.sample.usable, -1.0, np.clip(growth, -1.0, 1.0))
        self._evidence = np.maximum(self._evidence + growth * dt, 0.0)
        if self._evidence.max() < FAULTY:
            return None
        muscle = int(self._evidence.argmax())
        text = self._text(observation, muscle)
        suspects = np.flatnonzero(self._evidence > 0.5 * FAULTY).tolist()
        others = tuple(other for other in suspects if other != muscle)
        return Finding(muscle, ConditionKind.MODULE_NOT_FOLLOWING, text, others)

    def _differences(self, observation: Observation) -> Array | None:
        """Return the differences T − T_ref between measured and demanded tensions [N], (M,).

        The result is None without a command.
        """
        if observation.demand is None:
            return None
        difference: Array = observation.sample.motor_tension - self._reference(observation.demand)
        return difference

    def _reference(self, demand: Array) -> Array:
        """Return the demanded tension T_ref [N], (M,): that of a command, but at most T_max."""
        return np.minimum(demand, self._robot.tension.max)

    def _growth(self, observation: Observation, away: Array, correcting: Array) -> Array:
        """Return the growth of the evidence against each module [s/s], (M,).

        The values are not yet limited to ±1.

        Args:
            observation: The message.
            away: Smoothed size of the difference [N], (M,).
            correcting: Speed of each winch in the direction that reduces the difference [m/s].
        """
        assert observation.demand is not None
        limit, demand = self._robot.tension.limit, self._reference(observation.demand)
        excess = away - limit * correcting / CORRECTING
        allowed = ALLOWED * limit + ALLOWED_SHARE * demand
        # Slack tendons, which even a slow winch may take up, are left to `slack_tendon.py`.
        is_slack = observation.sample.motor_tension < slack_tension(demand)
        growth: Array = (excess - allowed - SURE * observation.sample.tension_spread) / (
            CLEAR * limit
        )
        return np.where(is_slack, -1.0, growth)

    def _text(self, observation: Observation, muscle: int) -> str:
        assert observation.demand is not None
        tension, demand = observation.sample.motor_tension[muscle], observation.demand[muscle]
        return (
            f'its command demands {demand:.0f} N, but its reading is {tension:.0f} N: its motor is '
            'jammed or weak, its tension or length reading is wrong, or it gets no commands'
        )


class PositionFollowing(ModuleFollowing):
    """Reports a position-controlled module whose length does not follow the target length."""

    def _differences(self, observation: Observation) -> Array | None:
        """Return the differences l − l_target between measured and target lengths [m], (M,).

        The result is None without a command.
        """
        if observation.command is None:
            return None
        return observation.sample.length - observation.command

    def _growth(self, observation: Observation, away: Array, correcting: Array) -> Array:
        excess = away - LAG * correcting - BEHIND
        tension, most = observation.sample.motor_tension, self._robot.tension.max
        growth: Array = np.where(tension > FULL * most, -1.0, excess / CLEARLY_BEHIND)
        return growth

    def _text(self, observation: Observation, muscle: int) -> str:
        assert observation.command is not None
        away = 1e3 * (observation.sample.length[muscle] - observation.command[muscle])
        return (
            f'its length differs by {away:.0f} mm from the commanded length, and does not approach '
            'this length: its motor is jammed or weak, its length reading is wrong, or it gets no '
            'commands'
        )
