# SPDX-License-Identifier: Apache-2.0
"""Export a learned body as an MJCF model, and compare the model with the network.

Links, joints, limits and masses are those of the robot directory. Route points are learned: the
calibrated body without a remainder is fitted to the network (`body_model.fit.fit_to_network`).
Each tendon has an actuator that represents a motor and its series elastic element. The control u is
the length of the tendon at which the element is slack:

    T = k (L − u),   0 ≤ T ≤ T_max,   k = dT/dx at T_mid = (T_bias + T_limit) / 2

x is the elongation of the element, and L is the length of the tendon in MuJoCo. The control is
u = l + offset, where l is the length in muscle_states.
Tendon friction is approximated by a constant force μ T_mid, although it is a share of the tension.
"""

from collections.abc import Callable
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
import pinocchio as pin

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.body_model.calibrated_body import CalibratedBody
from musculoskeletal_ae.body_model.fit import fit_to_network
from musculoskeletal_ae.emulator.foreign import mujoco_model
from musculoskeletal_ae.emulator.foreign.effects import NONE, Draw
from musculoskeletal_ae.emulator.modules import joint_gear
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.exporting.learned_routes import learned_routes
from musculoskeletal_ae.exporting.user_file import UserFile
from musculoskeletal_ae.files import file_error, new_directory
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.robot.description import RoutePoint
from musculoskeletal_ae.robot.drawing import SHORTEST_BONE
from musculoskeletal_ae.robot.robot import Robot

POSTURES = 1000  # compare the model and the network in this many postures
#: multiply this damping by the `joint_gear` of a joint [N·m·s/rad]; chosen for a stable simulation
DAMPING = 0.05
THIN = 0.008  # represent bones by capsules of this radius [m]
TIMESTEP = 0.002  # let MuJoCo simulate the exported model with this time step [s]
LEGEND = """\
length      standard deviation of the difference of lengths
moment arm  difference of dl/dq (norm over all joints, root mean square over the postures), and the
            size of dl/dq, in the same way
spring      largest error of the linear spring between T_bias and T_limit
offset      control = l + offset, where l is the length in muscle_states
Torques of weight and springs are those of the robot directory, unless the springs were learned.
The model does not represent the differences of lengths and moment arms above, the nonlinearity of
the elastic elements, friction proportional to tension, creep, sensor errors and heat.
"""


class ExportReport(NamedTuple):
    """Differences between an exported model and the network, over the workspace.

    Lengths and moment arms are compared with those of the network. The joint torque that gravity
    and springs exert is compared with that of the robot description, which includes the learned
    springs of the joints.
    """

    lengths: Array  # standard deviation of each muscle's length error at T_mid [m], (M,)
    #: error of each muscle's moment arms: norm over the joints, root mean square over the postures
    #: [m], (M,)
    arms: Array
    arm_size: Array  # size of the network's moment arms, computed in the same way [m], (M,)
    #: largest difference of the torque that holds the arm against weight and springs [N·m], (D,)
    torque: Array
    stretch: Array  # largest error of the linear spring within [T_bias, T_limit] [m], (M,)
    warnings: tuple[str, ...]  # warnings of MuJoCo about the model
    mjx: str  # text that says whether MJX can load the model
    kept: dict[str, str]  # why a muscle keeps the points of the robot directory, by muscle

    def text(self, robot: Robot, offsets: Array) -> str:
        """Return the report as text; `offsets` [m] (M,) convert measured lengths to controls."""
        counts = f'{robot.joint_count} joints, {robot.muscle_count} muscles, {POSTURES} postures'
        units = f'{"":<28}{"[mm]":>10}{"[mm]":>12}{"[mm]":>8}{"[mm]":>9}{"[m]":>11}'
        head = f'{"muscle":<28}{"length":>10}{"moment arm":>12}{"of":>8}{"spring":>9}{"offset":>11}'
        lines = [f'{counts}, at T_mid = (T_bias + T_limit) / 2', '', head, units]
        rows = zip(robot.muscles, self.lengths, self.arms, self.arm_size, self.stretch, offsets)
        for name, length, arm, size, stretch, offset in rows:
            numbers = f'{1e3 * length:>10.2f}{1e3 * arm:>12.2f}{1e3 * size:>8.1f}'
            lines.append(f'{name:<28}{numbers}{1e3 * stretch:>9.2f}{offset:>11.5f}')
        torques = ', '.join(
            f'{name} {unit.torque_text(value, ".2g")}'
            for name, value, unit in zip(robot.joints, self.torque, robot.units)
        )
        lines += ['', kept_text(self.kept)]
        warned = '; '.join(self.warnings) or 'none'
        about = 'torque of weight and springs, largest difference between robot.urdf and MuJoCo'
        lines += ['', f'{about}: {torques}']
        lines += [f'warnings of MuJoCo: {warned}', f'MJX {self.mjx}', '', LEGEND]
        return '\n'.join(lines)


def kept_text(kept: dict[str, str]) -> str:
    """Return a line that names the muscles which keep the points of the input.

    `kept` is the reason for each of them. Muscles with the same reason are listed together.
    """
    reasons = dict[str, list[str]]()
    for muscle, reason in kept.items():
        reasons.setdefault(reason, []).append(muscle)
    parts = [f'{", ".join(muscles)} ({reason})' for reason, muscles in reasons.items()]
    return f'muscles that keep their points: {"; ".join(parts) or "none"}'


def export_into(robot: Robot, mae: Mae, file: Path, out: Path, seed: int = 0) -> str:
    """Export learned attachment points into a copy of a user's MJCF file, with `report.txt`.

    Args:
        robot: The robot that was imported from the file.
        mae: The network that learned an arm of this robot.
        file: Path of the user's MJCF file.
        out: A new or empty directory.
        seed: Seed of the fit.

    Returns:
        The report.

    Raises:
        MusculoskeletalError: If the file is not that of the robot, the directory is not empty, or
            MuJoCo does not load the result.
    """
    user = UserFile(file)
    sites = user.sites_of(robot)
    if not any(chain(*sites)):
        raise file_error(
            file,
            f'it has no tendon with the name and the sites of a muscle of '
            f'{robot.description.directory}; import this file again, because the robot was '
            'imported from another version of it, or its muscles were renamed',
        )
    with new_directory(out):
        robot = robot.with_elasticity(mae.elasticity)
        body = CalibratedBody(robot)
        fit_to_network(body, mae, seed, with_remainder=False)
        learned = learned_routes(robot, body, mae, sites)
        for names, route, moved in zip(
            sites, robot.description.routes, learned.routes, strict=True
        ):
            pairs = zip(route, moved, strict=True)
            points = [pair for pair in pairs if isinstance(pair[0], RoutePoint)]
            for name, (before, after) in zip(names, points, strict=True):
                if name is not None and before is not after:
                    user.move(name, after.xyz)
        written = user.write(out)
        mjx = loads_in_mjx(mujoco.MjModel.from_xml_path(str(written)))
        head = f'{"muscle":<28}{"length [mm]":>18}{"moment arm [mm]":>20}'
        lines = [f'{written.name}: {file} with learned attachment points', '', head]
        parts = *learned.before, *learned.after
        for name, l0, a0, l1, a1 in zip(robot.muscles, *(1e3 * part for part in parts)):
            lines.append(f'{name:<28}{f"{l0:.2f} → {l1:.2f}":>18}{f"{a0:.2f} → {a1:.2f}":>20}')
        lines += ['', 'differences from the network: file → copy; computed as in export_mjcf']
        lines += ['', kept_text(learned.kept), f'MJX {mjx}', '']
        (out / 'report.txt').write_text(text := '\n'.join(lines), encoding='utf-8')
    return text


def loads_in_mjx(model: Any) -> str:
    """Return a text that says whether MJX can load a model."""
    try:
        from mujoco import mjx
    except ImportError:
        return 'was not tested: mujoco-mjx is not installed'
    try:
        mjx.put_model(model)
    except Exception as error:  # noqa: BLE001 - mjx raises errors of many kinds
        return f'cannot load the model: {" ".join(str(error).split())}'
    return 'can load the model'


def export(robot: Robot, mae: Mae, out: Path) -> ExportReport:
    """Export a learned body as `model.xml` and `report.txt` into a new or empty directory.

    Raises:
        MusculoskeletalError: If the directory is not empty, or MuJoCo does not load the model.
    """
    with new_directory(out):
        return _write(robot, mae, out)


def _write(robot: Robot, mae: Mae, out: Path) -> ExportReport:
    robot = robot.with_elasticity(mae.elasticity)
    body = CalibratedBody(robot)
    fit_to_network(body, mae, with_remainder=False)
    learned = learned_routes(robot, body, mae)
    moved = Robot(replace(robot.description, routes=learned.routes))
    moved = moved.with_elasticity(mae.elasticity)
    springs = _springs(robot, body)
    spec = _spec(moved, mae, springs)
    try:
        spec.compile()
        text = spec.to_xml()
    except (ValueError, mujoco.FatalError) as error:
        message = f'MuJoCo rejects the exported model: {" ".join(str(error).split())}'
        raise MusculoskeletalError(f'{out}: {message}') from error
    file = out / 'model.xml'
    file.write_text(text, encoding='utf-8')
    warnings: list[str] = []
    mujoco.set_mju_user_warning(warnings.append)
    try:
        model = mujoco.MjModel.from_xml_path(str(file))
    finally:
        mujoco.set_mju_user_warning(lambda _: None)
    report, offsets = _compare(robot, mae, model, springs, tuple(warnings), learned.kept)
    text = report.text(robot, offsets)
    (out / 'report.txt').write_text(text, encoding='utf-8')
    return report


class SpringTable(NamedTuple):
    """Linear springs that represent M muscles; each field has the shape (M,)."""

    tension: Array  # tension T_mid in the middle between T_bias and T_limit [N]
    elongation: Array  # elongation at T_mid [m]
    stiffness: Array  # stiffness of the linear spring [N/m]
    error: Array  # largest error of the elongation between T_bias and T_limit [m]


def _springs(robot: Robot, body: CalibratedBody) -> SpringTable:
    low, high, at_zero = robot.tension.bias, robot.tension.limit, robot.routes.length_at_zero
    mid = 0.5 * (low + high)
    rows = []
    for m in range(robot.muscle_count):
        law = body.elastic(m)
        tension = np.linspace(low[m], high[m], 50)
        elongation = law.elongation(np.full(50, at_zero[m]), tension)
        middle = float(law.elongation(at_zero[m], mid[m]))
        stiffness = 1.0 / float(law.compliance(at_zero[m], mid[m]))
        error = float(np.abs(middle + (tension - mid[m]) / stiffness - elongation).max())
        rows.append((mid[m], middle, stiffness, error))
    return SpringTable(*map(np.array, zip(*rows, strict=True)))


def _spec(robot: Robot, mae: Mae, springs: SpringTable) -> Any:
    """Return the MjSpec of a robot with learned route points, tendon friction and actuators."""
    exact, once = Draw(0, NONE), np.zeros(robot.muscle_count, dtype=np.int64)
    spec, bodies = mujoco_model.skeleton(robot, exact)
    mujoco_model.add_routes(robot, exact, once, spec, bodies)
    spec.modelname = robot.description.directory.name
    spec.option.timestep = TIMESTEP
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    kin, gear = robot.kinematics, joint_gear(robot.kinematics)
    dampers = robot.units.elasticity_outside(kin.elasticity).damping
    for i in range(1, kin.model.njoints):
        joint = spec.joint(kin.model.names[i])
        name, damping = kin.model.names[i], float(gear[i]) * DAMPING
        if name in robot.joints:
            damping += float(dampers[robot.joints.index(name)])
        joint.damping, joint.armature = [damping, 0.0, 0.0], 0.0
        bodies[i].name = f'{kin.model.names[i]} link'
        reach = kin.tree.placement_translation[kin.tree.parent == i]
        for end in reach[np.linalg.norm(reach, axis=1) > SHORTEST_BONE]:
            _bone(bodies[i], end)
    carrier, at = kin.placement(robot.description.end_effector)
    bodies[carrier].add_site(name='hand', pos=at.translation, quat=_quaternion(at))
    if np.linalg.norm(at.translation) > SHORTEST_BONE:
        _bone(bodies[carrier], at.translation)
    friction, most = np.abs(mae.friction) * springs.tension, robot.tension.max
    theta = robot.random_postures(POSTURES, np.random.default_rng(0))
    lengths = robot.routes.absolute_lengths(theta)
    for m, name in enumerate(robot.muscles):
        spec.tendon(name).frictionloss = float(friction[m])
        k = float(springs.stiffness[m])
        gain, bias = np.zeros(10), np.zeros(10)
        gain[0], bias[1] = k, -k  # force = k (u − L); a negative force shortens the tendon
        reach = float(most[m]) / k
        span = [float(lengths[:, m].min()) - reach, float(lengths[:, m].max()) + reach]
        spec.add_actuator(
            name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_TENDON,
            gaintype=mujoco.mjtGain.mjGAIN_FIXED, biastype=mujoco.mjtBias.mjBIAS_AFFINE,
            gainprm=gain, biasprm=bias, ctrllimited=True, ctrlrange=span,
            forcelimited=True, forcerange=[-float(most[m]), 0.0],
        )  # fmt: skip
    return spec


def _bone(body: Any, end: Array) -> None:
    free = {'contype': 0, 'conaffinity': 0, 'mass': 0.0, 'group': 1}
    kind = mujoco.mjtGeom.mjGEOM_CAPSULE
    body.add_geom(type=kind, fromto=[0.0, 0.0, 0.0, *end], size=[THIN, 0.0, 0.0], **free)


def _quaternion(at: pin.SE3) -> Array:
    coefficients: Array = pin.Quaternion(at.rotation).coeffs()
    return np.roll(coefficients, 1)


def _compare(
    robot: Robot,
    mae: Mae,
    model: Any,
    springs: SpringTable,
    warnings: tuple[str, ...],
    kept: dict[str, str],
) -> tuple[ExportReport, Array]:
    """Compare an exported model with the network from which it was made.

    Args:
        robot: The robot, with learned springs of the joints.
        mae: The network.
        model: The compiled MjModel.
        springs: Linear springs that represent the series elastic elements in the model.
        warnings: Warnings of MuJoCo about the model, for the report.
        kept: Why a muscle keeps the route points of the robot directory, by muscle; for the report.

    Returns:
        The report, and for each muscle the offset [m], (M,), that is added to a length l in
        muscle_states to get the control of the muscle's actuator.
    """
    theta = robot.random_postures(POSTURES, np.random.default_rng([1, 0xE2]))
    tension = np.broadcast_to(springs.tension, (POSTURES, robot.muscle_count))
    lengths, jacobian = mae.lengths(theta, tension), mae.muscle_jacobian(theta, tension)
    state, data, kin = _posture(robot, model), mujoco.MjData(model), robot.kinematics
    names = kin.model.names[1:]
    tree = np.array([model.joint(name).dofadr[0] for name in names])
    tendons = np.array([model.tendon(name).id for name in robot.muscles])
    theirs, arms, torques = np.empty_like(lengths), np.empty_like(jacobian), np.empty_like(theta)
    dense = np.zeros((model.ntendon, model.nv))
    rows = model.ten_J_rownnz, model.ten_J_rowadr, model.ten_J_colind
    for n, row in enumerate(theta):
        state(data, row)
        theirs[n] = data.ten_length[tendons]
        mujoco.mju_sparse2dense(dense, data.ten_J, *rows)
        arms[n] = kin.tree.of_theta(dense[tendons][:, tree], row)
        torques[n] = kin.tree.of_theta((data.qfrc_bias - data.qfrc_passive)[tree], row)
    # At T_mid, the elongation of the spring is the same in all postures.
    off = theirs - springs.elongation - lengths
    return ExportReport(
        lengths=off.std(axis=0),
        arms=np.sqrt(((arms - jacobian) ** 2).sum(axis=2).mean(axis=0)),
        arm_size=np.sqrt((jacobian**2).sum(axis=2).mean(axis=0)),
        torque=np.abs(torques - kin.holding_torque(theta)).max(axis=0),
        stretch=springs.error,
        warnings=warnings,
        mjx=loads_in_mjx(model),
        kept=kept,
    ), off.mean(axis=0) + springs.elongation - springs.tension / springs.stiffness


def _posture(robot: Robot, model: Any) -> Callable[[Any, Array], None]:
    places = np.array([model.joint(name).qposadr[0] for name in robot.kinematics.model.names[1:]])

    def put(data: Any, theta: Array) -> None:
        data.qpos[places], data.qvel[:] = robot.kinematics.tree.angles(theta), 0.0
        mujoco.mj_forward(model, data)

    return put
