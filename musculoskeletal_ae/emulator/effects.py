# SPDX-License-Identifier: Apache-2.0
"""What is wrong with the second body, and how much: every effect with its size, 0 to switch it off.

    Effects()                            as it is calibrated (`python -m bench second_body`)
    replace(Effects(), hysteresis=0.0)   one effect off; all else stays as it was drawn
    NONE                                 a body as its description or its file has it

An individual has between 3/4 and all of a size, or a normal deviation with that spread (σ). The
sources of the sizes are in doc/explanation/emulators.md.
"""

import zlib
from dataclasses import dataclass, fields

import numpy as np

from musculoskeletal_ae.arrays import Array


@dataclass(frozen=True)
class Effects:
    """Sizes of all effects."""

    # Mechanics of the body
    attachment: float = 0.0105  # σ of each coordinate of each route point [m]
    kinks: float = 0.01  # how much longer bones' heads and other muscles make a wire's way [m]
    slip_over: float = 0.0057  # jump of a wire that slips over a ridge, in 5 % of its postures [m]
    give: float = 5e-5  # how far a route point moves under its load [m/N]
    joint_friction: float = 0.02  # share of a joint's largest load by weight and muscles at T_bias
    links: float = 0.0  # in units of σ = 5 mm, 2° of axes, 15 % of masses, 20 mm of their centres
    # Elastic units of rubber
    stiffness: float = 0.4  # at most this share more or less than the data sheet's
    laws: float = 1.0  # share of the muscles with another law than the data sheet's
    hysteresis: float = 0.2  # width of the loop, share of the elongation
    creep: float = 0.05  # per decade of time, share of the elongation
    # Wires
    recovery: float = 0.45  # share of the stretch that comes late: most in 40 min, all in 12 h
    bedding: float = 0.005  # how much longer a wire gets in its first hours [m]
    knot: float = 0.0034  # slip of one knot, once [m]
    guide_friction: float = 0.4  # relative loss along the route in a posture at mid-range
    stiction: float = 0.34  # how much more at the start of a motion
    # Sensors
    tension_gain: float = 0.05  # σ
    tension_zero: float = 5.0  # σ [N]
    tension_bend: float = 0.02  # non-linearity, share of the full scale
    tension_drift: float = 0.2  # of the zero by heat [N/K]
    spool_gain: float = 0.05  # radius of the spool
    spool_layer: float = 0.1  # by how much the second layer of wire is wider
    eccentricity: float = 0.0008  # of the spool [m]
    spool_slip: float = 0.0011  # of the wire on its spool, once in five hours [m]
    length_drift: float = 0.001  # σ [m/h]
    joint_zero: float = np.radians(2.0)  # σ [rad]; times RACK [m] of what slides
    joint_bend: float = 0.01  # non-linearity, share of the joint's range
    backlash: float = np.radians(1.0)  # of the joint sensor's gear [rad], or times RACK [m]
    # Messages
    delay: float = 0.02  # of joint angles, and of lengths and tensions [s]
    jitter: float = 0.005  # range of the delay [s]
    dropouts: float = 0.001  # share of the messages of each module that do not come


NONE = Effects(**{field.name: 0.0 for field in fields(Effects)})


class Draw:
    """Draws of one individual: a name gives the same draws whatever else is switched off."""

    def __init__(self, seed: int, effects: Effects) -> None:
        self._seed, self.sizes = seed, effects

    def rng(self, name: str) -> np.random.Generator:
        """Return the random numbers of a name."""
        return np.random.default_rng([self._seed, zlib.crc32(name.encode())])

    def normal(self, name: str, shape: int | tuple[int, ...]) -> Array:
        """Return normal deviations with an effect's size as their σ."""
        return float(getattr(self.sizes, name)) * self.rng(name).normal(size=shape)

    def about(self, name: str, count: int, signed: bool = False) -> Array:
        """Return `count` values from 3/4 to all of an effect's size; signed: of either sign."""
        rng = self.rng(name)
        value: Array = getattr(self.sizes, name) * rng.uniform(0.75, 1.0, count)
        return value * rng.choice([-1.0, 1.0], count) if signed else value
