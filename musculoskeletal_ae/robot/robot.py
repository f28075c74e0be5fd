# SPDX-License-Identifier: Apache-2.0
"""The geometric model of a tendon-driven robot, built from its description."""

from __future__ import annotations

import copy
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools, Ints
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.robot.actuation import ACTUATIONS, Actuation
from musculoskeletal_ae.robot.description import (
    RobotDescription,
    Route,
    RoutePoint,
    TensionRange,
    load_description,
)
from musculoskeletal_ae.robot.groups import groups
from musculoskeletal_ae.robot.joint_elasticity import JointElasticity
from musculoskeletal_ae.robot.kinematics import Kinematics, body_frames
from musculoskeletal_ae.robot.routes import Routes
from musculoskeletal_ae.robot.series_elastic import SeriesElastic
from musculoskeletal_ae.robot.stiffness import muscle_stiffness


class Robot:
    """Geometric model of D joints and M muscles (paper, §III-B)."""

    description: RobotDescription
    joints: tuple[str, ...]  # names of the joints, in the order of θ
    muscles: tuple[str, ...]  # names of the muscles, in the order of T and l
    tension: TensionRange
    stiffness: Array  # K_stiff of muscle stiffness control [N/m], (M,)
    lower: Array  # lower joint limits [rad], (D,)
    upper: Array  # upper joint limits [rad], (D,)

    def __init__(self, description: RobotDescription) -> None:
        self.description = description
        self.joints, self.muscles = description.joints, description.muscles
        self.joint_count, self.muscle_count = len(self.joints), len(self.muscles)
        self.series_elastic = description.series_elastic
        self.tension = description.tension
        self.isolated: tuple[int, ...] = ()  # indices of isolated muscles in T and l
        #: which muscles are not isolated, (M,)
        self.used: Bools = np.ones(self.muscle_count, dtype=bool)
        self.stiffness = description.stiffness
        self.tension_source = description.tension_source
        #: root link of the URDF, the frame of poses and markers
        self.root_link = str(body_frames(description.model)[0].name)
        self.kinematics = Kinematics(
            description.model,
            self.joints,
            description.end_effector,
            description.couplings,
            description.joint_elasticity,
        )
        self.routes = Routes(self.kinematics, description.routes)
        self.groups = groups(self.routes.crossed)
        self.lower, self.upper = self.kinematics.lower, self.kinematics.upper
        #: units of the joints in files, messages and texts
        self.units = self.kinematics.units

    @property
    def actuation(self) -> Actuation:
        """How the modules turn commands into tensions, and what they measure."""
        return ACTUATIONS[self.description.actuation](self)

    @classmethod
    def load(cls, robot: str | Path) -> Robot:
        """Load a shipped robot by name, or a robot directory.

        Raises:
            RobotDescriptionError: If the description is invalid (`load_description`).
        """
        return cls(load_description(robot))

    def limb(self, joints: Ints, muscles: Ints) -> Robot:
        """Return a robot that has only the joints and muscles of one group, such as a limb.

        All other joints are fixed at zero.

        Args:
            joints: Indices of the joints in θ.
            muscles: Indices of the muscles in T and l.
        """
        whole = self.description
        elastic, tension = (
            [values[muscles] for values in vars(part).values()]
            for part in (whole.series_elastic, whole.tension)
        )
        description = replace(
            whole,
            joints=tuple(self.joints[j] for j in joints),
            muscles=tuple(self.muscles[m] for m in muscles),
            routes=tuple(whole.routes[m] for m in muscles),
            series_elastic=SeriesElastic(*elastic),
            stiffness=whole.stiffness[muscles],
            speed=whole.speed[muscles],
            release=whole.release[muscles],
            tension_source=whole.tension_source.of_muscles(muscles),
            tension=TensionRange(*tension),
            joint_elasticity=whole.joint_elasticity.of_joints(joints),
        )
        return Robot(description)

    def elongation(self, tension: Array) -> Array:
        """Return the elongation of series elastic elements and tendons [m], (M,).

        The stretch of the tendons is computed for their lengths at θ = 0. `tension` are the
        tensions [N], (M,).
        """
        return self.series_elastic.elongation(self.routes.length_at_zero, tension)

    def muscle_indices(self, names: Iterable[str]) -> list[int]:
        """Return the indices of the named muscles in T and l.

        Raises:
            MusculoskeletalError: If a name is not one of this robot's muscles.
        """
        names, legal = tuple(names), ', '.join(self.muscles)
        for name in names:
            if name not in self.muscles:
                raise MusculoskeletalError(f'unknown muscle {name!r}; legal: {legal}')
        return [self.muscles.index(name) for name in names]

    def names(self, muscles: Iterable[int]) -> str:
        """Return a text with the names of the muscles that have these indices in T and l."""
        return ', '.join(self.muscles[m] for m in muscles)

    def without(self, muscles: Iterable[int]) -> Robot:
        """Return a copy with exactly these muscles isolated.

        T_bias, T_limit and T_max of isolated muscles become 0. The copy shares the geometry with
        the original.
        """
        reduced, whole = copy.copy(self), self.description.tension
        reduced.isolated = tuple(sorted(muscles))
        used = reduced.used = ~np.isin(np.arange(self.muscle_count), reduced.isolated)
        reduced.tension = TensionRange(used * whole.bias, used * whole.limit, used * whole.max)
        return reduced

    def with_routes(self, routes: Iterable[Route]) -> Robot:
        """Return a copy with other tendon routes; it shares joints and links with the original."""
        changed = copy.copy(self)
        changed.description = replace(self.description, routes=tuple(routes))
        changed.routes = Routes(self.kinematics, changed.description.routes)
        changed.groups = groups(changed.routes.crossed)
        return changed

    def with_moved_points(self, shifts: Iterable[Array]) -> Robot:
        """Return a copy whose route points are moved; see `with_routes`.

        Args:
            shifts: Displacement of each point in the frame of its link [m], (3,), muscle by muscle.
        """
        each = iter(shifts)
        return self.with_routes(
            tuple(p._replace(xyz=p.xyz + next(each)) if isinstance(p, RoutePoint) else p for p in r)
            for r in self.description.routes
        )

    def with_elasticity(self, elasticity: JointElasticity | None) -> Robot:
        """Return a copy with learned springs and dampers.

        The copy shares the geometry with the original.

        Args:
            elasticity: The learned springs and dampers; None for those of the description.
        """
        own, stated = elasticity, self.description.joint_elasticity
        if own is None:
            own = stated
        elif own.damping.any() and not (own.stiffness.any() or own.preload.any()):
            # Only the damping was measured. The user may have stated springs since then.
            own = replace(stated, damping=own.damping)
        elif stated.tendons and not own.tendons:
            # Passive tendons are not learned, so a network does not contain them.
            own = replace(own, tendons=stated.tendons)
        if own is self.kinematics.elasticity:
            return self
        changed = copy.copy(self)
        changed.kinematics = self.kinematics.with_elasticity(own)
        return changed

    def muscle_lengths(self, theta: Array, tension: Array) -> Array:
        """Return the muscle lengths l of the geometric model [m], (..., M).

            l = f_geo(θ) − L_e(f_geo,abs(θ), T)

        f_geo,abs is the length of the route, f_geo the same relative to θ = 0, and L_e the
        elongation of series elastic element and tendon.

        Args:
            theta: Joint angles θ [rad], (..., D).
            tension: Tensions T [N], (..., M).
        """
        absolute = self.routes.absolute_lengths(theta)
        relative = absolute - self.routes.length_at_zero
        return relative - self.series_elastic.elongation(absolute, tension)

    def joint_load(self, torque: Array, jacobian: Array) -> Array:
        """Return an upper bound of the load of each joint in N postures [N·m], (D,).

        The load of a joint is the magnitude of its holding torque, plus the magnitudes of the
        torques that the muscles exert on it at T_bias. The bound is the sum of the largest values
        that these two parts have in any posture.

        Args:
            torque: Torque that holds the arm in N postures [N·m], (N, D).
            jacobian: Muscle Jacobian in these postures [m/rad], (N, M, D).
        """
        pulls = np.abs(jacobian) * self.tension.bias[:, None]
        load: Array = np.abs(torque).max(axis=0) + pulls.sum(axis=1).max(axis=0)
        return load

    def muscle_stiffness(self, theta: Array, tension: Array) -> Array:
        """Return the stiffness of each muscle: module and elastic element in series.

        Args:
            theta: Joint angles [rad], (..., D).
            tension: Tensions [N], (..., M).

        Returns:
            The stiffness of each muscle [N/m], (..., M).
        """
        absolute = self.routes.absolute_lengths(theta)
        return muscle_stiffness(self.stiffness, self.series_elastic.compliance(absolute, tension))

    def posture_text(self, theta: Array, digits: int = 2) -> str:
        """Return the joint positions θ (D,) as a text with the names and units of the joints."""
        each, form = zip(self.joints, theta, self.units, strict=True), f'.{digits}f'
        return ', '.join(f'{name} {unit.position_text(value, form)}' for name, value, unit in each)

    def random_postures(self, count: int, rng: np.random.Generator, margin: float = 0.0) -> Array:
        """Return uniformly distributed random θ [rad], (count, D).

        Args:
            count: Number of postures.
            rng: Random generator.
            margin: Share of each joint's range by which θ may exceed its limits.
        """
        beyond = margin * (self.upper - self.lower)
        shape = count, self.joint_count
        return rng.uniform(self.lower - beyond, self.upper + beyond, shape)
