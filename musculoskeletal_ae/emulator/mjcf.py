# SPDX-License-Identifier: Apache-2.0
"""A robot as a MuJoCo model: built from its directory, or a user's own MJCF file.

MuJoCo does rigid bodies, wrapping, joint stops and joint friction. Our muscle modules pull at its
tendons; the actuators of a file are left out.
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
from musculoskeletal_ae.robot.joint_tree import JointPoses
from musculoskeletal_ae.robot.kinematics import Kinematics, link_placement
from musculoskeletal_ae.robot.robot import Robot

ARMATURE, DAMPING = 0.005, 0.4  # [kg·m²], [N·m·s/rad] of a joint module; chosen
LENGTH_SPREAD, TURN_SPREAD = 0.005, np.radians(2.0)  # [m], [rad] of `Effects.links`
MASS_SPREAD, CENTRE_SPREAD = 0.15, 0.02  # share, [m]
THICKEST = 0.045  # [m] radius of a bone's head or a muscle
POSTURES = 300  # in which they are fitted
# MuJoCo makes a coupling as soft as either joint alone moves, whatever the ratio: by default, a
# slider that follows a joint that turns would lag by centimetres.
STIFF = [0.9999, 0.9999, 0.001, 0.5, 2.0]
HAND = 'hand of the emulator'
OF_MOTORS = (
    *('actdim', 'actearly', 'actlimited', 'actrange', 'armature', 'biasprm', 'biastype'),
    *('ctrllimited', 'ctrlrange', 'damping', 'delay', 'dynprm', 'dyntype', 'forcelimited'),
    *('forcerange', 'gainprm', 'gaintype', 'gear', 'group', 'nsample'),
)

Place = tuple[int, Array]  # joint, and where in its frame [m]
Obstacle = tuple[int, Array, Array]  # the same of its middle, and its axis

check_mujoco()
mujoco.set_mju_user_warning(lambda _: None)  # by default it writes a file where it was started


def from_directory(robot: Robot, draw: Draw, again: Ints) -> Any:
    """Return the body that a robot directory describes, individually off, as an MjSpec.

    By how much the route points of muscles are off is drawn `again` so often (M,).
    """
    spec, bodies = skeleton(robot, draw)
    add_routes(robot, draw, again, spec, bodies)
    joint, at = robot.kinematics.placement(robot.description.end_effector)
    _add_hand(bodies[joint], at)
    return _pulled(spec, robot)


def skeleton(robot: Robot, draw: Draw) -> tuple[Any, list[Any]]:
    """Return the links and joints of a robot, individually off, and the body of each joint."""
    kin, spec = robot.kinematics, mujoco.MjSpec()
    model, names, links = kin.model, list(kin.model.names), draw.sizes.links
    spec.option.gravity = model.gravity.linear
    spec.compiler.balanceinertia, spec.compiler.degree = True, False
    spec.compiler.boundmass = 1e-6  # of links that weigh nothing
    off = links * draw.rng('links').normal(size=(model.njoints, 4, 3))
    bodies, gear = [spec.worldbody], joint_gear(kin)
    for i in range(1, model.njoints):
        at, inertia, name = model.jointPlacements[i], model.inertias[i], names[i]
        long = np.linalg.norm(at.translation) > 2.0 * LENGTH_SPREAD  # two axes in one place stay so
        place = at.translation + LENGTH_SPREAD * off[i, 0] * long
        moved = {'name': f'moved by {name}', 'pos': place, 'quat': _turn(at.rotation)}
        body = bodies[model.parents[i]].add_body(**moved)
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
            joint.limited, joint.range = True, [robot.lower[k], robot.upper[k]]
        else:
            coupling, data = robot.description.couplings[name], np.zeros(mujoco.mjNEQDATA)
            if len(coupling.terms) > 5:
                told = f'joint {name!r} follows by a polynomial of degree {len(coupling.terms) - 1}'
                raise MusculoskeletalError(f'reality foreign: {told}; MuJoCo knows up to 4')
            data[: len(coupling.terms)] = coupling.terms
            link = {'objtype': mujoco.mjtObj.mjOBJ_JOINT, 'name1': name, 'name2': coupling.master}
            link |= {'data': data, 'solimp': STIFF}
            spec.add_equality(type=mujoco.mjtEq.mjEQ_JOINT, **link)
        bodies.append(body)
    return spec, bodies


def add_routes(robot: Robot, draw: Draw, again: Ints, spec: Any, bodies: list[Any]) -> None:
    """Add the wires: route points that are off, what is described to wrap round, and heads."""
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
                # Described ones are a little off as well.
                scale = rng.uniform(0.9, 1.1) if draw.sizes.kinks > 0.0 else 1.0
                _add_round(bodies[joint], name, place, axis, scale * item.radius)
                if item.side is not None:
                    side = f'{name} side'
                    beside = item.xyz + scale * (item.side - item.xyz)  # a ring stays one
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
    """Return the middle of each run of each muscle and how it lies, where joints are mid-range."""
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
    """Return what a wire is bent by between two ends, with its radius [m]; 0: by nothing.

    It is the head of a bone at a joint between them, or another muscle's belly: what can make its
    way longer by `kink` [m] in one of the postures, or by most. A wire may slip over it to its
    other side.
    """
    between = kin.tree.hangs_on[ends[0][0]] ^ kin.tree.hangs_on[ends[1][0]]
    joints = np.flatnonzero(between & ~kin.tree.prismatic)
    heads = [(int(joint), np.zeros(3), kin.tree.local_axis[joint]) for joint in joints]
    best, most = (0, np.zeros(3), np.zeros(3), 0.0), 0.0
    for carrier, middle, axis in [*heads, *others] if heads else ():
        turn, origin = poses.rotation[:, carrier], poses.translation[:, carrier]
        away = [poses.rotation[:, c] @ at + poses.translation[:, c] - origin for c, at in ends]
        local = [np.einsum('nji,nj->ni', turn, each) - middle for each in away]
        along = cylinder * ((local[1] - local[0]) @ axis)  # on a cylinder it winds as on a screw
        local = [each - cylinder * np.outer(each @ axis, axis) for each in local]
        apart = [np.linalg.norm(each, axis=1) for each in local]
        radius = np.linspace(0.0, min(0.8 * min(map(np.min, apart)), THICKEST), 30)[:, None]
        cosine = np.sum(local[0] * local[1], axis=1) / np.maximum(apart[0] * apart[1], 1e-12)
        touching = np.arccos(np.clip(cosine, -1.0, 1.0))
        way = np.zeros_like(radius)
        for each in apart:
            touching = touching - np.arccos(radius / np.maximum(each, 1e-12))
            way = way + np.sqrt(each**2 - radius**2)
        # Two straight runs that touch it, and the arc between them.
        bent = np.hypot(way + radius * touching, along)
        straight = np.hypot(np.linalg.norm(local[1] - local[0], axis=1), along)
        longer = np.max(np.where(touching > 0.0, bent - straight, 0.0), axis=1)
        if min(longer[-1], kink) > most + 1e-4:
            most = min(longer[-1], kink)
            best = carrier, middle, axis, float(np.interp(kink, longer, radius[:, 0]))
    return best


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


@contextmanager
def _loading(file: Path) -> Iterator[None]:
    """Say of a file that MuJoCo refuses it, and why."""
    try:
        yield
    except (OSError, ValueError, mujoco.FatalError) as error:
        raise _refusal(file, f'MuJoCo does not load it: {" ".join(str(error).split())}') from error


def from_file(robot: Robot, file: Path) -> Any:
    """Return the model of a user's own MJCF arm; other joints than the robot's are held.

    They are held where `import_robot` holds them.

    Raises:
        MusculoskeletalError: If MuJoCo does not load it, or what the robot's directory names is not
            in it.
    """
    with _loading(file):
        spec = open_mjcf(file)
    followers, kinds, wraps = robot.kinematics.model.names[1:], mujoco.mjtJoint, mujoco.mjtWrap
    links = _links_of_the_hand(robot)
    hand = _as_imported(spec, file, [*followers, *robot.muscles], [*links])
    _split_balls(spec, followers)
    tendons = [t for t in spec.tendons if all(w.type != wraps.mjWRAP_JOINT for w in t.path)]
    for kind, present, wanted in (
        ('joint', spec.joints, [*followers]),
        ('spatial tendon', tendons, robot.muscles),
        ('body', spec.bodies, [hand]),
    ):
        names = [thing.name for thing in present]
        if missing := [name for name in wanted if name not in names]:
            told = f'{kind} {missing[0]!r} of {robot.description.directory} is not in it'
            raise _refusal(file, f'{told}; it has: {", ".join(filter(None, names))}; import_robot')
    given_kinds = {joint.name: joint.type for joint in spec.joints}
    for name, slides in zip(followers, robot.kinematics.tree.prismatic[1:], strict=True):
        due, given = kinds.mjJNT_SLIDE if slides else kinds.mjJNT_HINGE, given_kinds[name]
        if given != due:
            what, legal = (each.name.removeprefix('mjJNT_').lower() for each in (given, due))
            told = f'joint {name!r} is a {what}, of {robot.description.directory} a {legal}'
            raise _refusal(file, f'{told}; import_robot')
    for thing in [*spec.actuators, *spec.sensors, *spec.keys, *spec.tuples]:  # which name others
        spec.delete(thing)
    held = [joint for joint in spec.joints if joint.name not in followers]
    gone = {joint.name for joint in held if joint.name}
    ties = _ties(spec, mujoco.mjtEq.mjEQ_JOINT, gone)
    bound = [t for t in spec.tendons if t not in tendons]
    bound = [t for t in bound if not gone.isdisjoint(wrap.target.name for wrap in t.path)]
    loose = _ties(spec, mujoco.mjtEq.mjEQ_TENDON, {tendon.name for tendon in bound})
    moved = list[tuple[Any, dict[str, Array]]]()
    if ties:
        with _loading(file):
            whole = spec.compile()
        moved = _moved_by(whole, spec, held)
    for thing in [*ties, *loose, *bound, *held]:
        spec.delete(thing)
    for pair in [*spec.pairs]:  # MuJoCo stops at a contact of two bodies that stand
        if not any(map(_moves, (spec.geom(pair.geomname1), spec.geom(pair.geomname2)))):
            spec.delete(pair)
    for joint in spec.joints:  # limits of what the file's own actuators do
        joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE
    # By name MuJoCo finds none that was named since it was compiled.
    at = links.get(hand) or next(at for link, at in links.items() if safe_name(hand, '') == link)
    _add_hand(next(body for body in spec.bodies if body.name == hand), at)
    with _loading(file):
        model = _pulled(spec, robot).compile()
    tie_rims(model)
    for thing, values in moved:
        for name, value in values.items():
            getattr(model, name)[thing.id] = value
    if moved:
        mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def _links_of_the_hand(robot: Robot) -> dict[str, pin.SE3]:
    """Return the end effector and the links that it is fixed to, with its pose in each of them."""
    model, name = robot.description.model, robot.description.end_effector
    joint, hand = link_placement(model, name)
    frame, links = model.getFrameId(name, pin.FrameType.BODY), dict[str, pin.SE3]()
    while frame > 0 and model.frames[frame].parentJoint == joint:
        link = model.frames[frame]
        if link.type == pin.FrameType.BODY:
            links[str(link.name)] = link.placement.inverse() * hand
        frame = link.parentFrame
    return links


def _split_balls(spec: Any, followers: list[str]) -> None:
    """Put three hinges in the place of each ball joint whose parts the robot has."""
    wanted = set(followers)
    for ball in [j for j in spec.joints if j.type == mujoco.mjtJoint.mjJNT_BALL]:
        parts = [f'{safe_name(ball.name, "")}_{axis}' for axis in 'xyz']
        if wanted.isdisjoint(parts):
            continue
        body, most = ball.parent, float(ball.range[1])
        given = {'pos': ball.pos, 'damping': ball.damping, 'stiffness': ball.stiffness}
        given |= {'armature': ball.armature, 'frictionloss': ball.frictionloss}
        limited = ball.limited != mujoco.mjtLimited.mjLIMITED_FALSE and most > 0.0
        spec.delete(ball)
        for name, axis in zip(parts, np.eye(3)):
            hinge = body.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_HINGE, axis=axis, **given)
            if limited:
                hinge.limited, hinge.range = mujoco.mjtLimited.mjLIMITED_TRUE, [-most, most]


def _moves(geom: Any) -> bool:
    body = geom.parent
    while body.name != 'world' and not body.joints:
        body = body.parent
    return bool(body.joints)


def _ties(spec: Any, kind: Any, names: set[str]) -> list[Any]:
    """Return the equalities of a kind that name one of some joints or tendons."""
    ties = [tie for tie in spec.equalities if tie.type == kind]
    return [tie for tie in ties if not names.isdisjoint([tie.name1, tie.name2])]


def _moved_by(model: Any, spec: Any, held: list[Any]) -> list[tuple[Any, dict[str, Array]]]:
    """Return bodies and joints of a file that stand elsewhere in their parents, as joints are held.

    Each comes with values for the model that has no such joints any more.
    """
    rest, data = resting_joints(model), mujoco.MjData(model)
    for joint in held:
        if joint.type in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE):
            data.qpos[model.jnt_qposadr[joint.id]] = rest[joint.id]
    mujoco.mj_kinematics(model, data)
    poses = [pin.SE3(turn.reshape(3, 3), at) for turn, at in zip(data.xmat, data.xpos)]
    holders, moved = {joint.parent.id for joint in held}, list[tuple[Any, dict[str, Array]]]()
    for body in spec.bodies:
        if body.id in holders:
            pose = poses[model.body_parentid[body.id]].actInv(poses[body.id])
            moved.append((body, {'body_pos': pose.translation, 'body_quat': _turn(pose.rotation)}))
    for joint in spec.joints:
        if joint.parent.id in holders and joint not in held:  # on which a held one may follow
            pose, i = poses[joint.parent.id], joint.id
            axis = pose.rotation.T @ data.xaxis[i]
            moved.append((joint, {'jnt_pos': pose.actInv(data.xanchor[i]), 'jnt_axis': axis}))
    return moved


def _as_imported(spec: Any, file: Path, wanted: list[str], hands: list[str]) -> str:
    """Let joints and tendons have the names that `import_robot` gives them; return the hand's.

    That is the first of several links that is a body of the file.
    """
    kinds = {'joint': spec.joints, 'tendon': spec.tendons, 'body': spec.bodies}
    bodies = {body.name for body in spec.bodies}
    hand = next((name for name in hands if name in bodies), hands[0])
    if {hand, *wanted} <= {thing.name for things in kinds.values() for thing in things}:
        return hand
    with _loading(file):
        spec.compile()  # gives each its place
    new: dict[str, dict[str, str]] = {'joint': {}, 'tendon': {}, 'body': {}}
    fixed = [t for t in spec.tendons if t.path[0].type == mujoco.mjtWrap.mjWRAP_JOINT]
    bound = {wrap.target.name: tendon.name for tendon in fixed for wrap in tendon.path}
    for kind, things in kinds.items():
        ordered = sorted(things, key=lambda thing: thing.id)
        names = names_of_all(kind, (thing.name for thing in ordered))
        called = list[tuple[Any, str]]()
        for thing, name in zip(ordered, names, strict=True):
            before = thing.name
            # What has a name that another is to have has to give it up.
            called_so = kind != 'body' and not {before, name}.isdisjoint(wanted)
            if kind == 'joint' and before in bound and name != before and called_so:
                told = f'tendon {bound[before]!r} is of joint {before!r}, which import_robot calls'
                raise _refusal(file, f'{told} {name!r}; call it so in the file')
            if not before or called_so:
                called.append((thing, name))
                thing.name = ''
            new[kind][before or name] = name
        for thing, name in called:
            thing.name = name
    ties = {mujoco.mjtEq.mjEQ_JOINT: 'joint', mujoco.mjtEq.mjEQ_TENDON: 'tendon'}
    for tie in [e for e in spec.equalities if e.type in ties]:
        pairs = new[ties[tie.type]].items()
        again = {old: name for old, name in pairs if not {old, name}.isdisjoint(wanted)}
        tie.name1, tie.name2 = (again.get(name, name) for name in (tie.name1, tie.name2))
    given = {safe: name for name, safe in new['body'].items()}
    return next((given[name] for name in hands if name in given), hand)


def bodies_as_imported(model: Any) -> dict[str, int]:
    """Return the bodies of a file by their own names and by those that `import_robot` gives."""
    own = {model.body(i).name: i for i in range(model.nbody)}
    del own[HAND]
    ours = [i for i in range(model.nbody) if model.body(i).name != HAND]
    given = names_of_all('body', (model.body(i).name for i in ours))
    return own | dict(zip(given, ours, strict=True))


def _pulled(spec: Any, robot: Robot) -> Any:
    """Return the model with a motor on the tendon of each muscle."""
    spec.option.timestep, spec.option.integrator = STEP, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    # A body that is thrown out of this world stays there until it is reset.
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    # Nothing that a file says of its own actuators, by default or at its tendons, is of ours.
    spec.option.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)
    spec.option.disableactuator = 0
    plain = mujoco.MjSpec().add_actuator()
    motor = {name: getattr(plain, name) for name in OF_MOTORS}
    for muscle in robot.muscles:
        spec.tendon(muscle).actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE
        motor |= {'name': muscle, 'target': muscle}
        spec.add_actuator(trntype=mujoco.mjtTrn.mjTRN_TENDON, **motor)
    return spec


def _refusal(file: Path, problem: str) -> MusculoskeletalError:
    return MusculoskeletalError(f'reality {file}: {problem}')
