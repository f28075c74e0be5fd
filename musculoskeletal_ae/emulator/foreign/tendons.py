# SPDX-License-Identifier: Apache-2.0
"""One step of the tendons, rubber elements and spools of emulator model `foreign`, by numba.

    element    x = g(T_end) (1 − h s_x / 2),  |s_x| ≤ 1
    slow       x = f(θ) − l − slack − Σ e_i,   τ_i ė_i = c_i − e_i
    guides     T = T_end exp(μ φ(θ) s (1 + p))
    load cell  (1 + a) T + b + non-linearity + drift · (temperature − 25 °C)
    spool      l (1 + gain) + share of the second layer + eccentricity · sin(l / radius)
    give       route points yield to their own load, with a low-pass filter

The element of each muscle has its own law g, by which the elongation x follows from the bone-side
tension T_end, and a hysteresis loop of the width h with the state s_x. x is the relative route
length f(θ) minus the motor-side length l, the slack, and slow elongations e_i. These are creep and
the delayed stretch of the tendon; each approaches c_i with the time constant τ_i. The motor-side
tension T follows from tendon friction μ per radian, the bend φ of the tendon, the direction s of
sliding, and stiction p. The load cell and the spool have errors as sensors of T and l.
"""

import math
from collections import namedtuple

import numpy as np
from numba import njit

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.emulator import modules
from musculoskeletal_ae.emulator.foreign.effects import Draw
from musculoskeletal_ae.emulator.modules import AMBIENT, STEP, Command, MuscleState
from musculoskeletal_ae.handle import Handle
from musculoskeletal_ae.robot.robot import Robot

# Modelling constants, chosen by hand. The magnitudes of the effects are in `effects.py`.
SLIDING = 0.0003  # let tendon friction build up over this sliding distance [m]
#: let the increased friction at the start of a motion (stiction) end over this sliding distance [m]
BREAKING = 0.0005
STICKING = 0.5  # let stiction build up at rest with this time constant [s]
#: let rubber change from one side of its hysteresis loop to the other over this elongation [m]
LOOP = 0.003
RIDGE = 5.0  # let this percentage of a route's lengths lie beyond the ridge [%]
BACK = 0.003  # let the tendon slip back this far before the ridge [m]
GUIDES = 1.0  # assume this bend of the tendon between its motor and its first route point [rad]
SPOOL = 0.01  # assume this radius of a spool [m]
#: let slow elongations build up with these time constants [s]: four of creep, equally large in each
#: of four decades of time, and two of the delayed stretch of a tendon
TIMES = np.array([1.0, 10.0, 100.0, 1000.0, 800.0, 14400.0])
#: give the last two time constants these shares of the delayed stretch
LATE = np.array([0.75, 0.25])
KNOTS = 200  # tabulate an elastic law with this many entries
GIVING = 0.1  # let a route point yield to its load with this time constant [s]


class Springs:
    """Laws of M series elastic elements with their tendons: tables of elongation over tension."""

    def __init__(self, robot: Robot, at_zero: Array, draw: Draw) -> None:
        """Draw the laws, which deviate from the series elastic elements of the robot description.

        Args:
            robot: The robot, with the data sheets of the elastic elements.
            at_zero: Tendon lengths at θ = 0 [m], (M,).
            draw: The random draws of the individual.
        """
        sheet, limit, count = robot.series_elastic, robot.tension.limit, robot.muscle_count
        self.tension: Array = np.linspace(0.0, 1.5, KNOTS)[:, None] * robot.tension.max
        share = self.tension / limit
        full = np.log1p(limit / sheet.force) / sheet.rate  # the elongation at T_limit
        cubic = np.linspace(0.0, 4.0, 4000)
        laws = np.array(
            [
                np.log1p(self.tension / sheet.force) / sheet.rate,  # data sheet
                full * share,  # linear
                full * np.interp(share, [0.0, 0.35, 4.0], [0.0, 0.65, 2.6]),  # bilinear
                full * np.interp(share, 0.3 * cubic + 0.7 * cubic**3, cubic),
                full * (0.8 * np.log1p(8.0 * share) / math.log(9.0) + 0.2 * share),  # worn out
            ]
        )
        rng = draw.rng('laws')
        # One muscle is linear and one worn out; the others are bilinear or cubic.
        law = rng.permutation(np.r_[1, 4, rng.choice([2, 3], max(count, 2) - 2)])[:count]
        law[rng.uniform(size=count) >= draw.sizes.laws] = 0
        stiffness = 1.0 + draw.sizes.stiffness * rng.uniform(-1.0, 1.0, count)
        element = laws[law, :, np.arange(count)].T / stiffness
        stretch = sheet.wire_stretch * at_zero  # immediate and delayed stretch of each tendon [m/N]
        #: delayed stretch of the tendons [m/N], (M,)
        self.late: Array = stretch * draw.about('recovery', count)
        #: immediate elongation of elements and tendons [m], (K, M)
        self.table: Array = element + (stretch - self.late) * self.tension
        #: the inverse table at even elongations: tensions [N] (M, K), and their spacing [m] (M,)
        even = np.linspace(0.0, 1.0, KNOTS)[:, None] * self.table[-1]
        columns = zip(even.T, self.table.T, self.tension.T)
        self.inverse: Array = np.array([np.interp(*column) for column in columns])
        self.spacing: Array = even[1]

    def elongation(self, tension: Array) -> Array:
        """Return the elongations [m], (..., M), at tensions [N], (..., M).

        Hysteresis, creep and delayed stretch are not included.
        """
        return self._read(self.table, tension)

    def compliance(self, _absolute: Array, tension: Array) -> Array:
        """Return the derivatives of the elongations [m/N], (..., M), at tensions [N], (..., M)."""
        slopes = [np.gradient(x, t) for x, t in zip(self.table.T, self.tension.T)]
        return self._read(np.transpose(slopes), tension)

    def _read(self, table: Array, tension: Array) -> Array:
        columns = enumerate(zip(self.tension.T, table.T))
        return np.stack([np.interp(tension[..., m], *column) for m, column in columns], axis=-1)


#: Constants of M tendons. The names that are not listed here are those of `Effects`.
#:     length_at_zero  l_abs(0) [m], (M,)
#:     table, spacing  inverse table of `Springs` [N] (M, K), and its spacing [m] (M,)
#:     late            delayed stretch [m/N], (M,)
#:     friction        friction per radian of bend, (M,)
#:     full_scale      of the load cell [N], (M,)
#:     layer_start     l at which the second layer on the spool begins [m], (M,)
#:     phase           of the spool's eccentricity [rad], (M,)
#:     ridge, side     l_abs at the ridge [m], and the side of it (±1) on which slip_over acts, (M,)
Tendons = namedtuple(
    'Tendons',
    'length_at_zero table spacing late friction full_scale layer_start phase ridge side '
    'hysteresis creep stiction tension_gain tension_zero tension_bend tension_drift spool_gain '
    'spool_layer eccentricity slip_over',
)
#: State of the tendons in addition to `MuscleState`.
#:     elongation      x [m], (M,)
#:     loop            side of the hysteresis loop, s_x, (M,)
#:     slow            slow elongations e_i [m], (M, 6)
#:     rest            share of stiction, p, (M,)
#:     bend            φ [rad], (M,)
#:     longer          lengthening with age [m], (M,)
#:     over            1 beyond the ridge, (M,)
#:     reading, cell   readings of l [m] and T [N] by the module's sensors, (M,)
Memory = namedtuple('Memory', 'elongation loop slow rest bend longer over reading cell')
#: Paths of the tendons, as arrays of MuJoCo.
#:     tendon          MuJoCo tendon of each muscle, (M,)
#:     point           points of all paths [m], (P, 3)
#:     kind            −1 for a site, otherwise the geom that the tendon wraps around, (P,)
#:     start, count    first point and number of points of each tendon
#:     site            sites of the muscles, in order
#:     body            body of each site, (S,)
#:     turn            rotation of each body, (B, 9)
#:     place           position of each site in its body [m], (S, 3); `guides_step` changes it
#:     rest            the same without load [m], (S, 3)
#:     give            displacement of each site under its load [m/N], (S,)
Guides = namedtuple('Guides', 'tendon point kind start count site body turn place rest give')


def make_tendons(
    robot: Robot, springs: Springs, at_zero: Array, span: Array, bend: Array, draw: Draw
) -> Tendons:
    """Make the tendons' constants from random draws.

    Args:
        robot: The robot, with the tension limits of its muscles.
        springs: The laws of the series elastic elements.
        at_zero: Lengths of the routes at θ = 0 [m], (M,).
        span: Lengths of the routes in N postures, relative to those at θ = 0 [m], (N, M).
        bend: Bends of the tendons at mid-range [rad], (M,).
        draw: Random draws of the individual.
    """
    count, full, rng = robot.muscle_count, robot.tension.max, draw.rng('spool')
    positive = 'hysteresis', 'creep', 'stiction', 'spool_layer', 'eccentricity'
    signed = 'tension_bend', 'tension_drift', 'spool_gain', 'slip_over'
    drawn = {name: draw.about(name, count) for name in positive}
    drawn |= {name: draw.about(name, count, signed=True) for name in signed}
    drawn |= {name: draw.normal(name, count) for name in ('tension_gain', 'tension_zero')}
    friction = draw.about('guide_friction', count) / (GUIDES + bend)
    start, phase = rng.uniform(-0.1, 0.1, count), rng.uniform(0.0, 2.0 * np.pi, count)
    side = rng.choice([-1.0, 1.0], count)
    ridge = at_zero + side * np.percentile(side * span, 100.0 - RIDGE, axis=0)
    table = springs.inverse, springs.spacing, springs.late
    return Tendons(at_zero, *table, friction, full, start, phase, ridge, side, **drawn)


@njit(cache=True)
def law(tendons: Tendons, m: int, elongation: float) -> float:
    """Return the tension [N] of the elastic element of muscle m at an elongation [m].

    The tension is 0 if the elongation is negative, and is extrapolated beyond the element's table.
    """
    if elongation <= 0.0:
        return 0.0
    at, table = min(elongation / tendons.spacing[m], 10.0 * KNOTS), tendons.table[m]
    k = min(int(at), table.shape[0] - 2)
    return table[k] + (at - k) * (table[k + 1] - table[k])


@njit(cache=True)
def spooled(tendons: Tendons, m: int, length: float) -> float:
    """Return what the length sensor of muscle m reads [m], apart from its offset and drift.

    `length` is the true motor-side length [m].
    """
    turned, phase = length / SPOOL, tendons.phase[m]
    wider = min(0.0, length - tendons.layer_start[m]) - min(0.0, -tendons.layer_start[m])
    off = tendons.spool_gain[m] * length + tendons.spool_layer[m] * wider
    return length + off + tendons.eccentricity[m] * (math.sin(turned + phase) - math.sin(phase))


@njit(cache=True)
def load_cell(tendons: Tendons, m: int, tension: float, temperature: float) -> float:
    """Return what the tension sensor of muscle m reads [N].

    `tension` is the true motor-side tension [N], `temperature` that of the module's housing [°C].
    """
    full = tendons.full_scale[m]
    share = min(1.0, tension / full)
    off = tendons.tension_zero[m] + tendons.tension_drift[m] * (temperature - AMBIENT)
    bend = tendons.tension_bend[m] * full * 4.0 * share * (1.0 - share)
    return (1.0 + tendons.tension_gain[m]) * tension + off + bend


@njit(cache=True)
def read(tendons: Tendons, muscle: MuscleState, memory: Memory, command: Command, m: int) -> None:
    """Read the sensors of module m into `memory`."""
    memory.reading[m] = spooled(tendons, m, muscle.length[m])
    memory.reading[m] += command.length_error[m] + command.zero[m]
    memory.cell[m] = load_cell(tendons, m, muscle.tension[m], muscle.housing[m])


#: Everything that `tendons_step` reads and writes.
TendonParts = namedtuple('TendonParts', 'tendons constants muscle memory command')
#: Everything that `guides_step` reads and writes: the guides, and tensions at the route points [N]
#: and bends [rad], each (M,).
GuideParts = namedtuple('GuideParts', 'guides tension bend')


@njit(cache=True)
def make_handle(parts: TendonParts | GuideParts) -> Handle:
    """Make the handle through which `tendons_step` or `guides_step` gets `parts`, uncopied."""
    return Handle(parts)


@njit(cache=True)
def tendons_step(arm: Handle, kind: int, absolute: Array, control: Array) -> None:
    """Advance muscle modules and tendons by one step of 1 ms.

    Args:
        arm: Handle to the TendonParts, which are changed in place.
        kind: Mode of the modules: SAFE, FOLLOW_LENGTH or FOLLOW_TENSION.
        absolute: Lengths of the routes [m], (M,).
        control: Receives the bone-side tensions with a negative sign [N], (M,), as MuJoCo expects
            them of motors that pull.
    """
    tendons, constants, muscle, memory, command = arm.held
    for m in range(absolute.shape[0]):
        read(tendons, muscle, memory, command, m)
        slid = modules.wind(constants, muscle, kind, command, m, memory.reading[m], memory.cell[m])
        muscle.sliding[m] = modules.friction_state(muscle.sliding[m], slid, SLIDING)
        rest = memory.rest[m] + STEP / STICKING * (1.0 - memory.rest[m])
        memory.rest[m] = rest * math.exp(-abs(slid) / BREAKING)
        beyond = tendons.side[m] * (absolute[m] - tendons.ridge[m])
        memory.over[m] = 1.0 if beyond > 0.0 else memory.over[m] * (beyond > -BACK)
        slack = command.slack[m] + memory.longer[m] + memory.slow[m].sum()
        slack += tendons.slip_over[m] * memory.over[m]
        x = absolute[m] - tendons.length_at_zero[m] - muscle.length[m] - slack
        grown = x - memory.elongation[m]
        memory.elongation[m] = x
        memory.loop[m] = modules.friction_state(memory.loop[m], grown, LOOP)
        end = law(tendons, m, x / (1.0 - 0.5 * tendons.hysteresis[m] * memory.loop[m]))
        if muscle.ruptured[m] > 0.0:
            end = 0.0
        grip = tendons.friction[m] * (GUIDES + memory.bend[m]) * muscle.sliding[m]
        muscle.end_tension[m] = end
        muscle.tension[m] = end * math.exp(grip * (1.0 + tendons.stiction[m] * memory.rest[m]))
        for i in range(TIMES.shape[0]):
            full = tendons.creep[m] * max(0.0, x) if i < 4 else LATE[i - 4] * tendons.late[m] * end
            memory.slow[m, i] += STEP / TIMES[i] * (full - memory.slow[m, i])
        modules.heat(constants, muscle, command, m)
        control[m] = -end


@njit(cache=True)
def guides_step(arm: Handle, duration: float) -> None:
    """Compute the angles by which tendons bend at their route points, and how far the points yield.

    Args:
        arm: Handle to the GuideParts, which are changed in place.
        duration: Time since the last call [s].
    """
    guides, tension, bend = arm.held
    line, load, i = np.zeros(3), np.zeros(3), 0
    for m in range(tension.shape[0]):
        bend[m] = 0.0
        first = guides.start[guides.tendon[m]]
        last = first + guides.count[guides.tendon[m]] - 1
        for p in range(first, last + 1):
            load[:] = 0.0
            both = True
            for other in (max(p - 1, first), min(p + 1, last)):  # the point itself at an end
                for r in range(3):
                    line[r] = guides.point[other, r] - guides.point[p, r]
                size = math.sqrt(line[0] ** 2 + line[1] ** 2 + line[2] ** 2)
                both &= size > 0.0
                if size > 0.0:
                    load += line / size
            if both:
                # The sum of two unit vectors at an angle of π − φ has the length 2 sin(φ / 2).
                size = math.sqrt(load[0] ** 2 + load[1] ** 2 + load[2] ** 2)
                bend[m] += 2.0 * math.asin(min(1.0, 0.5 * size))
            if guides.kind[p] == -1:
                s = guides.site[i]
                i += 1
                turn = guides.turn[guides.body[s]]
                for r in range(3):
                    along = turn[r] * load[0] + turn[3 + r] * load[1] + turn[6 + r] * load[2]
                    goal = guides.rest[s, r] + guides.give[s] * tension[m] * along
                    guides.place[s, r] += duration / GIVING * (goal - guides.place[s, r])
