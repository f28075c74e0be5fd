# SPDX-License-Identifier: Apache-2.0
"""Muscle modules and sensors, which all emulated arms share.

    MSC        T_ref = T_bias + max(0, K (l − l_target))      (paper, §III-E, eq. 5)
    motor      dl/dt = −gain (T_ref − T), within the speed limit and the length limits
    position   dl/dt = (l_target − l)/POSITION_LAG, within the speed of the module; T ≤ T_max
    heat       C₁ ċ₁ = k T² − (c₁−c₂)/R₁,  C₂ ċ₂ = (c₁−c₂)/R₁ − (c₂−c_a)/R₂

MSC is muscle stiffness control with the stiffness K. Except for heat, l and T are the length and
tension that the module's own sensors read. `muscles.yaml` says whether the modules follow MSC or
positions (`actuation`). A module that follows a length by MSC winds in a slack tendon with up to
TAKE_UP_SPEED, even if T_bias is so small that the gain alone would be slower. A position-controlled
module holds its length while it gets no commands, and pays out while its tension exceeds T_max. c₁,
c₂ and c_a are the temperatures of winding, housing and surroundings, with the heat capacities C and
the thermal resistances R.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
from numba import njit

from musculoskeletal_ae.arrays import Array, Bools, Ints
from musculoskeletal_ae.emulator.faults import SPEED_LIMIT, ArmReadings, Faults
from musculoskeletal_ae.exceptions import DivergedError, MusculoskeletalError
from musculoskeletal_ae.robot.joint_units import SLIDE
from musculoskeletal_ae.robot.kinematics import Kinematics
from musculoskeletal_ae.robot.robot import Robot

STEP = 0.001  # duration of a simulation step [s]
#: count an arm as diverged, and stop simulating it, if a joint is faster than this [rad/s or m/s]
FASTEST = 1000.0

#: modes of a module: safe state, following a target length, following a target tension
SAFE, FOLLOW_LENGTH, FOLLOW_TENSION = 0, 1, 2

# The following values are chosen by hand, because those of Musashi are not public.
#: let a module in the safe state change its tension towards T_bias at this rate [N/s]
RELEASE_RATE = 100.0
MOTOR_GAIN = 0.004  # wind in at this speed for each newton of missing tension [m/s/N]
#: Wind in a tendon without tension at this speed [m/s], and more slowly as the tension rises, down
#: to 0 at half of T_bias. MOTOR_GAIN alone would be too slow for weak muscles: 2 mm/s with a T_bias
#: of 0.5 N.
TAKE_UP_SPEED = 0.03
#: let a position-controlled module follow its target length with this time constant [s]
POSITION_LAG = 0.02
# Heat. Each motor is sized for its muscle: constant T_limit heats the average module to 85 °C at
# the housing and 105 °C in the winding.
AMBIENT = 25.0  # temperature of the surroundings, to which all modules cool down [°C]
LOSS = 20.0  # heat that a motor produces at T_limit [W]
WINDING_CAPACITY, HOUSING_CAPACITY = 20.0, 150.0  # heat capacities of an average module [J/K]
#: thermal resistances of winding and housing of an average module [K/W]
WINDING_RESISTANCE, HOUSING_RESISTANCE = 1.0, 3.0
#: draw LOSS, capacities and resistances with this standard deviation of their logarithms
HEAT_SPREAD = 0.15

# Sensors. The values are chosen by hand. Each reading gets noise of this standard deviation, and is
# rounded to this resolution, a power of two as of an A/D converter.
ANGLE_NOISE, ANGLE_RESOLUTION = 0.001, 2.0**-12  # noise and resolution of joint angles [rad]
LENGTH_NOISE, LENGTH_RESOLUTION = 1.0e-4, 2.0**-14  # noise and resolution of muscle lengths [m]
TENSION_NOISE, TENSION_RESOLUTION = 1.0, 2.0**-3  # noise and resolution of tensions [N]
#: limit the noise of a tension sensor to this share of T_bias: sensors of weak muscles are finer
TENSION_NOISE_SHARE = 0.1
#: noise and resolution of housing temperatures [°C]
TEMPERATURE_NOISE, TEMPERATURE_RESOLUTION = 0.2, 2.0**-3
#: noise and resolution of a motor current, expressed as a tension [N]
CURRENT_NOISE, CURRENT_RESOLUTION = 1.0, 2.0**-3
#: draw errors of a motor current as a measure of tension: standard deviation of the scale's
#: logarithm, standard deviation of the offset [N], and mean drive friction as a share of T_limit
CURRENT_SCALE, CURRENT_ZERO, DRIVE_FRICTION = 0.15, 5.0, 0.1
ACCELERATION_NOISE = 0.05  # give accelerometer axes noise of this standard deviation [m/s²]
#: give a marker's position [m] and orientation [rad] noise of these standard deviations
MARKER_NOISE, MARKER_TURN_NOISE = 0.002, 0.01


def joint_gear(kinematics: Kinematics) -> Array:
    """Return the factor of damping, stop stiffness and motor inertia for each joint, (J,).

    The factor is 1 for revolute joints. A prismatic joint is driven by a pinion (`JointUnits`), so
    its factor is 1/RACK² [1/m²].
    """
    gear: Array = np.where(kinematics.tree.prismatic, SLIDE.radian**-2, 1.0)
    return gear


class Modules(NamedTuple):
    """Constants of the modules, each of shape (M,)."""

    length_low: Array  # shortest motor-side length that the motor can reach [m]
    length_high: Array  # longest motor-side length that the motor can reach [m]
    stiffness: Array  # K of muscle stiffness control [N/m]
    follows_position: Array  # 1 for a position-controlled module, 0 for muscle stiffness control
    speed: Array  # largest speed at which the module can wind [m/s]
    tension_bias: Array  # tension bias T_bias [N]
    tension_max: Array  # tension maximum T_max [N]
    loss: Array  # heat per squared tension, k [W/N²]
    winding_capacity: Array  # heat capacity C₁ of the winding [J/K]
    housing_capacity: Array  # heat capacity C₂ of the housing [J/K]
    winding_resistance: Array  # thermal resistance R₁ between winding and housing [K/W]
    housing_resistance: Array  # thermal resistance R₂ between housing and surroundings [K/W]


class Command(NamedTuple):
    """Commands to the muscle modules, and the faults to emulate, each of shape (M,)."""

    value: Array  # target lengths [m] or tensions [N]
    length_error: Array  # reading of the length sensor minus the true l [m]
    stuck: Array  # share of its speed that each motor loses; 1 for a jammed one
    slack: Array  # excess length of the tendon [m]
    zero: Array  # offset that a fault adds to the reading of the length sensor [m]
    hot: Array  # lowest temperature of each housing that a fault imposes [°C]
    ceiling: Array  # highest reading of the tension sensor [N]


class MuscleState(NamedTuple):
    """State of the muscles, each of shape (M,); the compiled step writes to it."""

    length: Array  # true motor-side l [m]
    tension: Array  # true motor-side T [N]
    end_tension: Array  # true bone-side T_end [N]
    sliding: Array  # friction state s in [−1, 1]
    winding: Array  # temperature c₁ of the winding [°C]
    housing: Array  # temperature c₂ of the housing [°C]
    reference: Array  # tension T_ref that the control law of the module demands [N]
    ruptured: Array  # 1 for a ruptured tendon; `Faults` owns this array and alone changes it


@njit(cache=True)
def friction_state(state: float, moved: float, distance: float) -> float:
    """Return the new state of Dahl's friction model after sliding.

    At ±1, friction has its full size and opposes the motion.

    Args:
        state: State before, in [−1, 1].
        moved: Signed sliding distance [m] or [rad].
        distance: Sliding distance over which friction builds up, in the unit of `moved`.
    """
    direction = 1.0 if moved > 0.0 else -1.0
    return direction + (state - direction) * math.exp(-abs(moved) / distance)


@njit(cache=True)
def wind(
    modules: Modules, muscle: MuscleState, kind: int, command: Command, m: int,
    reading: float, tension: float,
) -> float:  # fmt: skip
    """Wind one module for one step of 1 ms, as its control law demands.

    Args:
        modules: Constants of all modules.
        muscle: State of all muscles, changed in place.
        kind: Mode of the modules: SAFE, FOLLOW_LENGTH or FOLLOW_TENSION.
        command: Commands to all modules, and their faults.
        m: Index of the module.
        reading: Length that the module's sensor reads [m].
        tension: Tension that the module's sensor reads [N].

    Returns:
        The length of tendon that was wound in [m]; negative if it was paid out.
    """
    tension = min(tension, command.ceiling[m])
    previous, bias = muscle.reference[m], modules.tension_bias[m]
    most = min(modules.speed[m], SPEED_LIMIT * (1.0 - command.stuck[m]))
    if modules.follows_position[m] > 0.0:
        speed = 0.0
        if kind == FOLLOW_LENGTH:
            speed = (command.value[m] - reading) / POSITION_LAG
        if tension > modules.tension_max[m]:
            speed = max(speed, MOTOR_GAIN * (tension - modules.tension_max[m]))
        return _turn(modules, muscle, m, min(most, max(-most, speed)))
    if kind == FOLLOW_LENGTH:
        desired = bias + max(0.0, modules.stiffness[m] * (reading - command.value[m]))
    elif kind == FOLLOW_TENSION:
        desired = max(0.0, command.value[m])
    else:
        change = STEP * RELEASE_RATE
        desired = previous + min(change, max(-change, bias - previous))
    muscle.reference[m] = min(modules.tension_max[m], desired)
    speed = -MOTOR_GAIN * (muscle.reference[m] - tension)
    if kind == FOLLOW_LENGTH and tension < 0.5 * bias:
        speed = min(speed, -TAKE_UP_SPEED * (1.0 - 2.0 * tension / bias))
    if muscle.ruptured[m] > 0.0:
        speed = -SPEED_LIMIT
    return _turn(modules, muscle, m, min(most, max(-most, speed)))


@njit(cache=True)
def _turn(modules: Modules, muscle: MuscleState, m: int, speed: float) -> float:
    """Turn motor m for one step of 1 ms, and return the length that was wound in [m].

    A positive `speed` [m/s] pays out. The motor stops at the length limits of the module.
    """
    before = muscle.length[m]
    after = min(modules.length_high[m], max(modules.length_low[m], before + STEP * speed))
    muscle.length[m] = after
    return before - after


@njit(cache=True)
def heat(modules: Modules, muscle: MuscleState, command: Command, m: int) -> None:
    """Update the temperatures of module m after one step of 1 ms at its present tension."""
    inner = (muscle.winding[m] - muscle.housing[m]) / modules.winding_resistance[m]
    outer = (muscle.housing[m] - AMBIENT) / modules.housing_resistance[m]
    loss = modules.loss[m] * muscle.tension[m] * muscle.tension[m]
    muscle.winding[m] += STEP * (loss - inner) / modules.winding_capacity[m]
    muscle.housing[m] += STEP * (inner - outer) / modules.housing_capacity[m]
    muscle.housing[m] = max(muscle.housing[m], command.hot[m])


def camera_reading(pose: pin.SE3, rng: np.random.Generator) -> pin.SE3:
    """Return a pose with the noise of a camera that observes the marker."""
    turn = pin.exp3(rng.normal(0.0, MARKER_TURN_NOISE, 3))
    shift = rng.normal(0.0, MARKER_NOISE, 3)
    return pin.SE3(pose.rotation @ turn, pose.translation + shift)


def accelerometer_reading(
    robot: Robot, theta: Array, link: str, rng: np.random.Generator, mount: Array | None = None
) -> Array:
    """Return the reading [m/s²] (3,) of an accelerometer in a link's axes while the arm rests.

    `mount` is the turn of the base (`Faults.mount`), (3, 3); by default, there is none.
    """
    turn = robot.kinematics.link_pose(theta, link).rotation
    if mount is not None:
        turn = mount @ turn
    held: Array = -turn.T @ robot.kinematics.model.gravity.linear
    return held + rng.normal(0.0, ACCELERATION_NOISE, 3)


def noisy(
    value: Array, noise: Array | float, resolution: Array | float, rng: np.random.Generator
) -> Array:
    """Return a sensor's reading of a value: with noise, rounded to the resolution."""
    read: Array = value + rng.normal(0.0, noise, value.shape)
    return np.rint(read / resolution) * resolution


class Arm(ABC):
    """An emulated arm that takes the place of the hardware."""

    individual: Any  # the true body that the seed selects
    _angles: Array  # positions of all joints of the tree [rad] or [m]
    _rates: Array  # velocities of all joints of the tree [rad/s] or [m/s]
    _order: Ints  # indices of the joints of θ in `_angles` and `_rates`

    def __init__(self, robot: Robot, seed: int, length_bias: Array) -> None:
        """Build the modules of the individual `seed`.

        `length_bias` [m] (M,) are the offsets of their length sensors.
        """
        self.robot, self._length_bias = robot, length_bias
        #: time without a command after which the modules go to their safe state [s]
        self.command_timeout = 0.5
        self._rng = np.random.default_rng([seed, 0x5E45])
        self._heat_rng = np.random.default_rng([seed, 0x4EA7])
        self.faults = Faults(robot, np.random.default_rng([seed, 0xFA17]))
        rng, count = np.random.default_rng([seed, 0xD21E]), robot.muscle_count
        #: errors of motor currents: factor of the tension, offset [N] and drive friction [N], (M,)
        self._current_scale = np.exp(rng.normal(0.0, CURRENT_SCALE, count))
        self._current_zero = rng.normal(0.0, CURRENT_ZERO, count)
        share = DRIVE_FRICTION * rng.uniform(0.5, 1.5, count)
        self._drive_friction: Array = share * robot.description.tension.limit
        self._mount = self.faults.mount  # present turn of the base, as a rotation matrix
        self._wrench = np.zeros(6)
        self._command = Command(
            np.zeros(robot.muscle_count), length_bias.copy(), self.faults.stuck,
            self.faults.slack, self.faults.zero, self.faults.hot, self.faults.ceiling,
        )  # fmt: skip
        muscle = MuscleState(*(np.zeros(robot.muscle_count) for _ in MuscleState._fields))
        self._muscle = muscle._replace(ruptured=self.faults.ruptured)

    def _make_modules(self, span: Array, stretch: Array) -> Modules:
        """Make the modules' constants.

        Args:
            span: Route lengths relative to those at θ = 0 [m], in N postures, (N, M).
            stretch: Elongation of each series elastic element and tendon at T_max [m], (M,).
        """
        low, high = span.min(axis=0) - stretch - 0.05, span.max(axis=0) + 0.05
        tension = self.robot.tension
        loss = LOSS / tension.limit**2
        mean = loss, WINDING_CAPACITY, HOUSING_CAPACITY, WINDING_RESISTANCE, HOUSING_RESISTANCE
        spread = self._heat_rng.normal(0.0, HEAT_SPREAD, (5, self.robot.muscle_count))
        thermal = (one * np.exp(factor) for one, factor in zip(mean, spread, strict=True))
        robot, ones = self.robot, np.ones(self.robot.muscle_count)
        follows = ones * robot.actuation.choose(0.0, 1.0)
        speed = robot.actuation.fastest(SPEED_LIMIT)
        limits = tension.bias, tension.max
        return Modules(low, high, robot.stiffness, follows, speed, *limits, *thermal)

    def reset(self, theta: Array | None = None) -> None:
        """Reset the arm to rest and to ambient temperature.

        The external wrench ends. All muscles carry T_bias, and the modules wait for the first
        command. Payload, length offsets and `faults` do not change.

        Args:
            theta: Joint angles [rad], (D,), which are clipped to the joint limits; by default 0.
        """
        posture = np.zeros(self.robot.joint_count) if theta is None else np.asarray(theta, float)
        self._stand(np.clip(posture, self.robot.lower, self.robot.upper))
        self._wrench[:] = 0.0
        self._muscle.sliding[:] = 0.0
        self._muscle.reference[:] = self.robot.tension.bias
        self._muscle.winding[:] = AMBIENT
        self._muscle.housing[:] = AMBIENT
        self._attach(np.ones(self.robot.muscle_count, dtype=bool))
        self._kind = SAFE
        self._age = 0.0

    def _attach(self, which: Bools) -> None:
        """Attach the muscles that are True in `which` (M,), so that they carry T_bias now."""
        bias = self.robot.tension.bias
        length = self.individual.muscle_lengths(self.theta[None], bias)[0] - self.faults.slack
        self._muscle.length[which] = length[which]
        self._muscle.tension[which] = bias[which]
        self._muscle.end_tension[which] = bias[which]

    @abstractmethod
    def _stand(self, theta: Array) -> None:
        """Set the joint angles to θ [rad], (D,), with all joints at rest."""

    @property
    def theta(self) -> Array:
        """True joint angles [rad], shape (D,), the reference for all errors."""
        angles: Array = self.robot.units.to_theta(self._angles[self._order])
        return angles

    @property
    def velocity(self) -> Array:
        """True joint velocities [rad/s], shape (D,)."""
        rates: Array = self.robot.units.to_theta(self._rates[self._order])
        return rates

    @property
    def tension(self) -> Array:
        """True motor-side tensions [N], shape (M,)."""
        return self._muscle.tension.copy()

    @property
    def end_tension(self) -> Array:
        """True bone-side tensions [N], shape (M,)."""
        return self._muscle.end_tension.copy()

    @property
    @abstractmethod
    def tendon_friction(self) -> Array:
        """Friction μ of each tendon along its route in the present posture, shape (M,)."""

    @property
    def winding(self) -> Array:
        """True temperatures of the motor windings [°C], shape (M,)."""
        return self._muscle.winding.copy()

    @property
    def divergence(self) -> str:
        """How the arm has diverged, with cause and remedy; '' if it has not. `reset` ends this.

        An arm has diverged if a joint is so fast (FASTEST) that it cannot be simulated.
        """
        speed = np.abs(self._rates[self._order])
        if speed.max() <= FASTEST:  # false if a speed is NaN
            return ''
        j = int(np.flatnonzero(~(speed <= FASTEST))[0])
        unit = self.robot.units[j].position
        problem = f'joint {self.robot.joints[j]} moves at {speed[j]:.4g} {unit}/s'
        return f'{problem}; legal: at most {FASTEST:g}. {self._divergence_cause()}'

    def check(self) -> None:
        """Check that the simulation is valid.

        Raises:
            DivergedError: If the arm has diverged.
        """
        if divergence := self.divergence:
            raise DivergedError(f'the emulated arm has diverged: {divergence}')

    def _divergence_cause(self) -> str:
        """Return sentences with the probable cause of a divergence, and its remedy."""
        return (
            'The forces on the arm exceed what its inertia can carry in steps of 1 ms; reduce the '
            'external wrench and `tension.limit`, or increase the inertia of the links'
        )

    @property
    def safe(self) -> bool:
        """Whether the modules are in the safe state, because the last command is too old."""
        return self._kind == SAFE

    def command_length(self, length: Array) -> None:
        """Let the modules follow target lengths [m], shape (M,).

        The robot description says whether they use muscle stiffness control or position control.
        """
        self._follow(FOLLOW_LENGTH, length)

    def command_tension(self, tension: Array) -> None:
        """Let the modules follow target tensions [N], shape (M,).

        Raises:
            MusculoskeletalError: If the modules follow positions; nothing changes then.
        """
        if not self.robot.actuation.follows_tensions:
            raise MusculoskeletalError(
                'with actuation: position, the modules follow lengths only; publish '
                'muscle_length_command instead of muscle_tension_command'
            )
        self._follow(FOLLOW_TENSION, tension)

    def _follow(self, kind: int, value: Array) -> None:
        self._kind, self._age = kind, 0.0
        self._command.value[:] = value

    @abstractmethod
    def set_payload(self, mass: float) -> None:
        """Set the payload: a ball of this mass [kg] and 5 cm radius at the end effector."""

    @property
    @abstractmethod
    def friction(self) -> Array:
        """Friction of the tendons (`kin`) or of the joints (`foreign`); may be changed in place."""

    def set_wrench(self, wrench: Array) -> None:
        """Set the force [N] and torque [N·m] on the end effector, in the root link's axes, (6,)."""
        self._wrench[:] = wrench

    def set_length_offset(self, offset: Array) -> None:
        """Set offsets of the length sensors [m], (M,), in addition to those of the individual.

        They replace offsets set earlier, and the drift of the sensors so far.
        """
        self._command.length_error[:] = self._length_bias + offset

    def set_faults(self, lines: Iterable[str]) -> None:
        """Set the active faults to those that the lines describe.

        Muscles whose tendon becomes shorter or whole, because a fault 'slack' or 'rupture' ends,
        return to T_bias.

        Raises:
            MusculoskeletalError: If a line is not legal; nothing changes then.
        """
        slack, ruptured = self.faults.slack.copy(), self.faults.ruptured.copy()
        self.faults.set(lines)
        is_mended = (self.faults.slack < slack) | (self.faults.ruptured < ruptured)
        self._attach(is_mended & (self.faults.ruptured == 0.0))

    def step(self, duration: float) -> None:
        """Advance the time by `duration` [s], rounded to whole steps of 1 ms."""
        if self.faults.mount is not self._mount:
            self._mount = self.faults.mount
            self._turn_gravity(self._mount)
        self.faults.pass_time(duration)
        for _ in range(round(duration / STEP)):
            self._age += STEP
            if self._age > self.command_timeout:
                self._kind = SAFE
            if self.divergence:
                return
            self._step()

    @abstractmethod
    def _step(self) -> None:
        """Advance the time by one step of 1 ms."""

    @abstractmethod
    def _turn_gravity(self, mount: Array) -> None:
        """Turn the gravity of the simulation as for a base turned by `mount` (`Faults.mount`)."""

    @abstractmethod
    def _raw_readings(self) -> ArmReadings:
        """Return the readings of all sensors without noise, rounding and faults."""

    def sense(self) -> ArmReadings:
        """Read all sensors once, with noise, bias, resolution and faults."""
        theta, muscles = self._raw_readings()
        ruptured, rng = self._muscle.ruptured > 0.0, self._rng
        # The tension sensor of a ruptured muscle reads 0; no tension sensor reads less than 0.
        finest = TENSION_NOISE_SHARE * self.robot.description.tension.bias
        fineness = np.minimum(1.0, finest / TENSION_NOISE)
        noise, resolution = fineness * TENSION_NOISE, fineness * TENSION_RESOLUTION
        measured = noisy(np.where(ruptured, 0.0, muscles.tension), noise, resolution, rng)
        theta = noisy(theta, ANGLE_NOISE, ANGLE_RESOLUTION, rng)
        read = muscles.replace(
            length=noisy(muscles.length, LENGTH_NOISE, LENGTH_RESOLUTION, rng),
            tension=np.where(ruptured, 0.0, np.maximum(measured, 0.0)),
            temperature=noisy(muscles.temperature, TEMPERATURE_NOISE, TEMPERATURE_RESOLUTION, rng),
        )
        if self.robot.tension_source.is_current:
            read.tension = self._read_currents(muscles.tension)
        readings = self.faults.apply(ArmReadings(theta, read))
        readings.muscles.tension = self.robot.tension_source.known(readings.muscles.tension)
        return readings

    def _read_currents(self, tension: Array) -> Array:
        """Read the tensions that noisy motor currents indicate [N], (M,).

        These tensions include the friction of the drive, which a motor carries in addition to the
        tension of its tendon.

        Args:
            tension: Tensions without noise [N], (M,), as from `_raw_readings`.
        """
        muscle = self._muscle
        load = np.where(muscle.ruptured > 0.0, 0.0, tension)
        load = load + self._drive_friction * muscle.sliding
        read = self._current_scale * load + self._current_zero
        return noisy(read, CURRENT_NOISE, CURRENT_RESOLUTION, self._rng)

    @property
    def hand(self) -> pin.SE3:
        """True pose of the end effector in the root link's frame."""
        return self.robot.kinematics.end_effector_pose(self.theta)

    def marker_pose(self) -> pin.SE3:
        """Return the end effector's pose in the root link's frame, with the noise of a camera."""
        return camera_reading(self.hand, self._rng)

    def accelerometer(self, link: str) -> Array:
        """Return the reading [m/s²] (3,) of an accelerometer on a link while the arm rests."""
        return accelerometer_reading(self.robot, self.theta, link, self._rng, self.faults.mount)

    @abstractmethod
    def route_points(self) -> Array:
        """Return the true route points in the root link's frame [m], shape (P, 3)."""
