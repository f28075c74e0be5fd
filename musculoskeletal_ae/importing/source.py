# SPDX-License-Identifier: Apache-2.0
"""Reduces an imported body to a chain, writes its directory, and compares it with the source."""

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from itertools import combinations_with_replacement
from pathlib import Path
from typing import Any, NamedTuple
from xml.sax.saxutils import quoteattr

import numpy as np
import pinocchio as pin
import yaml

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.exceptions import MusculoskeletalError, printable
from musculoskeletal_ae.importing.passive_lengths import SAMPLES, fitted
from musculoskeletal_ae.robot import series_elastic
from musculoskeletal_ae.robot.description import (
    STIFFNESS_DEFAULT,
    TENSION_DEFAULT,
    Route,
    RoutePoint,
    written,
)
from musculoskeletal_ae.robot.joint_tree import REVOLUTE, Coupling, joint_axis
from musculoskeletal_ae.robot.joint_units import PRISMATIC
from musculoskeletal_ae.robot.kinematics import link_placement, reduced
from musculoskeletal_ae.robot.robot import Robot

KINDS = REVOLUTE + PRISMATIC
POSTURES = 1000  # compare lengths with those of the source in this many random postures
#: compare moment arms with those of the source in this many random postures
ARM_POSTURES = 200
#: search in this many postures for the joints that change the length of a passive tendon
PROBES = 20
MOVED = 1e-8  # count a joint as moving a tendon if it changes the length by at least this [m]
WRONG_LENGTH = 5e-5  # report a passive tendon whose polynomial is wrong by at least this [m]
TURN = 1e-5  # compute moment arms as numerical derivatives of the lengths with this step [rad]
SHORT_ARM = 1e-3  # do not compare the sign of a shorter moment arm [m]
LISTED = 12  # name at most this many elements in a message, so that it stays readable
# The largest tension that the source states for a muscle becomes its tension.limit.
MAX_SHARE = 1.5  # set tension.max to this multiple of tension.limit
#: set tension.bias to this share of the limit if the muscle may be slack in the source; modules and
#: their sensors need a tension above 0
BIAS_SHARE = 0.01
# If tendons do not stretch in the source, give the muscles elastic elements that are as stiff as
# the emulated modules can regulate, but no stiffer than needed.
RIGID_STIFFNESS = 1e5  # make no element stiffer than this at tension.max [N/m]
#: let an element that stands for a rigid tendon stretch by this at tension.limit [m], which is
#: negligible
RIGID_ELONGATION = 5e-4
EARTH = 9.81  # replace another gravity of the source by that of the earth [m/s²]
#: limit a joint without usable limits to ± this: a revolute joint [rad] and a prismatic one [m]
UNLIMITED = {False: np.pi, True: 0.5}

#: returns the absolute length of each muscle in N postures [m], (N,), from joint positions, (N,)
#: each; joints without positions are at rest
Lengths = Callable[[dict[str, Array]], dict[str, Array]]


class Spring(NamedTuple):
    """A spring along x = Σ share · q, a weighted sum of joint positions q.

    The torque along x is −k (x − x_0).
    """

    shares: dict[str, float]  # share of each joint's position in x, by joint
    stiffness: float  # spring constant k [N·m/rad]
    rest: float  # value x_0 of x at which the spring exerts no torque [rad]
    name: str  # name of the spring in the source


class PassiveTendon(NamedTuple):
    """A tendon without a muscle, or the elasticity of a muscle's tendon in the source.

    Its force is −k (x − x_high) above x_high, −k (x − x_low) below x_low, and −d ẋ.
    """

    name: str
    stiffness: float  # spring constant k [N/m]
    #: lengths x_low and x_high between which the tendon exerts no force [m]
    slack: tuple[float, float]
    damping: float  # damping d of the tendon's length [N·s/m]


@dataclass
class Source:
    """The content of a file, as a pinocchio model in which links are frames."""

    name: str
    model: pin.Model = field(default_factory=pin.Model)
    links: list[str] = field(default_factory=list)  # names of the links; the root comes first
    rest: dict[str, float] = field(default_factory=dict)  # rest positions of joints; 0 if missing
    fixed: list[str] = field(default_factory=list)  # joints that are fixed in the source
    couplings: dict[str, Coupling] = field(default_factory=dict)
    routes: dict[str, Route] = field(default_factory=dict)
    strength: dict[str, float] = field(default_factory=dict)  # largest tension [N], if known
    #: tension that the actuators of a muscle always exert [N]; 0 if missing
    least: dict[str, float] = field(default_factory=dict)
    #: whether tendons cannot stretch in the source; if False, the source does not state their
    #: elasticity
    is_rigid: bool = False
    springs: list[Spring] = field(default_factory=list)
    #: damping of the joints [N·m·s/rad], by joint
    damping: dict[str, float] = field(default_factory=dict)
    passive: list[PassiveTendon] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    lengths: Lengths | None = None
    passive_lengths: Lengths | None = None  # lengths of all `passive` tendons, by name
    #: function that returns the body as a MuJoCo model, after `cut` (`adapted_mjcf.py`)
    adapted: Callable[[], str] | None = None
    end_effector: str = ''
    #: named points that may be the end effector: link, and position in its frame [m]
    points: dict[str, tuple[str, Array]] = field(default_factory=dict)
    #: joint limits in a separate file, and the name of this file
    given_limits: dict[str, tuple[float, float]] = field(default_factory=dict)
    limits_file: str = ''
    above: dict[str, str] = field(default_factory=dict)  # parent of each link, if known

    def note(self, kind: str, text: str) -> None:
        """Note a line for the report: `kind`, such as 'chosen' or 'dropped', and then `text`."""
        self.notes.append(f'{kind}: {printable(text)}')

    def lost(self) -> list[str]:
        """Return the notes about dropped muscles, tendons and actuators."""
        return [note for note in self.notes if re.match('dropped: (muscle|tendon|actuator) ', note)]

    def rename(self, kind: str, original: str | None, fallback: str, taken: Iterable[str]) -> str:
        """Return a legal name that is not in `taken`, and add a note if it is not the original.

        `fallback` is used if there is no original name. The note begins with `kind`, such as
        'muscle'.
        """
        (name,) = distinct([safe_name(original, fallback)], taken)
        self.renamed(kind, original, name)
        return name

    def renamed(self, kind: str, original: str | None, name: str) -> None:
        """Note that an element, such as a 'muscle' (`kind`), has another name than the original."""
        if original and name != original:
            self.note('renamed', f'{kind} {original} is {name} here')

    def limited(self, joint: str, slides: bool, low: float, high: float) -> tuple[float, float]:
        """Return the limits of a joint [rad, or m if it slides].

        Args:
            joint: Name of the joint.
            slides: Whether the joint is prismatic.
            low: Lower limit in the source; infinite if there is none.
            high: Upper limit in the source; infinite if there is none.

        Returns:
            The limits in the separate file of limits, if that file has the joint. Otherwise `low`
            and `high`; the default limits UNLIMITED, with a note, if these are unusable.
        """
        if joint in self.given_limits:
            return self.given_limits[joint]
        if np.isfinite([low, high]).all() and low < high and high - low < 100.0:
            return float(low), float(high)
        end = UNLIMITED[slides]
        range_text = 'no range'
        if low != high and abs(low) < np.inf:
            range_text = f'the unusable range {low:.4g} to {high:.4g}'
        remedy = self.limits_file or 'the source'
        chosen = f'joint {joint}: limits ±{end:.4g}, because the source has {range_text}'
        self.note('chosen', f'{chosen}; give it a range in {remedy}')
        return -end, end

    def add_joint(
        self, name: str, parent: int, at: pin.SE3, slides: bool, axis: Array,
        limits: tuple[float, float], rest: float = 0.0,
    ) -> int:  # fmt: skip
        """Add a joint, and return its index.

        Args:
            name: Unique name of the joint.
            parent: Index of the joint in whose frame `at` is; 0 for the root link.
            at: Pose of the joint.
            slides: Whether the joint is prismatic.
            axis: Direction of the joint's axis in its own frame, (3,).
            limits: Lower and upper limit in the source [rad or m].
            rest: Position of the joint in the rest posture of the source [rad or m].
        """
        kind = pin.JointModelPrismaticUnaligned if slides else pin.JointModelRevoluteUnaligned
        if (size := np.linalg.norm(axis)) < 1e-9:
            raise ValueError(
                f'joint {name}: axis {axis.tolist()}; expected a vector other than zero'
            )
        if self.model.existJointName(name):
            raise ValueError(f'joint {name}: expected a unique name that pinocchio does not use')
        low, high = (np.array([limit]) for limit in self.limited(name, slides, *limits))
        most = np.full(1, 1e3)
        joint: int = self.model.addJoint(parent, kind(axis / size), at, name, most, most, low, high)
        self.model.addJointFrame(joint)
        self.rest[name] = float(rest)
        return joint

    def add_link(
        self, name: str, joint: int, at: pin.SE3, inertia: pin.Inertia | None = None
    ) -> None:
        """Add a link at a pose in the frame of a joint; `inertia` is in the frame of the link."""
        kind, weight = pin.FrameType.BODY, inertia or pin.Inertia.Zero()
        self.model.addFrame(pin.Frame(name, joint, 0, at, kind, weight))
        self.links.append(name)

    def place(self, link: str) -> tuple[int, pin.SE3]:
        """Return the joint that carries a link, and the link's pose in the frame of the joint."""
        return link_placement(self.model, link)

    def span(self, joint: str) -> tuple[float, float]:
        """Return the limits of a joint [rad or m]."""
        q = self.model.joints[self.model.getJointId(joint)].idx_q
        return float(self.model.lowerPositionLimit[q]), float(self.model.upperPositionLimit[q])

    def reduce_range(self, joint: str, low: float, high: float) -> None:
        """Reduce a joint's limits to `low` and `high` [rad or m], where its muscles can hold it."""
        before = ' to '.join(f'{end:.4g}' for end in self.span(joint))
        q = self.model.joints[self.model.getJointId(joint)].idx_q
        for limits, end in (('lowerPositionLimit', low), ('upperPositionLimit', high)):
            ends = getattr(self.model, limits)
            ends[q] = end
            setattr(self.model, limits, ends)
        text = (
            f'limits of joint {joint}: robot.urdf has {low:.4g} to {high:.4g} instead of {before}'
        )
        reason = 'no muscle can hold the joint, or bring it back, outside the new limits'
        self.note('chosen', f'{text}, because {reason}')

    def slides(self, joint: str) -> bool:
        """Return whether a joint is prismatic."""
        return self.model.joints[self.model.getJointId(joint)].shortname() in PRISMATIC

    def settle(self) -> None:
        """Settle each coupled joint in the rest position that follows from that of its master."""
        for slave, c in self.couplings.items():
            self.rest[slave] = float(c.value(self.rest.get(c.master, 0.0)))

    def point_link(self, name: str) -> str:
        """Return `name`; if it is the name of a point, add a link of this name at the point."""
        if name in self.links or name not in self.points:
            return name
        link, xyz = self.points[name]
        joint, at = self.place(link)
        self.add_link(name, joint, at * pin.SE3(np.eye(3), xyz))
        self.above[name] = link
        return name


def listed(names: Sequence[str]) -> str:
    """Return a text that lists names, at most LISTED of them."""
    more = f' and {len(names) - LISTED} more' if len(names) > LISTED else ''
    return ', '.join(names[:LISTED]) + more


def tip_name(link: str) -> str:
    """Return the name of the point at the far end of a link's geometry."""
    return f'{link}_tip'


def tip(source: Source) -> str:
    """Return the link at the end of the longest chain.

    The longest chain has the most joints that are not coupled. Among chains with equally many of
    them, it has the most links after the last joint.
    """
    model, depth = source.model, [0]
    for i in range(1, model.njoints):
        depth.append(depth[model.parents[i]] + (model.names[i] not in source.couplings))

    def length(link: str) -> tuple[bool, int, int, int]:
        joint, links, up = source.place(link)[0], 0, source.above.get(link)
        while up in source.links and source.place(up)[0] == joint:
            links, up = links + 1, source.above.get(up)
        return joint > 0, depth[joint], links, source.links.index(link)

    return max(source.links, key=length)


def numbers(text: str | None, count: int, where: str) -> Array:
    """Return the `count` numbers in an XML text.

    Raises:
        ValueError: If the text is not `count` finite numbers; the message names `where`.
    """
    try:
        values = np.array([float(word) for word in (text or '').split()])
    except ValueError:
        values = np.zeros(0)
    if len(values) != count or not (np.abs(values) <= 1e6).all():
        raise ValueError(f'{where}: expected {count} finite numbers, got {(text or "")[:60]!r}')
    return values


def link_inertia(link: str, mass: float, centre: Array, tensor: Array) -> pin.Inertia:
    """Return the inertia of a link from its mass [kg], centre of mass [m] and tensor [kg·m²].

    Raises:
        ValueError: If the inertia is not physical; the message names the link.
    """
    try:
        return pin.Inertia(mass, centre, tensor)
    except RuntimeError as error:
        moments = ', '.join(f'{moment:.4g}' for moment in np.linalg.eigvalsh(tensor))
        problem = f'expected principal moments of inertia >= 0, got {moments} kg·m²'
        raise ValueError(f'link {link}: {problem}') from error


def safe_name(text: str | None, fallback: str) -> str:
    """Return a legal name for URDF and YAML, made from `text`, or `fallback` if none remains."""
    return re.sub(r'[^\w.+-]+', '_', text or '').strip('_')[:100] or fallback


def distinct(names: Iterable[str], taken: Iterable[str] = ()) -> list[str]:
    """Return unique names, made by appending underscores to names that are repeated or taken."""
    result, used = [], {*taken}
    for name in names:
        while name in used:
            name += '_'
        used.add(name)
        result.append(name)
    return result


def names_of_all(kind: str, originals: Iterable[str]) -> list[str]:
    """Return legal and unique names of all elements of a kind such as 'joint'.

    Elements without a name are numbered, such as 'joint_2'.
    """
    safe = (safe_name(name, f'{kind}_{i}') for i, name in enumerate(originals))
    return distinct(safe, ['universe'])  # reserved: pinocchio's name of the world


def unique(
    kind: str, items: Iterable[tuple[str, Any]], legal: str = 'unique names: rename one'
) -> dict[str, Any]:
    """Return the elements in `items`, pairs (name, element), as a dictionary by name.

    Raises:
        ValueError: If a name occurs twice. The message names the kind of the elements and states
            what is legal.
    """
    named: dict[str, Any] = {}
    for name, item in items:
        if name in named:
            raise ValueError(f'{kind} {name!r} is listed twice; expected {legal}')
        named[name] = item
    return named


def cut(
    source: Source,
    joints: Sequence[str] = (),
    muscles: Sequence[str] = (),
    without: Sequence[str] = (),
    base: str = '',
    end: str = '',
) -> None:
    """Reduce the source in place to the links that descend from the base, and fix unwanted joints.

    All other links are removed, with their muscles. Joints that do not stay movable are held fixed,
    with a note. Muscles that move no joint are removed as well. Unless `joints` names them, the
    joints of a floating base are held fixed, too.

    Args:
        source: The source, which is changed in place.
        joints: Joints that stay movable; by default all but those of a floating base. If `end` is
            given, joints that move neither it nor a coupled joint on the path to it are held fixed
            as well.
        muscles: Muscles that stay; by default all.
        without: Muscles to remove.
        base: The new root link; by default the present one.
        end: The end effector, a link or a point; by default it is chosen, with a note, and no joint
            is held fixed because of it.

    Raises:
        MusculoskeletalError: If a name is unknown or cannot be kept, or if no movable joint
            remains.
    """
    model, links = source.model, source.links
    if base and base not in links:
        raise MusculoskeletalError(f'--base: unknown link {base!r}; links: {listed(links)}')
    if end and end not in {*links, *source.points}:
        legal = f'links: {listed(links)}; points: {listed([*source.points])}'
        raise MusculoskeletalError(f'--end: unknown link or point {end!r}; {legal}')
    is_chosen, end = not end, source.point_link(end)
    root = source.place(base)[0] if base else 0
    inside = [i for i, above in enumerate(model.supports) if root in list(above)]
    if end and source.place(end)[0] not in inside:
        raise MusculoskeletalError(
            f'--end {end!r} does not descend from --base {base!r}; choose another end or base'
        )
    source.links = [name for name in links if source.place(name)[0] in inside]
    source.links.sort(key=lambda name: name != base)
    inner = [model.names[i] for i in inside if i not in (0, root)]
    movable = [n for n in inner if model.joints[model.getJointId(n)].shortname() in KINDS]
    couplings = source.couplings
    free = [name for name in movable if name not in {*couplings, *source.fixed}]
    floating = set() if joints else _floating_joints(source) & set(free)
    wanted = set(joints or free) - floating
    if missing := sorted(wanted - set(free)):
        kind = 'coupled' if missing[0] in couplings else 'unknown'
        problem = f'--joints: {kind} joint {missing[0]!r}'
        raise MusculoskeletalError(f'{problem}; joints: {", ".join(free)}')
    if end:
        above = {model.names[i] for i in model.supports[source.place(end)[0]]}
        # Keep masters of coupled joints in the chain, because they move the chain as well.
        wanted &= above | {c.master for slave, c in couplings.items() if slave in above}
    source.settle()
    source.couplings = {s: c for s, c in couplings.items() if s in movable and c.master in wanted}
    velocity = np.zeros(model.nv)
    for name, value in source.rest.items():
        velocity[model.joints[model.getJointId(name)].idx_v] = value
    kept = wanted | set(source.couplings)
    for name in inner:
        if name not in kept:
            reason = ', because it moves the whole body and no muscle moves it (keep it: --joints)'
            at = f'joint {name} at {source.rest.get(name, 0.0):.4g}'
            source.note('held fixed', at + reason * (name in floating))
    locked = [i for i in range(1, model.njoints) if model.names[i] not in kept]
    at_rest = pin.integrate(model, pin.neutral(model), velocity)
    source.model = reduced(model, locked, at_rest)
    for option, names in (('--muscles', muscles), ('--without', without)):
        if unknown := [name for name in names if name not in source.routes]:
            legal = ', '.join(source.routes)
            raise MusculoskeletalError(f'{option}: unknown muscle {unknown[0]!r}; muscles: {legal}')
    for name, route in list(source.routes.items()):
        lost = [item.link for item in route if item.link not in source.links]
        if lost:
            source.note('dropped', f'muscle {name}: attached to {lost[0]}, which is left out')
        elif len({source.place(p.link)[0] for p in route if isinstance(p, RoutePoint)}) < 2:
            source.note('dropped', f'muscle {name}: it moves no joint')
        elif name not in without and (not muscles or name in muscles):
            continue
        del source.routes[name]
    if count := sum(not source.strength.get(name) for name in source.routes):
        source.note(
            'chosen', f'tension of {count} muscles: the defaults, because the source states none'
        )
    if is_chosen:
        _choose_end(source)
    else:
        source.end_effector = end
    if not wanted:
        held = [note for note in source.notes if note.startswith('held fixed')]
        remedy = 'keep at least one by --joints, --base and --end'
        raise MusculoskeletalError('; '.join(['no movable joint remains', *held[:3], remedy]))


def _floating_joints(source: Source) -> set[str]:
    """Return the joints of a floating base: they move all links to which muscles are attached.

    No muscle can hold such a joint. It lets a whole animal fly or fall, for example.
    """
    model = source.model
    carriers = {source.place(item.link)[0] for route in source.routes.values() for item in route}
    above = [set(model.supports[carrier]) for carrier in carriers]
    return {model.names[i] for i in set.intersection(*above)} if above else set()


def _choose_end(source: Source) -> None:
    """Choose the far end of the longest chain (`tip`) as the end effector.

    A note in the report lists the other points that `--end` could choose.
    """
    link = tip(source)
    leaves = [name for name in source.links if name not in source.above.values()]
    others = [name for each in leaves for name in (tip_name(each), each)]
    others += [name for name, (carrier, _) in source.points.items() if carrier in (link, *leaves)]
    name = tip_name(link) if tip_name(link) in source.points else link
    legal = [each for each in dict.fromkeys(others) if each in {*source.links, *source.points}]
    legal.remove(name)
    more = f'; others: {listed(legal)}' if legal else ''
    source.note('chosen', f'end effector {name} (choose another with --end{more})')
    source.end_effector = source.point_link(name)


def _text(values: Any) -> str:
    return ' '.join(f'{v:.12g}' for v in np.ravel(values))


def urdf(source: Source) -> str:
    """Return the text of a URDF. Its root link has no mass and a z axis that points upwards."""
    model, root, (_, pose) = source.model, source.links[0], source.place(source.links[0])
    upright, size = pin.SE3(pose.rotation, np.zeros(3)), np.linalg.norm(model.gravity.linear)
    if size < 1e-6:
        source.note('chosen', 'gravity: along −z, because the source states none')
    else:
        down = pin.Quaternion.FromTwoVectors(model.gravity.linear / size, -np.eye(3)[2])
        upright = pin.SE3(down.matrix(), np.zeros(3)) * upright
        if abs(size - EARTH) > 0.02:
            source.note('chosen', f'gravity: {EARTH} m/s², although the source has {size:.4g} m/s²')
    #: by joint of the tree: the link whose frame coincides with that of the joint
    carriers = {0: root}
    if not upright.isIdentity(1e-9):
        (carriers[0],) = distinct([f'{root}_upright'], source.links)
        reason = f'because the z axis of the root must point upwards, and {root} is rotated'
        source.note('chosen', f'link {carriers[0]} was added as the root, {reason}')
    for link in source.links:
        joint, at = source.place(link)
        if joint and at.isIdentity(1e-9):
            carriers.setdefault(joint, link)
    parts = [f'<robot name="{source.name}">', f'  <link name={quoteattr(carriers[0])}/>']

    def attach(name: str, kind: str, link: str, parent: int, at: pin.SE3, more: str = '') -> None:
        at = at if parent else upright * pose.inverse() * at
        ends = f'<parent link={quoteattr(carriers[parent])}/><child link={quoteattr(link)}/>'
        turn = _text(pin.rpy.matrixToRpy(at.rotation))
        origin = f'<origin xyz="{_text(at.translation)}" rpy="{turn}"/>'
        parts.append(f'  <joint name={quoteattr(name)} type="{kind}">{ends}{origin}{more}</joint>')

    for i, name in enumerate(model.names[1:], 1):
        (spare,) = distinct([f'{name}_link'], {*source.links, *carriers.values()})
        link, own = carriers.setdefault(i, spare), model.inertias[i]
        pairs = combinations_with_replacement(range(3), 2)
        tensor = ' '.join(f'i{"xyz"[j]}{"xyz"[k]}="{own.inertia[j, k]:.12g}"' for j, k in pairs)
        mass = f'<origin xyz="{_text(own.lever)}"/><mass value="{_text(own.mass)}"/>'
        mass = f'<inertial>{mass}<inertia {tensor}/></inertial>' if own.mass > 0.0 else ''
        parts.append(f'  <link name={quoteattr(link)}>{mass}</link>')
        low, high = source.span(name)
        limits = f'lower="{low:.12g}" upper="{high:.12g}" effort="1000" velocity="10"'
        more = f'<axis xyz="{_text(joint_axis(model.joints[i]))}"/><limit {limits}/>'
        kind = 'prismatic' if source.slides(name) else 'revolute'
        attach(name, kind, link, model.parents[i], model.jointPlacements[i], more)
    others = [link for link in source.links if link not in carriers.values()]
    for link, name in zip(others, distinct([f'to_{link}' for link in others], model.names)):
        parts.append(f'  <link name={quoteattr(link)}/>')
        attach(name, 'fixed', link, *source.place(link))
    return '\n'.join([*parts, '</robot>', ''])


def write(source: Source, out: Path) -> None:
    """Write robot.urdf, muscles.yaml and, for a MuJoCo model, model.xml into a directory."""
    muscles: list[dict[str, Any]] = []
    for name, route in source.routes.items():
        muscles.append({'name': name, 'route': [written(item) for item in route]})
        muscles[-1] |= _modules(source, name)
    _note_chosen_constants(source)
    joints = [name for name in source.model.names[1:] if name not in source.couplings]
    document: dict[str, Any] = {'joints': joints, 'muscles': muscles}
    document['end_effector'] = source.end_effector
    if source.couplings:
        document['couplings'] = [_coupling(s, c) for s, c in source.couplings.items()]
    # Do this before `_joint_elasticity`, because passive tendons may add damping to joints.
    tendons = passive_tendons(source, joints)
    if elasticity := _joint_elasticity(source, joints):
        document['joint_elasticity'] = elasticity
    if tendons:
        document['passive_tendons'] = tendons
    text, body = yaml.safe_dump(document, sort_keys=False, default_flow_style=None), urdf(source)
    head = ''.join(f'# {line}\n' for line in [f'Imported from {source.name}.', *source.notes])
    (out / 'muscles.yaml').write_text(head + text, encoding='utf-8')
    (out / 'robot.urdf').write_text(body, encoding='utf-8')
    if source.adapted is not None:
        (out / 'model.xml').write_text(source.adapted(), encoding='utf-8')


def _modules(source: Source, muscle: str) -> dict[str, Any]:
    """Return the entries of a muscle in muscles.yaml that describe its tension and elasticity."""
    entries, force = dict[str, Any](), source.strength.get(muscle, 0.0)
    if force > 0.0:
        bias = np.clip(BIAS_SHARE * force, source.least.get(muscle, 0.0), 0.5 * force)
        tension = {'bias': bias, 'limit': force, 'max': MAX_SHARE * force}
        entries['tension'] = {key: float(f'{value:.6g}') for key, value in tension.items()}
    if source.is_rigid:
        limit = force or TENSION_DEFAULT['limit']
        most = MAX_SHARE * force or TENSION_DEFAULT['max']
        stiffness = min(RIGID_STIFFNESS, limit / RIGID_ELONGATION)
        rate = float(f'{stiffness / (limit + most):.6g}')
        entries['series_elastic'] = {
            'force': float(f'{limit:.6g}'),
            'rate': rate,
            'wire_stretch': 0.0,
        }
    return entries


def _note_chosen_constants(source: Source) -> None:
    """Note each constant of the muscle modules that the import chose."""
    if any(source.strength.values()):
        least = ', or the tension that its actuators always exert' if source.least else ''
        source.note(
            'chosen',
            'tension.limit is the largest tension in the source; tension.max is '
            f'{MAX_SHARE:g} times that, and tension.bias {100 * BIAS_SHARE:g} % of it{least}',
        )
    k = f'stiffness: K of muscle stiffness control {STIFFNESS_DEFAULT:g} N/m, the default'
    source.note('chosen', k)
    if not source.is_rigid:
        elastic = ', '.join(f'{key} {value:g}' for key, value in series_elastic.DEFAULT.items())
        text = f'series_elastic: {elastic}, the defaults, because the source states none'
        source.note('chosen', text)
        return
    forces = [source.strength.get(name) or TENSION_DEFAULT['limit'] for name in source.routes]
    each = [_modules(source, name)['series_elastic'] for name in source.routes]
    long = [1e3 * np.log(2.0) / entry['rate'] for entry in each]
    source.note(
        'chosen',
        'series_elastic: tendons do not stretch in the source; the emulated modules need elements '
        f'of at most {RIGID_STIFFNESS:g} N/m, which stretch by {min(long):.2g} to {max(long):.2g} '
        f'mm at the limits of {min(forces):.3g} to {max(forces):.3g} N',
    )


def passive_tendons(source: Source, joints: list[str]) -> list[dict[str, Any]]:
    """Return the entries of `passive_tendons` in muscles.yaml, and note how exact they are.

    Damping of passive tendons becomes damping of the joints, in `source.damping`.
    """
    if not source.passive or source.passive_lengths is None or not joints:
        return []
    low, high = np.array([source.span(name) for name in joints]).T
    centre, half = 0.5 * (low + high), 0.5 * (high - low)
    rng, entries = np.random.default_rng(0), list[dict[str, Any]]()
    share = rng.uniform(-1.0, 1.0, (2 * SAMPLES, len(joints)))
    positions = centre + half * share

    def lengths(at: Array) -> dict[str, Array]:
        assert source.passive_lengths is not None
        return source.passive_lengths(dict(zip(joints, at.T, strict=True)))

    # A tendon depends on the joints that change its length in any of the first postures.
    some = positions[:PROBES]
    still, slopes = lengths(some), dict[str, dict[int, float]]()
    for j in range(len(joints)):
        moved = some.copy()
        moved[:, j] += 0.01 * half[j]
        for name, length in lengths(moved).items():
            if np.abs(length - still[name]).max() > MOVED:
                slope = (length - still[name]) / (0.01 * half[j])
                slopes.setdefault(name, {})[j] = float(np.mean(slope**2))
    every = lengths(positions)
    for tendon in source.passive:
        own = list(slopes.get(tendon.name, {}))
        if not own:
            continue
        if tendon.damping:
            for j, squared in slopes[tendon.name].items():
                before = source.damping.get(joints[j], 0.0)
                source.damping[joints[j]] = before + tendon.damping * squared
            source.note('approximated', f'damping of tendon {tendon.name}: by damping its joints')
        if not tendon.stiffness:
            continue
        fit = fitted(share[:, own], half[own], every[tendon.name])
        if fit.error > WRONG_LENGTH:
            error = f'the length that its polynomial of degree {fit.degree} gives is wrong by'
            source.note(
                'approximated', f'passive tendon {tendon.name}: {error} {1e3 * fit.error:.2g} mm'
            )
        terms = zip(fit.coefficient.tolist(), fit.powers.tolist(), strict=True)
        entries.append(
            {
                'name': tendon.name,
                'stiffness': float(f'{tendon.stiffness:.10g}'),
                'slack': [float(f'{length:.10g}') for length in tendon.slack],
                'joints': [joints[j] for j in own],
                'centre': [float(f'{centre[j]:.12g}') for j in own],
                'length': [[float(f'{factor:.10g}'), *map(int, row)] for factor, row in terms],
            }
        )
    return entries


def _joint_elasticity(source: Source, joints: list[str]) -> list[dict[str, Any]]:
    """Return the entries of `joint_elasticity` in muscles.yaml.

    A spring of a linearly coupled joint becomes a spring of its master.
    """
    stiffness, preload = np.zeros((len(joints), len(joints))), np.zeros(len(joints))
    for spring in source.springs:
        share, rest, bent = np.zeros(len(joints)), spring.rest, list[str]()
        for name, factor in spring.shares.items():
            coupling = source.couplings.get(name)
            if coupling is not None and len(coupling.terms) > 2:
                bent.append(name)
            elif coupling is not None:
                offset, ratio = coupling.terms
                share[joints.index(coupling.master)] += factor * ratio
                rest -= factor * offset
            elif name in joints:
                share[joints.index(name)] += factor
            else:
                rest -= factor * source.rest.get(name, 0.0)
        if bent:
            source.note(
                'dropped',
                f'spring {spring.name}: its joint {bent[0]} follows another joint nonlinearly',
            )
            continue
        stiffness += spring.stiffness * np.outer(share, share)
        preload += spring.stiffness * rest * share
    angles = np.linalg.pinv(stiffness, hermitian=True) @ preload if joints else preload
    entries = list[dict[str, Any]]()
    for i, name in enumerate(joints):
        own = {'stiffness': stiffness[i, i], 'rest_angle': angles[i]}
        own['damping'] = source.damping.get(name, 0.0)
        entry: dict[str, Any] = {'joint': name}
        entry |= {key: float(f'{value:.10g}') for key, value in own.items() if abs(value) > 1e-12}
        coupled = {
            joints[j]: float(f'{stiffness[i, j]:.10g}')
            for j in range(i + 1, len(joints))
            if abs(stiffness[i, j]) > 1e-12
        }
        if coupled:
            entry['coupled'] = coupled
        if len(entry) > 1:
            entries.append(entry)
    return entries


def _coupling(slave: str, coupling: Coupling) -> dict[str, Any]:
    """Return an entry of `couplings` in muscles.yaml, for the joint `slave`."""
    entry: dict[str, Any] = {'joint': slave, 'master': coupling.master}
    offset, ratio, *higher = coupling.terms
    if higher:
        return {**entry, 'polynomial': list(coupling.terms)}
    return {**entry, 'ratio': ratio, 'offset': offset}


class Comparison(NamedTuple):
    """Differences between the lengths of an imported robot and those of its source, by muscle."""

    lengths: dict[str, float]  # largest error of the length [m]
    arms: dict[str, float]  # largest error of a moment arm [m]
    #: share of postures with a moment arm of the wrong sign, at the joint where it is largest
    flips: dict[str, float]


def compare(source: Source, robot: Robot) -> Comparison | None:
    """Compare lengths in POSTURES and moment arms in ARM_POSTURES postures.

    The source's moment arms are numerical derivatives of its lengths. MuJoCo computes the lengths
    of an MJCF file, and `cardsflow` those of straight routes on the URDF itself. The result is None
    if nothing computes the lengths of the source.
    """
    if source.lengths is None:
        return None
    theta, own = robot.random_postures(POSTURES, np.random.default_rng(0)), source.lengths

    def theirs(theta: Array) -> dict[str, Array]:
        kin = robot.kinematics
        return own(dict(zip(kin.model.names[1:], kin.tree.angles(theta).T)))

    ours = dict(zip(robot.muscles, robot.routes.absolute_lengths(theta).T))
    lengths = {
        name: float(np.abs(ours[name] - length).max())
        for name, length in theirs(theta).items()
        if name in ours
    }
    theta, step = theta[:ARM_POSTURES], TURN * np.eye(robot.joint_count)
    arms, flips = dict.fromkeys(lengths, 0.0), dict.fromkeys(lengths, 0.0)
    jacobian = robot.routes.muscle_jacobian(theta)
    for j, turn in enumerate(step):
        ahead, behind = theirs(theta + turn), theirs(theta - turn)
        for name in lengths:
            m = robot.muscles.index(name)
            if not robot.routes.crossed[m, j]:
                continue
            there, here = (ahead[name] - behind[name]) / (2.0 * TURN), jacobian[:, m, j]
            arms[name] = max(arms[name], float(np.abs(here - there).max()))
            wrong = (np.sign(here) != np.sign(there)) & (
                np.minimum(abs(here), abs(there)) > SHORT_ARM
            )
            flips[name] = max(flips[name], float(wrong.mean()))
    return Comparison(lengths, arms, flips)
