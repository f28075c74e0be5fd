# SPDX-License-Identifier: Apache-2.0
"""The second body: a reality that shares nothing with what the learner knows of bodies.

Rigid bodies, wrapping, stops and joint friction by MuJoCo; wires, rubber and spools by `wires`; the
muscle modules are those of every arm. It imports nothing of learning, of the geometric routes or of
the series-elastic class (`test/test_house.py`).
"""

import copy
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pinocchio as pin

from musculoskeletal_ae.arrays import Array, Bools
from musculoskeletal_ae.emulator import deviation, mjcf, wires
from musculoskeletal_ae.emulator.effects import NONE, Draw, Effects
from musculoskeletal_ae.emulator.faults import Readings
from musculoskeletal_ae.emulator.modules import STEP, Arm
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.robot.description import Wrap
from musculoskeletal_ae.robot.jumps import REDRAWN, jumping
from musculoskeletal_ae.robot.kinematics import body_frames
from musculoskeletal_ae.robot.robot import Robot

GUIDES_EVERY = 5  # steps
HISTORY = 64  # steps that sensors may be late
HOUR = 3600.0  # [s]
BEDDING_TIME = 2.0 * HOUR  # [s]
NUDGE = 1e-7  # [rad]
SLIP_TIME = 5.0 * HOUR  # [s] between two slips of a wire on its spool
OTHER_LIMITS = 0.02  # share of a joint's range by which a file's limits may be off
OTHER_ROUTE = 0.02  # [m] by which a file's lengths are not off if its routes are the robot's


class ForeignBody:
    """True lengths, moment arms, elastic laws and sensor errors of one arm, at rest and new."""

    def __init__(self, robot: Robot, model: Any, draw: Draw) -> None:
        """Look at a model whose joints and tendons have the robot's names."""
        self._robot, self._model = robot, model
        self._data = mujoco.MjData(model)
        names, count = robot.kinematics.model.names[1:], robot.muscle_count
        #: where the joints of the tree stand in qpos and qvel, and muscles among tendons
        self.tree = np.array([model.joint(name).id for name in names])
        self.tendons = np.array([model.tendon(name).id for name in robot.muscles])
        self.length_at_zero = self.absolute_lengths(np.zeros((1, robot.joint_count)))[0]
        self.elastic = wires.Springs(robot, self.length_at_zero, draw)
        self.tension_gain: Array = 1.0 + draw.normal('tension_gain', count)
        self.tension_bias: Array = draw.normal('tension_zero', count)
        self.length_bias: Array = np.zeros(count)

    def look(self, data: Any, theta: Array) -> Any:
        """Return some MjData with bones at θ [rad] (D,), lengths and moment arms."""
        data.qpos[self.tree] = self._robot.kinematics.tree.angles(theta)
        mujoco.mj_fwdPosition(self._model, data)
        return data

    def absolute_lengths(self, theta: Array) -> Array:
        """Return the lengths of the routes [m], θ (N, D) gives (N, M)."""
        return np.stack([self.look(self._data, row).ten_length[self.tendons] for row in theta])

    def muscle_jacobian(self, theta: Array) -> Array:
        """Return G [m/rad], θ (N, D) gives (N, M, D)."""
        model = self._model
        jacobian = np.empty((len(theta), model.ntendon, model.nv))
        rows = model.ten_J_rownnz, model.ten_J_rowadr, model.ten_J_colind
        for dense, angles in zip(jacobian, theta, strict=True):
            mujoco.mju_sparse2dense(dense, self.look(self._data, angles).ten_J, *rows)
        return self._robot.kinematics.tree.of_theta(
            jacobian[:, self.tendons][:, :, self.tree], theta
        )

    def muscle_lengths(self, theta: Array, tension: Array) -> Array:
        """Return l [m] without friction, loops, give and sensor errors, θ (N, D), T (N, M)."""
        relative = self.absolute_lengths(theta) - self.length_at_zero
        return relative - self.elastic.elongation(tension)


def _directory(robot: Robot, draw: Draw) -> Any:
    """Return the model of a robot directory, individually off.

    Route points are drawn again until no wire slips over the end of what it is described to wrap
    round, by centimetres: nobody lays it there.
    """
    again = np.zeros(robot.muscle_count, dtype=np.int64)
    model = mjcf.from_directory(robot, draw, again).compile()
    if not any(isinstance(item, Wrap) for route in robot.description.routes for item in route):
        return model

    def slipping(model: Any) -> Bools:
        return jumping(ForeignBody(robot, model, draw).absolute_lengths, robot)

    smooth = ~slipping(mjcf.from_directory(robot, Draw(0, NONE), again).compile())
    while again.max() < REDRAWN and (wrong := slipping(model) & smooth).any():
        again += wrong
        model = mjcf.from_directory(robot, draw, again).compile()
    return model


def _deviate(robot: Robot, model: Any, draw: Draw) -> None:
    """Let the body of a file be an individual; its wires jump only where those of the file do."""
    smooth = ~jumping(ForeignBody(robot, copy.copy(model), draw).absolute_lengths, robot)
    attachments = deviation.Attachments(robot, model, draw)
    for _ in range(REDRAWN):
        body = ForeignBody(robot, copy.copy(model), draw)
        if not (wrong := smooth & jumping(body.absolute_lengths, robot)).any():
            break
        attachments.move(wrong)
    deviation.change_masses(model, draw)


def _other_routes(robot: Robot, file: Path, off: Array) -> tuple[str, ...]:
    """Say which muscles of a file have other lengths than the robot's, by `off` [m] (N, M)."""
    most = np.abs(off).max(axis=0)
    return tuple(
        f'reality {file}: muscle {robot.muscles[m]!r} is up to {1e3 * most[m]:.0f} mm longer or '
        f'shorter there than in {robot.description.directory}; is it the same robot?'
        for m in np.flatnonzero(most > OTHER_ROUTE)
    )


def _other_limits(robot: Robot, file: Path, model: Any) -> Iterator[str]:
    """Say which joints of a file have other limits than the robot's."""
    for name, *due in zip(robot.joints, robot.lower, robot.upper):
        joint = model.joint(name).id
        given = model.jnt_range[joint] if model.jnt_limited[joint] else np.array([-np.inf, np.inf])
        if np.abs(given - due).max() > OTHER_LIMITS * (due[1] - due[0]):
            there = f'moves from {given[0]:.4g} to {given[1]:.4g} there'
            yield (
                f'reality {file}: joint {name!r} {there}, in {robot.description.directory} from '
                f'{due[0]:.4g} to {due[1]:.4g}; its stops are those of the file: '
                'give it the same range in both (MJCF counts in degrees unless told)'
            )


class LateSensors:
    """What is wrong with joint sensors and messages: offset, bend, backlash, and delay."""

    def __init__(self, robot: Robot, draw: Draw) -> None:
        joints, radian = robot.joint_count, robot.kinematics.radian
        self._joint_count, self._span = joints, robot.upper - robot.lower
        self._zero = radian * draw.normal('joint_zero', joints)
        self._bend = draw.about('joint_bend', joints, signed=True)
        self._backlash = radian * draw.about('backlash', joints)
        self._delays = draw.about('delay', 2)  # of joint sensors and of muscle modules [s]
        self._history = np.zeros((HISTORY, joints + 3 * robot.muscle_count))
        self._steps = 0

    def stand(self, theta: Array) -> None:
        """Let the joints stand at θ, in the middle of their backlash."""
        self._play = theta + self._zero

    def start(self, now: Array) -> None:
        """Let everything have been as it is now for as long as sensors are late."""
        self._history[:] = now

    def note(self, now: Array) -> None:
        """Take what is to be sensed after one more step."""
        self._steps += 1
        self._history[self._steps % HISTORY] = now

    def read(self, jitter: float) -> tuple[Array, Array, Array, Array]:
        """Return θ, l, T and heat as they are read; the jitter of the delay is in seconds."""
        late = np.maximum(self._delays + jitter, 0.0) / STEP
        seen = [self._history[(self._steps - round(steps)) % HISTORY] for steps in late]
        half, span = 0.5 * self._backlash, self._span
        theta = seen[0][: self._joint_count] + self._zero
        theta = theta + self._bend * span * np.sin(2.0 * np.pi * theta / span)
        self._play = np.clip(self._play, theta - half, theta + half)
        return self._play, *seen[1][self._joint_count :].reshape(3, -1)


class Ageing:
    """What changes over hours: wires bed in, a knot slips, spools slip, length sensors drift.

    Attributes:
        drift: Of the length sensors [m/s], (M,).
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
        """Return by how much wires are longer [m] (M,) in a time that begins now [s]."""
        age = self._time / BEDDING_TIME
        longer = self._bedding * -np.expm1(-age) + self._knot * (self._time > self._knot_time)
        slipping = self._slips.uniform(size=len(longer)) < duration / SLIP_TIME
        self._slipped = self._slipped + slipping * self._slips.choice([-1.0, 1.0], len(longer))
        self._time += duration
        result: Array = longer + self._spool_slip * self._slipped
        return result


class ForeignArm(Arm):
    """An arm of MuJoCo."""

    def __init__(
        self,
        robot: Robot,
        seed: int = 0,
        effects: Effects | None = None,
        file: Path | None = None,
        deviates: bool = False,
    ) -> None:
        """Build an individual at rest, modules safe; effects are as calibrated by default.

        A `file` is a user's own MJCF arm instead. It has its own effects and none of ours, unless
        the individual deviates from it, as `deviation` says.

        Raises:
            MusculoskeletalError: If the robot or the file cannot be built.
        """
        self.effects = (effects or Effects()) if file is None else NONE
        if file is not None and deviates:
            self.effects = deviation.effects(robot)
        draw = self._draw = Draw(seed, self.effects)
        try:
            model = self._model = mjcf.from_file(robot, file) if file else _directory(robot, draw)
            if file is not None and deviates:
                _deviate(robot, model, draw)
            data = self._data = mujoco.MjData(model)
            self.individual = body = ForeignBody(robot, copy.copy(model), draw)
            if file is not None and deviates:
                body.length_bias = deviation.slack(robot, draw)
        except (ValueError, mujoco.FatalError) as error:
            told = ' '.join(str(error).split())
            raise MusculoskeletalError(f'reality {file or "foreign"}: {told}') from error
        super().__init__(robot, seed, body.length_bias)
        if file is None or deviates:
            self._rub()
        elif effects is not None and effects.joint_friction == 0.0:
            model.dof_frictionloss[:] = model.tendon_frictionloss[:] = 0.0
        self._angles, self._rates = data.qpos, data.qvel
        self._order = np.array([model.joint(name).id for name in robot.joints])
        self._hand = model.body(mjcf.HAND).id
        self._guides = self._make_guides()
        muscles = robot.muscle_count
        self._memory = wires.Memory(*(np.zeros(muscles) for _ in wires.Memory._fields))
        self._memory = self._memory._replace(slow=np.zeros((muscles, len(wires.TIMES))))
        still = np.zeros(muscles)
        guided = wires.GuideParts(self._guides, self._muscle.end_tension, self._memory.bend)
        self._guided = wires.handed(guided)
        body.look(data, 0.5 * (robot.lower + robot.upper))
        self._root = self._root_pose() if file else pin.SE3.Identity()
        wires.guides_step(self._guided, 0.0)
        at_zero, bend = body.length_at_zero, self._memory.bend
        theta = robot.random_postures(500, np.random.default_rng(0))
        span = body.absolute_lengths(theta) - at_zero
        if file and not deviates:
            routes = _other_routes(robot, file, span - robot.muscle_lengths(theta, still))
            self.warnings = *routes, *_other_limits(robot, file, model)
        self.wires = wires.make_wires(robot, body.elastic, at_zero, span, bend, draw)
        self._wound = self._modules(span, body.elastic.elongation(robot.tension.max))
        self._wired = wires.handed(
            wires.WireParts(self.wires, self._wound, self._muscle, self._memory, self._command)
        )
        self._sensors = LateSensors(robot, draw)
        self._ageing = Ageing(robot, draw, self.effects.spool_slip)
        self._steps = 0
        self._pull = np.zeros(muscles)
        self._control = np.array([model.actuator(name).id for name in robot.muscles])
        self.reset()

    def _rub(self) -> None:
        """Let joints rub, each by its own load."""
        robot, draw, body = self.robot, self._draw, self.individual
        theta = robot.random_postures(200, draw.rng('load'))
        torque = robot.kinematics.holding_torque(theta)
        load = robot.joint_load(torque, body.muscle_jacobian(theta))
        joints = [self._model.joint(name).dofadr[0] for name in robot.joints]
        self._model.dof_frictionloss[joints] += load * draw.about('joint_friction', len(joints))

    def _root_pose(self) -> pin.SE3:
        """Return where a file has the robot's root link, joints mid-range.

        The link nearest to it that is in the file tells: `import_robot` renames, cuts, and puts an
        upright root below one that leans.
        """
        robot, model, data = self.robot, self._model, self._data
        known = mjcf.bodies_as_imported(model)
        links = [str(frame.name) for frame in body_frames(robot.description.model)]  # root first
        # The end effector is in the file, by `from_file`.
        link = next((link for link in links if link in known), robot.description.end_effector)
        i = known.get(link, self._hand)
        there = pin.SE3(data.xmat[i].reshape(3, 3), data.xpos[i])
        theta = 0.5 * (robot.lower + robot.upper)
        return there * robot.kinematics.link_pose(theta, link).inverse()

    def _make_guides(self) -> wires.Guides:
        model, data, tendons, sites = self._model, self._data, self.individual.tendons, []
        for t in tendons:
            path = slice(model.tendon_adr[t], model.tendon_adr[t] + model.tendon_num[t])
            of_sites = model.wrap_type[path] == mujoco.mjtWrap.mjWRAP_SITE
            sites.append(model.wrap_objid[path][of_sites])
        place, give = model.site_pos, self._draw.about('give', model.nsite)
        runs = data.wrap_xpos.reshape(-1, 3), data.wrap_obj.ravel(), data.ten_wrapadr
        site = np.concatenate(sites), model.site_bodyid, data.xmat.reshape(-1, 9)
        return wires.Guides(tendons, *runs, data.ten_wrapnum, *site, place, place.copy(), give)

    def _stand(self, theta: Array) -> None:
        mujoco.mj_resetData(self._model, self._data)
        self._guides.place[:] = self._guides.rest
        self.individual.look(self._data, theta)
        self._sensors.stand(theta)

    def reset(self, theta: Array | None = None) -> None:
        """Put the arm at rest at θ, as `Arm.reset`; it gets no younger by that."""
        super().reset(theta)
        self._memory.rest[:] = 1.0
        for m in range(self.robot.muscle_count):
            wires.read(self.wires, self._muscle, self._memory, self._command, m)
        self._sensors.start(self._now())
        self._last: Readings | None = None

    def _attach(self, which: Bools) -> None:
        super()._attach(which)
        memory, bias = self._memory, self.robot.tension.bias
        self._muscle.length[which] -= memory.longer[which]
        memory.elongation[which] = self.individual.elastic.elongation(bias)[which]
        memory.slow[which], memory.loop[which] = 0.0, 0.0

    def set_payload(self, mass: float) -> None:
        """Put a mass [kg] into the hand, as a ball of 5 cm radius at the end effector."""
        self._model.body_mass[self._hand] = mass
        self._model.body_inertia[self._hand] = 0.4 * mass * 0.05**2
        mujoco.mj_setConst(self._model, mujoco.MjData(self._model))

    def step(self, duration: float) -> None:
        """Let time pass [s], in whole steps of `STEP`."""
        self._memory.longer[:] = self._ageing.longer(duration)
        # The sensors drift until somebody zeroes them, as `set_length_offset` does.
        self._command.length_error[:] += self._ageing.drift * duration
        super().step(duration)

    def _step(self) -> None:
        model, data = self._model, self._data
        if self.broken:
            return
        mujoco.mj_step1(model, data)
        if not math.isfinite(data.ten_length.sum()):
            # MuJoCo's wrapping can be NaN where a wire just touches; beside that it is not.
            data.qpos += NUDGE
            mujoco.mj_step1(model, data)
        self._steps += 1
        if self._steps % GUIDES_EVERY == 0:
            wires.guides_step(self._guided, GUIDES_EVERY * STEP)
        absolute = data.ten_length[self.individual.tendons]
        wires.wires_step(self._wired, self._kind, absolute, self._pull)
        data.ctrl[self._control] = self._pull
        data.qfrc_applied[:] = 0.0
        if self._wrench.any():
            turn = self._root.rotation
            push, twist = turn @ self._wrench[:3], turn @ self._wrench[3:]
            at = data.xpos[self._hand]
            mujoco.mj_applyFT(model, data, push, twist, at, self._hand, data.qfrc_applied)
        mujoco.mj_step2(model, data)
        self._sensors.note(self._now())

    def _now(self) -> Array:
        """Return what is to be sensed: θ, l and T as the modules' sensors have them, heat."""
        memory, muscle = self._memory, self._muscle
        return np.concatenate([self.theta, memory.reading, memory.cell, muscle.housing])

    def _sensed(self) -> tuple[Array, Array, Array, Array]:
        return self._sensors.read(self.effects.jitter * self._rng.uniform(-0.5, 0.5))

    def sense(self) -> Readings:
        """Read all sensors once, late, with their noise, errors, resolution and faults."""
        now = super().sense()
        last = self._last or now
        lost = self._rng.uniform(size=len(now.length)) < self.effects.dropouts
        length, tension = (np.where(lost, old, new) for old, new in zip(last[1:3], now[1:3]))
        self._last = now._replace(length=length, tension=tension)
        return self._last

    @property
    def hand(self) -> pin.SE3:
        """True pose of the end effector in the root link's frame."""
        data, i = self._data, self._hand
        return self._root.actInv(pin.SE3(data.xmat[i].reshape(3, 3), data.xpos[i]))

    def route_points(self) -> Array:
        """True route points in the root link's frame [m], shape (P, 3)."""
        points: Array = self._data.site_xpos[self._guides.site] - self._root.translation
        return points @ self._root.rotation
