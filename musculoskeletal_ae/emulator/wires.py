# SPDX-License-Identifier: Apache-2.0
"""One millisecond of the second body's wires, rubber units and spools, compiled by numba.

rubber     x = g(T_end) (1 − h s_x / 2),  |s_x| ≤ 1       each muscle has its own law g
slow       x = f(θ) − l − slack − Σ e_i,   τ_i ė_i = c_i − e_i        creep, late stretch
guides     T = T_end exp(μ φ(θ) s (1 + p))     φ: by how much the wire is bent; p: stiction
load cell  (1 + a) T + b + bend + drift · (temperature − 25 °C)
spool      l (1 + gain) + the second layer's share + eccentricity · sin(l / radius)
give       a route point moves by its own load, low-passed
"""

import math
from collections import namedtuple

import numpy as np
from numba import njit

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.emulator import modules
from musculoskeletal_ae.emulator.effects import Draw
from musculoskeletal_ae.emulator.modules import AMBIENT, STEP, Command, MuscleState
from musculoskeletal_ae.handle import Handle
from musculoskeletal_ae.robot.robot import Robot

# Chosen, where effects.py has no size.
SLIDING = 0.0003  # [m] of sliding over which friction builds up
BREAKING = 0.0005  # [m] of sliding that ends stiction …
STICKING = 0.5  # [s] … and how long at rest it takes to come back
LOOP = 0.003  # [m] of elongation over which rubber changes from one side of its loop to the other
RIDGE, BACK = 5.0, 0.003  # [%] of the route's lengths beyond the ridge; [m] until it slips back
GUIDES = 1.0  # [rad] by which the wire is bent between its motor and its first route point
SPOOL = 0.01  # [m] radius
# Creep at an even rate over four decades of time; a wire's late stretch [s].
TIMES = np.array([1.0, 10.0, 100.0, 1000.0, 800.0, 14400.0])
LATE = np.array([0.75, 0.25])  # share of each of the last two
KNOTS = 200  # of the table of a law
GIVING = 0.1  # [s] in which a route point follows its load


class Springs:
    """Laws of M elastic units with their wires: elongation as a table over tension, from 0 on."""

    def __init__(self, robot: Robot, at_zero: Array, draw: Draw) -> None:
        """Draw the laws of wires of a length at θ = 0 [m], (M,); the robot is the data sheet."""
        sheet, limit, count = robot.series_elastic, robot.tension.limit, robot.muscle_count
        self.tension: Array = np.linspace(0.0, 1.5, KNOTS)[:, None] * robot.tension.max
        share = self.tension / limit
        full = np.log1p(limit / sheet.force) / sheet.rate  # the elongation at T_limit
        cubic = np.linspace(0.0, 4.0, 4000)
        laws = np.array(
            [
                np.log1p(self.tension / sheet.force) / sheet.rate,  # as the data sheet has it
                full * share,  # linear
                full * np.interp(share, [0.0, 0.35, 4.0], [0.0, 0.65, 2.6]),  # bilinear
                full * np.interp(share, 0.3 * cubic + 0.7 * cubic**3, cubic),
                full * (0.8 * np.log1p(8.0 * share) / math.log(9.0) + 0.2 * share),  # worn out
            ]
        )
        rng = draw.rng('laws')
        # One is linear and one worn, the rest bilinear or cubic.
        law = rng.permutation(np.r_[1, 4, rng.choice([2, 3], max(count, 2) - 2)])[:count]
        law[rng.uniform(size=count) >= draw.sizes.laws] = 0
        stiffness = 1.0 + draw.sizes.stiffness * rng.uniform(-1.0, 1.0, count)
        unit = laws[law, :, np.arange(count)].T / stiffness
        #: stretch of the whole wire, at once and late [m/N], (M,)
        stretch = sheet.wire_stretch * at_zero
        self.late: Array = stretch * draw.about('recovery', count)
        self.table: Array = unit + (stretch - self.late) * self.tension
        #: the other way round, evenly spaced in elongation: tensions (M, K), spacing (M,)
        even = np.linspace(0.0, 1.0, KNOTS)[:, None] * self.table[-1]
        columns = zip(even.T, self.table.T, self.tension.T)
        self.pull: Array = np.array([np.interp(*column) for column in columns])
        self.spacing: Array = even[1]

    def elongation(self, tension: Array) -> Array:
        """Return the elongation [m] in the middle of the loop, at once; T [N] (..., M)."""
        return self._read(self.table, tension)

    def compliance(self, _absolute: Array, tension: Array) -> Array:
        """Return ∂x/∂T [m/N], (..., M)."""
        slopes = [np.gradient(x, t) for x, t in zip(self.table.T, self.tension.T)]
        return self._read(np.transpose(slopes), tension)

    def _read(self, table: Array, tension: Array) -> Array:
        columns = enumerate(zip(self.tension.T, table.T))
        return np.stack([np.interp(tension[..., m], *column) for m, column in columns], axis=-1)


#: Constants of M wires, each (M,): l_abs(0) [m], table of `Springs` (M, K) and its spacing [m],
#: late stretch [m/N], friction per radian, full scale of the load cell [N], l where a second
#: layer begins [m], phase of the spool's eccentricity, l_abs at the ridge [m] and on which side
#: of it the wire is caught; the rest as in `Effects`.
Wires = namedtuple(
    'Wires',
    'length_at_zero pull spacing late friction full_scale layer_start phase ridge side '
    'hysteresis creep stiction tension_gain tension_zero tension_bend tension_drift spool_gain '
    'spool_layer eccentricity slip_over',
)
#: What wires remember beside `MuscleState`, each (M,): elongation x [m], side of the loop s_x, slow
#: elongations e_i [m] (M, 6), share of stiction p, bend φ [rad], by how much they grew longer [m],
#: 1 beyond the ridge, and what the module's sensors read of l [m] and T [N].
Memory = namedtuple('Memory', 'elongation loop slow rest bend longer over reading cell')
#: Where wires run, MuJoCo's arrays: tendon of each muscle (M,); points of all paths (P, 3) [m], −1
#: for a site or the geom that they wrap (P,), first point and number of points of each tendon; the
#: sites of the muscles in order; of all sites (S,) the body, its turn (B, 9), the place in it,
#: which is changed, the place without load (S, 3) [m], and how far they give [m/N].
Guides = namedtuple('Guides', 'tendon point kind start count site body turn place rest give')


def make_wires(
    robot: Robot, springs: Springs, at_zero: Array, span: Array, bend: Array, draw: Draw
) -> Wires:
    """Draw the constants of wires of a length at θ = 0 [m] (M,), bent at mid-range [rad] (M,).

    `span` is how much longer their routes are in N postures [m], (N, M).
    """
    count, full, rng = robot.muscle_count, robot.tension.max, draw.rng('spool')
    about = 'hysteresis', 'creep', 'stiction', 'spool_layer', 'eccentricity'
    either = 'tension_bend', 'tension_drift', 'spool_gain', 'slip_over'
    drawn = {name: draw.about(name, count) for name in about}
    drawn |= {name: draw.about(name, count, signed=True) for name in either}
    drawn |= {name: draw.normal(name, count) for name in ('tension_gain', 'tension_zero')}
    friction = draw.about('guide_friction', count) / (GUIDES + bend)
    start, phase = rng.uniform(-0.1, 0.1, count), rng.uniform(0.0, 2.0 * np.pi, count)
    side = rng.choice([-1.0, 1.0], count)
    ridge = at_zero + side * np.percentile(side * span, 100.0 - RIDGE, axis=0)
    table = springs.pull, springs.spacing, springs.late
    return Wires(at_zero, *table, friction, full, start, phase, ridge, side, **drawn)


@njit(cache=True)
def law(wires: Wires, m: int, elongation: float) -> float:
    """Return T [N] of unit m at an elongation [m] within the table, or the line beyond its end."""
    if elongation <= 0.0:
        return 0.0
    at, table = min(elongation / wires.spacing[m], 10.0 * KNOTS), wires.pull[m]
    k = min(int(at), table.shape[0] - 2)
    return table[k] + (at - k) * (table[k + 1] - table[k])


@njit(cache=True)
def spooled(wires: Wires, m: int, length: float) -> float:
    """Return what the length sensor makes of l [m], its errors of time and zero apart."""
    turned, phase = length / SPOOL, wires.phase[m]
    wider = min(0.0, length - wires.layer_start[m]) - min(0.0, -wires.layer_start[m])
    off = wires.spool_gain[m] * length + wires.spool_layer[m] * wider
    return length + off + wires.eccentricity[m] * (math.sin(turned + phase) - math.sin(phase))


@njit(cache=True)
def load_cell(wires: Wires, m: int, tension: float, temperature: float) -> float:
    """Return what the tension sensor makes of T [N]."""
    full = wires.full_scale[m]
    share = min(1.0, tension / full)
    off = wires.tension_zero[m] + wires.tension_drift[m] * (temperature - AMBIENT)
    bend = wires.tension_bend[m] * full * 4.0 * share * (1.0 - share)
    return (1.0 + wires.tension_gain[m]) * tension + off + bend


@njit(cache=True)
def read(wires: Wires, muscle: MuscleState, memory: Memory, command: Command, m: int) -> None:
    """Let the sensors of module m read."""
    memory.reading[m] = spooled(wires, m, muscle.length[m])
    memory.reading[m] += command.length_error[m] + command.zero[m]
    memory.cell[m] = load_cell(wires, m, muscle.tension[m], muscle.housing[m])


#: All that a step of the wires reads and writes, and one of the guides: tensions at the route
#: points [N] and bends [rad], (M,).
WireParts = namedtuple('WireParts', 'wires constants muscle memory command')
GuideParts = namedtuple('GuideParts', 'guides tension bend')


@njit(cache=True)
def handed(parts: WireParts | GuideParts) -> Handle:
    """Return what a step takes."""
    return Handle(parts)


@njit(cache=True)
def wires_step(arm: Handle, kind: int, absolute: Array, control: Array) -> None:
    """Move the motors by one STEP and leave what the wires pull in `control` [N] (M,), negative.

    The arm is WireParts, `absolute` the lengths of the routes [m], (M,).
    """
    wires, constants, muscle, memory, command = arm.held
    for m in range(absolute.shape[0]):
        read(wires, muscle, memory, command, m)
        slid = modules.wind(constants, muscle, kind, command, m, memory.reading[m], memory.cell[m])
        muscle.sliding[m] = modules.rubbed(muscle.sliding[m], slid, SLIDING)
        rest = memory.rest[m] + STEP / STICKING * (1.0 - memory.rest[m])
        memory.rest[m] = rest * math.exp(-abs(slid) / BREAKING)
        beyond = wires.side[m] * (absolute[m] - wires.ridge[m])
        memory.over[m] = 1.0 if beyond > 0.0 else memory.over[m] * (beyond > -BACK)
        slack = command.slack[m] + memory.longer[m] + memory.slow[m].sum()
        slack += wires.slip_over[m] * memory.over[m]
        x = absolute[m] - wires.length_at_zero[m] - muscle.length[m] - slack
        grown = x - memory.elongation[m]
        memory.elongation[m] = x
        memory.loop[m] = modules.rubbed(memory.loop[m], grown, LOOP)
        end = law(wires, m, x / (1.0 - 0.5 * wires.hysteresis[m] * memory.loop[m]))
        if muscle.ruptured[m] > 0.0:
            end = 0.0
        grip = wires.friction[m] * (GUIDES + memory.bend[m]) * muscle.sliding[m]
        muscle.end_tension[m] = end
        muscle.tension[m] = end * math.exp(grip * (1.0 + wires.stiction[m] * memory.rest[m]))
        for i in range(TIMES.shape[0]):
            full = wires.creep[m] * max(0.0, x) if i < 4 else LATE[i - 4] * wires.late[m] * end
            memory.slow[m, i] += STEP / TIMES[i] * (full - memory.slow[m, i])
        modules.heat(constants, muscle, command, m)
        control[m] = -end


@njit(cache=True)
def guides_step(arm: Handle, duration: float) -> None:
    """Find by how much the wires of GuideParts are bent; let points give for a while [s]."""
    guides, tension, bend = arm.held
    line, load, i = np.zeros(3), np.zeros(3), 0
    for m in range(tension.shape[0]):
        bend[m] = 0.0
        first = guides.start[guides.tendon[m]]
        last = first + guides.count[guides.tendon[m]] - 1
        for p in range(first, last + 1):
            load[:] = 0.0
            both = True
            for other in (max(p - 1, first), min(p + 1, last)):  # beyond an end: the same point
                for r in range(3):
                    line[r] = guides.point[other, r] - guides.point[p, r]
                size = math.sqrt(line[0] ** 2 + line[1] ** 2 + line[2] ** 2)
                both &= size > 0.0
                if size > 0.0:
                    load += line / size
            if both:
                # Two unit vectors that make the angle π − φ add up to one of length 2 sin(φ / 2).
                size = math.sqrt(load[0] ** 2 + load[1] ** 2 + load[2] ** 2)
                bend[m] += 2.0 * math.asin(min(1.0, 0.5 * size))
            if guides.kind[p] == -1:
                s = guides.site[i]
                i += 1
                turn = guides.turn[guides.body[s]]
                for r in range(3):
                    pull = turn[r] * load[0] + turn[3 + r] * load[1] + turn[6 + r] * load[2]
                    goal = guides.rest[s, r] + guides.give[s] * tension[m] * pull
                    guides.place[s, r] += duration / GIVING * (goal - guides.place[s, r])
