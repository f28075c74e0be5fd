# SPDX-License-Identifier: Apache-2.0
"""Import of MuJoCo models (MJCF), which the package `mujoco` loads.

Spatial tendons become routes: sites, wrapping spheres and cylinders with their side sites, and
branches over pulleys. Hinges and slides become joints; a body with several joints becomes a chain
of massless links, and a ball joint becomes three hinges. `equality/joint` becomes a coupling.
Springs and dampers of joints, and springs of fixed tendons, become `joint_elasticity`. Springs of
other tendons become `passive_tendons`, and their damping becomes damping of the joints.

If a site lies on the rim of an object that its tendon wraps around, rounding decides in MuJoCo
whether the tendon wraps. In this package, the site counts as outside (`robot/wrapping.py`). To make
MuJoCo agree, the import reduces the radius of the object there by a share 2·RIM.

`adapted_mjcf.py` writes the MuJoCo model that the emulator loads.
"""

from collections import defaultdict
from functools import partial
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import mujoco
import numpy as np
import pinocchio as pin
from scipy.spatial.transform import Rotation

from musculoskeletal_ae.arrays import Array, Bools
from musculoskeletal_ae.files import file_error
from musculoskeletal_ae.importing.adapted_mjcf import AdaptedModel
from musculoskeletal_ae.importing.source import (
    PassiveTendon,
    Source,
    Spring,
    distinct,
    names_of_all,
    safe_name,
    tip_name,
)
from musculoskeletal_ae.mujoco_version import check_mujoco
from musculoskeletal_ae.robot.description import RoutePoint, Wrap
from musculoskeletal_ae.robot.joint_tree import Coupling
from musculoskeletal_ae.robot.wrapping import RIM

check_mujoco()

#: for each kind of named element: the attribute of MjModel that counts the elements
COUNTS = {
    'body': 'nbody', 'joint': 'njnt', 'tendon': 'ntendon', 'actuator': 'nu', 'equality': 'neq',
}  # fmt: skip
#: determine the range of a tendon's length from this many random postures
RANGE_POSTURES = 200
LEAST_REACH = 1e-3  # ignore a far end that is closer than this to the origin of its body [m]
#: ignore a larger force of an actuator [N]: MuJoCo computes it for muscles without an initial
#: moment arm
STRONGEST = 1e6


def read_mjcf(file: Path, root: ET.Element) -> Source:
    """Read the robot of an MJCF file, whose root element is `root`.

    Raises:
        MusculoskeletalError: If MuJoCo cannot load the file.
    """
    for item in root.iter('include'):
        included = file.parent / (name := item.get('file', ''))
        if included.exists() and not included.is_file():
            raise file_error(file, f'the included file {name!r} is not a regular file')
    warnings: list[str] = []
    # By default, MuJoCo writes warnings to a file in the working directory.
    mujoco.set_mju_user_warning(warnings.append)
    try:
        spec = mujoco.MjSpec.from_file(str(file))
        spec.compiler.fusestatic = False  # do not merge bodies without joints: each becomes a link
        model = spec.compile()
    except (ValueError, mujoco.FatalError) as error:
        raise file_error(file, f'MuJoCo cannot load it: {" ".join(str(error).split())}') from error
    finally:
        mujoco.set_mju_user_warning(lambda _: None)
    reader = _Reader(model, file.stem)
    source = reader.source

    def adapted() -> str:
        try:
            text = AdaptedModel(source, spec, model, reader.names, reader.balls).text()
            mujoco.MjModel.from_xml_string(text)
        except (ValueError, LookupError, mujoco.FatalError) as error:
            problem = f'cannot be adapted to the robot: {" ".join(str(error).split())}'
            raise file_error(file, problem) from error
        return text

    source.adapted = adapted
    for warning in warnings:
        source.note('MuJoCo warns', ' '.join(warning.split()))
    return source


def tie_rims(model: Any) -> list[tuple[int, int]]:
    """Shrink the wrapping objects on whose rim a site of their own tendon lies.

    The radius of each such geom is reduced by a share 2·RIM, so the site lies outside.

    Returns:
        Indices (tendon, geom) for each site on a rim.
    """
    data, types, tied = mujoco.MjData(model), mujoco.mjtWrap, []
    mujoco.mj_kinematics(model, data)
    for t in range(model.ntendon):
        path = range(model.tendon_adr[t], model.tendon_adr[t] + model.tendon_num[t])
        for w in path:
            if model.wrap_type[w] not in (types.mjWRAP_SPHERE, types.mjWRAP_CYLINDER):
                continue
            geom = int(model.wrap_objid[w])
            turn, radius = data.geom_xmat[geom].reshape(3, 3), model.geom_size[geom][0]
            for site in (int(model.wrap_objid[w - 1]), int(model.wrap_objid[w + 1])):
                bodies = model.site_bodyid[site], model.geom_bodyid[geom]
                if model.body_weldid[bodies[0]] != model.body_weldid[bodies[1]]:
                    continue
                away = turn.T @ (data.site_xpos[site] - data.geom_xpos[geom])
                if model.wrap_type[w] == types.mjWRAP_CYLINDER:
                    away[2] = 0.0
                if abs(np.linalg.norm(away) - radius) <= RIM * radius:
                    tied.append((t, geom))
    for geom in {geom for _, geom in tied}:
        model.geom_size[geom][0] *= 1.0 - 2.0 * RIM
    return tied


def far_end(model: Any, data: Any, body: int) -> Array | None:
    """Return the point of a body's geometry that is farthest from the body's last joint.

    Without a joint, it is the point that is farthest from the origin of the body. Geoms that
    tendons wrap around count only if the body has no other geoms.

    Returns:
        The point in the frame of the body [m], (3,); None if the body has no geometry, or if the
        point lies at the origin of the body.
    """
    turn, origin = data.xmat[body].reshape(3, 3), data.xpos[body].copy()
    anchor = origin
    if model.body_jntnum[body]:
        anchor = data.xanchor[model.body_jntadr[body] + model.body_jntnum[body] - 1]
    round_ = np.isin(
        model.wrap_type, (mujoco.mjtWrap.mjWRAP_SPHERE, mujoco.mjtWrap.mjWRAP_CYLINDER)
    )
    wrapped = set(model.wrap_objid[round_].tolist())
    first = model.body_geomadr[body]
    own = list(range(first, first + model.body_geomnum[body]))
    ends = [_ends(model, data, g) for g in [g for g in own if g not in wrapped] or [*own]]
    ends = [points for points in ends if len(points)]
    if not ends:
        return None
    points = np.concatenate(ends)
    far = points[np.linalg.norm(points - anchor, axis=1).argmax()]
    result: Array = turn.T @ (far - origin)
    return result if np.linalg.norm(result) > LEAST_REACH else None


def _ends(model: Any, data: Any, geom: int) -> Array:
    """Return points at the ends of a geom, in the world frame [m], (N, 3)."""
    kinds, size, place = mujoco.mjtGeom, model.geom_size[geom], data.geom_xpos[geom]
    turn, kind = data.geom_xmat[geom].reshape(3, 3), model.geom_type[geom]
    if kind == kinds.mjGEOM_MESH:
        mesh = model.geom_dataid[geom]
        first = model.mesh_vertadr[mesh]
        local = model.mesh_vert[first : first + model.mesh_vertnum[mesh]].astype(float)
    elif kind in (kinds.mjGEOM_CAPSULE, kinds.mjGEOM_CYLINDER):
        reach = size[1] + size[0] * (kind == kinds.mjGEOM_CAPSULE)
        local = np.array([[0.0, 0.0, reach], [0.0, 0.0, -reach]])
    elif kind == kinds.mjGEOM_SPHERE:
        local = size[0] * np.concatenate([np.eye(3), -np.eye(3)])
    elif kind in (kinds.mjGEOM_BOX, kinds.mjGEOM_ELLIPSOID):
        local = np.concatenate([np.diag(size), -np.diag(size)])
    else:  # planes and height fields have no end
        return np.zeros((0, 3))
    return local @ turn.T + place


class _Reader:
    def __init__(self, model: Any, name: str) -> None:
        self.model, self.source = model, Source(safe_name(name, 'robot'))
        self.source.is_rigid = True
        weightless = model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_GRAVITY
        self.source.model.gravity.linear = model.opt.gravity * (not weightless)
        self.start = mujoco.MjData(model)
        mujoco.mj_kinematics(model, self.start)
        self.names = {kind: self._names(kind) for kind in COUNTS}
        self.balls: dict[int, list[str]] = {}
        #: for each coupled joint, the joint that it follows (−1: it is fixed) and the coefficients
        #: of its polynomial, the highest power first
        self.polynomials: dict[int, tuple[int, Array]] = {}
        self.tendons: dict[str, int] = {}
        self.passive: dict[str, int] = {}
        self.radius = model.geom_size[:, 0].copy()  # radii of the file, before `tie_rims`
        self._tie_rims()
        self._bodies()
        self._points()
        self._couplings()
        self._springs()
        self._passive_tendons()
        self._not_modelled()
        self._tendons()
        self.source.lengths = partial(self._lengths, self.tendons)
        self.source.passive_lengths = partial(self._lengths, self.passive)

    def _names(self, kind: str) -> list[str]:
        """Return the names of all elements of a kind; unnamed ones are numbered."""
        get, count = getattr(self.model, kind), getattr(self.model, COUNTS[kind])
        original = [get(i).name for i in range(count)]
        names = names_of_all(kind, original)
        for each, name in zip(original, names, strict=True):
            self.source.renamed(kind, each, name)
        return names

    def _springs(self) -> None:
        """Read springs and dampers of joints, and springs of fixed tendons."""
        m, source, kinds = self.model, self.source, mujoco.mjtJoint
        for j, name in enumerate(self.names['joint']):
            stiffness, damping = m.jnt_stiffness[j], float(m.dof_damping[m.jnt_dofadr[j]])
            if m.jnt_type[j] not in (kinds.mjJNT_HINGE, kinds.mjJNT_SLIDE):
                for effect in ('springs',) * bool(stiffness) + ('damping',) * bool(damping):
                    reason = 'which is neither a hinge nor a slide'
                    source.note('dropped', f'{effect} of joint {name}, {reason}')
                continue
            if stiffness:
                rest = float(m.qpos_spring[m.jnt_qposadr[j]])
                source.springs.append(Spring({name: 1.0}, float(stiffness), rest, f'of {name}'))
            if damping:
                source.damping[name] = damping
        for t in np.flatnonzero(self._is_fixed() & (m.tendon_stiffness > 0.0)).tolist():
            path = range(m.tendon_adr[t], m.tendon_adr[t] + m.tendon_num[t])
            shares = {self.names['joint'][m.wrap_objid[w]]: float(m.wrap_prm[w]) for w in path}
            low, high = m.tendon_lengthspring[t]
            name = f'tendon {self.names["tendon"][t]}'
            if high - low > 1e-9:  # the spring of the tendon is slack between two lengths
                continue
            source.springs.append(Spring(shares, float(m.tendon_stiffness[t]), float(low), name))

    def _passive_tendons(self) -> None:
        """Read the elasticity and damping of tendons that `_springs` does not represent."""
        m, source = self.model, self.source
        low, high = m.tendon_lengthspring.T
        is_linear = self._is_fixed() & (high - low <= 1e-9)
        stiffness = m.tendon_stiffness * ~is_linear
        for t in np.flatnonzero((stiffness > 0.0) | (m.tendon_damping > 0.0)).tolist():
            slack, name = (float(low[t]), float(high[t])), self.names['tendon'][t]
            parts = float(stiffness[t]), slack, float(m.tendon_damping[t])
            source.passive.append(PassiveTendon(name, *parts))
            self.passive[name] = t
        for kind, effect in (('joint', 'jnt_stiffness'), ('tendon', 'tendon_stiffness')):
            # Report springs whose force is a polynomial, which recent versions of MuJoCo have.
            higher = np.asarray(getattr(m, f'{effect}poly', np.zeros((0, 1))))
            for i in np.flatnonzero(higher.any(axis=1)).tolist():
                problem = f'nonlinear stiffness: {kind} {self.names[kind][i]}'
                source.note('dropped', problem)

    def _is_fixed(self) -> Bools:
        """Return a mask (tendons,) of the fixed tendons, which have no route."""
        fixed: Bools = self.model.wrap_type[self.model.tendon_adr] == mujoco.mjtWrap.mjWRAP_JOINT
        return fixed

    def _not_modelled(self) -> None:
        """Note what the robot directory cannot represent; most of that is in the emulated arm."""
        m, only = self.model, 'only in model.xml'
        if forces := self._named('joint', m.jnt_actfrclimited):
            self.source.note('dropped', f"limits of the actuators' force: joint {forces}")
        for kind, effect, values in (
            ('joint', 'armature', m.dof_armature[m.jnt_dofadr]),
            ('joint', 'friction', m.dof_frictionloss[m.jnt_dofadr]),
            ('tendon', 'armature', m.tendon_armature),
            ('tendon', 'limits', m.tendon_limited),
            ('tendon', 'friction', m.tendon_frictionloss),
            ('body', 'compensated weight', m.body_gravcomp),
        ):
            if named := self._named(kind, values):
                self.source.note(only, f'{effect}: {kind} {named}')
        touching = int(np.count_nonzero(m.geom_contype | m.geom_conaffinity))
        if m.npair or touching > 1:
            self.source.note(only, f'contacts: {touching} geoms may touch each other')

    def _named(self, kind: str, values: Any) -> str:
        """Return the names of the elements of a kind that have a value other than 0, as a text."""
        return ', '.join(self.names[kind][i] for i in np.flatnonzero(values).tolist())

    def _bodies(self) -> None:
        """Add links and joints; a joint's frame lies at its anchor and has the axes of its body."""
        m, data, at_start = self.model, self.start, {0: (0, pin.SE3.Identity())}
        for i in range(m.nbody):
            turn, carrier, stand = data.xmat[i].reshape(3, 3), *at_start[m.body_parentid[i]]
            for j in range(m.body_jntadr[i], m.body_jntadr[i] + m.body_jntnum[i]):
                if m.jnt_type[j] == mujoco.mjtJoint.mjJNT_FREE:
                    problem = (
                        f'free joint {self.names["joint"][j]}, at the pose that the file gives'
                    )
                    self.source.note('held fixed', problem)
                    continue
                before, stand = stand, pin.SE3(turn, data.xanchor[j].copy())
                carrier = self._joint(j, carrier, before.inverse() * stand)
            at_start[i] = carrier, stand
            at = pin.SE3(turn, data.xpos[i].copy())
            weight = pin.Inertia(float(m.body_mass[i]), np.zeros(3), np.diag(m.body_inertia[i]))
            centre = at.inverse() * pin.SE3(data.ximat[i].reshape(3, 3), data.xipos[i].copy())
            link = self.names['body'][i], carrier, stand.inverse() * at
            self.source.add_link(*link, centre.act(weight))
            if i:
                self.source.above[link[0]] = self.names['body'][m.body_parentid[i]]

    def _joint(self, j: int, carrier: int, at: pin.SE3) -> int:
        """Add joint j with the initial pose `at` in the frame of joint `carrier`.

        Returns:
            The index of the new joint; of the last one if a ball joint became three joints.
        """
        m, source, types, name = self.model, self.source, mujoco.mjtJoint, self.names['joint'][j]
        low, high = m.jnt_range[j] if m.jnt_limited[j] else (-np.inf, np.inf)
        kind, rest = m.jnt_type[j], float(m.qpos0[m.jnt_qposadr[j]])
        axes, names, slides = [m.jnt_axis[j].copy()], [name], kind == types.mjJNT_SLIDE
        if kind == types.mjJNT_BALL:
            source.note(
                'approximated',
                f'ball joint {name}: replaced by three hinges, about x, y and z in this order',
            )
            axes, rest, low = list(np.eye(3)), 0.0, -high
            names = distinct((f'{name}_{c}' for c in 'xyz'), self.names['joint'])
            self.balls[j] = names
        for part, axis in zip(names, axes):
            back, still = -axis * rest, np.zeros(3)
            at = at * (pin.SE3(np.eye(3), back) if slides else pin.SE3(pin.exp3(back), still))
            carrier = source.add_joint(part, carrier, at, slides, axis, (low, high), rest)
            at = pin.SE3.Identity()
        return carrier

    def _couplings(self) -> None:
        m, source = self.model, self.source
        for e in np.flatnonzero(m.eq_active0).tolist():
            if m.eq_type[e] != mujoco.mjtEq.mjEQ_JOINT:
                source.note(
                    'dropped', f'equality {self.names["equality"][e]}: it does not couple joints'
                )
                continue
            slave, master, terms = int(m.eq_obj1id[e]), int(m.eq_obj2id[e]), m.eq_data[e][4::-1]
            name, leader = self.names['joint'][slave], master
            while leader in self.polynomials:
                leader = self.polynomials[leader][0]
            if slave in self.polynomials or leader == slave:
                problem = f'equality {self.names["equality"][e]}: joint {name} is coupled already'
                source.note('dropped', problem)
                continue
            self.polynomials[slave], zero = (master, terms.copy()), m.qpos0[m.jnt_qposadr[slave]]
            if master < 0:
                source.fixed.append(name)
                source.rest[name] = float(zero + terms[-1])
                continue
            start = m.qpos0[m.jnt_qposadr[master]]
            value = np.poly1d([zero]) + np.poly1d(terms)(np.poly1d([1.0, -start]))
            rounded = [round(float(term), 12) for term in value.coeffs[::-1]]
            source.couplings[name] = Coupling.of_terms(self.names['joint'][master], rounded)

    def _tendons(self) -> None:
        m, source = self.model, self.source
        if not m.ntendon:
            raise ValueError('it has no tendon, and only tendons become muscles')
        driven = defaultdict(list)
        for a in range(m.nu):
            if m.actuator_trntype[a] == mujoco.mjtTrn.mjTRN_TENDON:
                driven[int(m.actuator_trnid[a][0])].append(self._pull(a))
            else:
                name = self.names['actuator'][a]
                source.note('dropped', f'actuator {name}: it does not act on a tendon')
        for t in range(m.ntendon):
            name, first = self.names['tendon'][t], m.tendon_adr[t]
            if m.wrap_type[first] == mujoco.mjtWrap.mjWRAP_JOINT:
                if m.tendon_stiffness[t] > 0.0:
                    continue
                source.note('dropped', f'tendon {name}: it is a fixed tendon, which has no route')
            elif driven and t not in driven:
                if m.tendon_stiffness[t] > 0.0:
                    continue  # a passive tendon
                source.note('dropped', f'tendon {name}: no actuator pulls it')
            else:
                self.tendons[name] = t
                self._route(name, range(first, first + m.tendon_num[t]))
                pulls = driven.get(t, [])
                least, most = (sum(ends) for ends in zip(*pulls)) if pulls else (0.0, np.inf)
                if m.tendon_actfrclimited[t]:  # a negative force shortens the tendon
                    ends = -m.tendon_actfrcrange[t][::-1]
                    least, most = np.clip([least, most], 0.0, max(0.0, float(ends[1])))
                source.strength[name] = float(most) if most < np.inf else 0.0
                if least > 0.0:
                    source.least[name] = float(least)
        if self.tendons and not driven:
            source.note('chosen', 'no actuator pulls a tendon, so every tendon is a muscle')

    def _pull(self, a: int) -> tuple[float, float]:
        """Return the least and the largest tension that actuator a can exert [N].

        The largest is infinity if the file states no limit.
        """
        m, ends = self.model, np.array([-np.inf, np.inf])
        gain, gear = m.actuator_gainprm[a], m.actuator_gear[a][0]
        if m.actuator_gaintype[a] == mujoco.mjtGain.mjGAIN_MUSCLE:
            force = gain[2] if gain[2] >= 0.0 else gain[3] / max(m.actuator_acc0[a], 1e-15)
            ends = np.array([-force, 0.0])
        elif (
            m.actuator_gaintype[a] == mujoco.mjtGain.mjGAIN_FIXED
            and m.actuator_biastype[a] == mujoco.mjtBias.mjBIAS_NONE
            and m.actuator_ctrllimited[a]
        ):  # a motor
            ends = gain[0] * m.actuator_ctrlrange[a]
        elif m.actuator_gaintype[a] == mujoco.mjtGain.mjGAIN_FIXED and m.actuator_ctrllimited[a]:
            # A servo such as `position`: force = gain · control + b₀ + b₁ · gear · length.
            length, bias = self._tendon_range(int(m.actuator_trnid[a][0])), m.actuator_biasprm[a]
            control, follows = gain[0] * m.actuator_ctrlrange[a], bias[1] * gear * length
            ends = bias[0] + np.array(
                [control.min() + follows.min(), control.max() + follows.max()]
            )
        if m.actuator_forcelimited[a]:
            ends = np.clip(ends, *m.actuator_forcerange[a])
        # In MuJoCo, a negative force shortens the tendon.
        least, pull = (float(end) for end in sorted(-gear * ends)) if gear else (0.0, 0.0)
        if pull <= 0.0:
            problem = (
                f'actuator {self.names["actuator"][a]}: it can only push, but a tendon only pulls'
            )
            self.source.note('dropped', problem)
        least = max(least, 0.0) if least > -np.inf else 0.0
        return least, max(pull, 0.0) if pull <= STRONGEST else np.inf

    def _route(self, name: str, wraps: range) -> None:
        m, types = self.model, mujoco.mjtWrap
        parts: list[list[RoutePoint | Wrap]] = [[]]
        divisor: float | None = None
        for w in wraps:
            kind, i = m.wrap_type[w], m.wrap_objid[w]
            if kind == types.mjWRAP_PULLEY:
                parts.append([])
                divisor = float(m.wrap_prm[w])
            elif kind == types.mjWRAP_SITE:
                body = self.names['body'][m.site_bodyid[i]]
                begins = divisor if not parts[-1] else None
                parts[-1].append(RoutePoint(body, m.site_pos[i].copy(), begins))
            else:
                round_axis = kind == types.mjWRAP_CYLINDER
                parts[-1].append(self._wrap(i, int(m.wrap_prm[w]), round_axis))
        # Leave out branches with a single site, because they have no length.
        self.source.routes[name] = tuple(item for part in parts if len(part) > 1 for item in part)

    def _wrap(self, geom: int, site: int, round_axis: bool) -> Wrap:
        m, body, data, side = self.model, int(self.model.geom_bodyid[geom]), self.start, None
        turn, side_link = data.xmat[body].reshape(3, 3), None
        if site >= 0:
            side = m.site_pos[site].copy()
            if m.site_bodyid[site] != body:
                side_link = self.names['body'][m.site_bodyid[site]]
        axis = turn.T @ data.geom_xmat[geom][2::3] if round_axis else None
        radius = float(self.radius[geom])
        if axis is not None and side is not None and side_link is None:
            out = side - m.geom_pos[geom]
            if np.linalg.norm(np.cross(axis, out)) < 1e-9 and np.linalg.norm(out) >= radius:
                # Move a side site away from the axis of a cylinder, as MuJoCo does.
                side = side + radius * turn.T @ data.geom_xmat[geom][::3]
        link = self.names['body'][body]
        return Wrap(link, m.geom_pos[geom].copy(), radius, axis, side, side_link)

    def _tie_rims(self) -> None:
        """Shrink objects with a site on their rim, and add a note for each (see `tie_rims`)."""
        for tendon, geom in tie_rims(self.model):
            body = self.names['body'][self.model.geom_bodyid[geom]]
            site = (
                f'muscle {self.names["tendon"][tendon]}: a site on the rim of an object on {body}'
            )
            self.source.note(
                'chosen',
                f'{site} counts as outside the object; in MuJoCo, rounding errors decide this',
            )

    def _points(self) -> None:
        """Set `source.points` to the points that may become the end effector.

        These are the far ends of bodies, then the sites that are on no tendon, then the other
        sites.
        """
        m, source, points = self.model, self.source, dict[str, tuple[str, Array]]()
        for i in range(1, m.nbody):
            if (far := far_end(m, self.start, i)) is not None:
                points[tip_name(self.names['body'][i])] = self.names['body'][i], far
        passed = {int(i) for i in m.wrap_objid[m.wrap_type == mujoco.mjtWrap.mjWRAP_SITE]}
        taken = {*source.links, *points}
        for i in sorted(range(m.nsite), key=lambda i: (i in passed, i)):
            if m.site(i).name and (name := safe_name(m.site(i).name, f'site_{i}')) not in taken:
                points[name] = self.names['body'][m.site_bodyid[i]], m.site_pos[i].copy()
        source.points = points

    def _tendon_range(self, tendon: int) -> Array:
        """Return the smallest and the largest length of a tendon in random postures [m]."""
        m, data, rng = self.model, mujoco.MjData(self.model), np.random.default_rng(0)
        lengths = []
        for _ in range(RANGE_POSTURES):
            for j in np.flatnonzero(m.jnt_limited & (m.jnt_type != mujoco.mjtJoint.mjJNT_BALL)):
                data.qpos[m.jnt_qposadr[j]] = rng.uniform(*m.jnt_range[j])
            lengths.append(float(self._with_tendons(data).ten_length[tendon]))
        return np.array([min(lengths), max(lengths)])

    def _with_tendons(self, data: Any) -> Any:
        """Compute the tendon lengths for the positions in MuJoCo's data; return the data."""
        mujoco.mj_kinematics(self.model, data)
        mujoco.mj_comPos(self.model, data)
        mujoco.mj_tendon(self.model, data)
        return data

    def _lengths(self, tendons: dict[str, int], values: dict[str, Array]) -> dict[str, Array]:
        """Return the tendon lengths that MuJoCo computes [m], (N,) each, by name.

        `tendons` are the tendons' indices, and `values` the joint positions [rad or m], (N,) each,
        both by name.
        """
        m, data, start = self.model, mujoco.MjData(self.model), self.model.qpos0
        address = {self.names['joint'][j]: at for j, at in enumerate(m.jnt_qposadr.tolist())}
        lengths = []
        for n in range(len(next(iter(values.values())))):
            data.qpos[:] = start
            for name in values.keys() & address:
                data.qpos[address[name]] = values[name][n]
            for j, parts in self.balls.items():
                at = slice(m.jnt_qposadr[j], m.jnt_qposadr[j] + 4)
                angles = [values[part][n] if part in values else 0.0 for part in parts]
                turn = Rotation.from_quat(np.roll(start[at], -1)) * Rotation.from_euler(
                    'XYZ', angles
                )
                data.qpos[at] = np.roll(turn.as_quat(), 1)
            for _ in self.polynomials:  # repeated, because a master may be a coupled joint itself
                for slave, (master, terms) in self.polynomials.items():
                    at = m.jnt_qposadr[[slave, master]]
                    moved = (data.qpos - start)[at[1]] if master >= 0 else 0.0
                    data.qpos[at[0]] = start[at[0]] + np.polyval(terms, moved)
            lengths.append(self._with_tendons(data).ten_length.copy())
        return dict(zip(tendons, np.array(lengths)[:, list(tendons.values())].T))
