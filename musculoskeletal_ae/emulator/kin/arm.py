# SPDX-License-Identifier: Apache-2.0
"""Emulator model `kin`: rigid bodies by pinocchio, muscles and friction compiled by numba.

Each muscle is a massless tendon between a muscle module and a series elastic element at its far
end:

    bone side  L_e(l_abs, T_end) = f(θ) − l
    friction   T = T_end exp(μ s),  |s| ≤ 1

L_e is the elongation of element and tendon at the bone-side tension T_end. At the joint angles θ
the route has the length l_abs, which exceeds the length at θ = 0 by f(θ). The module has wound the
tendon to the length l, at the motor-side tension T. The friction state s follows the sliding of the
tendon according to Dahl's model. Joint friction follows the same model, so that friction holds the
resting arm without creep.
"""

import math
from collections import namedtuple
from typing import Any

import numpy as np
import pinocchio as pin
from numba import njit

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.emulator import modules
from musculoskeletal_ae.emulator.faults import ArmReadings
from musculoskeletal_ae.emulator.kin import wrapping
from musculoskeletal_ae.emulator.kin.individual import Individual
from musculoskeletal_ae.emulator.kin.wrapping import Placed
from musculoskeletal_ae.emulator.modules import STEP, Command, Modules, MuscleState
from musculoskeletal_ae.handle import Handle
from musculoskeletal_ae.robot.kinematics import joint_space_inertia
from musculoskeletal_ae.robot.passive_tendon_torque import add_passive
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.muscle_states import MuscleReadings

#: let tendon friction build up to its full size over this sliding distance [m]
SLIDING_DISTANCE = 0.0005
#: give each joint module this inertia of rotor and bearings [kg·m²]; chosen by hand
ARMATURE = 0.004
STICKING_ANGLE = 0.003  # let joint friction build up to its full size over this angle [rad]
VISCOUS = 0.5  # give each joint this viscous friction [N·m·s/rad]
#: give the stops at joint limits this stiffness [N·m/rad] and damping [N·m·s/rad]
STOP_STIFFNESS, STOP_DAMPING = 400.0, 2.0
#: stiffen the stops of a joint if weight and muscles at T_bias load it by more than this [N·m]
STOP_LOAD = 40.0


#: Constants of one individual for the compiled step: series elastic elements, tendons and sensors
#: of M muscles; friction and stops of the J−1 joints of the tree; joint of the end effector, and
#: its position in that joint's frame [m]. `gear` multiplies viscous friction, `firmness` the stops.
#: `springs` (D, D), `preload`, `damping` (D,) and `passive` tendons are those of the joints of θ,
#: whose indices in the tree are `order`.
Body = namedtuple(
    'Body',
    'force rate wire_stretch length_at_zero tendon_friction sensor_gain sensor_offset '
    'joint_friction lower upper gear firmness effector_joint effector '
    'springs preload damping passive order',
)
#: q, q̇, friction state in [−1, 1] and generalised torque of the tree, each (J−1,).
JointState = namedtuple('JointState', 'q velocity sticking torque')
#: Everything that a step reads and writes. `wrench` is the force and torque on the end effector in
#: the axes of the root link, (6,).
Parts = namedtuple('Parts', 'routes placed body constants muscle joint command wrench')


@njit(cache=True)
def tension_from_elongation(elongation: float, force: float, rate: float, stretch: float) -> float:
    """Return the tension T [N] of a tendon and its series elastic element at an elongation.

        ln(1 + T/force)/rate + stretch·T = elongation

    The equation is solved by Newton's method in u = ln(1 + T/force). It is convex in u, and the
    start u = rate·elongation lies beyond the root. The iteration therefore converges without
    overshooting.

    Args:
        elongation: Elongation [m]; the tension is 0 if it is not positive (slack tendon).
        force: Constant of the element [N].
        rate: Constant of the element [1/m].
        stretch: Stretch of the tendon itself [m/N].
    """
    if elongation <= 0.0:
        return 0.0
    # This limit, far beyond any tension of a module, keeps exp() finite.
    u = min(rate * elongation, 6.0)
    for _ in range(20):
        grown = math.exp(u)
        step = (u / rate + stretch * force * (grown - 1.0) - elongation) / (
            1.0 / rate + stretch * force * grown
        )
        u -= step
        if abs(step) < 1e-9:
            break
    return force * (math.exp(u) - 1.0)


@njit(cache=True)
def make_handle(parts: Parts) -> Handle:
    """Make the handle through which `muscle_step` gets `parts`, without copying the arrays."""
    return Handle(parts)


@njit(cache=True)
def muscle_step(arm: Handle, kind: int, acceleration: Array) -> None:
    """Advance joints and muscle modules by one step of 1 ms, and compute the torques at the joints.

    The generalised torques of muscles, friction, springs, stops and the external wrench are written
    to the member `joint.torque` of the `Parts`.

    Args:
        arm: Handle to the `Parts`, which are changed in place.
        kind: Mode of the modules: SAFE, FOLLOW_LENGTH or FOLLOW_TENSION.
        acceleration: Acceleration of each joint of the tree [rad/s²] or [m/s²], (J−1,).
    """
    routes, placed, body, constants, muscle, joint, command, wrench = arm.held
    for i in range(joint.q.shape[0]):
        joint.velocity[i] += STEP * acceleration[i]
        joint.q[i] += STEP * joint.velocity[i]
    wrapping.place(routes, joint.q, placed)
    _step_muscles(body, constants, muscle, kind, command, placed.absolute)
    joint.torque[:] = 0.0
    for i in range(joint.q.shape[0]):
        turned = STEP * joint.velocity[i] * math.sqrt(body.gear[i])
        joint.sticking[i] = modules.friction_state(joint.sticking[i], turned, STICKING_ANGLE)
        joint.torque[i] -= body.joint_friction[i] * joint.sticking[i]
        joint.torque[i] -= body.gear[i] * (VISCOUS * joint.velocity[i])
        beyond = max(0.0, joint.q[i] - body.upper[i]) + min(0.0, joint.q[i] - body.lower[i])
        if beyond != 0.0:
            stop = STOP_STIFFNESS * beyond + STOP_DAMPING * joint.velocity[i]
            joint.torque[i] -= body.firmness[i] * stop
    for d in range(body.order.shape[0]):
        i = body.order[d]
        joint.torque[i] += body.preload[d] - body.damping[d] * joint.velocity[i]
        for e in range(body.order.shape[0]):
            joint.torque[i] -= body.springs[d, e] * joint.q[body.order[e]]
    if body.passive.law.shape[0]:
        own = joint.q[body.order]
        held, slopes = np.zeros(own.shape[0]), np.zeros((own.shape[0], own.shape[0]))
        add_passive(body.passive, own, held, slopes)
        for d in range(own.shape[0]):
            joint.torque[body.order[d]] -= held[d]
    for s in range(routes.first.shape[0]):
        tension = muscle.end_tension[routes.muscle[s]]
        wrapping.add_tension_torque(routes, s, placed, tension, joint.torque)
    tree, torque, i = routes.tree, joint.torque, body.effector_joint
    hand = wrapping.point_of(placed, i, body.effector)
    wrapping.add_torque(tree, placed, i, hand, wrench[:3], 1.0, torque)
    while i > 0:
        if not tree.prismatic[i]:
            for r in range(3):
                torque[i - 1] += placed.axis[i, r] * wrench[3 + r]
        i = tree.parent[i]


@njit(cache=True)
def _step_muscles(
    body: Body, constants: Modules, muscle: MuscleState, kind: int, command: Command,
    absolute: Array,
) -> None:  # fmt: skip
    for m in range(absolute.shape[0]):
        reading = muscle.length[m] + command.length_error[m] + command.zero[m]
        measured = body.sensor_gain[m] * muscle.tension[m] + body.sensor_offset[m]
        slid = modules.wind(constants, muscle, kind, command, m, reading, measured)
        muscle.sliding[m] = modules.friction_state(muscle.sliding[m], slid, SLIDING_DISTANCE)
        muscle.end_tension[m] = 0.0
        if muscle.ruptured[m] == 0.0:
            muscle.end_tension[m] = tension_from_elongation(
                absolute[m] - body.length_at_zero[m] - muscle.length[m] - command.slack[m],
                body.force[m],
                body.rate[m],
                body.wire_stretch[m] * absolute[m],
            )
        friction = math.exp(body.tendon_friction[m] * muscle.sliding[m])
        muscle.tension[m] = muscle.end_tension[m] * friction
        modules.heat(constants, muscle, command, m)


class EmulatedArm(modules.Arm):
    """An individual of the emulator model `kin`."""

    def __init__(self, robot: Robot, seed: int = 0, individual: Individual | None = None) -> None:
        """Build an emulated individual of a robot, at rest and before the first command.

        Args:
            robot: The robot to emulate.
            seed: Selects the individual, unless `individual` is given. It also seeds the sensor
                noise, the faults, and the errors of motor currents and thermal constants.
            individual: The true body of the arm; by default, it is drawn from `seed`.
        """
        self.individual = individual or Individual(robot, seed)
        super().__init__(robot, seed, self.individual.length_bias)
        self._order = robot.kinematics.tree.order
        self._model = pin.Model(robot.kinematics.model)
        self._gear = modules.joint_gear(robot.kinematics)[1:]
        self._model.armature = ARMATURE * self._gear
        self._data = self._model.createData()
        self._body = self._constants()
        self._bare_inertia = self._model.inertias[self._body.effector_joint].copy()
        true, at_zero = self.individual, self.individual.length_at_zero
        theta = robot.random_postures(500, np.random.default_rng(0))
        span = true.absolute_lengths(theta) - at_zero
        stretch = true.elastic.elongation(at_zero, robot.tension.max)
        self._module_constants = self._make_modules(span, stretch)
        self._placed = Placed.empty(true.routes, robot.muscle_count)
        self._joint = JointState(*(np.zeros(self._model.nv) for _ in range(4)))
        self._angles, self._rates = self._joint.q, self._joint.velocity
        self._make_handle()
        self.reset()

    def _make_handle(self) -> None:
        self._handle = make_handle(
            Parts(
                self.individual.routes, self._placed, self._body, self._module_constants,
                self._muscle, self._joint, self._command, self._wrench,
            )
        )  # fmt: skip

    def __getstate__(self) -> dict[str, Any]:
        """Return the state without the handle, because a copy needs a handle to its own arrays."""
        return {**self.__dict__, '_handle': None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._make_handle()

    def _constants(self) -> Body:
        robot, true, elastic = self.robot, self.individual, self.individual.elastic
        units = robot.units
        springs = units.elasticity_outside(true.joint_elasticity)
        # Coupled joints have neither friction nor stops of their own.
        friction, lower, upper = (np.full(self._model.nv, end) for end in (0.0, -np.inf, np.inf))
        friction[self._order] = units.to_effort(true.joint_friction)
        lower[self._order] = units.to_position(robot.lower)
        upper[self._order] = units.to_position(robot.upper)
        firmness = self._gear.copy()
        load = units.to_effort(true.joint_load) / STOP_LOAD
        firmness[self._order] = np.maximum(firmness[self._order], load)
        joint, hand = robot.kinematics.placement(robot.description.end_effector)
        return Body(
            elastic.force, elastic.rate, elastic.wire_stretch, true.length_at_zero,
            true.tendon_friction, true.tension_gain, true.tension_bias, friction, lower, upper,
            self._gear, firmness, joint, np.array(hand.translation),
            np.ascontiguousarray(springs.stiffness), springs.preload.copy(),
            springs.damping.copy(), springs.tendons.arrays, self._order.astype(np.int64),
        )  # fmt: skip

    def _stand(self, theta: Array) -> None:
        for state in (self._joint.velocity, self._joint.sticking, self._joint.torque):
            state[:] = 0.0
        self._joint.q[:] = self.robot.kinematics.tree.angles(theta)

    def set_payload(self, mass: float) -> None:
        """Set the payload: a ball of this mass [kg] and 5 cm radius at the end effector."""
        load = pin.Inertia.FromSphere(mass, 0.05) if mass > 0.0 else pin.Inertia.Zero()
        placed = load.se3Action(pin.SE3(np.eye(3), self._body.effector))
        self._model.inertias[self._body.effector_joint] = self._bare_inertia + placed

    @property
    def tendon_friction(self) -> Array:
        """Share of tension that each tendon loses along its route (friction μ), shape (M,)."""
        return self.individual.tendon_friction.copy()

    @property
    def friction(self) -> Array:
        """Friction μ of the tendons, which may be changed in place, shape (M,)."""
        return self.individual.tendon_friction

    def _turn_gravity(self, mount: Array) -> None:
        self._model.gravity.linear = mount.T @ self.robot.kinematics.model.gravity.linear

    def _step(self) -> None:
        model, data, joint = self._model, self._data, self._joint
        if not self.robot.kinematics.tree.is_geared:
            acceleration = pin.aba(model, data, joint.q, joint.velocity, joint.torque)
        else:
            acceleration = self._coupled_acceleration()
        muscle_step(self._handle, self._kind, acceleration)

    def _coupled_acceleration(self) -> Array:
        """Return the acceleration of each joint, (J−1,), if some are coupled or prismatic.

            q̈ = A θ̈ + Ȧ θ̇,   θ̈ = (Aᵀ M A)⁻¹ Aᵀ (τ − h − M Ȧ θ̇)

        q are the positions of all joints, and θ those of the joints that are not coupled to
        another one. A = ∂q/∂θ, M is the inertia with the armature, τ the generalised torque, and h
        the torque of weight and velocity. If a coupling is nonlinear, q̈ is corrected so that all
        couplings hold exactly at the end of the step.
        """
        model, data, joint, kin = self._model, self._data, self._joint, self.robot.kinematics
        theta, gear = self.theta, kin.tree.transmission(self.theta)
        inertia = joint_space_inertia(model, data, joint.q)
        bias = pin.nonLinearEffects(model, data, joint.q, joint.velocity)
        if kin.tree.is_nonlinear:
            turning = self.velocity[kin.tree.theta_index[1:]] ** 2
            bias = bias + inertia @ (kin.tree.curvatures(theta) * turning)
        free = gear.T @ (joint.torque - bias)
        acceleration = np.linalg.solve(gear.T @ inertia @ gear, free)
        if not kin.tree.is_nonlinear:
            return gear @ acceleration
        after = kin.tree.angles(theta + STEP * (self.velocity + STEP * acceleration))
        return ((after - joint.q) / STEP - joint.velocity) / STEP

    def _raw_readings(self) -> ArmReadings:
        muscle, true = self._muscle, self.individual
        tension = true.tension_gain * muscle.tension + true.tension_bias
        length = muscle.length + self._command.length_error + self._command.zero
        muscles = MuscleReadings(length=length, tension=tension, temperature=muscle.housing)
        return ArmReadings(self.theta, muscles)

    def route_points(self) -> Array:
        """Return the true route points in the root link's frame [m], shape (P, 3)."""
        return self._placed.world.copy()
