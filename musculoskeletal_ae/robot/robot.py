# SPDX-License-Identifier: Apache-2.0
"""A tendon-driven robot as its description gives it: the nominal body."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.robot.description import RobotDescription, load_description
from musculoskeletal_ae.robot.kinematics import Kinematics
from musculoskeletal_ae.robot.routes import Routes
from musculoskeletal_ae.robot.stiffness import muscle_stiffness


class Robot:
    """Geometric model of D joints and M muscles (paper, section "Initial Training").

    Attributes:
        description: The checked description; what follows is taken from it.
        joints: Names of the D joints, in the order of θ.
        muscles: Names of the M muscles, in the order of T and l.
        series_elastic: Elastic constants of the muscles.
        tension: Tension range [N].
        stiffness: K_stiff of muscle stiffness control [N/m].
        root_link: The URDF's root link, in whose frame poses and markers are given.
        kinematics: Link poses, gravity torque, end-effector Jacobian.
        routes: Muscle lengths and the muscle Jacobian of the nominal routes.
        lower: Lower joint limits [rad], shape (D,).
        upper: Upper joint limits [rad], shape (D,).
    """

    def __init__(self, description: RobotDescription) -> None:
        """Build the nominal body of a description."""
        self.description = description
        self.joints, self.muscles = description.joints, description.muscles
        self.joint_count, self.muscle_count = len(self.joints), len(self.muscles)
        self.series_elastic = description.series_elastic
        self.tension, self.stiffness = description.tension, description.stiffness
        self.root_link = description.root_link
        self.kinematics = Kinematics(
            description.model, description.joints, description.end_effector
        )
        self.routes = Routes(self.kinematics, description.routes)
        self.lower, self.upper = self.kinematics.lower, self.kinematics.upper

    @classmethod
    def load(cls, robot: str | Path) -> Robot:
        """Read a shipped robot's name or a directory; see `load_description` for errors."""
        return cls(load_description(robot))

    def muscle_indices(self, names: Iterable[str]) -> list[int]:
        """Return where in T and l the named muscles stand.

        Raises:
            MusculoskeletalError: If a name is not one of this robot's muscles.
        """
        indices = []
        for name in names:
            if name not in self.muscles:
                legal = ', '.join(self.muscles)
                raise MusculoskeletalError(f'unknown muscle {name!r}; legal: {legal}')
            indices.append(self.muscles.index(name))
        return indices

    def muscle_lengths(self, theta: Array, tension: Array) -> Array:
        """Return l = f_geo(θ) − L_e(f_geo,abs(θ), T) [m], θ (..., D), T (..., M)."""
        absolute = self.routes.absolute_lengths(theta)
        relative = absolute - self.routes.length_at_zero
        lengths: Array = relative - self.series_elastic.elongation(absolute, tension)
        return lengths

    def muscle_stiffness(self, theta: Array, tension: Array) -> Array:
        """Return k(θ, T) [N/m] of MSC and the elastic unit in series, θ (..., D), T (..., M)."""
        absolute = self.routes.absolute_lengths(theta)
        return muscle_stiffness(self.stiffness, self.series_elastic.compliance(absolute, tension))

    def random_postures(self, count: int, rng: np.random.Generator, margin: float = 0.0) -> Array:
        """Return θ uniform in the joint limits [rad], shape (count, D).

        Args:
            count: How many.
            rng: Source of randomness.
            margin: Reach beyond each limit, as a share of the joint's range.
        """
        beyond = margin * (self.upper - self.lower)
        shape = count, self.joint_count
        return rng.uniform(self.lower - beyond, self.upper + beyond, shape)
