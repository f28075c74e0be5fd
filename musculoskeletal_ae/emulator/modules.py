# SPDX-License-Identifier: Apache-2.0
"""Muscle modules and sensors: what every emulated arm has, whatever its body is made of.

    MSC        T_ref = T_bias + max(0, K (l − l_target))      (paper, §III-E, eq. 5)
    motor      dl/dt = −gain (T_ref − T), within the speed limit and the length limits
    heat       C₁ ċ₁ = k T² − (c₁−c₂)/R₁,  C₂ ċ₂ = (c₁−c₂)/R₁ − (c₂−c_a)/R₂

l and T are those that the module's own sensors read.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
from numba import njit

from musculoskeletal_ae.arrays import Array, Bools, Ints
from musculoskeletal_ae.emulator.faults import SPEED_LIMIT, Faults, Readings
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.robot.kinematics import RACK, Kinematics
from musculoskeletal_ae.robot.robot import Robot

STEP = 0.001  # [s]

# What a module follows.
SAFE, FOLLOW_LENGTH, FOLLOW_TENSION = 0, 1, 2

# Chosen, plausible for Musashi's (not public).
RELEASE_RATE = 100.0  # [N/s] at which a module that went safe approaches T_bias
MOTOR_GAIN = 0.004  # [m/s/N]
# Heat: a motor suits its muscle; T_limit for good settles at 85 °C at the housing and 105 °C in the
# winding, of a mean module.
AMBIENT = 25.0  # [°C]
LOSS = 20.0  # [W] at T_limit
WINDING_CAPACITY, HOUSING_CAPACITY = 20.0, 150.0  # [J/K]
WINDING_RESISTANCE, HOUSING_RESISTANCE = 1.0, 3.0  # [K/W]
HEAT_SPREAD = 0.15  # standard deviation of the logarithm of each of the five, as of elastic units

# Sensors; chosen: noise is one standard deviation, then rounded to the
# resolution, a power of two as a converter's counts are.
ANGLE_NOISE, ANGLE_RESOLUTION = 0.001, 2.0**-12  # [rad]; times RACK [m] of what slides
LENGTH_NOISE, LENGTH_RESOLUTION = 1.0e-4, 2.0**-14  # [m]
TENSION_NOISE, TENSION_RESOLUTION = 1.0, 2.0**-3  # [N]
TEMPERATURE_NOISE, TEMPERATURE_RESOLUTION = 0.2, 2.0**-3  # [°C]
ACCELERATION_NOISE = 0.05  # [m/s²]
MARKER_NOISE, MARKER_TURN_NOISE = 0.002, 0.01  # [m], [rad]


def joint_gear(kinematics: Kinematics) -> Array:
    """Return what drag, stops and inertia of joint modules are multiplied by, (J,) of the tree.

    It is 1 where they turn a joint, and that of the pinion [1/m²] where they slide it.
    """
    gear: Array = np.where(kinematics.tree.prismatic, RACK**-2, 1.0)
    return gear


class Modules(NamedTuple):
    """Constants of the modules, each of shape (M,)."""

    length_low: Array  # l at the ends of what the motor can wind [m]
    length_high: Array
    stiffness: Array  # K of muscle stiffness control [N/m]
    tension_bias: Array  # [N]
    tension_max: Array
    loss: Array  # k [W/N²]
    winding_capacity: Array  # C₁ [J/K]
    housing_capacity: Array  # C₂
    winding_resistance: Array  # R₁ [K/W]
    housing_resistance: Array  # R₂


class Command(NamedTuple):
    """What the modules follow and what is wrong with them, each of shape (M,)."""

    value: Array  # target lengths [m] or tensions [N]
    length_error: Array  # reading of the length sensor minus the true l [m]
    stuck: Array  # share of its speed that the motor lacks
    slack: Array  # by how much the wire is too long [m]
    zero: Array  # by how much more the length sensor is off [m]
    hot: Array  # least temperature of the housing [°C]


class MuscleState(NamedTuple):
    """What changes, each of shape (M,); the compiled step writes into it."""

    length: Array  # l at the motor, true [m]
    tension: Array  # T at the motor, true [N]
    end_tension: Array  # T at the elastic unit [N]
    sliding: Array  # friction state s in [−1, 1]
    winding: Array  # c₁ [°C]
    housing: Array  # c₂ [°C]
    reference: Array  # T_ref of the module [N]
    ruptured: Array  # 1 where the wire is cut


@njit(cache=True)
def rubbed(state: float, moved: float, distance: float) -> float:
    """Return Dahl's state of friction in [−1, 1] after `moved`; `distance` turns it round."""
    direction = 1.0 if moved > 0.0 else -1.0
    return direction + (state - direction) * math.exp(-abs(moved) / distance)


@njit(cache=True)
def wind(
    modules: Modules, muscle: MuscleState, kind: int, command: Command, m: int,
    reading: float, pull: float,
) -> float:  # fmt: skip
    """Let motor m act on what its sensors read [m], [N]; return how much it wound in [m]."""
    before, last, bias = muscle.length[m], muscle.reference[m], modules.tension_bias[m]
    if kind == FOLLOW_LENGTH:
        desired = bias + max(0.0, modules.stiffness[m] * (reading - command.value[m]))
    elif kind == FOLLOW_TENSION:
        desired = max(0.0, command.value[m])
    else:
        change = STEP * RELEASE_RATE
        desired = last + min(change, max(-change, bias - last))
    muscle.reference[m] = min(modules.tension_max[m], desired)
    speed = -MOTOR_GAIN * (muscle.reference[m] - pull)
    if muscle.ruptured[m] > 0.0:
        speed = -SPEED_LIMIT
    most = SPEED_LIMIT * (1.0 - command.stuck[m])
    speed = min(most, max(-most, speed))
    after = min(modules.length_high[m], max(modules.length_low[m], before + STEP * speed))
    muscle.length[m] = after
    return before - after


@njit(cache=True)
def heat(modules: Modules, muscle: MuscleState, command: Command, m: int) -> None:
    """Warm module m by its tension for one step."""
    inner = (muscle.winding[m] - muscle.housing[m]) / modules.winding_resistance[m]
    outer = (muscle.housing[m] - AMBIENT) / modules.housing_resistance[m]
    loss = modules.loss[m] * muscle.tension[m] * muscle.tension[m]
    muscle.winding[m] += STEP * (loss - inner) / modules.winding_capacity[m]
    muscle.housing[m] += STEP * (inner - outer) / modules.housing_capacity[m]
    muscle.housing[m] = max(muscle.housing[m], command.hot[m])


def seen_by_camera(pose: pin.SE3, rng: np.random.Generator) -> pin.SE3:
    """Return a pose as a camera sees the marker, with its noise."""
    turn = pin.exp3(rng.normal(0.0, MARKER_TURN_NOISE, 3))
    shift = rng.normal(0.0, MARKER_NOISE, 3)
    return pin.SE3(pose.rotation @ turn, pose.translation + shift)


def felt_at_rest(robot: Robot, theta: Array, link: str, rng: np.random.Generator) -> Array:
    """Return what an accelerometer in a link's axes reads of a resting arm [m/s²], shape (3,)."""
    turn = robot.kinematics.link_pose(theta, link).rotation
    held: Array = -turn.T @ robot.kinematics.model.gravity.linear
    return held + rng.normal(0.0, ACCELERATION_NOISE, 3)


def noisy(
    value: Array, noise: Array | float, resolution: Array | float, rng: np.random.Generator
) -> Array:
    """Return a value as a sensor reads it."""
    read: Array = value + rng.normal(0.0, noise, value.shape)
    return np.rint(read / resolution) * resolution


class Arm(ABC):
    """An arm that plays reality behind the topics."""

    individual: Any  # the true body that a seed picked
    warnings: tuple[str, ...] = ()  # what a person who starts it should know
    #: angles and velocities of all joints, and where those of θ stand in either
    _angles: Array
    _rates: Array
    _order: Ints

    def __init__(self, robot: Robot, seed: int, length_bias: Array) -> None:
        """Build the modules, whose length sensors are off by `length_bias` [m] (M,)."""
        self.robot, self._length_bias = robot, length_bias
        self.command_timeout = 0.5  # [s] without a command until the modules go safe
        self._rng = np.random.default_rng([seed, 0x5E45])
        self._heat_rng = np.random.default_rng([seed, 0x4EA7])
        self.faults = Faults(robot, np.random.default_rng([seed, 0xFA17]))
        self._wrench = np.zeros(6)
        self._command = Command(
            np.zeros(robot.muscle_count), length_bias.copy(), self.faults.stuck,
            self.faults.slack, self.faults.zero, self.faults.hot,
        )  # fmt: skip
        self._muscle = MuscleState(*(np.zeros(robot.muscle_count) for _ in MuscleState._fields))

    def _modules(self, span: Array, stretch: Array) -> Modules:
        """Return the constants, for lengths [m] (N, M) of postures and L_e at T_max [m] (M,)."""
        low, high = span.min(axis=0) - stretch - 0.05, span.max(axis=0) + 0.05
        tension = self.robot.tension
        loss = LOSS / tension.limit**2
        mean = loss, WINDING_CAPACITY, HOUSING_CAPACITY, WINDING_RESISTANCE, HOUSING_RESISTANCE
        spread = self._heat_rng.normal(0.0, HEAT_SPREAD, (5, self.robot.muscle_count))
        warmth = (one * np.exp(factor) for one, factor in zip(mean, spread, strict=True))
        return Modules(low, high, self.robot.stiffness, tension.bias, tension.max, *warmth)

    def reset(self, theta: Array | None = None) -> None:
        """Put the arm at rest at θ (default: hanging, θ = 0 within the limits), free, mended, cool.

        Payload, length offsets and `faults` stay as set.
        """
        posture = np.zeros(self.robot.joint_count) if theta is None else np.asarray(theta, float)
        self._stand(np.clip(posture, self.robot.lower, self.robot.upper))
        self._wrench[:] = 0.0
        self._muscle.sliding[:] = 0.0
        self._muscle.ruptured[:] = 0.0
        self._muscle.reference[:] = self.robot.tension.bias
        self._muscle.winding[:] = AMBIENT
        self._muscle.housing[:] = AMBIENT
        self._attach(np.ones(self.robot.muscle_count, dtype=bool))
        self._kind = SAFE
        self._age = 0.0

    def _attach(self, which: Bools) -> None:
        """Wind the given muscles so that they carry T_bias in the present posture."""
        bias = self.robot.tension.bias
        length = self.individual.muscle_lengths(self.theta[None], bias)[0] - self.faults.slack
        self._muscle.length[which] = length[which]
        self._muscle.tension[which] = bias[which]
        self._muscle.end_tension[which] = bias[which]

    @abstractmethod
    def _stand(self, theta: Array) -> None:
        """Put the bones at rest at θ [rad] (D,)."""

    @property
    def theta(self) -> Array:
        """True joint angles [rad], shape (D,): what errors are measured against."""
        angles: Array = self._angles[self._order]
        return angles

    @property
    def velocity(self) -> Array:
        """True joint velocities [rad/s], shape (D,)."""
        rates: Array = self._rates[self._order]
        return rates

    @property
    def tension(self) -> Array:
        """True muscle tensions at the modules [N], shape (M,)."""
        return self._muscle.tension.copy()

    @property
    def end_tension(self) -> Array:
        """True tensions where the wires act on bones [N], shape (M,)."""
        return self._muscle.end_tension.copy()

    @property
    def winding(self) -> Array:
        """True temperatures of the motors' windings [°C], shape (M,)."""
        return self._muscle.winding.copy()

    @property
    def broken(self) -> bool:
        """Whether forces beyond all bounds left no posture that is a number, until `reset`."""
        return not np.isfinite(self.theta).all()

    @property
    def safe(self) -> bool:
        """Whether the modules went safe for want of commands."""
        return self._kind == SAFE

    def command_length(self, length: Array) -> None:
        """Follow target lengths [m], shape (M,), by muscle stiffness control."""
        self._follow(FOLLOW_LENGTH, length)

    def command_tension(self, tension: Array) -> None:
        """Follow target tensions [N], shape (M,)."""
        self._follow(FOLLOW_TENSION, tension)

    def _follow(self, kind: int, value: Array) -> None:
        self._kind, self._age = kind, 0.0
        self._command.value[:] = value

    @abstractmethod
    def set_payload(self, mass: float) -> None:
        """Put a mass [kg] into the hand, as a ball of 5 cm radius at the end effector."""

    def set_wrench(self, wrench: Array) -> None:
        """Push the end effector with force [N] and torque [N·m], axes of the root link, (6,)."""
        self._wrench[:] = wrench

    def set_length_offset(self, offset: Array | Sequence[float]) -> None:
        """Shift the length sensors as re-wiring does: by one offset [m] for all, or one for each.

        Raises:
            MusculoskeletalError: If there are other numbers of them; nothing changes then.
        """
        if len(offset) not in (1, self.robot.muscle_count):
            legal = f'1 or {self.robot.muscle_count} numbers [m]'
            raise MusculoskeletalError(f'{list(offset)}; legal: {legal}')
        self._command.length_error[:] = self._length_bias + np.asarray(offset)

    def set_ruptured(self, muscles: Iterable[str]) -> None:
        """Cut the named muscles and mend all others, which take up T_bias where they are.

        Raises:
            MusculoskeletalError: If there is no such muscle; nothing changes then.
        """
        cut = np.zeros(self.robot.muscle_count, dtype=bool)
        cut[self.robot.muscle_indices(muscles)] = True
        mended = (self._muscle.ruptured > 0.0) & ~cut
        self._muscle.ruptured[:] = cut
        self._attach(mended)

    def set_faults(self, lines: Iterable[str]) -> None:
        """Break what the lines say and mend all else; wires made shorter take up T_bias.

        Raises:
            MusculoskeletalError: If one says nothing legal; nothing changes then.
        """
        before = self.faults.slack.copy()
        self.faults.set(lines)
        self._attach((self.faults.slack < before) & (self._muscle.ruptured == 0.0))

    def step(self, duration: float) -> None:
        """Let time pass [s], in whole steps of `STEP`."""
        for _ in range(round(duration / STEP)):
            self._age += STEP
            if self._age > self.command_timeout:
                self._kind = SAFE
            self._step()

    @abstractmethod
    def _step(self) -> None:
        """Let one `STEP` pass."""

    @abstractmethod
    def _sensed(self) -> tuple[Array, Array, Array, Array]:
        """Return θ [rad] (D,), l [m], T [N] and temperatures [°C] (M,), wrong but without noise."""

    def sense(self) -> Readings:
        """Read all sensors once, with their noise, bias, resolution and faults."""
        theta, length, tension, housing = self._sensed()
        cut, rng, radian = self._muscle.ruptured > 0.0, self._rng, self.robot.kinematics.radian
        # A cut wire pulls on no sensor, and a tension unit does not read below zero.
        pull = noisy(np.where(cut, 0.0, tension), TENSION_NOISE, TENSION_RESOLUTION, rng)
        readings = Readings(
            noisy(theta, ANGLE_NOISE * radian, ANGLE_RESOLUTION * radian, rng),
            noisy(length, LENGTH_NOISE, LENGTH_RESOLUTION, rng),
            np.where(cut, 0.0, np.maximum(pull, 0.0)),
            noisy(housing, TEMPERATURE_NOISE, TEMPERATURE_RESOLUTION, rng),
        )
        return self.faults.sensed(readings)

    @property
    def hand(self) -> pin.SE3:
        """True pose of the end effector in the root link's frame."""
        return self.robot.kinematics.end_effector_pose(self.theta)

    def marker_pose(self) -> pin.SE3:
        """See the end effector's pose in the root link's frame, with a camera's noise."""
        return seen_by_camera(self.hand, self._rng)

    def accelerometer(self, link: str) -> Array:
        """Return what an accelerometer in a link's axes reads at rest [m/s²], shape (3,)."""
        return felt_at_rest(self.robot, self.theta, link, self._rng)

    @abstractmethod
    def route_points(self) -> Array:
        """True route points in the root link's frame [m], shape (P, 3)."""
