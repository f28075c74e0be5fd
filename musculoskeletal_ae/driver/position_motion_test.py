# SPDX-License-Identifier: Apache-2.0
"""Check the response of a driver whose modules follow positions, one muscle at a time.

At first, every l_target is the current l, and every l must stay there. Then, for each muscle, the
target moves inwards slowly until the tension has risen or the target has moved by FURTHEST. l must
follow

    l → l_target

and T must not fall meanwhile. The target then returns and moves outwards, and l must follow again.
"""

from collections.abc import Generator, Sequence

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.driver.motion_test import (
    ABOVE_BIAS,
    HOLD,
    RELEASE,
    RESPONSE,
    RUN_AWAY_TENSION,
    SETTLE,
    SPEED,
    MotionTest,
    RunAwayError,
    Wait,
    WrongOrderError,
)
from musculoskeletal_ae.driver.verdict import Verdict
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.report import distinct
from musculoskeletal_ae.signals.muscle_states import MuscleReadings

#: first step of a muscle's target length inwards, from which the latency is measured [m]
STEP = 0.003
FURTHEST = 0.015  # wind a muscle in by at most this [m]
OUTWARDS = 0.005  # pay a muscle out by this after winding it in, to check the other direction [m]
FOLLOWS = 0.0015  # accept a module at rest whose l differs from l_target by at most this [m]
#: report a fault if the change of l, divided by that of l_target, is outside this range
SHARES = 0.7, 1.4
#: while the arm is held, permit T to rise by this [N], even if T then exceeds the highest test
#: tension
RISE = 20.0
#: release a muscle, and end the test, if its l is further away from l_target than this [m]
RUN_AWAY = 0.03


class Positioning(MotionTest):
    """Moves muscles by position commands, and checks their responses."""

    def __init__(
        self, verdict: Verdict, muscles: Sequence[int] = (), highest: float | None = None
    ) -> None:
        """Prepare to test muscles.

        Args:
            verdict: Receives the results.
            muscles: Indices of the muscles to test. Without any, all muscles are tested.
            highest: Tension at which winding in a muscle ends [N]. None for a tension of ABOVE_BIAS
                above T_bias, but at most tension.limit.

        Raises:
            MusculoskeletalError: If `highest` is above a muscle's tension.limit.
        """
        super().__init__(verdict, muscles)
        tension = self._robot.tension
        self._highest: Array = np.minimum(tension.bias + ABOVE_BIAS, tension.limit)
        if highest is not None:
            m = int(tension.limit.argmin())
            if highest > tension.limit[m]:
                wanted, limit = distinct(highest, tension.limit[m])
                raise MusculoskeletalError(
                    f'--tension {wanted} N exceeds tension.limit of {self._robot.muscles[m]!r}, '
                    f'{limit} N; choose a lower value'
                )
            self._highest = np.full(self._robot.muscle_count, highest)
        #: tension at which a muscle is released while the arm is held [N] (M,)
        self._most: Array = np.full(self._robot.muscle_count, np.inf)

    # -- commands -------------------------------------------------------------------------------

    def _command(self, length: Array) -> Array:  # noqa: ARG002
        return self._target.copy()

    def _hold(self) -> Wait:
        yield from self._wait(RELEASE)
        mean = self._mean()
        self._most = np.maximum(self._highest, mean.tension + RISE)
        self._target[:] = mean.length
        yield from self._wait(SETTLE)
        held = self._mean().length
        if winds := self._exchanged(held):
            raise WrongOrderError(winds)
        for m in np.flatnonzero(np.abs(held - self._target) > FOLLOWS).tolist():
            off = 1e3 * (held - self._target)[m]
            self.verdict.failed('position hold', m, off=off)

    def _run_away(
        self,
        newest: MuscleReadings,
        start: MuscleReadings,  # noqa: ARG002
    ) -> RunAwayError | None:
        length, tension = newest.length, newest.tension
        far = np.abs(length - self._target) > RUN_AWAY
        m = self._lasting((tension > self._highest + RUN_AWAY_TENSION) | far)
        if self._tested is None and (tension > self._most).any():
            m = int((tension > self._most).argmax())
        if m is None:
            return None
        detail = f'T rose to {tension[m]:.0f} N'
        if far[m]:
            detail = f'l deviates by {1e3 * (length - self._target)[m]:+.0f} mm from l_target'
        return RunAwayError(m, 'position ran away', detail=detail)

    def _release(self, error: RunAwayError) -> Generator[None, None, dict[int, int]]:
        winds = self._exchanged(self._newest.length) if self._tested is None else {}
        # The module that follows the command of an exchanged muscle is paid out as well.
        m = [error.muscle, *winds]
        self._target[m] += self._robot.actuation.release[m]
        end = self._now + RELEASE
        while self._now < end:
            yield
        return winds

    def _exchanged(self, length: Array) -> dict[int, int]:
        """Return, while the arm is held, which module each command moves; {} if unknown.

        Every target is the l that a module had published. Modules that follow the commands of other
        muscles move to the l of these muscles. While they still move, only two modules that move
        towards each other's l can be recognised.

        Args:
            length: Measured lengths [m], (M,).
        """
        moved = length - self._target
        movers = np.flatnonzero(np.abs(moved) > FOLLOWS)
        if len(movers) < 2:
            return {}
        distance = np.abs(length[movers][:, None] - self._target[movers][None, :])
        np.fill_diagonal(distance, np.inf)
        nearest = distance.argmin(axis=1)
        has_arrived = distance.min(axis=1) < 2.0 * FOLLOWS
        is_order = len(set(nearest.tolist())) == len(movers)
        if len(movers) == 2:
            a, b = movers
            apart = self._target[b] - self._target[a]
            meets = np.sign(moved[a]) == np.sign(apart) and np.sign(moved[b]) == -np.sign(apart)
            is_order = meets and (np.abs(moved[movers]) < abs(apart) + FOLLOWS).all()
            has_arrived[:] = True
        if not (is_order and has_arrived.all()):
            return {}
        return dict(zip(movers[nearest].tolist(), movers.tolist(), strict=True))

    def _mean(self) -> MuscleReadings:
        """Return the mean of the last readings."""
        return MuscleReadings.of_rows(self._readings().rows.mean(axis=0))

    # -- checks ---------------------------------------------------------------------------------

    def _try(self, m: int) -> Wait:
        verdict, home, start = self.verdict, self._mean(), float(self._target[m])
        begun, latency = self._now, 0.0
        answer = max(2.0 * RESPONSE[1], 0.3 * STEP)
        self._target[m] = start - STEP
        while self._now - begun < HOLD:
            yield from self._wait(1e-9)
            if not latency and abs(self._newest.length[m] - home.length[m]) > answer:
                latency = self._now - begun
        last = self._now
        while self._target[m] > start - FURTHEST and self._may_go_on(m):
            self._target[m] -= SPEED * self._since(last)
            last = self._now
            yield from self._wait(1e-9)
        yield from self._wait(HOLD)
        wound, asked = self._mean(), start - self._target[m]
        moved = home.length - wound.length
        others = np.abs(moved) * (np.arange(len(moved)) != m)
        if abs(moved[m]) < SHARES[0] * STEP * 0.5:
            yield from self._go(m, start)
            other = int(others.argmax())
            if others[other] > 0.5 * asked:
                raise WrongOrderError({m: other})
            verdict.failed('no answer', m)
            return
        pulled = wound.tension[m] - home.tension[m]
        if not SHARES[0] < moved[m] / asked < SHARES[1]:
            detail = (
                f'l fell by {1e3 * moved[m]:.1f} mm while l_target fell by {1e3 * asked:.1f} mm'
            )
            verdict.failed('position gain', m, detail=detail)
        else:
            verdict.passed('unit', m)
        if np.isnan(pulled):
            verdict.notes.append(
                f'{self.trying}: the tension is unknown, so the sign of l was not checked'
            )
        elif pulled < -RESPONSE[0]:
            detail = f'T fell by {-pulled:.0f} N as l fell by {1e3 * moved[m]:.1f} mm'
            verdict.failed('position sign', m, detail=detail)
        else:
            verdict.passed('sign', m)
        yield from self._go(m, start)
        yield from self._go(m, start + OUTWARDS)
        out = self._mean().length[m] - home.length[m]
        if out < SHARES[0] * OUTWARDS:
            verdict.failed('position outwards', m, out=1e3 * out, asked=1e3 * OUTWARDS)
        else:
            verdict.passed('law', m)
        yield from self._go(m, start)
        self._judge_latency(m, latency)

    def _may_go_on(self, m: int) -> bool:
        """Return whether muscle m may be wound in further; True if its tension is unknown."""
        return not float(self._readings().tension[:, m].mean()) > self._highest[m]
