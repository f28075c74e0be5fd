# SPDX-License-Identifier: Apache-2.0
"""The effects of the emulator model `foreign` and their sizes; size 0 switches an effect off.

    Effects()                            calibrated sizes (notes/removed_benches.md, `second_body`)
    replace(Effects(), hysteresis=0.0)   one effect off; all other draws stay the same
    NONE                                 no effect: the body of the description or the MJCF file

The seed draws the effects of an individual. Most are drawn between 3/4 and all of their size. Sizes
that are marked σ are the standard deviation of a normal distribution. The relative deviation of an
element's stiffness is drawn between −1 and 1 times the size `stiffness`. The sizes `laws`,
`spool_slip`, `jitter` and `dropouts` hold for every individual. doc/explanation/emulators.md lists
the sources of the sizes.
"""

import zlib
from dataclasses import dataclass, fields

import numpy as np

from musculoskeletal_ae.arrays import Array


@dataclass(frozen=True)
class Effects:
    """Sizes of all effects of the emulator model `foreign`; 0 switches an effect off."""

    # Body
    attachment: float = 0.0105  # σ of each coordinate of each route point [m]
    kinks: float = 0.01  # detour of a tendon around the heads of bones and other muscles [m]
    #: jump of the length at a ridge, over which a tendon slips in 5 % of the postures [m]
    slip_over: float = 0.0057
    give: float = 5e-5  # displacement of a route point per newton of its load [m/N]
    #: friction of a joint, relative to its largest load by weight and muscles at T_bias
    joint_friction: float = 0.02
    #: factor of these σ: link lengths 5 mm, axes 2°, masses 15 %, centres of mass 20 mm
    links: float = 0.0
    springs: float = 0.25  # σ of the logarithm of the stiffness of each joint's spring
    #: σ of the rest angle of each spring [rad]
    spring_rest: float = 0.08
    # Series elastic elements, made of rubber
    stiffness: float = 0.4  # largest relative deviation from the data sheet
    laws: float = 1.0  # share of the muscles whose law differs from the data sheet
    hysteresis: float = 0.2  # width of the loop, relative to the elongation
    creep: float = 0.05  # creep per decade of time, relative to the elongation
    # Tendons
    #: share of the stretch that builds up with a delay: most of it within 40 min, all of it within
    #: 12 h
    recovery: float = 0.45
    bedding: float = 0.005  # lengthening of a tendon in its first hours [m]
    knot: float = 0.0034  # length by which a knot slips once, at a random time [m]
    guide_friction: float = 0.4  # relative tension loss along the route, joints at mid-range
    stiction: float = 0.34  # relative increase of friction at the start of a motion
    # Sensors
    tension_gain: float = 0.05  # σ of the relative error of a tension sensor's gain
    tension_zero: float = 5.0  # σ of the offset of a tension sensor [N]
    tension_bend: float = 0.02  # non-linearity of a tension sensor, relative to the full scale
    tension_drift: float = 0.2  # drift of a tension sensor's offset with temperature [N/K]
    spool_gain: float = 0.05  # relative error of the spool's radius
    spool_layer: float = 0.1  # relative increase of the radius by the second layer of tendon
    eccentricity: float = 0.0008  # eccentricity of the spool [m]
    spool_slip: float = 0.0011  # slip of a tendon on its spool, on average once in five hours [m]
    length_drift: float = 0.001  # σ of the drift of a length sensor's offset [m/h]
    joint_zero: float = np.radians(2.0)  # σ of the offset of a joint sensor [rad]
    joint_bend: float = 0.01  # non-linearity of a joint sensor, relative to the joint's range
    backlash: float = np.radians(1.0)  # backlash of the joint sensor [rad]
    # Messages
    delay: float = 0.02  # delay of joint angles, and of lengths and tensions [s]
    jitter: float = 0.005  # range over which the delay varies from one reading to the next [s]
    dropouts: float = 0.001  # share of each module's messages that are lost


NONE = Effects(**{field.name: 0.0 for field in fields(Effects)})


class Draw:
    """Random draws of one individual; each depends only on the seed and on the name of the draw."""

    def __init__(self, seed: int, effects: Effects) -> None:
        self._seed, self.sizes = seed, effects

    def rng(self, name: str) -> np.random.Generator:
        """Return a new random generator that depends on the seed and on `name`."""
        return np.random.default_rng([self._seed, zlib.crc32(name.encode())])

    def normal(self, name: str, shape: int | tuple[int, ...]) -> Array:
        """Return normally distributed values whose σ is the size of the effect `name`."""
        return float(getattr(self.sizes, name)) * self.rng(name).normal(size=shape)

    def about(self, name: str, count: int, signed: bool = False) -> Array:
        """Return `count` values between 3/4 and 1 times the size of the effect `name`.

        With `signed`, each value has a random sign.
        """
        rng = self.rng(name)
        value: Array = getattr(self.sizes, name) * rng.uniform(0.75, 1.0, count)
        return value * rng.choice([-1.0, 1.0], count) if signed else value
