# SPDX-License-Identifier: Apache-2.0
"""How muscle modules turn commands into tensions. `actuation` in muscles.yaml selects the kind.

    StiffnessControl   T = T_bias + max(0, K_stiff (l − l_target))   (paper, §III-E, eq. 5)
    PositionControl    l → l_target; T results from the stretch of the series elastic elements

l is the muscle length and T its tension, l_target the commanded length, and K_stiff the control
stiffness. Control, safe stop and detectors call `Robot.actuation` wherever the two kinds of modules
differ. They never ask which kind the arm has.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools
from musculoskeletal_ae.robot.muscle_file import POSITION, STIFFNESS

if TYPE_CHECKING:
    from musculoskeletal_ae.robot.robot import Robot

Choice = TypeVar('Choice')
#: a command: its kind (LENGTH or TENSION), and target lengths [m] or tensions [N]
Kinded = tuple[str, Array]

LENGTH, TENSION = 'length', 'tension'  # kinds of commands: target lengths, or target tensions

DESIRED_SHARE = 0.3  # assume and prefer tensions of this share of T_limit, as in a well-tensed arm
#: let rest feedback pay out a needlessly tense muscle under stiffness control by at most this [m];
#: it covers length errors and the tension that friction retains in a tendon
RELIEF = 0.01
#: let rest feedback pay out a muscle with a position-controlled module by at most this [m]; such a
#: module turns length errors of an untrained network into slack or into tension
SLACK = 0.03
#: Let a command to a position-controlled module use this fraction of the length by which its tendon
#: can stretch before the tension reaches T_limit. The remainder covers errors of L_e and the age of
#: T.
SHARE = 0.7
#: extrapolate a rise of the tension by this time [s]; it covers the age of T and the lag of the
#: module
AHEAD = 0.04
#: correct this fraction of the tension error by one length command to a position-controlled module
ADMITTANCE = 0.5
#: after the tension of a position-controlled module exceeded T_limit, let its shortest permitted
#: length command decrease at this speed [m/s]
RECOVERY = 0.01
DEPTH = 0.015  # wind a suspect muscle under stiffness control in by at most this [m]


class Actuation(ABC):
    """How the muscle modules of one arm turn commands into tensions, and what they measure.

    Attributes:
        follows_tensions: Whether the modules accept tension commands as well as length commands.
    """

    follows_tensions: bool

    def __init__(self, robot: Robot) -> None:
        """Describe the modules of `robot`, whose `tension.bias` must be 0 for isolated muscles."""
        self._robot = robot

    @property
    def _bias(self) -> Array:
        return self._robot.tension.bias

    # -- tensions that are known -----------------------------------------------------------------

    @property
    def assumed_tension(self) -> Array:
        """Tension that models and plans assume where none is measured [N], (M,).

        It is 30 % of T_limit (DESIRED_SHARE), but at least T_bias. `check_robot` also prefers
        tensions near this share of T_limit.
        """
        whole = self._robot.description.tension
        return np.maximum(whole.bias, DESIRED_SHARE * whole.limit)

    def known_tension(self, measured: Array) -> Array:
        """Return measured tensions [N], (..., M), or assumed tensions if none are measured."""
        if self._robot.tension_source.is_known:
            return measured
        return np.full_like(measured, self.assumed_tension)

    # -- commands and tensions -------------------------------------------------------------------

    def choose(self, by_stiffness: Choice, by_position: Choice) -> Choice:
        """Return `by_stiffness` under stiffness control, `by_position` under position control."""
        return by_stiffness if self.follows_tensions else by_position

    @property
    def kept_tension(self) -> Array:
        """Tension that the modules maintain even if no command winds in the tendon [N], (M,).

        It is T_bias under stiffness control. Position control maintains no tension.
        """
        return self.choose(self._bias, np.zeros_like(self._bias))

    @abstractmethod
    def demanded(self, length: Array, command: Array) -> Array | None:
        """Return the tensions that a length command demands [N], (M,), not limited to T_max.

        Return None if the modules follow positions, because a position demands no tension.

        Args:
            length: Measured lengths [m], (M,).
            command: Target lengths [m], (M,).
        """

    @abstractmethod
    def tension_per_length(self, tension: Array) -> Array:
        """Return how much tension one metre of a shorter length command adds [N/m], (M,).

        Args:
            tension: The present tensions [N], (M,).
        """

    @abstractmethod
    def command_for(self, length: Array, tension: Array, wanted: Array) -> Kinded:
        """Return a command that moves the tensions towards the wanted tensions.

        Args:
            length: Present lengths [m], (M,).
            tension: Present tensions [N], (M,).
            wanted: The wanted tensions [N], (M,).

        Returns:
            LENGTH and target lengths [m], or TENSION and target tensions [N], (M,).
        """

    def present_tension(self, length: Array, command: Array, tension: Array) -> Array:
        """Return the tension command that can replace a length command without a jump [N], (M,).

        Args:
            length: Measured lengths [m], (M,).
            command: Target lengths of the length command [m], (M,).
            tension: Measured tensions [N], (M,).
        """
        demand = self.demanded(length, command)
        return np.maximum(tension, self._bias) if demand is None else demand

    def is_pulling(self, length: Array, command: Array) -> Bools:
        """Return which modules follow their target length instead of maintaining T_bias, (M,).

        Args:
            length: Measured lengths [m], (M,).
            command: Target lengths [m], (M,).
        """
        pulling: Bools = length > command
        return self.choose(pulling, np.ones_like(pulling))

    def tension_of_lag(self, lag: float, speed: Array) -> Array:
        """Return by how much the tension of a muscle that is paid out exceeds T_bias [N], (M,).

        A module under stiffness control that pays out at a speed lags behind its command by the
        length `lag` times speed. The control stiffness converts this length into a tension.
        Position-controlled drives pay out without tension.

        Args:
            lag: Time by which the modules lag behind their commands [s].
            speed: Speed at which the modules pay out [m/s], (M,); not negative.
        """
        if not self.follows_tensions:
            return np.zeros_like(speed)
        return self._robot.stiffness * lag * speed

    def fastest(self, rate_limit: float) -> Array:
        """Return the rate limit of each length command [m/s], (M,).

        This is `rate_limit` [m/s], or the speed of the module if it is lower.
        """
        return np.minimum(rate_limit, self._robot.description.speed)

    # -- limits ----------------------------------------------------------------------------------

    @property
    def largest_relief(self) -> float:
        """Largest length by which rest feedback pays out a muscle that is too tense [m]."""
        return self.choose(RELIEF, SLACK)

    @abstractmethod
    def depth(self, tension: Array, rate: Array, limit: Array) -> Array:
        """Return by how much a command may be shorter than the measured length [m], (M,).

        A tension that is about to exceed its limit makes the value small. The value is negative
        where the muscle has to be paid out.

        Args:
            tension: Tensions [N], (M,).
            rate: Rates of change of the tensions [N/s], (M,).
            limit: Tension limits [N], (M,).
        """

    @abstractmethod
    def largest_depth(self, limit: Array) -> Array:
        """Return the largest value that `depth` can have at any tension [m], (M,).

        Args:
            limit: Tension limits [N], (M,).
        """

    def usable_lead(self, lead: Array | float) -> Array | float:
        """Return by how much a command to a lagging module may exceed `depth` [m].

        Under stiffness control, it is the whole lead, because a module stops winding in at the
        demanded tension. A position-controlled module would follow a leading command even if the
        arm were blocked.

        Args:
            lead: Lag of each module behind its command while it winds in [m], scalar or (M,).
        """
        return self.choose(lead, 0.0)

    def recovered(self, shortest: Array, dt: float) -> Array:
        """Return the shortest permitted commands after a tension exceeded its limit [m], (M,).

        Under stiffness control, this is no restriction (−∞), because the modules regulate the
        tension by themselves. With position control, the commands decrease by 10 mm/s: paying out
        reverses the friction of the tendon, so the tension falls by far more than the elastic
        elements explain. If the module wound in again at full speed, the tension would exceed its
        limit again before the next reading arrives.

        Args:
            shortest: Shortest lengths that were permitted at the last call [m], (M,).
            dt: Time since the last call [s].
        """
        return self.choose(np.full_like(shortest, -np.inf), shortest - RECOVERY * dt)

    @property
    def release(self) -> Array:
        """Length that a stop pays out where no tension is measured [m], (M,).

        By default it is the length that lowers the tension from T_limit to T_bias in the same
        posture.
        """
        robot, whole = self._robot, self._robot.description.tension
        usual = robot.elongation(whole.limit) - robot.elongation(whole.bias)
        stated = robot.description.release
        return np.where(np.isnan(stated), usual, stated)

    @abstractmethod
    def released(
        self, last: Array, start: Array, length: Array, tension: Array, longest: Array,
        is_fresh: bool,
    ) -> Array:  # fmt: skip
        """Return the lengths to which a stop pays the muscles out [m], (M,).

        Args:
            last: The last length command [m], (M,).
            start: Lengths at which paying out started [m], (M,).
            length: Measured lengths [m], (M,).
            tension: Measured tensions [N], (M,).
            longest: Length at which each muscle is slack in any posture [m], (M,).
            is_fresh: Whether the measured lengths and tensions are up to date.
        """

    @abstractmethod
    def rise(self, muscle: int, length: float, command: float, tension: float) -> float:
        """Return by how much the tension of a suspect muscle that is wound in exceeds T_bias [N].

        Args:
            muscle: Index of the muscle.
            length: Measured length [m].
            command: Target length [m].
            tension: Measured tension [N].
        """

    def winding_depth(self, muscle: int) -> float:
        """Return the length [m] by which `muscle` may be wound in while it is verified.

        The limit applies whatever the sensors of the suspect muscle read. It is DEPTH under
        stiffness control, and `release` with position control.
        """
        return DEPTH if self.follows_tensions else float(self.release[muscle])


class StiffnessControl(Actuation):
    """Modules under muscle stiffness control, which maintain T_bias by themselves."""

    follows_tensions = True

    def demanded(self, length: Array, command: Array) -> Array:
        """Return the tensions that a length command demands [N], (M,).

            T = T_bias + max(0, K_stiff (l − l_target))

        K_stiff is the control stiffness of each module.

        Args:
            length: Measured lengths l [m], (M,).
            command: Target lengths l_target [m], (M,).
        """
        demand: Array = self._bias + np.maximum(0.0, self._robot.stiffness * (length - command))
        return demand

    def tension_per_length(self, tension: Array) -> Array:  # noqa: ARG002
        """Return the control stiffness K_stiff of each module [N/m], (M,), at any tension."""
        return self._robot.stiffness

    def command_for(self, length: Array, tension: Array, wanted: Array) -> Kinded:  # noqa: ARG002
        """Return a tension command of `wanted` [N], (M,), because these modules follow tensions."""
        return TENSION, wanted

    def depth(self, tension: Array, rate: Array, limit: Array) -> Array:  # noqa: ARG002
        """Return by how much [m] a command is shorter than l if it demands `limit`, (M,)."""
        return self.largest_depth(limit)

    def largest_depth(self, limit: Array) -> Array:
        """Return the largest `depth` [m] for any T and dT/dt, (M,)."""
        depth: Array = (limit - self._bias) / self._robot.stiffness
        return depth

    def released(
        self, last: Array, start: Array, length: Array, tension: Array, longest: Array,  # noqa: ARG002
        is_fresh: bool,
    ) -> Array:  # fmt: skip
        """Return the lengths to which a stop pays the muscles out [m], (M,).

        These are the measured lengths, because a command equal to the length demands only T_bias.
        If the measured lengths are out of date, `longest` is returned where it is longer. Isolated
        muscles are paid out to `longest` at most.
        """
        # If the length is out of date, the muscle is paid out to its largest possible length.
        end = length if is_fresh else np.maximum(length, longest)
        # The length sensor of an isolated muscle may be faulty, so its reading is limited.
        return np.where(self._robot.used, end, np.minimum(end, longest))

    def rise(self, muscle: int, length: float, command: float, tension: float) -> float:
        """Return by how much the higher of measured and demanded tension exceeds T_bias [N].

        The demanded tension follows from the measured length and the length command, both [m].
        """
        measured = tension - self._robot.description.tension.bias[muscle]
        return float(max(measured, self._robot.stiffness[muscle] * (length - command)))


class PositionControl(Actuation):
    """Position-controlled modules, which maintain no tension by themselves."""

    follows_tensions = False

    def demanded(self, length: Array, command: Array) -> None:  # noqa: ARG002
        """Return None, because a position demands no particular tension."""
        return

    def tension_per_length(self, tension: Array) -> Array:
        """Return the stiffness of series elastic element and tendon of each muscle [N/m], (M,)."""
        at_zero = self._robot.routes.length_at_zero
        stiffness: Array = 1.0 / self._robot.series_elastic.compliance(at_zero, tension)
        return stiffness

    def command_for(self, length: Array, tension: Array, wanted: Array) -> Kinded:
        """Return a length command [m], (M,), that corrects half of the error of each tension.

        In the same posture, the length changes by as much as the elongation of series elastic
        element and tendon.
        """
        measured = np.maximum(tension, 0.0)
        goal = measured + ADMITTANCE * (wanted - measured)
        elongation = self._robot.elongation
        return LENGTH, length + elongation(measured) - elongation(goal)

    def depth(self, tension: Array, rate: Array, limit: Array) -> Array:
        """Return by how much a command may be shorter than the measured length [m], (M,).

        This is a part (SHARE) of the elongation that is left until the tension reaches its limit. A
        rising tension is first extrapolated by 0.04 s (AHEAD). Where the tension exceeds its limit,
        the value is negative: the elongation by which the muscle has to be paid out. If no tension
        is measured, the value is `release`.
        """
        if not self._robot.tension_source.is_known:
            return self.release
        elongation = self._robot.elongation
        depth = elongation(limit) - elongation(tension)
        soon = elongation(limit) - elongation(tension + AHEAD * np.maximum(rate, 0.0))
        return np.where(depth > 0.0, SHARE * np.maximum(soon, 0.0), depth)

    def largest_depth(self, limit: Array) -> Array:  # noqa: ARG002
        """Return `release` [m], (M,): the value of `depth` where no tension is known."""
        return self.release

    def released(
        self, last: Array, start: Array, length: Array, tension: Array, longest: Array,
        is_fresh: bool,
    ) -> Array:  # fmt: skip
        """Return the lengths to which a stop pays the muscles out [m], (M,), at most `longest`.

        At these lengths, the tension falls to T_bias. A muscle whose tension does not exceed T_bias
        keeps its command `last`. Where no tension is measured, or it is out of date, the result is
        `start` plus `release`.
        """
        robot, bias = self._robot, self._robot.description.tension.bias
        end = start + self.release
        if is_fresh and self._robot.tension_source.is_known:
            excess = robot.elongation(tension) - robot.elongation(bias)
            measured = length + np.maximum(excess, 0.0)
            # Where the tension does not exceed T_bias, the module keeps its last command.
            measured = np.where(tension > bias, np.maximum(measured, last), last)
            # The tension sensor of an isolated muscle may be faulty.
            end = np.where(robot.used, measured, end)
        return np.minimum(end, longest)

    def rise(self, muscle: int, length: float, command: float, tension: float) -> float:  # noqa: ARG002
        """Return by how much the measured tension of the muscle exceeds T_bias [N]."""
        return float(tension - self._robot.description.tension.bias[muscle])


ACTUATIONS: dict[str, type[Actuation]] = {STIFFNESS: StiffnessControl, POSITION: PositionControl}
