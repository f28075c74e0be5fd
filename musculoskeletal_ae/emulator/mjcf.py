# SPDX-License-Identifier: Apache-2.0
"""A robot as a MuJoCo model: built from its directory, or a user's own MJCF file.

MuJoCo does rigid bodies, wrapping, joint stops and joint friction. Our muscle modules pull at its
tendons; the actuators of a file are left out.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pinocchio as pin

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.emulator.effects import Draw
from musculoskeletal_ae.emulator.modules import STEP
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.robot.description import Wrap
from musculoskeletal_ae.robot.kinematics import JointPoses
from musculoskeletal_ae.robot.robot import Robot

ARMATURE, DAMPING = 0.005, 0.4  # [kg·m²], [N·m·s/rad] of a joint module; chosen
LENGTH_SPREAD, TURN_SPREAD = 0.005, np.radians(2.0)  # [m], [rad] of `Effects.links`
MASS_SPREAD, CENTRE_SPREAD = 0.15, 0.02  # share, [m]
THICKEST_HEAD = 0.045  # [m]
POSTURES = 300  # in which heads are fitted
HAND = 'hand of the emulator'

mujoco.set_mju_user_warning(lambda _: None)  # by default it writes a file where it was started


def from_directory(robot: Robot, draw: Draw) -> Any:
    """Return the body that a robot directory describes, individually off, as an MjSpec."""
    kin, spec = robot.kinematics, mujoco.MjSpec()
    model, names, links = kin.model, list(kin.model.names), draw.sizes.links
    spec.option.gravity = model.gravity.linear
    spec.compiler.balanceinertia, spec.compiler.degree = True, False
    spec.compiler.boundmass = 1e-6  # of links that weigh nothing
    weight = np.abs(kin.holding_torque(robot.random_postures(200, draw.rng('weight')))).max()
    friction = weight * draw.about('joint_friction', robot.joint_count)
    off = links * draw.rng('links').normal(size=(model.njoints, 4, 3))
    bodies = [spec.worldbody]
    for i in range(1, model.njoints):
        at, inertia, name = model.jointPlacements[i], model.inertias[i], names[i]
        long = np.linalg.norm(at.translation) > 2.0 * LENGTH_SPREAD  # two axes in one place stay so
        place = at.translation + LENGTH_SPREAD * off[i, 0] * long
        body = bodies[model.parents[i]].add_body(name=name, pos=place, quat=_turn(at.rotation))
        scale = np.exp(MASS_SPREAD * off[i, 1, 0])
        body.mass, body.explicitinertial = scale * inertia.mass, True
        body.ipos = inertia.lever + CENTRE_SPREAD * off[i, 2]
        about = scale * inertia.inertia + 1e-9 * np.eye(3)
        body.fullinertia = [*np.diag(about), about[0, 1], about[0, 2], about[1, 2]]
        axis = pin.exp3(TURN_SPREAD * off[i, 3]) @ kin.local_axis[i]
        kinds = mujoco.mjtJoint
        kind = kinds.mjJNT_SLIDE if kin.prismatic[i] else kinds.mjJNT_HINGE
        joint = body.add_joint(name=name, type=kind, axis=axis, armature=ARMATURE, damping=DAMPING)
        if name in robot.joints:
            k = robot.joints.index(name)
            joint.limited, joint.range = True, [robot.lower[k], robot.upper[k]]
            joint.frictionloss = friction[k]
        else:
            coupling, data = robot.description.couplings[name], np.zeros(11)
            data[:2] = coupling.offset, coupling.ratio
            link = {'objtype': mujoco.mjtObj.mjOBJ_JOINT, 'name1': name, 'name2': coupling.master}
            spec.add_equality(type=mujoco.mjtEq.mjEQ_JOINT, data=data, **link)
        bodies.append(body)
    _add_routes(robot, draw, spec, bodies)
    joint, at = kin.placement(robot.description.end_effector)
    _add_hand(bodies[joint], at)
    return _pulled(spec, robot)


def _add_routes(robot: Robot, draw: Draw, spec: Any, bodies: list[Any]) -> None:
    """Add the wires: route points that are off, what is described to wrap round, and heads."""
    kin, off, rng = robot.kinematics, draw.rng('attachment'), draw.rng('heads')
    poses = kin.joint_poses(robot.random_postures(POSTURES, draw.rng('postures')))
    for muscle, route in zip(robot.muscles, robot.description.routes):
        tendon, before = spec.add_tendon(name=muscle), list[tuple[int, Array]]()
        for n, item in enumerate(route):
            joint, at = kin.placement(item.link)
            place, name, side = at.act(item.xyz), f'{muscle}, {n}', ''
            if isinstance(item, Wrap):
                axis = None if item.axis is None else at.rotation @ item.axis
                # Described ones are a little off as well.
                radius = item.radius * (rng.uniform(0.9, 1.1) if draw.sizes.heads > 0.0 else 1.0)
                _add_round(bodies[joint], name, place, axis, radius)
                if item.side is not None:
                    side = f'{name} side'
                    bodies[joint].add_site(name=side, pos=at.act(item.side))
                tendon.wrap_geom(name, side)
                before = []
                continue
            here = joint, place + draw.sizes.attachment * off.normal(size=3)
            share, cylinder = draw.sizes.heads * rng.uniform(0.8, 1.2), rng.uniform() < 0.5
            for last in before if share > 0.0 else ():
                carrier, axis, radius = _head(robot, poses, [last, here], share, cylinder)
                if radius > 1e-3:
                    _add_round(bodies[carrier], f'{name} head', np.zeros(3), axis, radius)
                    tendon.wrap_geom(f'{name} head', '')
            bodies[joint].add_site(name=name, pos=here[1])
            tendon.wrap_site(name)
            before = [here]


def _head(
    robot: Robot, poses: JointPoses, ends: list[tuple[int, Array]], share: float, cylinder: bool
) -> tuple[int, Array | None, float]:
    """Return joint, axis (None: a sphere) and radius [m] of the bone's head that a wire passes.

    It stands at the joint between its two ends that the straight line is nearest to, and touches
    the line in a `share` of the postures. A wire may slip over it to its other side.
    """
    kin, best, head = robot.kinematics, np.inf, (0, None, 0.0)
    between = kin.hangs_on[ends[0][0]] ^ kin.hangs_on[ends[1][0]]
    for joint in np.flatnonzero(between & ~kin.prismatic):
        away = []
        for carrier, place in ends:
            place = poses.rotation[:, carrier] @ place + poses.translation[:, carrier]
            axis, offset = poses.axis[:, joint], place - poses.translation[:, joint]
            along = np.sum(offset * axis, axis=1, keepdims=True) * axis
            away.append(offset - along if cylinder else offset)
        line = away[1] - away[0]
        at = -np.sum(away[0] * line, axis=1) / np.maximum(np.sum(line * line, axis=1), 1e-12)
        distance = np.linalg.norm(away[0] + np.clip(at, 0.0, 1.0)[:, None] * line, axis=1)
        if np.median(distance) < best:
            best, least = np.median(distance), min(np.linalg.norm(a, axis=1).min() for a in away)
            radius = min(float(np.quantile(distance, min(share, 1.0))), 0.8 * least, THICKEST_HEAD)
            head = int(joint), kin.local_axis[joint] if cylinder else None, radius
    return head


def _add_round(body: Any, name: str, place: Array, axis: Array | None, radius: float) -> None:
    """Add a sphere or a cylinder that wires wrap round and nothing else touches."""
    kind, turn = mujoco.mjtGeom.mjGEOM_SPHERE, pin.Quaternion.Identity()
    if axis is not None:
        kind = mujoco.mjtGeom.mjGEOM_CYLINDER
        turn = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), axis)
    free = {'contype': 0, 'conaffinity': 0, 'mass': 0.0, 'size': [radius, radius, 0.0]}
    body.add_geom(name=name, type=kind, pos=place, quat=_turn(turn.matrix()), **free)


def _turn(rotation: Array) -> Array:
    """Return a rotation as MuJoCo's quaternion."""
    coefficients: Array = pin.Quaternion(rotation).coeffs()
    return np.roll(coefficients, 1)


def _add_hand(body: Any, at: pin.SE3) -> None:
    """Add the end effector, which holds the payload; its axes are those of its link."""
    hand = body.add_body(name=HAND, pos=at.translation, quat=_turn(at.rotation))
    hand.explicitinertial, hand.ipos = True, np.zeros(3)


def from_file(robot: Robot, file: Path) -> Any:
    """Return a user's own MJCF arm as an MjSpec; other joints than the robot's are held.

    Raises:
        MusculoskeletalError: If MuJoCo does not load it, or what the robot's directory names is not
            in it.
    """
    try:
        spec = mujoco.MjSpec.from_file(str(file))
    except (OSError, ValueError, mujoco.FatalError) as error:
        raise _refusal(file, f'MuJoCo does not load it: {" ".join(str(error).split())}') from error
    followers = robot.kinematics.model.names[1:]
    for kind, present, wanted in (
        ('joint', spec.joints, [*followers]),
        ('spatial tendon', spec.tendons, robot.muscles),
        ('body', spec.bodies, [robot.description.end_effector]),
    ):
        names = [thing.name for thing in present]
        if missing := [name for name in wanted if name not in names]:
            told = f'{kind} {missing[0]!r} of {robot.description.directory} is not in it'
            raise _refusal(file, f'{told}; it has: {", ".join(filter(None, names))}; import_robot')
    for thing in [*spec.actuators, *spec.sensors, *spec.keys]:
        spec.delete(thing)
    for joint in [joint for joint in spec.joints if joint.name not in followers]:
        spec.delete(joint)
    _add_hand(spec.body(robot.description.end_effector), pin.SE3.Identity())
    return _pulled(spec, robot)


def _pulled(spec: Any, robot: Robot) -> Any:
    """Return the model with a motor on the tendon of each muscle."""
    spec.option.timestep, spec.option.integrator = STEP, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    # A body that is thrown out of this world stays there until it is reset.
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    for muscle in robot.muscles:
        spec.add_actuator(name=muscle, target=muscle, trntype=mujoco.mjtTrn.mjTRN_TENDON)
    return spec


def _refusal(file: Path, problem: str) -> MusculoskeletalError:
    return MusculoskeletalError(f'reality {file}: {problem}')
