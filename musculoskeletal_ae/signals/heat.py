# SPDX-License-Identifier: Apache-2.0
"""Winding temperatures of the muscle modules, and the tensions that these permit.

The motor's winding heats its housing, which the air cools (arXiv 2407.08055):

    C₁ ċ₁ = k T² − (c₁ − c₂)/R₁,   C₂ ċ₂ = (c₁ − c₂)/R₁ − (c₂ − c_a)/R₂

c₁, c₂ and c_a are the temperatures of winding, housing and air. C₁ and C₂ are the heat capacities
of winding and housing, R₁ and R₂ the thermal resistances from winding to housing and from housing
to air. Holding the tension T heats the winding with the power k T².

c₂ is measured, c₁ is not. While the arm operates, an extended Kalman filter estimates c₁ − c₂, c₂,
the logarithms of κ = k/C₂, τ₁ = R₁C₁ and τ₂ = R₂C₂, and c_a. Process noise lets the constants
change slowly. The ratio r = R₁/R₂ cannot be estimated (doc/explanation/control_and_safety.md).

The highest permitted tension of a muscle heats the winding just to the temperature limit if it is
held for HELD or MOMENT seconds. If κ or τ₂ departs from its first known value by the factor
CHANGED, the module has changed: its motor drags, its housing is covered, or its tension sensor is
faulty.
"""

import math

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools
from musculoskeletal_ae.robot.robot import Robot

HELD = 60.0  # plan no tension that overheats a winding when it is held for this time [s]
MOMENT = 5.0  # command no tension that overheats a winding when it is held for this time [s]
EVERY = 1.0  # compute the winding temperatures at this interval, from the means over it [s]
#: after a gap between two messages that is longer than this [s], let the temperatures settle
#: without learning the thermal constants
LONGEST = 10.0
#: If a housing's temperature differs from the estimate by more than this [°C], adopt it without
#: learning from it: the sensor or another source of heat is the cause, not the motor.
JUMP = 2.0
#: expect this standard deviation of the measured housing temperature, averaged over EVERY [°C]
NOISE = 0.1
#: assume this ratio r = R₁/R₂ of the thermal resistances from winding to housing and from housing
#: to air: a typical value of small motors, whose ratios vary widely
RATIO = 0.4
#: at first, assume that holding T_limit makes the housing this much warmer than the air [°C]
RISE = 80.0
WINDING_TIME = 30.0  # at first, assume this time constant τ₁ of the winding [s]
HOUSING_TIME = 800.0  # at first, assume this time constant τ₂ of the housing [s]
AIR = 25.0  # at first, assume this air temperature c_a [°C]
#: start the filter with these standard deviations of its state: winding minus housing temperature
#: c₁ − c₂ [°C], housing temperature c₂ [°C], log κ, log τ₁, log τ₂ and air temperature c_a [°C]
SPREAD = np.array([5.0, 0.2, 0.7, 0.5, 0.5, 5.0])
#: let the six quantities of SPREAD drift with these standard deviations, per √s, so that the filter
#: follows slow changes
WALK = np.array([0.1, 0.02, 0.003, 0.002, 0.002, 0.02])
#: limit the logarithms of the thermal constants κ, τ₁ and τ₂ to this distance from their initial
#: estimates
FAR = 2.5
SLOPE = 1e-4  # compute the numerical derivatives of the filter with this step
#: compare later thermal constants with those that were learned after this time [s]
LEARNED = 1200.0
#: use learned thermal constants as the reference for later ones only if their logarithms have a
#: smaller standard deviation than this
KNOWN = 0.2
REST_STEP = 30.0  # search for the end of a rest in steps of this time [s]
LONGEST_REST = 3600.0  # search up to this rest [s]; report a longer one as 'more than 60 min'
CHANGED = 1.5  # report a module once a thermal constant differs from its reference by this factor


def flow(state: Array, square: Array, dt: float) -> Array:
    """Return the state of the thermal model after a time dt of constant tension.

    Args:
        state: The state at the beginning, (6, ...): temperature of the winding minus that of the
            housing [K], temperature of the housing [°C], the logarithms of the thermal constants κ,
            τ₁ and τ₂, and temperature of the air [°C].
        square: Squared tension [N²], (...).
        dt: The time [s].

    Returns:
        The same six quantities at the end, (6, ...).
    """
    inner, outer, *logs, air = state
    kappa, winding, housing = np.exp(logs)
    share = winding / (housing * RATIO)  # C₁/C₂
    cooling, tau = (outer - air) / housing, winding / (1.0 + share)
    settled = tau * (kappa * square / share + cooling)
    gone = -np.expm1(-dt / tau)
    mean = settled * dt + (inner - settled) * tau * gone
    after = outer + share / winding * mean - cooling * dt
    return np.stack([inner + (settled - inner) * gone, after, *logs, air])


def soon(seconds: float) -> str:
    """Return how soon a rest of a predicted duration [s] ends, such as 'in about 3 min'."""
    if not math.isfinite(seconds):
        return f'in more than {LONGEST_REST / 60.0:.0f} min'
    return 'now' if seconds == 0.0 else f'in about {math.ceil(seconds / 60.0)} min'


class Heat:
    """Estimates temperatures of all muscle modules, and the tensions that these permit.

    The constants of the thermal model are estimated as well, because they differ between modules.
    """

    def __init__(self, robot: Robot) -> None:
        self._tension, count = robot.tension, robot.muscle_count
        begin = np.array([0.0, AIR, 0.0, *np.log([WINDING_TIME, HOUSING_TIME]), AIR])
        self._state: Array = np.tile(begin[:, None], count)
        self._state[2] = np.log(RISE / HOUSING_TIME / self._tension.limit**2)
        self._begin = self._state[2:5].copy()
        self._covariance: Array = np.tile(np.diag(SPREAD**2), (count, 1, 1))
        self._known = np.zeros(count, dtype=bool)  # whether the housing temperature is measured
        #: whether the housing temperature appeared, vanished or jumped since the last update
        self._interrupted = np.zeros(count, dtype=bool)
        self._age: Array = np.zeros(count)  # time spent learning [s]
        self._reference: Array = np.full((2, count), np.nan)  # log κ, log τ₂ when first known
        self._sums: Array = np.zeros((2, count))
        self._passed, self._messages = 0.0, 0
        #: caches of `limits` and `rest_needed` by their arguments, cleared by each update
        self._limits: dict[float, tuple[Array, Array]] = {}
        self._rests: dict[tuple[float, bytes], Array] = {}
        #: muscles whose constants have changed since they were first known, with a description
        self.changed: dict[int, str] = {}

    @property
    def core(self) -> Array:
        """Estimated winding temperatures [°C], (M,); NaN where no housing temperature is known."""
        return np.where(self._known, self._state[0] + self._state[1], np.nan)

    def accept(self, *muscles: int) -> None:
        """Accept the changed thermal constants of some modules as the new reference.

        Args:
            muscles: Indices of the muscles. Those that are not in `changed` keep their reference.
        """
        for m in self.changed.keys() & muscles:
            self._reference[:, m] = self._state[[2, 4], m]
            del self.changed[m]

    def limits(self, highest: float) -> tuple[Array, Array]:
        """Return the highest tensions at which no winding exceeds a temperature.

        The tensions lie between T_bias and tension.max. A muscle with unknown temperature is
        limited by tension.max only.

        Args:
            highest: The temperature limit of the windings [°C].

        Returns:
            The tensions [N] that can be held for HELD seconds, and the tensions [N] that can be
            held for MOMENT seconds, (M,) each.
        """
        if highest in self._limits:
            return self._limits[highest]
        limits = []
        for free, warming in self._look_ahead():
            square = np.where(self._state[1] < highest, (highest - free) / warming, 0.0)
            most = np.sqrt(np.maximum(square, 0.0))
            most = np.where(self._known, most, np.inf)
            limits.append(np.clip(most, self._tension.bias, self._tension.max))
        self._limits = {highest: (limits[0], limits[1])}
        return self._limits[highest]

    @property
    def is_known(self) -> Bools:
        """Whether the housing temperature of each module is known, (M,)."""
        return self._known

    def rest_needed(self, highest: float, tension: Array) -> Array:
        """Return for how long each muscle has to rest until it may hold a tension for HELD seconds.

        Args:
            highest: The temperature limit of the windings [°C].
            tension: The tension [N], (M,).

        Returns:
            The durations [s], (M,), rounded up to REST_STEP; infinite if they exceed LONGEST_REST
            or if the temperature is not known.
        """
        key = highest, tension.tobytes()
        if key not in self._rests:
            rest, state, passed = np.full(len(tension), np.inf), self._state, 0.0
            while passed <= LONGEST_REST and (self._known & np.isinf(rest)).any():
                ahead = state
                for _ in range(round(HELD / REST_STEP)):
                    ahead = flow(ahead, tension**2, REST_STEP)
                is_cool = np.maximum(state[0] + state[1], ahead[0] + ahead[1]) <= highest
                rest = np.where(is_cool & self._known, np.minimum(rest, passed), rest)
                state = flow(state, self._tension.bias**2, REST_STEP)
                passed += REST_STEP
            self._rests[key] = rest
        return self._rests[key]

    def step(self, tension: Array, housing: Array, dt: float) -> None:
        """Update the temperatures with one measurement of all modules.

        Args:
            tension: Tensions T [N], (M,).
            housing: Temperatures of the housings [°C], (M,); unknown where not finite.
            dt: Time since the previous measurement [s].
        """
        known = np.isfinite(housing)
        if dt > LONGEST:
            self._miss(housing, known, dt)
        measured = self._state[1]
        changed = known & (np.abs(housing - measured) > JUMP) | (known != self._known)
        if np.count_nonzero(changed):
            self._state[1] = np.where(known & changed, housing, measured)
            self._interrupted |= changed
            self._limits, self._rests, self._known = {}, {}, known
        self._sums[0] += tension * tension
        self._sums[1] += housing  # an unknown temperature makes the sum NaN
        self._messages, self._passed = self._messages + 1, self._passed + dt
        if self._passed < EVERY:
            return
        square, mean = self._sums / self._messages
        # Without a valid temperature, the winding's temperature is predicted but not corrected.
        is_valid = known & ~self._interrupted
        self._update(square, mean, is_valid, min(self._passed, LONGEST))
        self._limits, self._rests, self._interrupted[:] = {}, {}, False
        self._sums[:], self._passed, self._messages = 0.0, 0.0, 0

    def _miss(self, housing: Array, known: Bools, dt: float) -> None:
        """Continue after a gap of dt [s] in the measurements; the constants stay as they were."""
        self._state[0] *= np.exp(-dt / np.exp(self._state[3]))
        self._state[1] = np.where(known, housing, self._state[1])
        self._interrupted |= known
        self._covariance[:, :2] = self._covariance[:, :, :2] = 0.0
        self._covariance[:, [0, 1], [0, 1]] = SPREAD[:2] ** 2

    def _update(self, square: Array, housing: Array, is_valid: Bools, dt: float) -> None:
        """Predict the state after dt [s], and correct it where the housing temperature is valid.

        Args:
            square: Mean T² over dt [N²], (M,).
            housing: Mean housing temperature over dt [°C], (M,).
            is_valid: Whether each housing temperature is valid, (M,).
            dt: Time since the last update, at most LONGEST [s].
        """
        before, covariance = self._state, self._covariance
        after = flow(before, square, dt)
        moved = flow(before[:, None] + SLOPE * np.eye(6)[:, :, None], square, dt)
        slope = ((moved - after[:, None]) / SLOPE).transpose(2, 0, 1)
        covariance = slope @ covariance @ slope.transpose(0, 2, 1) + np.diag(WALK**2 * dt)
        gain = covariance[:, :, 1] / (covariance[:, 1, 1] + NOISE**2)[:, None]
        corrected = covariance - gain[:, :, None] * covariance[:, None, 1]
        after = after + np.where(is_valid, gain.T * (housing - after[1]), 0.0)
        after[2:5] = np.clip(after[2:5], self._begin - FAR, self._begin + FAR)
        self._state = after
        self._covariance = np.where(is_valid[:, None, None], corrected, self._covariance)
        self._age += np.where(is_valid, dt, 0.0)
        logs, unsure = after[[2, 4]], self._covariance[:, [2, 4], [2, 4]].max(axis=1)
        first = (self._age > LEARNED) & (unsure < KNOWN**2) & np.isnan(self._reference[0])
        self._reference = np.where(first, logs, self._reference)
        factor = np.exp(logs - self._reference)
        texts = (
            'heats up at {:.2g} times its earlier rate under the same tension',
            'cools with {:.2g} times its earlier time constant',
        )
        self.changed = {
            int(m): texts[k].format(factor[k, m])
            for k, m in np.argwhere(np.abs(np.log(factor)) > np.log(CHANGED))
        }

    def _look_ahead(self) -> list[tuple[Array, Array]]:
        """Predict the winding temperatures after HELD and after MOMENT seconds.

        Returns:
            Two pairs, for HELD and for MOMENT: the winding temperature without tension [°C], and
            its increase per squared tension [K/N²], (M,) each.
        """
        squares = np.array([0.0, 1.0])[:, None] * self._tension.limit**2
        state = np.repeat(self._state[:, None], 2, axis=1)
        ahead = list[tuple[Array, Array]]()
        for n in range(round(HELD / MOMENT)):
            state = flow(state, squares, MOMENT)
            if n in (0, round(HELD / MOMENT) - 1):
                free, warm = state[0] + state[1]
                ahead.insert(0, (free, (warm - free) / self._tension.limit**2))
        return ahead
