# SPDX-License-Identifier: Apache-2.0
"""The emulated arm: an individual body with muscle modules and sensors, stepped without ROS."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.emulator import mechanics
from musculoskeletal_ae.emulator.individual import Individual
from musculoskeletal_ae.emulator.modules import Arm, joint_gear
from musculoskeletal_ae.emulator.wrapping import Placed
from musculoskeletal_ae.robot.kinematics import joint_space_inertia
from musculoskeletal_ae.robot.robot import Robot

ARMATURE = 0.004  # [kg·m²] rotor and bearing inertia of a joint module; chosen


class EmulatedArm(Arm):
    """Rigid bodies by pinocchio, muscles by `mechanics`, modules and faults by `modules`."""

    def __init__(self, robot: Robot, seed: int = 0, individual: Individual | None = None) -> None:
        """Build an individual of a robot at rest, modules safe; `seed` is of its noise, too."""
        self.individual = individual or Individual(robot, seed)
        super().__init__(robot, seed, self.individual.length_bias)
        self._order = robot.kinematics.order
        self._model = pin.Model(robot.kinematics.model)
        self._gear = joint_gear(robot.kinematics)[1:]
        self._model.armature = ARMATURE * self._gear
        self._data = self._model.createData()
        self._body = self._constants()
        self._bare_inertia = self._model.inertias[self._body.effector_joint].copy()
        true, zero = self.individual, self.individual.length_at_zero
        span = true.absolute_lengths(robot.random_postures(500, np.random.default_rng(0))) - zero
        self._wound = self._modules(span, true.elastic.elongation(zero, robot.tension.max))
        self._placed = Placed.empty(true.routes, robot.muscle_count)
        self._joint = mechanics.JointState(*(np.zeros(self._model.nv) for _ in range(4)))
        self._angles, self._rates = self._joint.q, self._joint.velocity
        self.reset()

    def _constants(self) -> mechanics.Body:
        robot, true, unit = self.robot, self.individual, self.individual.elastic
        # Joints that follow others have no friction and no stops of their own.
        friction, lower, upper = (np.full(self._model.nv, end) for end in (0.0, -np.inf, np.inf))
        friction[self._order] = true.joint_friction
        lower[self._order], upper[self._order] = robot.lower, robot.upper
        firmness = self._gear.copy()
        load = true.load / mechanics.STOP_LOAD
        firmness[self._order] = np.maximum(firmness[self._order], load)
        joint, hand = robot.kinematics.placement(robot.description.end_effector)
        return mechanics.Body(
            unit.force, unit.rate, unit.wire_stretch, true.length_at_zero, true.cable_friction,
            true.tension_gain, true.tension_bias, friction, lower, upper, self._gear, firmness,
            joint, np.array(hand.translation),
        )  # fmt: skip

    def _stand(self, theta: Array) -> None:
        for state in (self._joint.velocity, self._joint.sticking, self._joint.torque):
            state[:] = 0.0
        self._joint.q[:] = self.robot.kinematics.tree_angles(theta)

    def set_payload(self, mass: float) -> None:
        """Put a mass [kg] into the hand, as a ball of 5 cm radius at the end effector."""
        load = pin.Inertia.FromSphere(mass, 0.05) if mass > 0.0 else pin.Inertia.Zero()
        placed = load.se3Action(pin.SE3(np.eye(3), self._body.effector))
        self._model.inertias[self._body.effector_joint] = self._bare_inertia + placed

    def _step(self) -> None:
        mechanics.muscle_step(
            self.individual.routes, self._placed, self._body, self._wound, self._muscle,
            self._joint, self._kind, self._command, self._wrench, self._acceleration(),
        )  # fmt: skip

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

    def _sensed(self) -> tuple[Array, Array, Array, Array]:
        muscle, true = self._muscle, self.individual
        tension = true.tension_gain * muscle.tension + true.tension_bias
        length = muscle.length + self._command.length_error + self._command.zero
        return self.theta, length, tension, muscle.housing

    def route_points(self) -> Array:
        """True route points in the root link's frame [m], shape (P, 3)."""
        return self._placed.world.copy()
