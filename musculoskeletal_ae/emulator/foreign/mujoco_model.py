# SPDX-License-Identifier: Apache-2.0
"""MuJoCo model of a robot: built from its directory, or the body of an imported MuJoCo model.

MuJoCo simulates rigid bodies, wrapping, joint stops and joint friction. The emulated muscle modules
(`modules.py`) act on MuJoCo's tendons, each by a motor with the name of the muscle.
"""

from itertools import pairwise
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pinocchio as pin

from musculoskeletal_ae.arrays import Array, Ints
from musculoskeletal_ae.emulator.foreign.effects import Draw
from musculoskeletal_ae.emulator.modules import STEP, joint_gear
from musculoskeletal_ae.exceptions import MusculoskeletalError, RobotDescriptionError
from musculoskeletal_ae.importing.adapted_mjcf import HAND
from musculoskeletal_ae.mujoco_version import check_mujoco
from musculoskeletal_ae.robot.description import Wrap, branches
from musculoskeletal_ae.robot.joint_elasticity import JointElasticity
from musculoskeletal_ae.robot.joint_tree import JointPoses
from musculoskeletal_ae.robot.kinematics import Kinematics
from musculoskeletal_ae.robot.robot import Robot

#: give each joint module this inertia and damping [kg·m²], [N·m·s/rad]; chosen by hand
ARMATURE, DAMPING = 0.005, 0.4
#: change link lengths [m] and joint axes [rad] by these σ times `Effects.links`
LENGTH_SPREAD, TURN_SPREAD = 0.005, np.radians(2.0)
#: change logarithms of masses, and their centres [m], by these σ times `Effects.links`
MASS_SPREAD, CENTRE_SPREAD = 0.15, 0.02
THICKEST = 0.045  # limit the radius of the head of a bone, or of the belly of a muscle, to this [m]
POSTURES = 300  # fit the radii of heads and muscles in this many random postures
# Couple joints with this constraint stiffness (solimp). MuJoCo's default disregards the ratio of a
# coupling: a prismatic joint that follows a revolute one would lag by centimetres.
STIFF = [0.9999, 0.9999, 0.001, 0.5, 2.0]
SPRING = 'spring'  # begin the names of springs that couple joints with this word
#: replace the inverse mass by which MuJoCo scales the contacts of a body if it is below this share
#: of the inverse mass at the body's shapes
LEAST_WEIGHT_SHARE = 0.01

Place = tuple[int, Array]  # a place on a link: its joint, and the position in its frame [m]
#: an object around which tendons wrap: its joint, and its centre [m] and axis in that joint's frame
Obstacle = tuple[int, Array, Array]

check_mujoco()
# Drop warnings; by default, MuJoCo writes them to a file in the current directory.
mujoco.set_mju_user_warning(lambda _: None)


def from_directory(robot: Robot, draw: Draw, again: Ints) -> Any:
    """Return the compiled MuJoCo model of one individual of a robot directory.

    Args:
        robot: The robot whose directory describes the body.
        draw: The random draws of the individual.
        again: How often the deviations of each muscle's route points are redrawn, (M,).
    """
    spec, bodies = skeleton(robot, draw)
    add_routes(robot, draw, again, spec, bodies)
    joint, at = robot.kinematics.placement(robot.description.end_effector)
    _add_hand(bodies[joint], at)
    for muscle in robot.muscles:
        tendon = mujoco.mjtTrn.mjTRN_TENDON
        spec.add_actuator(name=muscle, target=muscle, trntype=tendon)
    return spec.compile()


def skeleton(robot: Robot, draw: Draw) -> tuple[Any, list[Any]]:
    """Return an individual's links and joints as an MjSpec, and the MuJoCo body of each joint."""
    kin, spec = robot.kinematics, mujoco.MjSpec()
    if passive := kin.elasticity.tendons.names:
        problem = f'passive tendon {passive[0]!r} has no route'
        raise MusculoskeletalError(
            f'a MuJoCo model cannot be made from {robot.description.directory}: {problem}; use the '
            'model.xml that import_robot wrote as emulator model, or `kin`; export with --into'
        )
    model, names, links = kin.model, list(kin.model.names), draw.sizes.links
    spec.option.gravity = model.gravity.linear
    spec.compiler.balanceinertia, spec.compiler.degree = True, False
    spec.compiler.boundmass = 1e-6  # lets MuJoCo accept links without mass
    off = links * draw.rng('links').normal(size=(model.njoints, 4, 3))
    bodies, gear = [spec.worldbody], joint_gear(kin)
    springs, units = robot.units.elasticity_outside(_drawn_springs(robot, draw)), robot.units
    limits = [*zip(units.to_position(robot.lower), units.to_position(robot.upper))]
    for i in range(1, model.njoints):
        at, inertia, name = model.jointPlacements[i], model.inertias[i], names[i]
        # Do not move the origin of a joint that almost coincides with its parent: both belong to a
        # joint module, whose axes meet in one point.
        is_apart = np.linalg.norm(at.translation) > 2.0 * LENGTH_SPREAD
        place = at.translation + LENGTH_SPREAD * off[i, 0] * is_apart
        placement = {'name': f'moved by {name}', 'pos': place, 'quat': _turn(at.rotation)}
        body = bodies[model.parents[i]].add_body(**placement)
        scale = np.exp(MASS_SPREAD * off[i, 1, 0])
        body.mass, body.explicitinertial = scale * inertia.mass, True
        body.ipos = inertia.lever + CENTRE_SPREAD * off[i, 2]
        about = scale * inertia.inertia + 1e-9 * np.eye(3)
        body.fullinertia = [*np.diag(about), about[0, 1], about[0, 2], about[1, 2]]
        axis = pin.exp3(TURN_SPREAD * off[i, 3]) @ kin.tree.local_axis[i]
        kinds = mujoco.mjtJoint
        kind = kinds.mjJNT_SLIDE if kin.tree.prismatic[i] else kinds.mjJNT_HINGE
        module = {'armature': gear[i] * ARMATURE, 'damping': gear[i] * DAMPING}
        joint = body.add_joint(name=name, type=kind, axis=axis, **module)
        if name in robot.joints:
            k = robot.joints.index(name)
            joint.limited, joint.range = True, limits[k]
            damping = float(gear[i] * DAMPING + springs.damping[k])
            joint.damping = [damping, 0.0, 0.0]
        else:
            coupling, data = robot.description.couplings[name], np.zeros(mujoco.mjNEQDATA)
            if len(coupling.terms) > 5:
                degree = len(coupling.terms) - 1
                problem = f'the coupling of joint {name!r} is a polynomial of degree {degree}'
                raise MusculoskeletalError(
                    f'reality `foreign`: {problem}; legal in MuJoCo: at most 4; use reality `kin`'
                )
            data[: len(coupling.terms)] = coupling.terms
            link = {'objtype': mujoco.mjtObj.mjOBJ_JOINT, 'name1': name, 'name2': coupling.master}
            link |= {'data': data, 'solimp': STIFF}
            spec.add_equality(type=mujoco.mjtEq.mjEQ_JOINT, **link)
        bodies.append(body)
    _add_springs(robot, springs, spec)
    return spec, bodies


def _drawn_springs(robot: Robot, draw: Draw) -> JointElasticity:
    """Return the robot's joint springs with the random deviations that `draw` selects."""
    kin, drawn = robot.kinematics, draw.rng('springs').normal(size=(2, robot.joint_count))
    factor = np.exp(draw.sizes.springs * drawn[0])
    return kin.elasticity.deviating(factor, draw.sizes.spring_rest * drawn[1])


def _add_springs(robot: Robot, springs: JointElasticity, spec: Any) -> None:
    """Add the springs of the joints to a MuJoCo model.

    MuJoCo has no springs between joints. The stiffness matrix of joints that springs couple is
    therefore represented by fixed tendons with stiffness, one for each eigenvector v of the matrix.
    Each of them acts along the coordinate v · q of the joint positions q.

    Args:
        robot: The robot that has the springs.
        springs: The springs in the units of the joints.
        spec: The MjSpec, to which the springs are added.
    """
    off = springs.stiffness - np.diag(np.diag(springs.stiffness))
    for k in np.flatnonzero(~off.any(axis=1)).tolist():
        joint = spec.joint(robot.joints[k])
        joint.stiffness, joint.springref = (
            [float(springs.stiffness[k, k]), 0.0, 0.0],
            springs.rest[k],
        )
    coupled = np.flatnonzero(off.any(axis=1)).tolist()
    values, vectors = np.linalg.eigh(springs.stiffness[np.ix_(coupled, coupled)])
    for value, vector in zip(values, vectors.T, strict=True):
        if value <= 1e-9 * values[-1]:
            continue
        if vector @ springs.rest[coupled] < 0.0:
            vector = -vector  # a rest length of −1 would mean to MuJoCo that none is given
        names = ', '.join(robot.joints[k] for k in coupled)
        tendon = spec.add_tendon(name=f'{SPRING} {len(spec.tendons)} of {names}')
        for k, share in zip(coupled, vector, strict=True):
            tendon.wrap_joint(robot.joints[k], float(share))
        rest = float(vector @ springs.rest[coupled])
        tendon.stiffness, tendon.springlength = [float(value), 0.0, 0.0], [rest, rest]


def add_routes(robot: Robot, draw: Draw, again: Ints, spec: Any, bodies: list[Any]) -> None:
    """Add the tendons: route points with deviations, and objects that the tendons wrap around.

    The objects are those of the description, and heads of bones or bellies of other muscles.

    Args:
        robot: The robot whose directory describes the routes.
        draw: The random draws of the individual.
        again: How often the deviations of each muscle's route points are redrawn, (M,).
        spec: The MjSpec, to which tendons, sites and objects are added.
        bodies: The MuJoCo body of each joint.
    """
    kin, off, rng = robot.kinematics, draw.rng('attachment'), draw.rng('heads')
    poses = kin.tree.joint_poses(robot.random_postures(POSTURES, draw.rng('postures')))
    bellies = _bellies(robot)
    for muscle, route, times in zip(robot.muscles, robot.description.routes, again):
        tendon, before = spec.add_tendon(name=muscle), list[Place]()
        redrawn = draw.rng(f'attachment of {muscle}, {times}') if times else None
        for n, item in enumerate(route):
            joint, at = kin.placement(item.link)
            place, name, side = at.act(item.xyz), f'{muscle}, {n}', ''
            if isinstance(item, Wrap):
                if item.swivels:
                    raise RobotDescriptionError(
                        f'{muscle}: MuJoCo has no swivelling pulleys (wrap: pulley); use the '
                        'emulator model kin, or replace the pulley by a point'
                    )
                axis = None if item.axis is None else at.rotation @ item.axis
                # Where the individual has random obstacles, wrap objects of the robot description
                # get a random size, too.
                scale = rng.uniform(0.9, 1.1) if draw.sizes.kinks > 0.0 else 1.0
                _add_round(bodies[joint], name, place, axis, scale * item.radius)
                if item.side is not None:
                    side = f'{name} side'
                    # If the side site is inside the object, the tendon passes through a ring. The
                    # site is scaled with the object, so that it stays inside.
                    beside = item.xyz + scale * (item.side - item.xyz)
                    carrier, place = joint, at.act(beside)
                    if item.side_link is not None:
                        carrier, place = kin.attach(item.side_link, item.side)
                    bodies[carrier].add_site(name=side, pos=place)
                tendon.wrap_geom(name, side)
                before = []
                continue
            if item.divisor is not None and n:
                tendon.wrap_pulley(item.divisor)
                before = []
            shift = off.normal(size=3)
            if redrawn is not None:
                shift = redrawn.normal(size=3)
            here = joint, place + draw.sizes.attachment * shift
            kink, cylinder = draw.sizes.kinks * rng.uniform(0.75, 1.0), rng.uniform() < 0.5
            for last in before if kink > 0.0 else ():
                others = [belly for owner, belly in bellies if owner != muscle]
                ends = last, here
                carrier, mid, axis, radius = _obstacle(kin, poses, ends, others, kink, cylinder)
                if radius > 1e-3:
                    shape = mid, axis if cylinder else None, radius
                    _add_round(bodies[carrier], f'{name} kink', *shape)
                    tendon.wrap_geom(f'{name} kink', '')
            bodies[joint].add_site(name=name, pos=here[1])
            tendon.wrap_site(name)
            before = [here]


def _bellies(robot: Robot) -> list[tuple[str, Obstacle]]:
    """Return the bellies of all muscles, each with the name of its muscle.

    Every straight section of a route has a belly, along the section as it is with all joints at
    mid-range. Other tendons may wrap around it.
    """
    kin, bellies = robot.kinematics, list[tuple[str, Obstacle]]()
    poses = kin.tree.joint_poses(0.5 * (robot.lower + robot.upper)[None])
    turn, origin = poses.rotation[0], poses.translation[0]
    for muscle, route in zip(robot.muscles, robot.description.routes):
        placed = [
            pair
            for branch in branches(route)
            for pair in pairwise(kin.attach(item.link, item.xyz) for item in branch)
        ]
        for (joint, place), (other, end) in placed:
            end = turn[joint].T @ (turn[other] @ end + origin[other] - origin[joint])
            line = (end - place) / max(float(np.linalg.norm(end - place)), 1e-9)
            bellies.append((muscle, (joint, 0.5 * (place + end), line)))
    return bellies


def _obstacle(
    kin: Kinematics,
    poses: JointPoses,
    ends: tuple[Place, Place],
    others: list[Obstacle],
    kink: float,
    cylinder: bool,
) -> tuple[int, Array, Array, float]:
    """Choose an object around which a straight section of a tendon wraps.

    Candidates are the heads of bones at joints between the ends of the section, and the bellies of
    other muscles. The tendon may slip over the object to the other side.

    Args:
        kin: The kinematics of the robot.
        poses: Poses of the joints in N postures.
        ends: The two ends of the section.
        others: The bellies of other muscles.
        kink: Length by which the object lengthens the tendon in at least one posture [m]; less if
            no object can do so.
        cylinder: Whether the object is a cylinder instead of a sphere.

    Returns:
        Index of the joint that carries the object; centre [m] and axis of the object in the frame
        of this joint; radius of the object [m], 0 if there is no object.
    """
    between = kin.tree.descends_from[ends[0][0]] ^ kin.tree.descends_from[ends[1][0]]
    joints = np.flatnonzero(between & ~kin.tree.prismatic)
    heads = [(int(joint), np.zeros(3), kin.tree.local_axis[joint]) for joint in joints]
    best, most = (0, np.zeros(3), np.zeros(3), 0.0), 0.0
    for carrier, middle, axis in [*heads, *others] if heads else ():
        turn, origin = poses.rotation[:, carrier], poses.translation[:, carrier]
        away = [poses.rotation[:, c] @ at + poses.translation[:, c] - origin for c, at in ends]
        local = [np.einsum('nji,nj->ni', turn, each) - middle for each in away]
        # On a cylinder, the tendon is a helix; on a sphere, it does not move along the axis.
        along = cylinder * ((local[1] - local[0]) @ axis)
        local = [each - cylinder * np.outer(each @ axis, axis) for each in local]
        apart = [np.linalg.norm(each, axis=1) for each in local]
        radius = np.linspace(0.0, min(0.8 * min(map(np.min, apart)), THICKEST), 30)[:, None]
        cosine = np.sum(local[0] * local[1], axis=1) / np.maximum(apart[0] * apart[1], 1e-12)
        touching = np.arccos(np.clip(cosine, -1.0, 1.0))
        way = np.zeros_like(radius)
        for each in apart:
            touching = touching - np.arccos(radius / np.maximum(each, 1e-12))
            way = way + np.sqrt(each**2 - radius**2)
        # The bent tendon consists of two straight tangents and the arc between them.
        bent = np.hypot(way + radius * touching, along)
        straight = np.hypot(np.linalg.norm(local[1] - local[0], axis=1), along)
        longer = np.max(np.where(touching > 0.0, bent - straight, 0.0), axis=1)
        if min(longer[-1], kink) > most + 1e-4:
            most = min(longer[-1], kink)
            best = carrier, middle, axis, float(np.interp(kink, longer, radius[:, 0]))
    return best


def _add_round(body: Any, name: str, place: Array, axis: Array | None, radius: float) -> None:
    """Add an object without collisions to a body, for tendons to wrap around.

    The object is a sphere around `place` [m] in the body's frame, or a cylinder along `axis` if one
    is given.
    """
    kind, turn = mujoco.mjtGeom.mjGEOM_SPHERE, pin.Quaternion.Identity()
    if axis is not None:
        kind = mujoco.mjtGeom.mjGEOM_CYLINDER
        turn = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), axis)
    free = {'contype': 0, 'conaffinity': 0, 'mass': 0.0, 'size': [radius, radius, 0.0]}
    body.add_geom(name=name, type=kind, pos=place, quat=_turn(turn.matrix()), **free)


def _turn(rotation: Array) -> Array:
    """Return a rotation matrix as a MuJoCo quaternion."""
    coefficients: Array = pin.Quaternion(rotation).coeffs()
    return np.roll(coefficients, 1)


def _add_hand(body: Any, at: pin.SE3) -> None:
    """Add a body that represents the end effector, at the pose `at`, and carries the payload."""
    hand = body.add_body(name=HAND, pos=at.translation, quat=_turn(at.rotation))
    hand.explicitinertial, hand.ipos = True, np.zeros(3)


def from_file(robot: Robot, file: Path) -> Any:
    """Return the compiled model of the file that `import_robot` wrote beside a robot.

    The joint limits are those of the robot directory, with firm stops.

    Raises:
        MusculoskeletalError: If MuJoCo cannot load the file, if the file lacks a tendon, a motor or
            the hand, or if its joints are not those of the robot.
    """
    try:
        model = mujoco.MjModel.from_xml_path(str(file))
    except (ValueError, mujoco.FatalError) as error:
        reason = ' '.join(str(error).split())
        raise MusculoskeletalError(f'reality {file}: MuJoCo cannot load it: {reason}') from error
    joints = robot.kinematics.model.names[1:]
    for kind, needed, get, count in (
        ('joint', joints, model.joint, model.njnt),
        ('tendon', robot.muscles, model.tendon, model.ntendon),
        ('motor', robot.muscles, model.actuator, model.nu),
        ('body', (HAND,), model.body, model.nbody),
    ):
        names = [get(i).name for i in range(count)]
        if missing := [name for name in needed if name not in names]:
            raise other_robot(robot, file, f'{kind} {missing[0]!r} is missing')
        if kind == 'joint' and (more := [name for name in names if name not in [*needed]]):
            raise other_robot(robot, file, f'joint {more[0]!r} is not a joint of the robot')
    kinds = mujoco.mjtJoint
    for name, slides in zip(joints, robot.kinematics.tree.prismatic[1:], strict=True):
        if model.joint(name).type != (kinds.mjJNT_SLIDE if slides else kinds.mjJNT_HINGE):
            raise other_robot(robot, file, f'joint {name!r} has another type')
    ids = [model.joint(name).id for name in robot.joints]
    ends = robot.units.to_position(np.array([robot.lower, robot.upper]))
    model.jnt_limited[ids], model.jnt_range[ids] = 1, ends.T
    # The stops of MuJoCo yield in proportion to torque over inertia: a strong muscle would press a
    # light finger far beyond its limits.
    model.jnt_solimp[ids] = STIFF
    set_constants(model)
    return model


def set_constants(model: Any) -> None:
    """Compute the constants of a compiled model that depend on its masses, in place.

    MuJoCo makes a contact softer in proportion to the inverse mass w = tr(J M⁻¹ Jᵀ) / 3 that the
    body has at its centre of mass at qpos0. Many files place the centre of mass of a finger's first
    link on the axes of its joints. If no joint before it can move, w is 0 there: the contact
    becomes rigid, and a slight touch accelerates the finger beyond all limits. For such a body, w
    is therefore averaged over the centres of its shapes that can touch other bodies.
    """
    data = mujoco.MjData(model)
    mujoco.mj_setConst(model, data)
    if not model.nv:
        return
    data.qpos[:] = model.qpos0
    mujoco.mj_fwdPosition(model, data)
    touches = (model.geom_contype | model.geom_conaffinity) != 0
    touches[model.pair_geom1] = touches[model.pair_geom2] = True
    for body in np.flatnonzero(model.body_weldid != 0).tolist():
        shapes = np.flatnonzero(touches & (model.geom_bodyid == body))
        weights = [_inverse_mass(model, data, body, data.geom_xpos[g]) for g in shapes]
        weight = float(np.mean(weights)) if weights else 0.0
        if model.body_invweight0[body, 0] < LEAST_WEIGHT_SHARE * weight:
            model.body_invweight0[body, 0] = weight


def _inverse_mass(model: Any, data: Any, body: int, point: Array) -> float:
    """Return the inverse mass w [1/kg] of a body at a point in the world frame [m], (3,)."""
    jacobian, solved = np.zeros((3, model.nv)), np.zeros((3, model.nv))
    mujoco.mj_jac(model, data, jacobian, None, point, body)
    mujoco.mj_solveM(model, data, solved, jacobian)
    return float(np.sum(jacobian * solved)) / 3.0


def other_robot(robot: Robot, file: Path, problem: str) -> MusculoskeletalError:
    """Return the error for a MuJoCo file that is not the model of the robot, with the `problem`."""
    directory = robot.description.directory
    remedy = 'import the MuJoCo model again, and use the model.xml that import_robot writes'
    return MusculoskeletalError(
        f'{file} (parameter reality) is not the model of {directory}: {problem}; {remedy}'
    )


def set_options(model: Any) -> None:
    """Set the time step and the other options of the simulation in a compiled model."""
    model.opt.timestep, model.opt.integrator = STEP, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    # Let a diverged simulation stay diverged until `Arm.reset`; MuJoCo would reset it by itself.
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
