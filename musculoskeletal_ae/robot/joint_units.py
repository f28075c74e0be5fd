# SPDX-License-Identifier: Apache-2.0
"""Units of the joints: the border between θ and the positions of joints in files and messages.

The core knows one kind of joint. All entries of θ are in [rad], all joint torques in [N·m]. A
prismatic joint is treated as if a pinion of radius RACK moved it: θ is the angle of the pinion. In
files, messages and texts, its position is in [m], and its torque is a force in [N]. With r = RACK
for prismatic joints and r = 1 for revolute ones,

    position = r θ,   effort = τ / r,   stiffness outside = K / r²

Code that reads a position converts it to θ, and code that publishes or prints θ converts it back.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, NamedTuple, SupportsIndex

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools, Ints

if TYPE_CHECKING:  # slow imports, which the parameters of the nodes do not need
    import pinocchio as pin

    from musculoskeletal_ae.robot.joint_elasticity import JointElasticity

PRISMATIC = ('JointModelPX', 'JointModelPY', 'JointModelPZ', 'JointModelPrismaticUnaligned')
#: let θ of a prismatic joint rise by 1 rad when the joint moves by this distance [m]: the radius of
#: an assumed pinion
RACK = 0.06


class JointUnit(NamedTuple):
    """Units of one joint's position, torque and stiffness outside the core."""

    radian: float  # position of the joint at θ = 1 rad
    position: str
    torque: str
    stiffness: str

    def position_text(self, theta: float, form: str = '.2f') -> str:
        """Return the joint's position θ [rad] as text with its unit, in the format `form`."""
        return f'{theta * self.radian:{form}} {self.position}'

    def range_text(self, low: float, high: float, form: str = '.2f') -> str:
        """Return the range from `low` to `high`, both θ [rad], as text such as '0.00 to 0.05 m'.

        `form` is the format of the numbers.
        """
        low, high = low * self.radian, high * self.radian
        return f'{low:{form}} to {high:{form}} {self.position}'

    def torque_text(self, torque: float, form: str = '.2f') -> str:
        """Return a joint torque [N·m] as text; of a prismatic joint, the force [N] instead.

        `form` is the format of the number.
        """
        return f'{torque / self.radian:{form}} {self.torque}'

    def stiffness_text(self, stiffness: float, form: str = '.2f') -> str:
        """Return a joint stiffness [N·m/rad] as text; of a prismatic joint, in [N/m] instead.

        `form` is the format of the number.
        """
        return f'{stiffness / self.radian**2:{form}} {self.stiffness}'


TURN, SLIDE = JointUnit(1.0, 'rad', 'N·m', 'N·m/rad'), JointUnit(RACK, 'm', 'N', 'N/m')


class JointUnits:
    """Names and units of D joints, and conversions between θ and the positions outside."""

    def __init__(self, names: Sequence[str], slides: Sequence[bool]) -> None:
        """State the names of the joints, in the order of θ, and whether each is prismatic."""
        self.names = tuple(names)
        self._units = tuple(SLIDE if is_prismatic else TURN for is_prismatic in slides)
        #: whether each joint is prismatic, (D,)
        self.slides: Bools = np.array(slides, dtype=bool)
        #: position of each joint at θ = 1 rad [rad or m], (D,)
        self.radian: Array = np.array([unit.radian for unit in self._units])

    @classmethod
    def of_model(cls, model: pin.Model, joints: Sequence[str]) -> JointUnits:
        """Return the units of some joints of a pinocchio model."""
        kinds = [model.joints[model.getJointId(name)].shortname() for name in joints]
        return cls(joints, [kind in PRISMATIC for kind in kinds])

    def __getitem__(self, joint: SupportsIndex) -> JointUnit:
        return self._units[joint]

    def __len__(self) -> int:
        return len(self._units)

    def __iter__(self) -> Iterator[JointUnit]:
        return iter(self._units)

    def to_theta(self, position: Array, joints: Ints | slice | int = slice(None)) -> Array:
        """Return θ [rad], (..., D), for positions, velocities or accelerations of the joints.

        Args:
            position: Values in [rad] or [m], (..., D).
            joints: Indices of the joints in the last axis, or the index of the only joint; by
                default all.
        """
        theta: Array = position / self.radian[joints]
        return theta

    def to_position(self, theta: Array, joints: Ints | slice | int = slice(None)) -> Array:
        """Return positions, velocities or accelerations in [rad] or [m]: inverse of `to_theta`."""
        position: Array = theta * self.radian[joints]
        return position

    def covariance_of_positions(self, covariance: Array) -> Array:
        """Return the covariance of the positions for that of θ [rad²], (D, D) each."""
        result: Array = self.radian[:, None] * covariance * self.radian
        return result

    def to_effort(self, torque: Array) -> Array:
        """Return torques and forces [N·m or N], (..., D), for joint torques [N·m], (..., D)."""
        effort: Array = torque / self.radian
        return effort

    def to_stiffness(self, stiffness: Array) -> Array:
        """Return joint stiffnesses [N·m/rad], (D,), for those in [N·m/rad or N/m], (D,)."""
        result: Array = stiffness * self.radian**2
        return result

    def elasticity_to_core(self, outside: JointElasticity) -> JointElasticity:
        """Return springs and dampers in [N·m] and [rad] for those in the units of the joints."""
        return outside.scaled(self.radian)

    def elasticity_outside(self, elasticity: JointElasticity) -> JointElasticity:
        """Return springs and dampers in the joints' units: inverse of `elasticity_to_core`."""
        return elasticity.scaled(1.0 / self.radian)

    def mean_errors(self, error: Array) -> Array:
        """Return the mean 2-norms of errors over the revolute and over the prismatic joints [rad].

        Args:
            error: Errors of θ [rad], (N, D) or (D,); NaN where they are unknown.

        Returns:
            The means over all rows with known errors, (2,); NaN if there is none.
        """
        means = np.full(2, np.nan)
        for kind, joints in enumerate((~self.slides, self.slides)):
            off = np.atleast_2d(error)[:, joints]
            off = off[np.isfinite(off).any(axis=1)]
            if len(off):
                means[kind] = np.linalg.norm(np.nan_to_num(off), axis=1).mean()
        return means

    def errors_text(self, means: Array, form: str = '.4f') -> str:
        """Return the means of `mean_errors` as text, such as '0.0123 rad and 1.20 mm', or ''.

        Args:
            means: Mean errors of the revolute and of the prismatic joints [rad], (2,).
            form: Format of the number in [rad].
        """
        turn, slide = means
        parts = [] if np.isnan(turn) else [f'{turn:{form}} rad']
        parts += [] if np.isnan(slide) else [f'{1e3 * RACK * slide:.2f} mm']
        return ' and '.join(parts)

    def error_text(self, error: Array, form: str = '.4f') -> str:
        """Return the mean size of errors of θ [rad], (N, D) or (D,), as text; see `errors_text`."""
        return self.errors_text(self.mean_errors(error), form)

    @property
    def distance_unit(self) -> str:
        """Unit of a distance ‖Δθ‖ between postures, for texts."""
        return f'rad ({1e3 * RACK:g} mm = 1 rad)' if self.slides.any() else 'rad'

    @property
    def position_unit(self) -> str:
        """Units of positions in a list of all joints, such as 'rad or m'."""
        return ' or '.join(sorted({unit.position for unit in self}, reverse=True))
