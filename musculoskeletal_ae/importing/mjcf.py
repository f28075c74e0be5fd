# SPDX-License-Identifier: Apache-2.0
"""MuJoCo models (MJCF), through the `mujoco` package: what loads there loads here.

Spatial tendons become routes: sites, wrapping spheres and cylinders with their side sites. Hinges
and slides become joints, a body with several of them a chain of massless links; a ball joint three
hinges. `equality/joint` becomes a coupling, a polynomial the line nearest to it.
"""

from collections import defaultdict
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import mujoco
import numpy as np
import pinocchio as pin
from scipy.spatial.transform import Rotation

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.importing.source import Source, distinct, names_of_all, refuse, safe_name
from musculoskeletal_ae.mujoco_version import check_mujoco
from musculoskeletal_ae.robot.description import RoutePoint, Wrap
from musculoskeletal_ae.robot.joint_tree import resolved

check_mujoco()

#: where a model says how many it has of each kind that has names here
COUNTS = {
    'body': 'nbody', 'joint': 'njnt', 'tendon': 'ntendon', 'actuator': 'nu', 'equality': 'neq',
}  # fmt: skip
STRONGEST = 1e6  # [N]; MuJoCo makes a muscle without a lever at the start stronger


def read_mjcf(file: Path, root: ET.Element) -> Source:
    """Read an MJCF file; a SourceError says if MuJoCo does not load it."""
    for item in root.iter('include'):
        included = file.parent / (name := item.get('file', ''))
        if included.exists() and not included.is_file():
            raise refuse(file, f'what it includes, {name!r}, is no regular file')
    warnings: list[str] = []
    mujoco.set_mju_user_warning(warnings.append)  # by default it writes a file where it was started
    try:
        model = open_mjcf(file).compile()
    except (ValueError, mujoco.FatalError) as error:
        raise refuse(file, f'MuJoCo does not load it: {" ".join(str(error).split())}') from error
    finally:
        mujoco.set_mju_user_warning(lambda _: None)
    source = _Reader(model, file.stem).source
    for warning in warnings:
        source.note('MuJoCo warns', ' '.join(warning.split()))
    return source


def open_mjcf(file: Path) -> Any:
    """Return an MJCF file's MjSpec, whose bodies all stay: MuJoCo may fuse a hand with its arm."""
    spec = mujoco.MjSpec.from_file(str(file))
    spec.compiler.fusestatic = False
    return spec


def resting_joints(model: Any) -> list[float]:
    """Return where `import_robot` holds each hinge and slide of a model, if it leaves it out."""
    reader = _Reader(model, '')
    source = reader.source
    source.couplings = resolved(source.couplings)
    source.settle()
    return [source.rest.get(name, 0.0) for name in reader.names['joint']]


class _Reader:
    def __init__(self, model: Any, name: str) -> None:
        self.model, self.source = model, Source(safe_name(name, 'robot'))
        weightless = model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_GRAVITY
        self.source.model.gravity.linear = model.opt.gravity * (not weightless)
        self.start = mujoco.MjData(model)
        mujoco.mj_kinematics(model, self.start)
        self.names = {kind: self._names(kind) for kind in COUNTS}
        self.balls: dict[int, list[str]] = {}
        #: joint that follows another (−1: none), by which polynomial
        self.polynomials: dict[int, tuple[int, Array]] = {}
        self.tendons: dict[str, int] = {}
        self._bodies()
        self._couplings()
        self._not_modelled()
        self._tendons()
        self.source.lengths = self._lengths

    def _names(self, kind: str) -> list[str]:
        """Return the name of each thing of a kind, or its kind and number."""
        get, count = getattr(self.model, kind), getattr(self.model, COUNTS[kind])
        original = [get(i).name for i in range(count)]
        names = names_of_all(kind, original)
        for each, name in zip(original, names, strict=True):
            self.source.renamed(kind, each, name)
        return names

    def _not_modelled(self) -> None:
        m = self.model
        for kind, effect, values in (
            ('joint', 'springs', m.jnt_stiffness),
            ('joint', 'armature', m.dof_armature[m.jnt_dofadr]),
            ('joint', 'damping', m.dof_damping[m.jnt_dofadr]),
            ('joint', 'friction', m.dof_frictionloss[m.jnt_dofadr]),
            ('tendon', 'springs', m.tendon_stiffness),
            ('tendon', 'limits', m.tendon_limited),
            ('tendon', 'damping', m.tendon_damping),
            ('tendon', 'friction', m.tendon_frictionloss),
            ('body', 'compensated weight', m.body_gravcomp),
        ):
            if named := ', '.join(self.names[kind][i] for i in np.flatnonzero(values).tolist()):
                self.source.note('dropped', f'{effect}: {kind} {named}')
        touching = int(np.count_nonzero(m.geom_contype | m.geom_conaffinity))
        if m.npair or touching > 1:
            self.source.note('dropped', f'contacts: {touching} geoms may touch each other')

    def _bodies(self) -> None:
        """Add links and joints; at the start a joint stands as its body does, in its anchor."""
        m, data, at_start = self.model, self.start, {0: (0, pin.SE3.Identity())}
        for i in range(m.nbody):
            turn, carrier, stand = data.xmat[i].reshape(3, 3), *at_start[m.body_parentid[i]]
            for j in range(m.body_jntadr[i], m.body_jntadr[i] + m.body_jntnum[i]):
                if m.jnt_type[j] == mujoco.mjtJoint.mjJNT_FREE:
                    problem = f'free joint {self.names["joint"][j]}, where the file puts it'
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
        """Add a joint that stands at a pose in the carrier at the start; return its number."""
        m, source, types, name = self.model, self.source, mujoco.mjtJoint, self.names['joint'][j]
        low, high = m.jnt_range[j] if m.jnt_limited[j] else (-np.inf, np.inf)
        kind, rest = m.jnt_type[j], float(m.qpos0[m.jnt_qposadr[j]])
        axes, names, slides = [m.jnt_axis[j].copy()], [name], kind == types.mjJNT_SLIDE
        if kind == types.mjJNT_BALL:
            source.note('approximated', f'ball joint {name}: three hinges, x then y then z')
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
                source.note('dropped', f'equality {self.names["equality"][e]}: not of joints')
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
            source.couple(name, self.names['joint'][master], value)

    def _tendons(self) -> None:
        m, source = self.model, self.source
        driven = defaultdict(list)
        for a in range(m.nu):
            if m.actuator_trntype[a] == mujoco.mjtTrn.mjTRN_TENDON:
                driven[int(m.actuator_trnid[a][0])].append(self._strength(a))
            else:
                source.note('dropped', f'actuator {self.names["actuator"][a]}: on no tendon')
        for t in range(m.ntendon):
            name, first = self.names['tendon'][t], m.tendon_adr[t]
            if m.wrap_type[first] == mujoco.mjtWrap.mjWRAP_JOINT:
                source.note('dropped', f'tendon {name}: a fixed one, which has no route')
            elif driven and t not in driven:
                source.note('dropped', f'tendon {name}: no actuator pulls it')
            else:
                self.tendons[name] = t
                self._route(name, range(first, first + m.tendon_num[t]))
                known = [force for force in driven.get(t, []) if force < np.inf]
                source.strength[name] = sum(known)
        if self.tendons and not driven:
            source.note('chosen', 'every tendon is a muscle: no actuator pulls any')

    def _strength(self, a: int) -> float:
        """Return what an actuator of a tendon can pull [N]; inf: the file does not limit it."""
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
        if m.actuator_forcelimited[a]:
            ends = np.clip(ends, *m.actuator_forcerange[a])
        # A force that shortens is negative in MuJoCo.
        pull = float(max(-gear * ends)) if gear else 0.0
        if pull <= 0.0:
            problem = (
                f'actuator {self.names["actuator"][a]}: it can only push, and a wire only pulls'
            )
            self.source.note('dropped', problem)
        return max(pull, 0.0) if pull <= STRONGEST else np.inf

    def _route(self, name: str, wraps: range) -> None:
        m, types = self.model, mujoco.mjtWrap
        branches: list[list[RoutePoint | Wrap]] = [[]]
        divided = False
        for w in wraps:
            kind, i = m.wrap_type[w], m.wrap_objid[w]
            if kind == types.mjWRAP_PULLEY:
                branches.append([])
                divided |= bool(m.wrap_prm[w] != 1.0)
            elif kind == types.mjWRAP_SITE:
                body = self.names['body'][m.site_bodyid[i]]
                branches[-1].append(RoutePoint(body, m.site_pos[i].copy()))
            else:
                round_axis = kind == types.mjWRAP_CYLINDER
                branches[-1].append(self._wrap(name, i, int(m.wrap_prm[w]), round_axis))
        branches = [branch for branch in branches if branch]
        if divided or len(branches) > 1:
            problem = (
                f'muscle {name}: of {len(branches)} branches over pulleys one is kept, undivided'
            )
            self.source.note('approximated', problem)
        # Of several branches the format keeps one: the one that joints move most.
        kept = max(branches, key=lambda branch: len({item.link for item in branch}))
        self.source.routes[name] = tuple(kept)

    def _wrap(self, name: str, geom: int, site: int, round_axis: bool) -> Wrap:
        m, body, data, side = self.model, int(self.model.geom_bodyid[geom]), self.start, None
        turn = data.xmat[body].reshape(3, 3)
        if site >= 0:
            side = turn.T @ (data.site_xpos[site] - data.xpos[body])
            if m.site_bodyid[site] != body:
                problem = f'muscle {name}: side site {m.site(site).name!r} is on another body'
                self.source.note('approximated', f'{problem}; taken where it is at the start')
        axis = turn.T @ data.geom_xmat[geom][2::3] if round_axis else None
        radius = float(m.geom_size[geom][0])
        if axis is not None and side is not None:
            out = side - m.geom_pos[geom]
            if np.linalg.norm(np.cross(axis, out)) < 1e-9 and np.linalg.norm(out) >= radius:
                side = side + radius * turn.T @ data.geom_xmat[geom][::3]  # as MuJoCo has it
        return Wrap(self.names['body'][body], m.geom_pos[geom].copy(), radius, axis, side)

    def _lengths(self, values: dict[str, Array]) -> dict[str, Array]:
        """Return MuJoCo's own lengths."""
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
            for _ in self.polynomials:  # as often as one may follow another
                for slave, (master, terms) in self.polynomials.items():
                    at = m.jnt_qposadr[[slave, master]]
                    moved = (data.qpos - start)[at[1]] if master >= 0 else 0.0
                    data.qpos[at[0]] = start[at[0]] + np.polyval(terms, moved)
            mujoco.mj_kinematics(m, data)
            mujoco.mj_comPos(m, data)
            mujoco.mj_tendon(m, data)
            lengths.append(data.ten_length.copy())
        return dict(zip(self.tendons, np.array(lengths)[:, list(self.tendons.values())].T))
