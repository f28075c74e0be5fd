# SPDX-License-Identifier: Apache-2.0
"""MuJoCo model of a robot, built from its directory or from a user's MJCF file.

MuJoCo simulates rigid bodies, wrapping, joint stops and joint friction. The emulated muscle modules
(`modules.py`) act on MuJoCo's tendons; the actuators of a file are removed.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pinocchio as pin

from musculoskeletal_ae.arrays import Array, Ints
from musculoskeletal_ae.emulator.effects import Draw
from musculoskeletal_ae.emulator.modules import STEP, joint_gear
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.importing.mjcf import open_mjcf, resting_joints, tie_rims
from musculoskeletal_ae.importing.source import names_of_all, safe_name
from musculoskeletal_ae.mujoco_version import check_mujoco
from musculoskeletal_ae.robot.description import Wrap, branches
from musculoskeletal_ae.robot.joint_elasticity import JointElasticity
from musculoskeletal_ae.robot.joint_tree import JointPoses
from musculoskeletal_ae.robot.kinematics import Kinematics, body_frames, link_placement
from musculoskeletal_ae.robot.robot import Robot

ARMATURE, DAMPING = 0.005, 0.4  # of a joint module [kg·m²], [N·m·s/rad]; chosen by hand
# The following four are the σ that `Effects.links` multiplies.
LENGTH_SPREAD, TURN_SPREAD = 0.005, np.radians(2.0)  # of link lengths [m] and joint axes [rad]
MASS_SPREAD, CENTRE_SPREAD = 0.15, 0.02  # of the logarithm of masses, and of their centres [m]
THICKEST = 0.045  # largest radius of the head of a bone, or of a muscle [m]
POSTURES = 300  # number of random postures in which the radii of heads and muscles are fitted
# Constraint stiffness (solimp) of couplings. With MuJoCo's default, which disregards the ratio of a
# coupling, a prismatic joint that follows a revolute one would lag by centimetres.
STIFF = [0.9999, 0.9999, 0.001, 0.5, 2.0]
HAND, SPRING = 'hand of the emulator', 'spring'
OF_MOTORS = (
    *('actdim', 'actearly', 'actlimited', 'actrange', 'armature', 'biasprm', 'biastype'),
    *('ctrllimited', 'ctrlrange', 'damping', 'delay', 'dynprm', 'dyntype', 'forcelimited'),
    *('forcerange', 'gainprm', 'gaintype', 'gear', 'group', 'nsample'),
)

Place = tuple[int, Array]  # joint, and position in its frame [m]
Obstacle = tuple[int, Array, Array]  # joint, and centre [m] and axis in its frame

check_mujoco()
mujoco.set_mju_user_warning(lambda _: None)  # the default writes a file to the current directory


def from_directory(robot: Robot, draw: Draw, again: Ints) -> Any:
    """Return the MuJoCo model (an MjSpec) of one individual of a robot directory.

    Args:
        robot: The robot.
        draw: The random draws of the individual.
        again: How often the deviations of each muscle's route points are redrawn, (M,).
    """
    spec, bodies = skeleton(robot, draw)
    add_routes(robot, draw, again, spec, bodies)
    joint, at = robot.kinematics.placement(robot.description.end_effector)
    _add_hand(bodies[joint], at)
    return _with_motors(spec, robot)


def skeleton(robot: Robot, draw: Draw) -> tuple[Any, list[Any]]:
    """Return an individual's links and joints as an MjSpec, and the MuJoCo body of each joint."""
    kin, spec = robot.kinematics, mujoco.MjSpec()
    model, names, links = kin.model, list(kin.model.names), draw.sizes.links
    spec.option.gravity = model.gravity.linear
    spec.compiler.balanceinertia, spec.compiler.degree = True, False
    spec.compiler.boundmass = 1e-6  # for links without mass
    off = links * draw.rng('links').normal(size=(model.njoints, 4, 3))
    bodies, gear = [spec.worldbody], joint_gear(kin)
    springs, units = robot.units.elasticity_outside(_drawn_springs(robot, draw)), robot.units
    limits = [*zip(units.to_position(robot.lower), units.to_position(robot.upper))]
    for i in range(1, model.njoints):
        at, inertia, name = model.jointPlacements[i], model.inertias[i], names[i]
        # A joint that is hardly apart from its parent belongs to a joint module with several axes
        # through one point. Its origin is not moved, so that these axes still meet.
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
    """Return the springs of an individual's joints."""
    kin, drawn = robot.kinematics, draw.rng('springs').normal(size=(2, robot.joint_count))
    factor = np.exp(draw.sizes.springs * drawn[0])
    return kin.elasticity.deviating(factor, draw.sizes.spring_rest * drawn[1])


def _add_springs(robot: Robot, springs: JointElasticity, spec: Any) -> None:
    """Add the springs of the joints to a MuJoCo model.

    MuJoCo has no springs between joints. The stiffness matrix of joints that springs couple is
    therefore represented by fixed tendons with stiffness, one for each eigenvector v of the matrix.
    Each of them acts along the coordinate v · q of the joint positions q.

    Args:
        robot: The robot.
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
            vector = -vector  # for MuJoCo, a spring length of −1 means that none is given
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
        robot: The robot.
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
        along = cylinder * ((local[1] - local[0]) @ axis)  # on a cylinder the path is a helix
        local = [each - cylinder * np.outer(each @ axis, axis) for each in local]
        apart = [np.linalg.norm(each, axis=1) for each in local]
        radius = np.linspace(0.0, min(0.8 * min(map(np.min, apart)), THICKEST), 30)[:, None]
        cosine = np.sum(local[0] * local[1], axis=1) / np.maximum(apart[0] * apart[1], 1e-12)
        touching = np.arccos(np.clip(cosine, -1.0, 1.0))
        way = np.zeros_like(radius)
        for each in apart:
            touching = touching - np.arccos(radius / np.maximum(each, 1e-12))
            way = way + np.sqrt(each**2 - radius**2)
        # Two straight tangents, and the arc between them.
        bent = np.hypot(way + radius * touching, along)
        straight = np.hypot(np.linalg.norm(local[1] - local[0], axis=1), along)
        longer = np.max(np.where(touching > 0.0, bent - straight, 0.0), axis=1)
        if min(longer[-1], kink) > most + 1e-4:
            most = min(longer[-1], kink)
            best = carrier, middle, axis, float(np.interp(kink, longer, radius[:, 0]))
    return best


def _add_round(body: Any, name: str, place: Array, axis: Array | None, radius: float) -> None:
    """Add a sphere or a cylinder for tendons to wrap around, without collisions."""
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


@contextmanager
def _loading(file: Path) -> Iterator[None]:
    """Translate errors of MuJoCo into a MusculoskeletalError that names the file."""
    try:
        yield
    except (OSError, ValueError, mujoco.FatalError) as error:
        problem = f'MuJoCo cannot load it: {" ".join(str(error).split())}'
        raise _file_error(file, problem) from error


def from_file(robot: Robot, file: Path) -> Any:
    """Return the compiled model of a user's MJCF file, with a motor on the tendon of each muscle.

    Joints that the robot does not have are fixed in the position that `import_robot` uses.

    Raises:
        MusculoskeletalError: If MuJoCo cannot load the file, or the file lacks a joint, tendon or
            body that the robot directory names, or a joint has another type or cannot be renamed.
    """
    with _loading(file):
        spec = open_mjcf(file)
    followers, kinds, wraps = robot.kinematics.model.names[1:], mujoco.mjtJoint, mujoco.mjtWrap
    links = _links_of_the_hand(robot)
    hand = _rename_as_imported(spec, file, [*followers, *robot.muscles], [*links])
    _split_balls(spec, followers)
    tendons = [t for t in spec.tendons if all(w.type != wraps.mjWRAP_JOINT for w in t.path)]
    for kind, present, wanted in (
        ('joint', spec.joints, [*followers]),
        ('spatial tendon', tendons, robot.muscles),
        ('body', spec.bodies, [hand]),
    ):
        names = [thing.name for thing in present]
        if missing := [name for name in wanted if name not in names]:
            available = ', '.join(filter(None, names))
            problem = f'{kind} {missing[0]!r} of {robot.description.directory} is missing'
            remedy = f'the file has: {available}; create the robot with import_robot'
            raise _file_error(file, f'{problem}; {remedy}')
    joint_types = {joint.name: joint.type for joint in spec.joints}
    for name, slides in zip(followers, robot.kinematics.tree.prismatic[1:], strict=True):
        expected = kinds.mjJNT_SLIDE if slides else kinds.mjJNT_HINGE
        actual = joint_types[name]
        if actual != expected:
            there, here = (t.name.removeprefix('mjJNT_').lower() for t in (actual, expected))
            problem = f'joint {name!r} is a {there}, but in {robot.description.directory} a {here}'
            raise _file_error(file, f'{problem}; create the robot with import_robot')
    # Delete these first, because they refer to other elements.
    for thing in [*spec.actuators, *spec.sensors, *spec.keys, *spec.tuples]:
        spec.delete(thing)
    held = [joint for joint in spec.joints if joint.name not in followers]
    held_names = {joint.name for joint in held if joint.name}
    joint_equalities = _equalities(spec, mujoco.mjtEq.mjEQ_JOINT, held_names)
    fixed_tendons = [t for t in spec.tendons if t not in tendons]
    fixed_tendons = [
        t for t in fixed_tendons if not held_names.isdisjoint(wrap.target.name for wrap in t.path)
    ]
    tendon_names = {tendon.name for tendon in fixed_tendons}
    tendon_equalities = _equalities(spec, mujoco.mjtEq.mjEQ_TENDON, tendon_names)
    placements = list[tuple[Any, dict[str, Array]]]()
    if joint_equalities:
        with _loading(file):
            complete = spec.compile()
        placements = _placements_of_held(complete, spec, held)
    for thing in [*joint_equalities, *tendon_equalities, *fixed_tendons, *held]:
        spec.delete(thing)
    for pair in [*spec.pairs]:  # MuJoCo rejects a contact pair of two immobile bodies
        if not any(map(_moves, (spec.geom(pair.geomname1), spec.geom(pair.geomname2)))):
            spec.delete(pair)
    for joint in spec.joints:  # these limits are for the file's own actuators
        joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE
    # MuJoCo does not find by name what was renamed after compilation, so search for the body.
    at = links.get(hand) or next(at for link, at in links.items() if safe_name(hand, '') == link)
    _add_hand(next(body for body in spec.bodies if body.name == hand), at)
    with _loading(file):
        model = _with_motors(spec, robot).compile()
    tie_rims(model)
    for thing, values in placements:
        for name, value in values.items():
            getattr(model, name)[thing.id] = value
    if placements:
        mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def _links_of_the_hand(robot: Robot) -> dict[str, pin.SE3]:
    """Return the end effector's pose in the frame of each link that is rigidly connected to it.

    The first link is the end effector itself; the links that carry it come next.
    """
    model, name = robot.description.model, robot.description.end_effector
    joint, hand = link_placement(model, name)
    frame, carriers = model.getFrameId(name, pin.FrameType.BODY), list[Any]()
    while frame > 0 and model.frames[frame].parentJoint == joint:
        carriers.append(model.frames[frame])
        frame = model.frames[frame].parentFrame
    links = dict[str, pin.SE3]()
    for link in [*carriers, *body_frames(model)]:
        if link.type == pin.FrameType.BODY and link.parentJoint == joint:
            links.setdefault(str(link.name), link.placement.inverse() * hand)
    return links


def _split_balls(spec: Any, followers: list[str]) -> None:
    """Replace each ball joint by three hinges, if the robot has at least one of these hinges."""
    wanted = set(followers)
    for ball in [j for j in spec.joints if j.type == mujoco.mjtJoint.mjJNT_BALL]:
        parts = [f'{safe_name(ball.name, "")}_{axis}' for axis in 'xyz']
        if wanted.isdisjoint(parts):
            continue
        body, limit = ball.parent, float(ball.range[1])
        names = 'pos', 'damping', 'stiffness', 'armature', 'frictionloss'
        properties = {name: getattr(ball, name) for name in names}
        properties['type'] = mujoco.mjtJoint.mjJNT_HINGE
        limited = ball.limited != mujoco.mjtLimited.mjLIMITED_FALSE and limit > 0.0
        spec.delete(ball)
        for name, axis in zip(parts, np.eye(3)):
            hinge = body.add_joint(name=name, axis=axis, **properties)
            if limited:
                hinge.limited, hinge.range = mujoco.mjtLimited.mjLIMITED_TRUE, [-limit, limit]


def _moves(geom: Any) -> bool:
    body = geom.parent
    while body.name != 'world' and not body.joints:
        body = body.parent
    return bool(body.joints)


def _equalities(spec: Any, kind: Any, names: set[str]) -> list[Any]:
    """Return the equality constraints of type `kind` on a joint or tendon that `names` contains."""
    equalities = [each for each in spec.equalities if each.type == kind]
    return [each for each in equalities if not names.isdisjoint([each.name1, each.name2])]


def _placements_of_held(
    model: Any, spec: Any, held: list[Any]
) -> list[tuple[Any, dict[str, Array]]]:
    """Return the new placements of bodies and joints after the held joints have been removed.

    Args:
        model: The compiled model, with all joints.
        spec: The MjSpec of the model.
        held: The joints that are fixed in their position and removed.

    Returns:
        For each body or joint whose placement in its parent depends on a held joint, the values of
        the model's fields (such as 'body_pos') that it must have without the held joints.
    """
    rest, data = resting_joints(model), mujoco.MjData(model)
    for joint in held:
        if joint.type in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE):
            data.qpos[model.jnt_qposadr[joint.id]] = rest[joint.id]
    mujoco.mj_kinematics(model, data)
    poses = [pin.SE3(turn.reshape(3, 3), at) for turn, at in zip(data.xmat, data.xpos)]
    holders = {joint.parent.id for joint in held}
    placements = list[tuple[Any, dict[str, Array]]]()
    for body in spec.bodies:
        if body.id in holders:
            pose = poses[model.body_parentid[body.id]].actInv(poses[body.id])
            values = {'body_pos': pose.translation, 'body_quat': _turn(pose.rotation)}
            placements.append((body, values))
    for joint in spec.joints:
        # A held joint of the same body may come after `joint` and move it.
        if joint.parent.id in holders and joint not in held:
            pose, i = poses[joint.parent.id], joint.id
            axis = pose.rotation.T @ data.xaxis[i]
            placements.append((joint, {'jnt_pos': pose.actInv(data.xanchor[i]), 'jnt_axis': axis}))
    return placements


def _rename_as_imported(spec: Any, file: Path, wanted: list[str], hands: list[str]) -> str:
    """Rename the joints and tendons of a file as `import_robot` does, and find the hand's body.

    Args:
        spec: The model of the file, changed in place.
        file: The file, for messages.
        wanted: Names of joints and tendons that the robot needs.
        hands: Names of links that may carry the end effector, the best first.

    Returns:
        The name of the first body in `hands` that the file contains.
    """
    kinds = {'joint': spec.joints, 'tendon': spec.tendons, 'body': spec.bodies}
    bodies = {body.name for body in spec.bodies}
    hand = next((name for name in hands if name in bodies), hands[0])
    if {hand, *wanted} <= {thing.name for things in kinds.values() for thing in things}:
        return hand
    with _loading(file):
        spec.compile()  # assigns ids
    new: dict[str, dict[str, str]] = {'joint': {}, 'tendon': {}, 'body': {}}
    fixed = [t for t in spec.tendons if t.path[0].type == mujoco.mjtWrap.mjWRAP_JOINT]
    bound = {wrap.target.name: tendon.name for tendon in fixed for wrap in tendon.path}
    for kind, things in kinds.items():
        ordered = sorted(things, key=lambda thing: thing.id)
        names = names_of_all(kind, (thing.name for thing in ordered))
        renamed = list[tuple[Any, str]]()
        for thing, name in zip(ordered, names, strict=True):
            before = thing.name
            # Also rename an element whose own name another element needs.
            is_renamed = kind != 'body' and not {before, name}.isdisjoint(wanted)
            if kind == 'joint' and before in bound and name != before and is_renamed:
                problem = f'import_robot renames joint {before!r} to {name!r}, but MuJoCo cannot'
                problem = f'{problem} rename it in tendon {bound[before]!r}'
                raise _file_error(file, f'{problem}; use the new name in the file')
            if not before or is_renamed:
                renamed.append((thing, name))
                thing.name = ''
            new[kind][before or name] = name
        for thing, name in renamed:
            thing.name = name
    kind_of_equality = {mujoco.mjtEq.mjEQ_JOINT: 'joint', mujoco.mjtEq.mjEQ_TENDON: 'tendon'}
    for each in [e for e in spec.equalities if e.type in kind_of_equality]:
        pairs = new[kind_of_equality[each.type]].items()
        new_names = {old: name for old, name in pairs if not {old, name}.isdisjoint(wanted)}
        each.name1 = new_names.get(each.name1, each.name1)
        each.name2 = new_names.get(each.name2, each.name2)
    own_names = {safe: name for name, safe in new['body'].items()}
    return next((own_names[name] for name in hands if name in own_names), hand)


def bodies_as_imported(model: Any) -> dict[str, int]:
    """Return the ids of a file's bodies by their own names and by those of `import_robot`."""
    own = {model.body(i).name: i for i in range(model.nbody)}
    del own[HAND]
    ids = [i for i in range(model.nbody) if model.body(i).name != HAND]
    imported = names_of_all('body', (model.body(i).name for i in ids))
    return own | dict(zip(imported, ids, strict=True))


def _with_motors(spec: Any, robot: Robot) -> Any:
    """Return the model with a motor on the tendon of each muscle."""
    spec.option.timestep, spec.option.integrator = STEP, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    # A diverged simulation stays diverged until `Arm.reset`.
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    # Settings that the file makes for its own actuators must not affect our motors.
    spec.option.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)
    spec.option.disableactuator = 0
    plain = mujoco.MjSpec().add_actuator()
    motor = {name: getattr(plain, name) for name in OF_MOTORS}
    # MuJoCo does not find by name what was renamed after compilation.
    tendons = {tendon.name: tendon for tendon in spec.tendons}
    for muscle in robot.muscles:
        tendons[muscle].actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE
        motor |= {'name': muscle, 'target': muscle}
        spec.add_actuator(trntype=mujoco.mjtTrn.mjTRN_TENDON, **motor)
    return spec


def _file_error(file: Path, problem: str) -> MusculoskeletalError:
    return MusculoskeletalError(f'reality {file}: {problem}')
