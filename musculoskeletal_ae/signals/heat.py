# SPDX-License-Identifier: Apache-2.0
"""How hot the windings are, and what each muscle may pull for how long.

A motor that warms its housing, which the surroundings cool (arXiv 2407.08055):

    C₁ ċ₁ = k T² − (c₁ − c₂)/R₁,   C₂ ċ₂ = (c₁ − c₂)/R₁ − (c₂ − c_a)/R₂

The housing's temperature c₂ is measured, the winding's c₁ is not. While the arm moves, an extended
Kalman filter learns c₁ − c₂, c₂, the logarithms of κ = k/C₂, τ₁ = R₁C₁ and τ₂ = R₂C₂, and c_a, each
a random walk; r = R₁/R₂ cannot be learned (doc/explanation/control_and_safety.md).

The highest tension of a muscle is the one that, held for a time from now on, brings its winding to
the highest temperature. A constant that leaves what it was, once that was known, says that the
module has changed: its motor drags, its housing is covered, or its tension sensor is wrong.
"""

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools
from musculoskeletal_ae.robot.robot import Robot

HELD, MOMENT = 60.0, 5.0  # [s] ahead: of what is planned, and of what is never exceeded
EVERY, LONGEST = 1.0, 10.0  # [s] between two updates, and at most that one takes in
JUMP = 5.0  # [°C] that no housing changes by in such a time: a sensor, or heat from elsewhere
NOISE = 0.1  # [°C] of c₂'s mean over EVERY
RATIO = 0.4  # r; chosen: of small motors, with much spread
# To begin with: a housing 80 °C above the air if T_limit is held for good; all chosen.
RISE, WINDING_TIME, HOUSING_TIME, AIR = 80.0, 30.0, 800.0, 25.0
#: standard deviations of c₁ − c₂, c₂ [°C], log κ, log τ₁, log τ₂, c_a [°C]: to begin with, and of
#: what a second brings
SPREAD = np.array([5.0, 0.2, 0.7, 0.5, 0.5, 5.0])
WALK = np.array([0.1, 0.02, 0.003, 0.002, 0.002, 0.02])
FAR = 2.5  # [log] that no constant goes from where it began
SLOPE = 1e-4  # of numerical derivatives
# A constant that changed: by what factor since it was known, and how well it must be [log].
LEARNED, CHANGED, KNOWN = 1200.0, 1.5, 0.2  # [s]


def flow(state: Array, square: Array, dt: float) -> Array:
    """Return states (6, ...) after dt [s] of a tension of so large a square [N²] (...)."""
    inner, outer, *logs, air = state
    kappa, winding, housing = np.exp(logs)
    share = winding / (housing * RATIO)  # C₁/C₂
    cooling, tau = (outer - air) / housing, winding / (1.0 + share)
    settled = tau * (kappa * square / share + cooling)
    gone = -np.expm1(-dt / tau)
    mean = settled * dt + (inner - settled) * tau * gone
    after = outer + share / winding * mean - cooling * dt
    return np.stack([inner + (settled - inner) * gone, after, *logs, air])


class Heat:
    """Learns every module's constants, and says what its muscle may pull."""

    def __init__(self, robot: Robot) -> None:
        self._tension, count = robot.tension, robot.muscle_count
        begin = np.array([0.0, AIR, 0.0, *np.log([WINDING_TIME, HOUSING_TIME]), AIR])
        self._state: Array = np.tile(begin[:, None], count)
        self._state[2] = np.log(RISE / HOUSING_TIME / self._tension.limit**2)
        self._begin = self._state[2:5].copy()
        self._covariance: Array = np.tile(np.diag(SPREAD**2), (count, 1, 1))
        self._known = np.zeros(count, dtype=bool)  # whether there is a temperature of the housing
        self._spoilt = np.zeros(count, dtype=bool)  # it came, went or jumped since the last update
        self._age: Array = np.zeros(count)  # [s] of learning
        self._reference: Array = np.full((2, count), np.nan)  # log κ, log τ₂ as first known
        self._sums: Array = np.zeros((2, count))
        self._passed, self._messages = 0.0, 0
        #: by the highest temperature, as long as nothing else is known
        self._limits: dict[float, tuple[Array, Array]] = {}
        #: muscles whose constants are not what they were when they were first known, and how
        self.changed: dict[int, str] = {}

    @property
    def core(self) -> Array:
        """Estimated temperatures of the windings [°C] (M,); NaN where the housing's is unknown."""
        return np.where(self._known, self._state[0] + self._state[1], np.nan)

    def accept(self, *muscles: int) -> None:
        """Take the modules of muscles that have changed as they are now."""
        for m in self.changed.keys() & muscles:
            self._reference[:, m] = self._state[[2, 4], m]
            del self.changed[m]

    def limits(self, highest: float) -> tuple[Array, Array]:
        """Return the tensions [N] (M,) that bring no winding above so many °C within HELD, MOMENT.

        Between T_bias and tension.max; an unknown temperature limits nothing.
        """
        if highest in self._limits:
            return self._limits[highest]
        found = []
        for free, warming in self._look_ahead():
            square = np.where(self._state[1] < highest, (highest - free) / warming, 0.0)
            most = np.sqrt(np.maximum(square, 0.0))
            most = np.where(self._known, most, np.inf)
            found.append(np.clip(most, self._tension.bias, self._tension.max))
        self._limits = {highest: (found[0], found[1])}
        return self._limits[highest]

    def step(self, tension: Array, housing: Array, dt: float) -> None:
        """Take T [N] and temperatures of the housings [°C] (M,), dt [s] after the last ones.

        What is not finite is not known.
        """
        known = np.isfinite(housing)
        if dt > LONGEST:
            self._miss(housing, known, dt)
        measured = self._state[1]
        changed = known & (np.abs(housing - measured) > JUMP) | (known != self._known)
        if np.count_nonzero(changed):
            self._state[1] = np.where(known & changed, housing, measured)
            self._spoilt |= changed
            self._limits, self._known = {}, known
        self._sums[0] += tension * tension
        self._sums[1] += housing  # where one is unknown, the sum tells nothing either
        self._messages, self._passed = self._messages + 1, self._passed + dt
        if self._passed < EVERY:
            return
        square, mean = self._sums / self._messages
        # One thermometer that fails tells nothing; windings warm all the same, and others tell.
        self._update(square, mean, known & ~self._spoilt, min(self._passed, LONGEST))
        self._limits, self._spoilt[:] = {}, False
        self._sums[:], self._passed, self._messages = 0.0, 0.0, 0

    def _miss(self, housing: Array, known: Bools, dt: float) -> None:
        """Go on after dt [s] of which nothing is known: it says nothing of constants."""
        self._state[0] *= np.exp(-dt / np.exp(self._state[3]))
        self._state[1] = np.where(known, housing, self._state[1])
        self._spoilt |= known
        self._covariance[:, :2] = self._covariance[:, :, :2] = 0.0
        self._covariance[:, [0, 1], [0, 1]] = SPREAD[:2] ** 2

    def _update(self, square: Array, housing: Array, told: Bools, dt: float) -> None:
        before, covariance = self._state, self._covariance
        after = flow(before, square, dt)
        moved = flow(before[:, None] + SLOPE * np.eye(6)[:, :, None], square, dt)
        slope = ((moved - after[:, None]) / SLOPE).transpose(2, 0, 1)
        covariance = slope @ covariance @ slope.transpose(0, 2, 1) + np.diag(WALK**2 * dt)
        gain = covariance[:, :, 1] / (covariance[:, 1, 1] + NOISE**2)[:, None]
        corrected = covariance - gain[:, :, None] * covariance[:, None, 1]
        after = after + np.where(told, gain.T * (housing - after[1]), 0.0)
        after[2:5] = np.clip(after[2:5], self._begin - FAR, self._begin + FAR)
        self._state = after
        self._covariance = np.where(told[:, None, None], corrected, self._covariance)
        self._age += np.where(told, dt, 0.0)
        logs, unsure = after[[2, 4]], self._covariance[:, [2, 4], [2, 4]].max(axis=1)
        first = (self._age > LEARNED) & (unsure < KNOWN**2) & np.isnan(self._reference[0])
        self._reference = np.where(first, logs, self._reference)
        factor = np.exp(logs - self._reference)
        says = 'warms {:.2g} times', 'keeps its heat {:.2g} times'
        self.changed = {
            int(m): f'{says[k].format(factor[k, m])} as much as it did'
            for k, m in np.argwhere(np.abs(np.log(factor)) > np.log(CHANGED))
        }

    def _look_ahead(self) -> list[tuple[Array, Array]]:
        """Return c₁ without tension [°C] and what T² adds [K/N²], (M,) each, HELD and MOMENT on."""
        pulled = np.array([0.0, 1.0])[:, None] * self._tension.limit**2
        state = np.repeat(self._state[:, None], 2, axis=1)
        ahead = list[tuple[Array, Array]]()
        for n in range(round(HELD / MOMENT)):
            state = flow(state, pulled, MOMENT)
            if n in (0, round(HELD / MOMENT) - 1):
                free, warm = state[0] + state[1]
                ahead.insert(0, (free, (warm - free) / self._tension.limit**2))
        return ahead
