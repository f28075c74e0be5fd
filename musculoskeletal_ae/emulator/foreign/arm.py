# SPDX-License-Identifier: Apache-2.0
"""Emulator model `foreign`, whose muscles share no code with the model that the learner fits.

MuJoCo simulates rigid bodies, wrapping, stops and joint friction. The file `tendons.py` simulates
tendons, series elastic elements and spools. The muscle modules are those of all emulated arms. This
file imports neither learning nor the geometric routes nor the series elastic class (checked by
`test/test_house.py`).
"""

import copy
import math
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pinocchio as pin

from musculoskeletal_ae.arrays import Array, Bools
from musculoskeletal_ae.design.route_jumps import MOST_DRAWS, newly_jumping
from musculoskeletal_ae.emulator.faults import ArmReadings
from musculoskeletal_ae.emulator.foreign import deviation, mujoco_model, tendons
from musculoskeletal_ae.emulator.foreign.effects import NONE, Draw, Effects
from musculoskeletal_ae.emulator.modules import STEP, Arm
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.importing.adapted_mjcf import HAND
from musculoskeletal_ae.importing.source import listed
from musculoskeletal_ae.robot.description import Wrap
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.muscle_states import MuscleReadings

#: update the bends of the tendons, and how far route points yield, once in this many steps
GUIDES_EVERY = 5
#: reject delays of sensors that exceed this many steps of 1 ms, which is the length of the history
HISTORY = 64
HOUR = 3600.0  # one hour in seconds
BEDDING_TIME = 2.0 * HOUR  # let a new tendon lengthen under load with this time constant [s]
NUDGE = 1e-7  # change the joint angles by this if MuJoCo's wrapping returns NaN in a posture [rad]
SLIP_TIME = 5.0 * HOUR  # let a tendon slip on its spool at this mean interval [s]
#: refuse a file if the length of a muscle differs from the robot's by more than this [m] in most
#: postures
OTHER_ROUTE = 0.02


class ForeignBody:
    """The true lengths, moment arms, elastic laws and sensor errors of one emulated arm.

    These properties are those of the arm at rest, before its tendons have aged.
    """

    def __init__(self, robot: Robot, model: Any, draw: Draw) -> None:
        """Draw the elastic elements and sensor errors of the arm that `model` describes.

        Args:
            robot: The robot, with the data sheets of the elastic elements.
            model: A MuJoCo model. Its joints and tendons must have the names of the robot's joints
                and muscles.
            draw: The random draws of the individual.
        """
        self._robot, self._model = robot, model
        self._data = mujoco.MjData(model)
        names, count = robot.kinematics.model.names[1:], robot.muscle_count
        #: indices of the tree's joints in qpos and qvel
        self.tree = np.array([model.joint(name).id for name in names])
        #: MuJoCo tendon of each muscle
        self.tendon_ids = np.array([model.tendon(name).id for name in robot.muscles])
        self.length_at_zero = self.absolute_lengths(np.zeros((1, robot.joint_count)))[0]
        self.elastic = tendons.Springs(robot, self.length_at_zero, draw)
        self.tension_gain: Array = 1.0 + draw.normal('tension_gain', count)
        self.tension_bias: Array = draw.normal('tension_zero', count)
        self.length_bias: Array = np.zeros(count)

    def set_posture(self, data: Any, theta: Array) -> Any:
        """Set the joint angles of an MjData to θ [rad], (D,); return it with updated lengths."""
        data.qpos[self.tree] = self._robot.kinematics.tree.angles(theta)
        mujoco.mj_fwdPosition(self._model, data)
        return data

    def _routed(self, q: Array) -> Any:
        """Return an MjData with the lengths and moment arms of the tendons in one posture.

        Contacts are not computed, because they would take most of the time in some files. `q` are
        the positions of all joints of the tree [rad] or [m], (J−1,).
        """
        data = self._data
        data.qpos[self.tree] = q
        mujoco.mj_kinematics(self._model, data)
        mujoco.mj_comPos(self._model, data)
        mujoco.mj_tendon(self._model, data)
        return data

    def absolute_lengths(self, theta: Array) -> Array:
        """Return the lengths of the routes [m], (N, M), for joint angles θ [rad], (N, D)."""
        data = (self._routed(row) for row in self._robot.kinematics.tree.angles(theta))
        return np.stack([each.ten_length[self.tendon_ids] for each in data])

    def muscle_jacobian(self, theta: Array) -> Array:
        """Return the muscle Jacobian ∂l/∂θ [m/rad], (N, M, D), for joint angles θ [rad], (N, D)."""
        model = self._model
        jacobian = np.empty((len(theta), model.ntendon, model.nv))
        rows = model.ten_J_rownnz, model.ten_J_rowadr, model.ten_J_colind
        tree = self._robot.kinematics.tree
        for dense, q in zip(jacobian, tree.angles(theta), strict=True):
            mujoco.mju_sparse2dense(dense, self._routed(q).ten_J, *rows)
        return tree.of_theta(jacobian[:, self.tendon_ids][:, :, self.tree], theta)

    def muscle_lengths(self, theta: Array, tension: Array) -> Array:
        """Return the muscle lengths [m], (N, M), for joint angles (N, D) and tensions (N, M).

        They do not include the effects of friction, hysteresis, yielding route points and sensor
        errors.

        Args:
            theta: Joint angles [rad].
            tension: Tensions [N].
        """
        relative = self.absolute_lengths(theta) - self.length_at_zero
        return relative - self.elastic.elongation(tension)


def _individual_model(robot: Robot, draw: Draw) -> Any:
    """Return the MuJoCo model of a robot directory, with the deviations of an individual.

    If a tendon slips over the end of an object that it wraps around, its length jumps by
    centimetres. No one would route a tendon there. The route points of such a tendon are therefore
    redrawn, unless it also jumps without deviations. The number of draws is limited (MOST_DRAWS),
    so some tendons may still jump.
    """
    again = np.zeros(robot.muscle_count, dtype=np.int64)
    model = mujoco_model.from_directory(robot, draw, again)
    if not any(isinstance(item, Wrap) for route in robot.description.routes for item in route):
        return model

    nominal = ForeignBody(robot, mujoco_model.from_directory(robot, Draw(0, NONE), again), draw)

    def slipping(model: Any) -> Bools:
        body = ForeignBody(robot, model, draw)
        return newly_jumping(body.absolute_lengths, nominal.absolute_lengths, robot)

    while again.max() < MOST_DRAWS and (wrong := slipping(model)).any():
        again += wrong
        model = mujoco_model.from_directory(robot, draw, again)
    return model


def _imported_model(robot: Robot, file: Path, draw: Draw, deviates: bool) -> Any:
    """Return the MuJoCo model of a file that `import_robot` wrote.

    If `deviates`, the model gets the deviations of the individual that `draw` selects.

    Raises:
        MusculoskeletalError: If the file is not the model of the robot.
    """
    model = mujoco_model.from_file(robot, file)
    given = ForeignBody(robot, copy.copy(model), draw)
    theta = robot.random_postures(100, np.random.default_rng(0))
    relative = given.absolute_lengths(theta) - given.length_at_zero
    off = np.abs(relative - robot.muscle_lengths(theta, np.zeros(robot.muscle_count)))
    typical = np.median(off, axis=0)  # the median ignores the few postures in which a length jumps
    for m in np.flatnonzero(typical > OTHER_ROUTE):
        name, millimetres = robot.muscles[m], 1e3 * typical[m]
        problem = f'the length of muscle {name!r} typically differs by {millimetres:.0f} mm'
        raise mujoco_model.other_robot(robot, file, problem)
    if deviates:
        _deviate(robot, model, given, draw)
    return model


def _deviate(robot: Robot, model: Any, given: ForeignBody, draw: Draw) -> None:
    """Give the MuJoCo model of a file the random deviations of an individual, in place.

    If displaced attachment points make the length of a tendon jump, because the tendon slips over
    the end of an object, its points are redrawn. The number of draws is limited (MOST_DRAWS), so
    some tendons may still jump. Tendons that already jump in `given`, the body of the file, are not
    redrawn.
    """
    attachments = deviation.Attachments(robot, model, draw)
    for _ in range(MOST_DRAWS):
        body = ForeignBody(robot, copy.copy(model), draw)
        wrong = newly_jumping(body.absolute_lengths, given.absolute_lengths, robot)
        if not wrong.any():
            break
        attachments.move(wrong)
    deviation.change_masses(model, draw)


class LateSensors:
    """Errors of the joint sensors (offset, non-linearity, backlash), and delays of all messages."""

    def __init__(self, robot: Robot, draw: Draw) -> None:
        joints = robot.joint_count
        self._span = robot.upper - robot.lower
        self._zero = draw.normal('joint_zero', joints)
        self._bend = draw.about('joint_bend', joints, signed=True)
        self._backlash = draw.about('backlash', joints)
        self._delays = draw.about('delay', 2)  # delay of joint sensors, and of muscle modules [s]
        #: true θ [rad], (HISTORY, D), and readings of the modules, after each of the last steps
        self._theta = np.zeros((HISTORY, robot.joint_count))
        self._muscles = MuscleReadings(length=np.zeros((HISTORY, robot.muscle_count)))
        self._steps = 0

    def stand(self, theta: Array) -> None:
        """Start from rest at θ [rad], (D,), each joint sensor in the middle of its backlash."""
        self._play = theta + self._zero

    def start(self, theta: Array, muscles: MuscleReadings) -> None:
        """Start with the present θ [rad], (D,), and readings of the modules as history."""
        self._theta[:], self._muscles.rows[:] = theta, muscles.rows

    def append(self, theta: Array, muscles: MuscleReadings) -> None:
        """Append θ [rad], (D,), and the readings of the modules, one step after the last ones."""
        self._steps += 1
        place = self._steps % HISTORY
        self._theta[place], self._muscles.rows[place] = theta, muscles.rows

    def read(self, jitter: float) -> ArmReadings:
        """Read the sensors as they were before the delays of their messages.

        The joint angles have the errors of the joint sensors.

        Args:
            jitter: Time that is added to the delays [s]; may be negative.
        """
        late = np.maximum(self._delays + jitter, 0.0) / STEP
        of_joints, of_muscles = ((self._steps - round(steps)) % HISTORY for steps in late)
        half, span = 0.5 * self._backlash, self._span
        theta = self._theta[of_joints] + self._zero
        theta = theta + self._bend * span * np.sin(2.0 * np.pi * theta / span)
        self._play = np.clip(self._play, theta - half, theta + half)
        return ArmReadings(self._play, self._muscles.at(of_muscles))


class Ageing:
    """Changes over hours: tendons lengthen, slip in a knot or on a spool, and sensors drift.

    Attributes:
        drift: Drift of the length sensors [m/s], (M,).
    """

    def __init__(self, robot: Robot, draw: Draw, spool_slip: float) -> None:
        muscles = robot.muscle_count
        self._time, self._spool_slip = 0.0, spool_slip
        self.drift: Array = draw.normal('length_drift', muscles) / HOUR
        self._bedding = draw.about('bedding', muscles)
        rng, knot = draw.rng('slips'), np.zeros(muscles)
        self._knot_time, knot[rng.integers(muscles)] = rng.uniform(0.0, HOUR), 1.0
        self._knot = knot * draw.about('knot', 1)
        self._slips, self._slipped = rng, np.zeros(muscles)

    def longer(self, duration: float) -> Array:
        """Return the present lengthening of each tendon [m], (M,), and let `duration` [s] pass."""
        age = self._time / BEDDING_TIME
        longer = self._bedding * -np.expm1(-age) + self._knot * (self._time > self._knot_time)
        slipping = self._slips.uniform(size=len(longer)) < duration / SLIP_TIME
        self._slipped = self._slipped + slipping * self._slips.choice([-1.0, 1.0], len(longer))
        self._time += duration
        result: Array = longer + self._spool_slip * self._slipped
        return result


class ForeignArm(Arm):
    """An emulated arm that MuJoCo simulates: emulator model `foreign`, or a user's MJCF file."""

    def __init__(
        self,
        robot: Robot,
        seed: int = 0,
        effects: Effects | None = None,
        file: Path | None = None,
        deviates: bool = False,
    ) -> None:
        """Build an emulated individual, at rest and before the first command.

        Args:
            robot: The robot to emulate.
            seed: Selects the individual.
            effects: Sizes of the effects of a body that is built from the robot directory; by
                default the calibrated ones. A body of `file` ignores them.
            file: The `model.xml` that `import_robot` wrote beside the robot, instead of a body that
                is built from the robot directory.
            deviates: Whether the arm is an individual that differs from `file`
                (`emulator/foreign/deviation.py`).

        Raises:
            MusculoskeletalError: If the robot or the file cannot be built.
        """
        self.effects = effects or Effects()
        if file is not None:
            self.effects = deviation.effects(robot) if deviates else NONE
        draw = self._draw = Draw(seed, self.effects)
        try:
            if file is None:
                model = _individual_model(robot, draw)
            else:
                model = _imported_model(robot, file, draw, deviates)
            mujoco_model.set_options(model)
            self._model, data = model, mujoco.MjData(model)
            self._data = data
            self.individual = body = ForeignBody(robot, copy.copy(model), draw)
            if file is not None and deviates:
                body.length_bias = deviation.slack(robot, draw)
        except (ValueError, mujoco.FatalError) as error:
            reason = ' '.join(str(error).split())
            raise MusculoskeletalError(f'reality {file or "foreign"}: {reason}') from error
        super().__init__(robot, seed, body.length_bias)
        self._upright_gravity = model.opt.gravity.copy()
        if file is None or deviates:
            self._set_joint_friction()
        self._angles, self._rates = data.qpos, data.qvel
        self._order = np.array([model.joint(name).id for name in robot.joints])
        self._hand = model.body(HAND).id
        self._guides = self._make_guides()
        muscles = robot.muscle_count
        self._memory = tendons.Memory(*(np.zeros(muscles) for _ in tendons.Memory._fields))
        self._memory = self._memory._replace(slow=np.zeros((muscles, len(tendons.TIMES))))
        guided = tendons.GuideParts(self._guides, self._muscle.end_tension, self._memory.bend)
        self._guides_handle = tendons.make_handle(guided)
        body.set_posture(data, 0.5 * (robot.lower + robot.upper))
        self._root = self._root_pose() if file else pin.SE3.Identity()
        tendons.guides_step(self._guides_handle, 0.0)
        at_zero, bend = body.length_at_zero, self._memory.bend
        theta = robot.random_postures(500, np.random.default_rng(0))
        span = body.absolute_lengths(theta) - at_zero
        self.tendons = tendons.make_tendons(robot, body.elastic, at_zero, span, bend, draw)
        stretch = body.elastic.elongation(robot.tension.max)
        self._module_constants = self._make_modules(span, stretch)
        self._tendons_handle = tendons.make_handle(
            tendons.TendonParts(
                self.tendons, self._module_constants, self._muscle, self._memory, self._command
            )
        )
        self._sensors = LateSensors(robot, draw)
        self._ageing = Ageing(robot, draw, self.effects.spool_slip)
        self._steps = 0
        self._tendon_force = np.zeros(muscles)
        self._control = np.array([model.actuator(name).id for name in robot.muscles])
        self.reset()

    def _set_joint_friction(self) -> None:
        """Set the friction of each joint by its largest load from weight and muscles at T_bias."""
        robot, draw, body = self.robot, self._draw, self.individual
        theta = robot.random_postures(200, draw.rng('load'))
        torque = robot.kinematics.holding_torque(theta)
        load = robot.units.to_effort(robot.joint_load(torque, body.muscle_jacobian(theta)))
        joints = [self._model.joint(name).dofadr[0] for name in robot.joints]
        self._model.dof_frictionloss[joints] += load * draw.about('joint_friction', len(joints))

    def _root_pose(self) -> pin.SE3:
        """Return the pose of the robot's root link in the world frame of MuJoCo.

        An imported robot may have another root than the MuJoCo model, so the pose is computed from
        that of the hand. The arm must be at mid-range.
        """
        theta = 0.5 * (self.robot.lower + self.robot.upper)
        return self._hand_pose() * self.robot.kinematics.end_effector_pose(theta).inverse()

    def _hand_pose(self) -> pin.SE3:
        """Return the pose of the end effector in the world frame of MuJoCo."""
        data, i = self._data, self._hand
        return pin.SE3(data.xmat[i].reshape(3, 3), data.xpos[i])

    def _make_guides(self) -> tendons.Guides:
        model, data, sites = self._model, self._data, []
        tendon_ids = self.individual.tendon_ids
        for t in tendon_ids:
            path = slice(model.tendon_adr[t], model.tendon_adr[t] + model.tendon_num[t])
            of_sites = model.wrap_type[path] == mujoco.mjtWrap.mjWRAP_SITE
            sites.append(model.wrap_objid[path][of_sites])
        place, give = model.site_pos, self._draw.about('give', model.nsite)
        runs = data.wrap_xpos.reshape(-1, 3), data.wrap_obj.ravel(), data.ten_wrapadr
        site = np.concatenate(sites), model.site_bodyid, data.xmat.reshape(-1, 9)
        return tendons.Guides(tendon_ids, *runs, data.ten_wrapnum, *site, place, place.copy(), give)

    def _stand(self, theta: Array) -> None:
        mujoco.mj_resetData(self._model, self._data)
        self._guides.place[:] = self._guides.rest
        self.individual.set_posture(self._data, theta)
        self._sensors.stand(theta)

    def reset(self, theta: Array | None = None) -> None:
        """Reset the arm to rest at θ [rad], (D,), as `Arm.reset` does.

        The age of the tendons, and thus their lengthening, does not change.
        """
        super().reset(theta)
        self._memory.rest[:] = 1.0
        for m in range(self.robot.muscle_count):
            tendons.read(self.tendons, self._muscle, self._memory, self._command, m)
        self._sensors.start(self.theta, self._module_readings())
        self._last_readings: MuscleReadings | None = None

    def _attach(self, which: Bools) -> None:
        super()._attach(which)
        memory, bias = self._memory, self.robot.tension.bias
        self._muscle.length[which] -= memory.longer[which]
        memory.elongation[which] = self.individual.elastic.elongation(bias)[which]
        memory.slow[which], memory.loop[which] = 0.0, 0.0

    def _turn_gravity(self, mount: Array) -> None:
        turn = self._root.rotation @ mount.T @ self._root.rotation.T
        self._model.opt.gravity[:] = turn @ self._upright_gravity

    @property
    def tendon_friction(self) -> Array:
        """Friction μ of each tendon along its route in the present posture, shape (M,)."""
        friction: Array = self.tendons.friction * (tendons.GUIDES + self._memory.bend)
        return friction

    @property
    def friction(self) -> Array:
        """Friction of the joints, which may be changed in place."""
        friction: Array = self._model.dof_frictionloss
        return friction

    def set_payload(self, mass: float) -> None:
        """Set the payload: a ball of this mass [kg] and 5 cm radius at the end effector."""
        self._model.body_mass[self._hand] = mass
        self._model.body_inertia[self._hand] = 0.4 * mass * 0.05**2
        mujoco_model.set_constants(self._model)

    def step(self, duration: float) -> None:
        """Advance the time by `duration` [s], rounded to whole steps of 1 ms."""
        self._memory.longer[:] = self._ageing.longer(duration)
        # The drift adds up, until `set_length_offset` sets the offsets anew.
        self._command.length_error[:] += self._ageing.drift * duration
        super().step(duration)

    def _step(self) -> None:
        model, data = self._model, self._data
        mujoco.mj_step1(model, data)
        if not math.isfinite(data.ten_length.sum()):
            # MuJoCo's wrapping can return NaN in the posture where a tendon just touches an object.
            data.qpos += NUDGE
            mujoco.mj_step1(model, data)
        self._steps += 1
        if self._steps % GUIDES_EVERY == 0:
            tendons.guides_step(self._guides_handle, GUIDES_EVERY * STEP)
        absolute = data.ten_length[self.individual.tendon_ids]
        tendons.tendons_step(self._tendons_handle, self._kind, absolute, self._tendon_force)
        data.ctrl[self._control] = self._tendon_force
        data.qfrc_applied[:] = 0.0
        if self._wrench.any():
            turn = self._root.rotation
            force, torque = turn @ self._wrench[:3], turn @ self._wrench[3:]
            at = data.xpos[self._hand]
            mujoco.mj_applyFT(model, data, force, torque, at, self._hand, data.qfrc_applied)
        mujoco.mj_step2(model, data)
        self._sensors.append(self.theta, self._module_readings())

    def _divergence_cause(self) -> str:
        model, touching = self._model, dict[str, None]()
        for contact in self._data.contact:
            pair = (model.body(model.geom_bodyid[geom]).name for geom in contact.geom)
            touching[' and '.join(pair)] = None
        if not touching:
            return super()._divergence_cause()
        return (
            f'These bodies touch: {listed([*touching])}. Contacts of overlapping or very light '
            'bodies can accelerate them without bounds; exclude contacts that the robot does not '
            'have (contact/exclude in the MuJoCo file), or increase the armature of the joints'
        )

    def _module_readings(self) -> MuscleReadings:
        """Return what the sensors of the modules measure at this moment."""
        memory, muscle = self._memory, self._muscle
        return MuscleReadings(
            length=memory.reading, tension=memory.cell, temperature=muscle.housing
        )

    def _raw_readings(self) -> ArmReadings:
        return self._sensors.read(self.effects.jitter * self._rng.uniform(-0.5, 0.5))

    def sense(self) -> ArmReadings:
        """Read all sensors once, with delay, noise, errors, resolution and faults."""
        now = super().sense()
        read, last = now.muscles, self._last_readings or now.muscles
        lost = self._rng.uniform(size=self.robot.muscle_count) < self.effects.dropouts
        self._last_readings = read.replace(
            length=np.where(lost, last.length, read.length),
            tension=np.where(lost, last.tension, read.tension),
        )
        return now._replace(muscles=self._last_readings)

    @property
    def hand(self) -> pin.SE3:
        """True pose of the end effector in the root link's frame."""
        return self._root.actInv(self._hand_pose())

    def route_points(self) -> Array:
        """Return the true route points in the root link's frame [m], shape (P, 3)."""
        points: Array = self._data.site_xpos[self._guides.site] - self._root.translation
        return points @ self._root.rotation
