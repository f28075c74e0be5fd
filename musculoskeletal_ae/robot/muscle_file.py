# SPDX-License-Identifier: Apache-2.0
"""The format of muscles.yaml (doc/reference/file_formats.md describes it for users).

This module checks each entry on its own. `description.py` then checks what depends on robot.urdf or
on the values of several muscles.
"""

from collections import Counter
from collections.abc import Iterable
from itertools import pairwise
from typing import Annotated, Literal

import numpy as np
from msgspec import UNSET, Meta, UnsetType, field

from musculoskeletal_ae.exceptions import printable
from musculoskeletal_ae.robot.joint_tree import MOST_TERMS
from musculoskeletal_ae.schema import (
    LONGEST_LIST,
    Name,
    Names,
    NotNegative,
    Number,
    Positive,
    Strict,
    Vector,
)

STIFFNESS, POSITION = 'stiffness', 'position'  # values of `actuation`
MOST_POWER = 12  # refuse a higher power than this in the length of a passive tendon
SHORTEST_AXIS = 1e-6  # refuse an axis shorter than this, because it defines no direction


class ElasticEntry(Strict, frozen=True):
    """Constants of a series elastic element; omitted constants have their defaults."""

    force: Positive | UnsetType = UNSET
    rate: Positive | UnsetType = UNSET
    wire_stretch: NotNegative | UnsetType = UNSET


class TensionEntry(Strict, frozen=True):
    """Tensions of a muscle [N]; omitted tensions have their defaults."""

    bias: Positive | UnsetType = UNSET
    limit: Positive | UnsetType = UNSET
    max: Positive | UnsetType = UNSET


class DriveEntry(Strict, frozen=True):
    """A motor whose current is measured instead of a tension."""

    torque_constant: Positive  # torque per current of the motor [N·m/A]
    gear: Positive  # turns of the motor per turn of the spool
    spool_radius: Positive  # radius of the spool [m]

    @property
    def newton_per_ampere(self) -> float:
        """Tension per current without friction [N per A]."""
        return self.torque_constant * self.gear / self.spool_radius


class RouteEntry(Strict, frozen=True):
    """A point of a route or, with `wrap`, a surface that the tendon wraps around."""

    link: Name
    xyz: Vector
    wrap: Literal['sphere', 'cylinder', 'pulley'] | None = None
    axis: Vector | None = None
    radius: Positive | None = None
    side: Vector | None = None
    side_link: Name | None = None  # link in whose frame `side` is given; default: `link`
    #: set at a point where another branch of the tendon begins, whose length counts 1/divisor
    divisor: Positive | None = None

    def __post_init__(self) -> None:
        """Check that the keys suit the kind of entry, and check the geometry of a cylinder."""
        if self.wrap is None:
            of_wraps = self.axis, self.radius, self.side, self.side_link
            if any(value is not None for value in of_wraps):
                legal = 'need `wrap: sphere`, `wrap: cylinder` or `wrap: pulley`'
                raise ValueError(f'axis, radius, side and side_link {legal}')
            return
        if self.divisor is not None:
            raise ValueError('divisor: legal only at a point where a branch begins; remove it here')
        if self.side_link is not None and self.side is None:
            raise ValueError("side_link needs side; key 'side' is missing")
        if self.radius is None:
            raise ValueError("key 'radius' is missing")
        if self.wrap == 'sphere':
            if self.axis is not None:
                legal = 'link, xyz, wrap, radius, side, side_link'
                raise ValueError(f"unknown key 'axis'; legal for a sphere: {legal}")
            return
        if self.axis is None:
            raise ValueError("key 'axis' is missing")
        axis = np.array(self.axis)
        length = float(np.linalg.norm(axis))
        if length < SHORTEST_AXIS:
            legal = f'a vector with a length of at least {SHORTEST_AXIS:g}'
            raise ValueError(f'axis: expected {legal}, got {list(self.axis)}')
        if self.wrap == 'pulley' and self.side is not None:
            raise ValueError(
                "unknown key 'side'; legal for a pulley: link, xyz, wrap, axis, radius"
            )
        if self.side is not None and self.side_link in (None, self.link):
            out = np.array(self.side) - np.array(self.xyz)
            beside = np.linalg.norm(np.cross(axis / length, out))
            if beside < 1e-9 and np.linalg.norm(out) >= self.radius:
                raise ValueError('side: expected a point beside the axis, got a point on the axis')


class MuscleEntry(Strict, frozen=True):
    """A muscle. Omitted keys have the values that the file states for all muscles."""

    name: Name
    route: Annotated[tuple[RouteEntry, ...], Meta(min_length=2, max_length=LONGEST_LIST)]
    series_elastic: ElasticEntry | None = None
    stiffness: Positive | UnsetType = UNSET
    speed: Positive | UnsetType = UNSET
    release: Positive | UnsetType = UNSET
    drive: DriveEntry | None = None
    tension: TensionEntry = TensionEntry()

    def __post_init__(self) -> None:
        """Check the name and the order of the route."""
        # Refuse commas, because messages join the names of several muscles with commas.
        if self.name != self.name.strip() or ',' in self.name:
            problem = 'name: expected a name without a comma and without spaces around it'
            raise ValueError(f'{problem}, got {self.name!r}')
        if printable(self.name) != self.name:
            raise ValueError(f'name: expected printable characters only, got {self.name!r}')
        is_wrap = [entry.wrap is not None for entry in self.route]
        if is_wrap[0] or is_wrap[-1] or any(map(all, pairwise(is_wrap))):
            raise ValueError('route: expected a point before and after each wrap')
        begins = [entry.divisor is not None for entry in self.route]
        if any(wrap and begin for wrap, begin in zip(is_wrap, begins[1:])):
            raise ValueError(
                'route: expected no wrap before a point with a divisor, because a wrap lies '
                'between two points of one branch'
            )


class CouplingEntry(Strict, frozen=True):
    """A joint that follows another: q = ratio · q_master + offset, or by a polynomial."""

    joint: Name
    master: Name
    ratio: Number = 1.0
    offset: Number = 0.0
    polynomial: Annotated[tuple[Number, ...], Meta(min_length=1, max_length=MOST_TERMS)] | None = (
        None  # coefficients of q_master's powers, the constant first
    )

    def __post_init__(self) -> None:
        """Check that the entry does not state both a polynomial and a ratio or offset."""
        if self.polynomial is not None and (self.ratio, self.offset) != (1.0, 0.0):
            raise ValueError('expected polynomial, or ratio and offset, got both')


class JointElasticityEntry(Strict, frozen=True):
    """Spring and damper of a joint; for a prismatic joint, [m] and [N] replace [rad] and [N·m]."""

    joint: Name
    stiffness: NotNegative = 0.0  # stiffness of the joint's own spring [N·m/rad]
    rest_angle: Number = 0.0  # angle at which the spring exerts no torque [rad]
    damping: NotNegative = 0.0  # damping of the joint [N·m·s/rad]
    #: off-diagonal entries of the stiffness matrix by the name of the other joint [N·m/rad]
    coupled: Annotated[dict[Name, Number], Meta(max_length=LONGEST_LIST)] = field(
        default_factory=dict
    )


class PassiveTendonEntry(Strict, frozen=True):
    """A passive tendon, which pulls (or pushes) while its length is outside `slack`."""

    name: Name
    stiffness: Positive  # spring constant of the tendon [N/m]
    slack: tuple[Number, Number]  # the lengths between which it exerts no force [m]
    joints: Names
    #: joint positions from which the polynomial of the length counts [rad or m]
    centre: Annotated[tuple[Number, ...], Meta(max_length=LONGEST_LIST)]
    #: terms of its length [m]: a coefficient each, and for each joint the power of its distance
    #: from `centre`
    length: Annotated[
        tuple[Annotated[tuple[Number, ...], Meta(max_length=LONGEST_LIST)], ...],
        Meta(min_length=1, max_length=LONGEST_LIST),
    ]

    def __post_init__(self) -> None:
        """Check that all parts have the same number of joints, and check `slack` and the powers."""
        count = len(self.joints)
        if len(self.centre) != count:
            raise ValueError(f'centre: expected {count} numbers, got {len(self.centre)}')
        if self.slack[0] > self.slack[1]:
            low, high = self.slack
            raise ValueError(f'slack: expected the smaller length first, got [{low}, {high}]')
        for term in self.length:
            powers = term[1:]
            is_legal = all(0 <= p <= MOST_POWER and p == int(p) for p in powers)
            if len(powers) != count or not is_legal:
                legal = f'a coefficient and {count} whole powers from 0 to {MOST_POWER}'
                raise ValueError(f'length: expected {legal}, got {list(term)}')


class MuscleFile(Strict, frozen=True):
    """The content of muscles.yaml: joints, muscles, and constants that all muscles share."""

    joints: Names
    muscles: Annotated[tuple[MuscleEntry, ...], Meta(min_length=1, max_length=LONGEST_LIST)]
    series_elastic: ElasticEntry | None = None
    actuation: Literal['stiffness', 'position'] = 'stiffness'
    tension_source: Literal['sensor', 'current', 'none'] = 'sensor'
    drive: DriveEntry | None = None  # motors of all muscles, if their currents are measured
    stiffness: Positive | UnsetType = UNSET  # K_stiff of muscle stiffness control [N/m]
    speed: Positive | UnsetType = UNSET  # speed of a position-controlled module [m/s]
    release: Positive | UnsetType = UNSET  # length that a stop pays out if T is unknown [m]
    tension: TensionEntry = TensionEntry()
    end_effector: Name | None = None
    end_effectors: Names | None = None
    couplings: Annotated[tuple[CouplingEntry, ...], Meta(max_length=LONGEST_LIST)] = ()
    joint_elasticity: Annotated[
        tuple[JointElasticityEntry, ...], Meta(max_length=LONGEST_LIST)
    ] = ()
    passive_tendons: Annotated[tuple[PassiveTendonEntry, ...], Meta(max_length=LONGEST_LIST)] = ()

    def __post_init__(self) -> None:
        """Check that names are unique, and that the file has no keys that exclude each other."""
        _check_unique('joints', self.joints)
        _check_unique('muscles', (muscle.name for muscle in self.muscles))
        _check_unique('end_effectors', self.end_effectors or ())
        _check_unique('couplings', (coupling.joint for coupling in self.couplings))
        _check_unique('joint_elasticity', (entry.joint for entry in self.joint_elasticity))
        _check_unique('passive_tendons', (entry.name for entry in self.passive_tendons))
        if self.end_effector is not None and self.end_effectors is not None:
            raise ValueError('expected end_effector or end_effectors, got both')
        self._check_actuation()

    def _check_drives(self) -> None:
        """Check that motors are described (`drive`) if and only if their currents are measured."""
        owners = [each.name for each in self.muscles if each.drive is not None]
        if self.tension_source == 'current':
            if self.drive is None and len(owners) < len(self.muscles):
                raise ValueError(
                    "tension_source 'current' needs drive: {torque_constant: [N·m/A], gear: ratio, "
                    'spool_radius: [m]}, of the robot or of each muscle'
                )
        elif self.drive is not None or owners:
            raise ValueError(
                f'drive needs tension_source: current, but tension_source is '
                f'{self.tension_source!r}; remove drive, or set tension_source: current'
            )

    def _check_actuation(self) -> None:
        """Check that the file has no key that only another `actuation` than its own uses."""
        is_position = self.actuation == 'position'
        if self.tension_source != 'sensor' and not is_position:
            raise ValueError(
                f'tension_source {self.tension_source!r} needs actuation: position, but actuation '
                "is 'stiffness'; publish the tension that the modules regulate "
                '(tension_source: sensor), or set actuation: position'
            )
        self._check_drives()
        foreign = ('stiffness',) if is_position else ('speed', 'release')
        needed = 'actuation: stiffness' if is_position else 'actuation: position'
        for key in foreign:
            owners = [f'muscle {each.name!r}' for each in self.muscles
                      if getattr(each, key) is not UNSET]  # fmt: skip
            if getattr(self, key) is not UNSET:
                owners.insert(0, 'the robot')
            if owners:
                raise ValueError(
                    f'{key} of {owners[0]} needs {needed}, but actuation is {self.actuation!r}; '
                    f'remove {key}, or set {needed}'
                )


def _check_unique(key: str, names: Iterable[str]) -> None:
    for name, count in Counter(names).items():
        if count > 1:
            raise ValueError(f'{key}: {name!r} is listed twice; names must be unique')
