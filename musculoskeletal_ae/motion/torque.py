# SPDX-License-Identifier: Apache-2.0
"""Joint torque control by muscle tensions: methods `tension` and `float`."""

from __future__ import annotations

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.settings import Setup
from musculoskeletal_ae.motion.activities import TENSION, ActivityControl, Command, Inputs
from musculoskeletal_ae.robot.joint_stops import supporting_stops
from musculoskeletal_ae.robot.tension import least_tension

# Gains of the method `tension`; K_p holds the arm near its target, and K_d damps its motion.
POSITION_GAIN = 10.0  # gain K_p of the posture error [N·m/rad]
VELOCITY_GAIN = 0.5  # gain K_d of the joint velocity [N·m·s/rad]
SMOOTHING = 0.05  # smooth the noisy estimate with this time constant [s]

# Method `float`, which compensates gravity, adds these springs and dampers to the holding torque:
HOLD = 15.0  # stiffness of the spring that holds the arm at θ_held [N·m/rad]
#: move θ_held with the arm once the arm is this far from it [rad]; a hand therefore has to exert
#: HOLD · BAND = 0.75 N·m to move a joint
BAND = 0.05
DAMPING = 1.0  # joint torque against the motion, per unit of the joint velocity [N·m·s/rad]
WALL = 30.0  # stiffness of the spring that pushes a joint away from its limits [N·m/rad]
WALL_AT = 0.05  # let this spring act from this distance before a joint limit [rad]


class TorqueControl(ActivityControl):
    """Joint torque by muscle tension: the method `tension`.

        τ = g(θ) + effort + K_p (θ_target − θ) − K_d dθ/dt
        T = least tension with −Gᵀ T = τ within [T_bias, T_limit]; if there is none, the tension
            whose torque −Gᵀ T is nearest to τ

    The network computes G at (θ, T) (paper, §III-E, muscle tension-based control; Kawamura 2016),
    and θ is the low-pass-filtered estimate.
    """

    def __init__(self, setup: Setup) -> None:
        self._setup, robot = setup, setup.robot
        self._missing_torque: Array = np.zeros(robot.joint_count)
        self._command: Array = robot.tension.bias  # last tension command [N], (M,)
        self._smooth: Array | None = None  # low-pass-filtered θ [rad], (D,)

    def enter(self, inputs: Inputs) -> None:
        """Enter the activity, starting from the present tensions."""
        self._command = np.maximum(inputs.tension, self._setup.robot.tension.bias)
        self._smooth = None

    def step(self, inputs: Inputs) -> Command | None:
        """Advance by one control step; return the tension command, or None without a target."""
        if inputs.target is None:
            return None
        return self._command_towards(inputs.target, inputs.effort, inputs)

    def leave(self) -> None:
        """Leave the activity."""

    @property
    def has_arrived(self) -> bool:
        """Always true: the position gain pulls the arm to its target from the first command on."""
        return True

    @property
    def missing_torque(self) -> Array:
        """Torque [N·m], (D,), that the tensions of the last step do not provide."""
        return self._missing_torque

    def _command_towards(self, target: Array, effort: Array, inputs: Inputs) -> Command:
        robot, dt = self._setup.robot, inputs.dt
        before = inputs.theta if self._smooth is None else self._smooth
        self._smooth = smooth = before + dt / (dt + SMOOTHING) * (inputs.theta - before)
        velocity = (inputs.theta - smooth) / SMOOTHING
        torque = robot.kinematics.holding_torque(smooth) + effort
        torque = torque + self._feedback(smooth, velocity, target)
        jacobian = inputs.mae.muscle_jacobian(smooth, self._command)
        tension, self._missing_torque = least_tension(
            jacobian,
            torque,
            robot.tension.bias,
            inputs.limit,
            stops=self._stops(smooth, target, effort),
        )
        # Scale the changes of all tensions by the same factor. If the old and the new tensions hold
        # the arm, all tensions in between then hold it as well.
        change = tension - self._command
        actuation, rate_limit = robot.actuation, self._setup.settings.rate_limit
        rates = actuation.tension_per_length(self._command) * actuation.fastest(rate_limit)
        fastest = rates * dt
        share = float((fastest / np.maximum(fastest, np.maximum(np.abs(change), 1e-9))).min())
        self._command = self._command + change * share
        return Command(TENSION, self._command.copy())

    def _stops(self, theta: Array, target: Array, effort: Array) -> Array | None:
        """Return the stops that support joints, (S, D): those at which θ and the target are."""
        return supporting_stops(self._setup.robot, np.stack([theta, target]), effort=effort)

    def _feedback(self, theta: Array, velocity: Array, target: Array) -> Array:
        """Return the torque [N·m], (D,), that pulls θ towards `target` and damps the velocity."""
        return POSITION_GAIN * (target - theta) - VELOCITY_GAIN * velocity


class GravityCompensation(TorqueControl):
    """Gravity compensation for hand guiding: the method `float`.

        τ = g(θ) + HOLD (θ_held − θ) − DAMPING dθ/dt + WALL (clip(θ) − θ)
        θ_held ← clip(θ_held, θ − BAND, θ + BAND)

    A virtual spring of stiffness HOLD holds the arm at θ_held. Once the spring is stretched by
    BAND, θ_held follows the arm. The spring thus acts like joint friction, so that errors of the
    gravity model do not make the arm creep.

    A second virtual spring, of stiffness WALL, pushes the arm away from the joint limits. It begins
    at the distance WALL_AT from them: clip(θ) is θ, limited to this smaller range. θ_held stays
    within the joint limits.
    """

    def __init__(self, setup: Setup) -> None:
        super().__init__(setup)
        self.held: Array | None = None  # θ_held, at which the spring holds the arm [rad], (D,)

    def enter(self, inputs: Inputs) -> None:
        """Enter the activity in the present posture, starting from the present tensions."""
        super().enter(inputs)
        self.held = None

    def step(self, inputs: Inputs) -> Command | None:
        """Advance by one control step and return the tension command."""
        return self._command_towards(inputs.theta, np.zeros_like(inputs.theta), inputs)

    def _stops(self, theta: Array, target: Array, effort: Array) -> None:
        """Return no stops: the muscles carry the arm, so that a hand can lead it off a stop."""

    def _feedback(self, theta: Array, velocity: Array, target: Array) -> Array:
        low, high = self._setup.robot.lower, self._setup.robot.upper
        held = target if self.held is None else np.clip(self.held, theta - BAND, theta + BAND)
        self.held = np.clip(held, low, high)
        wall = np.clip(theta, low + WALL_AT, high - WALL_AT) - theta
        return HOLD * (self.held - theta) - DAMPING * velocity + WALL * wall
