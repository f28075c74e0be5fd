# SPDX-License-Identifier: Apache-2.0
"""MuJoCo models (MJCF), through the `mujoco` package: what loads there loads here.

Spatial tendons become routes: sites, wrapping spheres and cylinders with their side sites. Hinges
and slides become joints, a body with several of them a chain of massless links; a ball joint three
hinges. `equality/joint` becomes a coupling, a polynomial the line nearest to it.
"""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.files import read_text
from musculoskeletal_ae.importing.source import (
    FIXED,
    PRISMATIC,
    REVOLUTE,
    STRENGTH,
    Link,
    Source,
    SourceError,
    inertia,
    linear_fit,
    refuse,
    safe_name,
)
from musculoskeletal_ae.robot.description import Route, RoutePoint, Wrap
from musculoskeletal_ae.robot.kinematics import Coupling

SAMPLED = 100  # postures in which the branches of a pulley are compared


def read_mjcf(file: Path) -> Source:
    """Read an MJCF file.

    Raises:
        SourceError: If `mujoco` is not installed, or does not load the file.
    """
    try:
        import mujoco
    except ImportError as error:
        told = "MJCF is read by MuJoCo's own package: pip install mujoco==3.10.0"
        raise SourceError(told) from error
    read_text(file, refuse)  # a regular file, of bounded size
    try:
        model = mujoco.MjModel.from_xml_path(str(file))
    except (ValueError, mujoco.FatalError) as error:
        raise refuse(file, f'MuJoCo does not load it: {" ".join(str(error).split())}') from error
    return _Reader(mujoco, model, file.stem).source


def _pose(position: Array, quaternion: Array) -> pin.SE3:
    w, x, y, z = quaternion
    return pin.SE3(pin.Quaternion(w, x, y, z).normalized().matrix(), np.array(position))


class _Reader:
    def __init__(self, mujoco: Any, model: Any, name: str) -> None:
        self.mj, self.model, self.source = mujoco, model, Source(name)
        self.source.gravity = model.opt.gravity.copy()
        self.body_frame: list[pin.SE3] = []  # of each body in the frame of its link
        self.balls: dict[int, list[str]] = {}
        for i in range(model.nbody):
            self._body(i)
        self._couplings()
        self._tendons()
        self.source.lengths = self._lengths

    def name(self, kind: str, i: int) -> str:
        """Return the name of a thing, or its kind and number."""
        return safe_name(getattr(self.model, kind)(i).name, f'{kind}_{i}')

    def _body(self, i: int) -> None:
        m, source, body = self.model, self.source, self.name('body', i)
        if i == 0:
            self.body_frame.append(pin.SE3.Identity())
            source.links.append(Link(body, ''))
            return
        up = m.body_parentid[i]
        parent = self.name('body', up)
        at = self.body_frame[up] * _pose(m.body_pos[i], m.body_quat[i])
        joints = range(m.body_jntadr[i], m.body_jntadr[i] + m.body_jntnum[i])
        steps = [step for j in joints for step in self._joint(j)]
        frame = pin.SE3.Identity()
        for k, (joint, kind, axis, anchor, rest, limits, start) in enumerate(steps):
            if kind == FIXED:  # a free joint: the body stands where the file puts it
                at = self.body_frame[up] * start
                source.note('held fixed', f'free joint {joint} of {body}, where the file puts it')
                continue
            link = body if k == len(steps) - 1 else f'{body}_{joint}'
            placement = at * pin.SE3(np.eye(3), anchor) * start
            source.links.append(Link(link, parent, placement, joint, kind, axis, limits, rest))
            # The source's frame, turned by the joint about the anchor.
            frame = pin.SE3(np.eye(3), -anchor)
            at, parent = frame, link
        if not steps or steps[-1][1] == FIXED:
            source.links.append(Link(body, parent, at))
        self.body_frame.append(frame)
        if m.body_mass[i] > 0.0:
            turn = _pose(np.zeros(3), m.body_iquat[i]).rotation
            own = inertia(m.body_mass[i], m.body_ipos[i], np.diag(m.body_inertia[i]), turn)
            source.links[-1].inertia = frame.act(own)

    def _joint(self, j: int) -> list[tuple[str, str, Array, Array, float, tuple[float, float], pin.SE3]]:  # noqa: E501  # fmt: skip
        """Return name, kind, axis, anchor, rest, limits and start of what becomes of a joint."""
        m, source, types, name = self.model, self.source, self.mj.mjtJoint, self.name('joint', j)
        kind, at = m.jnt_type[j], m.jnt_qposadr[j]
        axis, anchor, zero = m.jnt_axis[j].copy(), m.jnt_pos[j].copy(), m.qpos0[at]
        low, high = m.jnt_range[j] if m.jnt_limited[j] else (-np.inf, np.inf)
        if kind == types.mjJNT_FREE:
            pose = _pose(m.qpos0[at : at + 3], m.qpos0[at + 3 : at + 7])
            return [(name, FIXED, axis, anchor, 0.0, (0.0, 0.0), pose)]
        if kind == types.mjJNT_BALL:
            source.note('approximated', f'ball joint {name}: three hinges, x then y then z')
            self.balls[j] = [f'{name}_{letter}' for letter in 'xyz']
            start = _pose(np.zeros(3), m.qpos0[at : at + 4])
            steps = []
            for k, part in enumerate(self.balls[j]):
                limits = source.limited(part, REVOLUTE, -high, high)
                begin = pin.SE3.Identity() if k else start
                steps.append((part, REVOLUTE, np.eye(3)[k], anchor, 0.0, limits, begin))
            return steps
        if kind == types.mjJNT_HINGE:
            start = pin.SE3(pin.exp3(-axis * zero), np.zeros(3))
            limits = source.limited(name, REVOLUTE, low, high)
            return [(name, REVOLUTE, axis, anchor, float(zero), limits, start)]
        start = pin.SE3(np.eye(3), -axis * zero)
        limits = source.limited(name, PRISMATIC, low, high)
        return [(name, PRISMATIC, axis, np.zeros(3), float(zero), limits, start)]

    def _couplings(self) -> None:
        m, source = self.model, self.source
        self.polynomials: dict[int, tuple[int, Array]] = {}
        for e in range(m.neq):
            if m.eq_type[e] != self.mj.mjtEq.mjEQ_JOINT or not m.eq_active0[e]:
                if m.eq_active0[e]:
                    source.note('dropped', f'equality {self.name("equality", e)}: not of joints')
                continue
            slave, master = int(m.eq_obj1id[e]), int(m.eq_obj2id[e])
            zero, name = m.qpos0[m.jnt_qposadr[slave]], self.name('joint', slave)
            terms = m.eq_data[e][:5].copy()
            self.polynomials[slave] = master, terms
            if master < 0:
                source.joint(name).rest = value = float(zero + terms[0])
                link = source.joint(name)
                link.placement, link.kind = link.motion_at_rest, FIXED
                source.note('held fixed', f'joint {name} at {value:.4g}, by an equality')
                continue
            start = m.qpos0[m.jnt_qposadr[master]]
            follows = self.name('joint', master)

            def value_at(x: Array, zero: float = zero, start: float = start, terms: Array = terms) -> Array:  # noqa: E501  # fmt: skip
                return zero + np.asarray(np.polyval(terms[::-1], x - start))

            slope, offset, error = linear_fit(value_at, *source.joint(follows).limits)
            source.couplings[name] = Coupling(follows, slope, offset)
            if error > 1e-6:
                told = f'joint {name} follows {follows} by a line, off by up to {error:.3g}'
                source.note('approximated', told)

    def _tendons(self) -> None:
        m, mj, source = self.model, self.mj, self.source
        driven = defaultdict(list)
        for a in range(m.nu):
            if m.actuator_trntype[a] == mj.mjtTrn.mjTRN_TENDON:
                driven[int(m.actuator_trnid[a][0])].append(a)
            else:
                source.note('dropped', f'actuator {self.name("actuator", a)}: on no tendon')
        self.tendons: dict[str, int] = {}
        for t in range(m.ntendon):
            name = self.name('tendon', t)
            first = m.tendon_adr[t]
            wraps = range(first, first + m.tendon_num[t])
            if m.wrap_type[first] == mj.mjtWrap.mjWRAP_JOINT:
                source.note('dropped', f'tendon {name}: a fixed one, which has no route')
                continue
            if driven and t not in driven:
                source.note('dropped', f'tendon {name}: no actuator pulls it')
                continue
            self.tendons[name] = t
            source.routes[name] = self._route(name, wraps)
            forces = [self._strength(a) for a in driven.get(t, [])]
            if any(forces):
                source.strength[name] = max(forces)
        if source.strength:
            source.note('chosen', STRENGTH)

    def _strength(self, a: int) -> float:
        m = self.model
        gain = m.actuator_gainprm[a]
        if m.actuator_gaintype[a] == self.mj.mjtGain.mjGAIN_MUSCLE:
            return float(gain[2] if gain[2] > 0.0 else gain[3] / m.actuator_acc0[a])
        limited = m.actuator_forcelimited[a]
        return float(np.abs(m.actuator_forcerange[a]).max()) if limited else 0.0

    def _place(self, body: int, position: Array) -> tuple[str, Array]:
        return self.name('body', body), self.body_frame[body].act(np.array(position))

    def _route(self, name: str, wraps: range) -> Route:
        m, types = self.model, self.mj.mjtWrap
        branches: list[list[RoutePoint | Wrap]] = [[]]
        for w in wraps:
            kind, i = m.wrap_type[w], m.wrap_objid[w]
            if kind == types.mjWRAP_PULLEY:
                branches.append([])
            elif kind == types.mjWRAP_SITE:
                branches[-1].append(RoutePoint(*self._place(m.site_bodyid[i], m.site_pos[i])))
            else:
                branches[-1].append(self._wrap(name, i, int(m.wrap_prm[w]), kind))
        branches = [branch for branch in branches if branch]
        if len(branches) > 1:
            # Of several branches the format keeps one: the one that joints move most.
            kept = max(branches, key=lambda branch: len({item.link for item in branch}))
            told = f'muscle {name}: of {len(branches)} branches over pulleys one is kept'
            self.source.note('approximated', told)
            return tuple(kept)
        return tuple(branches[0])

    def _wrap(self, name: str, geom: int, site: int, kind: int) -> Wrap:
        m, body = self.model, int(self.model.geom_bodyid[geom])
        link, centre = self._place(body, m.geom_pos[geom])
        axis = side = None
        if kind == self.mj.mjtWrap.mjWRAP_CYLINDER:
            turn = _pose(np.zeros(3), m.geom_quat[geom]).rotation
            axis = self.body_frame[body].rotation @ turn[:, 2]
        if site >= 0:
            if m.site_bodyid[site] == body:
                side = self._place(body, m.site_pos[site])[1]
            else:
                data = self.mj.MjData(m)
                self.mj.mj_kinematics(m, data)
                seen = data.xmat[body].reshape(3, 3).T @ (data.site_xpos[site] - data.xpos[body])
                side = self.body_frame[body].act(seen)
                told = f'muscle {name}: side site {self.name("site", site)} is on another body'
                self.source.note('approximated', f'{told}; taken where it is at the start')
        return Wrap(link, centre, float(m.geom_size[geom][0]), axis, side)

    def _lengths(self, values: dict[str, Array]) -> dict[str, Array]:
        """Return MuJoCo's own lengths."""
        m, mj, data = self.model, self.mj, self.mj.MjData(self.model)
        count = len(next(iter(values.values())))
        addresses = {self.name('joint', j): int(m.jnt_qposadr[j]) for j in range(m.njnt)}
        result = {name: np.empty(count) for name in self.tendons}
        for n in range(count):
            data.qpos[:] = m.qpos0
            for name, value in values.items():
                if name in addresses:
                    data.qpos[addresses[name]] = value[n]
            for j, parts in self.balls.items():
                at, turn = int(m.jnt_qposadr[j]), np.eye(3)
                for axis, part in zip(np.eye(3), parts):
                    turn = turn @ pin.exp3(axis * values[part][n])
                start = _pose(np.zeros(3), m.qpos0[at : at + 4]).rotation
                x, y, z, w = pin.Quaternion(start @ turn).coeffs()
                data.qpos[at : at + 4] = w, x, y, z
            for slave, (master, terms) in self._ordered():
                start = 0.0 if master < 0 else data.qpos[m.jnt_qposadr[master]] - m.qpos0[m.jnt_qposadr[master]]  # noqa: E501  # fmt: skip
                at = m.jnt_qposadr[slave]
                data.qpos[at] = m.qpos0[at] + np.polyval(terms[::-1], start)
            mj.mj_kinematics(m, data)
            mj.mj_comPos(m, data)
            mj.mj_tendon(m, data)
            for name, t in self.tendons.items():
                result[name][n] = data.ten_length[t]
        return result

    def _ordered(self) -> list[tuple[int, tuple[int, Array]]]:
        """Return couplings, masters first."""
        order: list[int] = []
        waiting = dict(self.polynomials)
        while waiting:
            ready = [slave for slave, (master, _) in waiting.items() if master not in waiting]
            ready = ready or list(waiting)
            order += ready
            for slave in ready:
                del waiting[slave]
        return [(slave, self.polynomials[slave]) for slave in order]
