# SPDX-License-Identifier: Apache-2.0
"""Is a suspect muscle broken: what it does while the controller winds it in a little.

The arm has stopped, and the estimate is made without the suspect already. Once its command falls
again (`control/safety`), what it reads, T and l, is compared with what muscle stiffness
control demands of it, T_ref = T_bias + K (l − l_target), and with the length l' that the other
muscles make likely:

    l does not change at all                its sensor is frozen, or dead
    T near zero; l' − l > FAR or growing    ruptured: the winch winds in what is left of the wire
    T does not change at all                its sensor is stuck, or dead
    |l − l'| > FAR                          the length sensor has jumped
    l stays, T does not rise                jammed: the winch does not do as it is told
    T near zero all the same                its sensor is dead
    T follows T_ref                         healthy
    else                                    jammed

A sound sensor is never quite still. A suspect that nobody winds stays isolated.
"""

import math

import numpy as np

from musculoskeletal_ae.plausibility import SLACK

HEALTHY = 'healthy'
VERIFYING = '; verifying it'  # ends the report of an anomaly: the arm may go on by itself
BEGUN, JUDGED = 0.001, 0.8  # [m] that the command has fallen, [s] of that
PATIENCE = 8.0  # [s] without an answer
FAR, FOLLOWED = 0.025, 0.005  # [m]
USUAL = 30.0  # T_bias [N] of the arms that those in N are of; weaker ones need less
CLOSE, SHARE = 8.0, 0.35  # [N]; of what is demanded beyond T_bias: T is as demanded
TIGHT, STOOD = 20.0, 0.0005  # [N]; [m] that the winch moves by though it is told to
STILL = 1e-6  # [m], [N] of a sensor that says always the same


class Verification:
    """Watches one muscle, from the message on that made it a suspect."""

    def __init__(self, muscle: int, bias: float, stiffness: float) -> None:
        """The muscle's place, its T_bias [N] and K [N/m]."""
        self.muscle, self._bias, self._stiffness = muscle, bias, stiffness
        self._time, self._highest = 0.0, -math.inf
        self._scale = min(1.0, bias / USUAL)
        self._before = bias, bias  # T and T_ref where it was not wound in yet
        self._rows: list[tuple[float, float, float, float]] = []
        self._watched = 0.0

    def step(
        self, tension: float, length: float, command: float | None, likely: float, dt: float
    ) -> str:
        """Take T [N], l, l_target and l' [m], dt [s] after those before; return what it is, or ''.

        l_target is None where none is known.
        """
        self._time, demand = self._time + dt, math.inf
        if command is not None:
            demand = self._bias + max(0.0, self._stiffness * (length - command))
            if command >= self._highest:
                self._highest, self._before = command, (tension, demand)
            if command < self._highest - BEGUN:
                self._watched += dt
                self._rows.append((tension, length, demand, length - likely))
        if self._watched >= JUDGED:
            return self._judged()
        if self._time < PATIENCE:
            return ''
        # One that pulls as if it were wound in already is not.
        return 'jammed' if tension > demand + TIGHT * self._scale else 'nobody wound it in'

    def _judged(self) -> str:
        tension, length, demand, off = np.array(self._rows).T
        late, quarter = slice(len(tension) // 2, None), max(len(tension) // 4, 1)
        pull, wanted, beside = (float(np.median(part[late])) for part in (tension, demand, off))
        gone, follows = pull < SLACK * self._bias, off[0] - off[-1] > FOLLOWED
        if np.ptp(length) < STILL:
            return 'its length sensor stands still'
        if gone and (beside < -FAR or follows):
            return 'ruptured'
        if np.ptp(tension) < STILL:
            return 'its tension sensor stands still'
        if not gone and abs(beside) > FAR:
            return f'its length sensor is off by {1e3 * beside:.0f} mm'
        stood = abs(length[:quarter].mean() - length[-quarter:].mean()) < STOOD
        close = CLOSE * self._scale
        rise, asked = pull - self._before[0], wanted - self._before[1]
        if stood and (gone or rise < SHARE * asked > SHARE * close):
            return 'jammed'
        if gone:
            return 'its tension sensor stands still'
        if abs(pull - wanted) < close + SHARE * (wanted - self._bias):
            return HEALTHY
        return 'jammed'
