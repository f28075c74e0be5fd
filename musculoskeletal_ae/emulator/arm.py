# SPDX-License-Identifier: Apache-2.0
"""The emulated arm: an individual body with muscle modules and sensors, stepped without ROS."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import pinocchio as pin

from musculoskeletal_ae.arrays import Array, Bools
from musculoskeletal_ae.emulator import mechanics
from musculoskeletal_ae.emulator.faults import Faults, Readings
from musculoskeletal_ae.emulator.individual import Individual
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.robot.kinematics import joint_space_inertia
from musculoskeletal_ae.robot.robot import Robot

ARMATURE = 0.004  # [kg·m²] rotor and bearing inertia of a joint module; chosen

# Sensors; chosen: noise is one standard deviation, then rounded to the
# resolution, a power of two as a converter's counts are.
ANGLE_NOISE, ANGLE_RESOLUTION = 0.001, 2.0**-12  # [rad]
LENGTH_NOISE, LENGTH_RESOLUTION = 1.0e-4, 2.0**-14  # [m]
TENSION_NOISE, TENSION_RESOLUTION = 1.0, 2.0**-3  # [N]
TEMPERATURE_NOISE, TEMPERATURE_RESOLUTION = 0.2, 2.0**-3  # [°C]
MARKER_NOISE, MARKER_TURN_NOISE = 0.002, 0.01  # [m], [rad]


def seen_by_camera(pose: pin.SE3, rng: np.random.Generator) -> pin.SE3:
    """Return a pose as a camera sees the marker, with its noise."""
    turn = pin.exp3(rng.normal(0.0, MARKER_TURN_NOISE, 3))
    shift = rng.normal(0.0, MARKER_NOISE, 3)
    return pin.SE3(pose.rotation @ turn, pose.translation + shift)


class EmulatedArm:
    """Rigid bodies by pinocchio, muscles and modules by `mechanics`, faults on request.

    Attributes:
        robot: The geometric model that the description gives.
        individual: The true body that `seed` picked.
        command_timeout: Seconds without a command until the modules go safe.
        faults: Of wires, motors and sensors.
    """

    def __init__(
        self,
        robot: Robot,
        seed: int = 0,
        individual: Individual | None = None,
        command_timeout: float = 0.5,
    ) -> None:
        """Build an arm at rest, modules safe.

        Args:
            robot: The description's nominal body.
            seed: Which individual, and its sensor noise.
            individual: The true body; drawn from `seed` by default.
            command_timeout: Seconds without a command until the modules go safe.
        """
        self.robot = robot
        self.individual = individual or Individual(robot, seed)
        self.command_timeout = command_timeout
        self._rng = np.random.default_rng([seed, 0x5E45])
        self.faults = Faults(robot, np.random.default_rng([seed, 0xFA17]))
        self._order = robot.kinematics.order
        self._model = pin.Model(robot.kinematics.model)
        self._model.armature = np.full(self._model.nv, ARMATURE)
        self._data = self._model.createData()
        frame = self._model.frames[robot.kinematics.end_effector_frame]
        self._effector_joint = int(frame.parentJoint)
        self._effector: Array = np.array(frame.placement.translation)
        self._bare_inertia = self._model.inertias[self._effector_joint].copy()
        self._wrench = np.zeros(6)
        self._payload = 0.0
        self._body = self._constants()
        muscles = robot.muscle_count
        self._command = mechanics.Command(
            np.zeros(muscles),
            self.individual.length_bias.copy(),
            self.faults.stuck,
            self.faults.slack,
            self.faults.zero,
            self.faults.hot,
        )
        tree_joints, segments = len(self.individual.tree.parent), len(self.individual.routes.first)
        self._scratch = mechanics.Scratch(
            np.zeros((tree_joints, 3, 3)),
            np.zeros((tree_joints, 3)),
            np.zeros((tree_joints, 3)),
            np.zeros(self.individual.routes.point.shape),
            np.zeros(muscles),
            np.zeros((segments, 3)),
            np.zeros((segments, 3)),
            np.zeros(3),
        )
        self._muscle = mechanics.MuscleState(*(np.zeros(muscles) for _ in range(8)))
        self._joint = mechanics.JointState(*(np.zeros(self._model.nv) for _ in range(4)))
        self.reset()

    def _constants(self) -> mechanics.Body:
        robot, true = self.robot, self.individual
        span = true.absolute_lengths(robot.random_postures(500, np.random.default_rng(0)))
        span = span - true.length_at_zero
        stretch = true.elastic.elongation(true.length_at_zero, robot.tension.max)
        # Joints that follow others have no friction and no stops of their own.
        friction, lower, upper = (np.full(self._model.nv, end) for end in (0.0, -np.inf, np.inf))
        friction[self._order] = true.joint_friction
        lower[self._order], upper[self._order] = robot.lower, robot.upper
        return mechanics.Body(
            true.elastic.force,
            true.elastic.rate,
            true.elastic.wire_stretch,
            true.length_at_zero,
            true.cable_friction,
            friction,
            lower,
            upper,
            span.min(axis=0) - stretch - 0.05,
            span.max(axis=0) + 0.05,
            robot.stiffness,
            robot.tension.bias,
            robot.tension.max,
            true.tension_gain,
            true.tension_bias,
        )

    def reset(self, theta: Array | None = None) -> None:
        """Put the arm at rest at θ (default: hanging, θ = 0 within the limits), free, mended, cool.

        Payload, length offsets and `faults` stay as set.
        """
        posture = np.zeros(self.robot.joint_count) if theta is None else np.asarray(theta, float)
        posture = np.clip(posture, self.robot.lower, self.robot.upper)
        for state in (self._joint.velocity, self._joint.sticking, self._joint.torque):
            state[:] = 0.0
        self._joint.q[:] = self.robot.kinematics.tree_angles(posture)
        self._wrench[:] = 0.0
        bias = self.robot.tension.bias
        self._muscle.sliding[:] = 0.0
        self._muscle.ruptured[:] = 0.0
        self._muscle.reference[:] = bias
        self._muscle.winding[:] = mechanics.AMBIENT
        self._muscle.housing[:] = mechanics.AMBIENT
        self._attach(np.ones(self.robot.muscle_count, dtype=bool))
        self._kind = mechanics.SAFE
        self._age = 0.0

    def _attach(self, which: Bools) -> None:
        """Wind the given muscles so that they carry T_bias in the present posture."""
        bias = self.robot.tension.bias
        length = self.individual.muscle_lengths(self.theta[None], bias)[0]
        self._muscle.length[which] = length[which]
        self._muscle.tension[which] = bias[which]
        self._muscle.end_tension[which] = bias[which]

    @property
    def theta(self) -> Array:
        """True joint angles [rad], shape (D,): what errors are measured against."""
        angles: Array = self._joint.q[self._order]
        return angles

    @property
    def velocity(self) -> Array:
        """True joint velocities [rad/s], shape (D,)."""
        rates: Array = self._joint.velocity[self._order]
        return rates

    @property
    def tension(self) -> Array:
        """True muscle tensions at the modules [N], shape (M,)."""
        return self._muscle.tension.copy()

    @property
    def broken(self) -> bool:
        """Whether forces beyond all bounds left no posture that is a number, until `reset`."""
        return not np.isfinite(self._joint.q).all()

    @property
    def safe(self) -> bool:
        """Whether the modules went safe for want of commands."""
        return self._kind == mechanics.SAFE

    def command_length(self, length: Array) -> None:
        """Follow target lengths [m], shape (M,), by muscle stiffness control."""
        self._follow(mechanics.FOLLOW_LENGTH, length)

    def command_tension(self, tension: Array) -> None:
        """Follow target tensions [N], shape (M,)."""
        self._follow(mechanics.FOLLOW_TENSION, tension)

    def _follow(self, kind: int, value: Array) -> None:
        self._kind, self._age = kind, 0.0
        self._command.value[:] = value

    def set_payload(self, mass: float) -> None:
        """Put a mass [kg] into the hand, as a ball of 5 cm radius at the end effector."""
        self._payload = mass
        load = pin.Inertia.FromSphere(mass, 0.05) if mass > 0.0 else pin.Inertia.Zero()
        placed = load.se3Action(pin.SE3(np.eye(3), self._effector))
        self._model.inertias[self._effector_joint] = self._bare_inertia + placed

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
        self._command.length_error[:] = self.individual.length_bias + np.asarray(offset)

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

    def step(self, duration: float) -> None:
        """Let time pass [s], in whole steps of `mechanics.STEP`."""
        individual, joint = self.individual, self._joint
        for _ in range(round(duration / mechanics.STEP)):
            self._age += mechanics.STEP
            if self._age > self.command_timeout:
                self._kind = mechanics.SAFE
            acceleration = self._acceleration()
            mechanics.muscle_step(
                individual.tree,
                individual.routes,
                self._body,
                self._muscle,
                joint,
                self._scratch,
                self._kind,
                self._command,
                self._wrench,
                self._effector,
                self._effector_joint,
                acceleration,
            )

    def _acceleration(self) -> Array:
        """Return q̈ of the tree; of coupled joints, q̈ = A (Aᵀ M A)⁻¹ Aᵀ (τ − h)."""
        model, data, joint = self._model, self._data, self._joint
        gear = self.robot.kinematics.transmission
        if gear is None:
            free: Array = pin.aba(model, data, joint.q, joint.velocity, joint.torque)
            return free
        inertia = joint_space_inertia(model, data, joint.q)
        bias = pin.nonLinearEffects(model, data, joint.q, joint.velocity)
        # Pinocchio's M holds the armature already.
        coupled = np.linalg.solve(gear.T @ inertia @ gear, gear.T @ (joint.torque - bias))
        return gear @ coupled

    def sense(self) -> Readings:
        """Read all sensors once, with their noise, bias, resolution and faults."""
        muscle, true = self._muscle, self.individual
        tension = true.tension_gain * muscle.tension + true.tension_bias
        # A cut wire pulls on no sensor, and a tension unit does not read below zero.
        tension = np.where(muscle.ruptured > 0.0, 0.0, tension)
        noisy = self._noisy(tension, TENSION_NOISE, TENSION_RESOLUTION)
        length = muscle.length + self._command.length_error + self._command.zero
        readings = Readings(
            self._noisy(self.theta, ANGLE_NOISE, ANGLE_RESOLUTION),
            self._noisy(length, LENGTH_NOISE, LENGTH_RESOLUTION),
            np.where(muscle.ruptured > 0.0, 0.0, np.maximum(noisy, 0.0)),
            self._noisy(muscle.housing, TEMPERATURE_NOISE, TEMPERATURE_RESOLUTION),
        )
        return self.faults.sensed(readings)

    def _noisy(self, value: Array, noise: float, resolution: float) -> Array:
        read: Array = value + self._rng.normal(0.0, noise, value.shape)
        return np.round(read / resolution) * resolution

    def marker_pose(self) -> pin.SE3:
        """See the end effector's pose in the root link's frame, with a camera's noise."""
        return seen_by_camera(self.robot.kinematics.end_effector_pose(self.theta), self._rng)

    def route_points(self) -> Array:
        """True route points in the root link's frame [m], shape (P, 3)."""
        return self._scratch.world.copy()
