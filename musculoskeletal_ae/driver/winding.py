# SPDX-License-Identifier: Apache-2.0
"""What a driver does with commands: each muscle is wound in a little, one at a time.

At first every l_target is the l of that moment, which must give T_bias. Then, for each muscle, the
target steps inwards until the MSC law

    T = min(T_max, T_bias + max(0, K (l − l_target)))

at the l that is read asks for a low tension; back; and beyond l, where T must stay at T_bias. The
law is judged by what l and T were read, so that it does not matter how far the arm gives way.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Generator, Sequence
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.driver.verdict import Verdict
from musculoskeletal_ae.robot.robot import Robot

ABOVE_BIAS = 40.0  # [N] that the highest tension lies above T_bias, unless said otherwise
SETTLE, HOLD, RELEASE, MEAN = 1.5, 0.5, 0.6, 0.3  # [s]
SPEED = 0.01  # [m/s] at which a target goes on inwards while the arm gives way
RELEASE_SPEED = 0.03  # [m/s] at which it goes back
FURTHEST = 0.025  # [m] that a muscle is wound in
SLACK = 0.01  # [m] that l_target then lies beyond l
RUN_AWAY_TENSION, RUN_AWAY = 60.0, 0.05  # [N] above what is asked for, [m]: it is let go
MOMENT = 0.1  # [s] for which a falling arm may pull harder
LATEST = 0.1  # [s] from a command to the first change
TENSION_TOLERANCE = 10.0  # [N]
SLOPES = 0.7, 1.4  # of what the law asks for
RESPONSE = 4.0, 0.0006  # [N], [m] above noise
CLIP = 20.0, 0.05  # asked for beyond tension.max [N], tolerated beyond it (share)


class _Reading(NamedTuple):
    """Means over a moment, each (M,), and what the law asks for there."""

    length: Array
    tension: Array
    third: Array  # row 3
    demand: Array


class RunAwayError(Exception):
    """A muscle does something else than what was asked for."""


class Winding:
    """Winds muscles in, one command a message, and judges what they do."""

    def __init__(
        self, robot: Robot, muscles: Sequence[int] = (), highest: float | None = None
    ) -> None:
        """Try some muscles (none: all), with at most `highest` [N] asked for."""
        self._robot = robot
        self._muscles = tuple(muscles) or tuple(range(robot.muscle_count))
        bias = robot.tension.bias
        self._highest: Array = np.maximum(
            bias + CLIP[0], bias + ABOVE_BIAS if highest is None else highest
        )
        self.verdict = Verdict(robot)
        self.trying = ''  # what is going on, for people
        self._now = 0.0
        self._recent: deque[tuple[float, Array]] = deque()
        self._target: Array = np.full(robot.muscle_count, np.nan)  # none before l is known
        self._stiffness: Array = robot.stiffness
        self._tame_at: Array = np.zeros(robot.muscle_count)  # when each last pulled as asked [s]
        self._run = self._sequence()
        self.done = False

    def step(self, states: Array, now: float) -> Array | None:
        """Take l, T, temperature (3, M) at a time [s]; return l_target [m] (M,) if there is one."""
        self._now = now
        self._recent.append((now, states))
        while now - self._recent[0][0] > MEAN:
            self._recent.popleft()
        if self.done:
            return None
        try:
            next(self._run)
        except StopIteration:
            self.done = True
            return None
        return None if np.isnan(self._target).any() else self._target.copy()

    # -- what is commanded ----------------------------------------------------------------------

    def _sequence(self) -> Generator[None, None, None]:
        robot, verdict = self._robot, self.verdict
        try:
            self.trying = 'hold'
            yield from self._wait(MEAN)
            self._target[:] = self._mean().length
            yield from self._wait(SETTLE)
            self._target[:] = self._mean().length
            yield from self._wait(HOLD)
            held = self._mean()
            off = held.tension - held.demand
            for m in np.flatnonzero(np.abs(off) > TENSION_TOLERANCE).tolist():
                told = f'T is {held.tension[m]:.0f} N where the law asks for {held.demand[m]:.0f} N'
                how = f'{self._law(m)}; is the wire slack, is T in N and its zero right?'
                verdict.failed('law', (m,), told, how)
            for m in self._muscles:
                self.trying = robot.muscles[m]
                yield from self._try(m)
        except RunAwayError as error:
            m, told = error.args
            how = 'it was let go: sign and unit of l, T and of the command; is T = T_bias + …?'
            verdict.failed('law', (m,), told, how)
            # Out, and then silence, in which modules go safe by themselves.
            self._target += 2.0 * RUN_AWAY
            end = self._now + RELEASE
            while self._now < end:
                yield

    def _wait(self, duration: float) -> Generator[None, None, None]:
        end, start = self._now + duration, self._recent[-1][1] if self._recent else None
        while self._now < end:
            yield
            states = self._recent[-1][1]
            asked = np.minimum(self._demand(states[0]), self._robot.tension.limit)
            for m in range(self._robot.muscle_count):
                if not states[1, m] > asked[m] + RUN_AWAY_TENSION:
                    self._tame_at[m] = self._now
                elif self._now - self._tame_at[m] > MOMENT:
                    told = f'T rose to {states[1, m]:.0f} N, {asked[m]:.0f} N were asked for'
                    raise RunAwayError(m, told)
                if start is not None and start[0, m] - states[0, m] > RUN_AWAY:
                    raise RunAwayError(m, f'l fell by {1e3 * (start[0, m] - states[0, m]):.0f} mm')

    def _demand(self, length: Array) -> Array:
        robot = self._robot
        demand: Array = robot.tension.bias + np.maximum(
            0.0, self._stiffness * (length - self._target)
        )
        return demand

    def _mean(self) -> _Reading:
        length, tension, third = np.mean([states for _, states in self._recent], axis=0)
        demand = np.minimum(self._demand(length), self._robot.tension.max)
        return _Reading(length, tension, third, demand)

    def _try(self, m: int) -> Generator[None, None, None]:
        robot, verdict = self._robot, self.verdict
        home, latency = self._mean(), list[float]()
        levels = [home]
        for share in (0.5, 1.0):
            # The weight of the arm may ask for more than T_bias already.
            level = home.demand[m] + share * (self._highest - robot.tension.bias)[m]
            levels.append((yield from self._wind(m, level, home.length[m], latency)))
        if not self._responds(m, home, levels[-1]):
            yield from self._ask_outwards(m, home, levels[-1])
            return
        verdict.passed('order', m)
        verdict.passed('unit', m)
        if levels[-1].length[m] > home.length[m] + RESPONSE[1]:
            told = f'l rose by {1e3 * (levels[-1].length - home.length)[m]:.1f} mm while winding in'
            verdict.failed('sign', (m,), told, 'l must fall when the motor winds in')
        else:
            verdict.passed('sign', m)
        clip = robot.tension.max[m]
        if clip <= self._highest[m]:
            past = yield from self._wind(m, clip + CLIP[0], home.length[m], [])
            if past.tension[m] > (1.0 + CLIP[1]) * clip:
                told = f'T is {past.tension[m]:.0f} N, tension.max {clip:g} N'
                verdict.failed('clip', (m,), told, 'T_ref = min(T_max, T_bias + max(0, …))')
            else:
                verdict.passed('clip', m)
        yield from self._go(m, home.length[m])
        yield from self._go(m, self._mean().length[m] + SLACK)
        out = self._mean()
        yield from self._go(m, home.length[m])
        self._judge(m, levels, out)
        if latency:
            least = min(latency)
            if least > LATEST:
                told = f'{1e3 * least:.0f} ms from command to the first change'
                how = f'at most {1e3 * LATEST:g}: no queues, no filters, one cycle of the bus'
                verdict.failed('latency', (m,), told, how)
            else:
                verdict.passed('latency', m)

    def _go(self, m: int, goal: float) -> Generator[None, None, None]:
        """Bring a target to where it is to rest, not faster than the arm may follow."""
        last = self._now
        while self._target[m] != goal:
            yield from self._wait(1e-9)
            most = RELEASE_SPEED * (self._now - last)
            self._target[m] += np.clip(goal - self._target[m], -most, most)
            last = self._now
        yield from self._wait(RELEASE)

    def _wind(
        self, m: int, level: float, home: float, latency: list[float]
    ) -> Generator[None, None, _Reading]:
        """Ask for a level [N], follow the arm as it gives way, and return what is then read."""
        before = self._mean()
        further = (level - self._robot.tension.bias[m]) / self._stiffness[m]
        noise = np.std([states[1, m] for _, states in self._recent])
        self._target[m] = before.length[m] - further
        start = last = self._now
        seen = False
        while self._now - start < HOLD or (
            self._demand(self._recent[-1][1][0])[m] < level
            and home - self._target[m] < FURTHEST + further
        ):
            yield from self._wait(1e-9)
            length, tension, _ = self._recent[-1][1][:, m]
            changed = abs(tension - before.tension[m]) > RESPONSE[0] + 2.0 * noise
            if not seen and (changed or before.length[m] - length > 2.0 * RESPONSE[1]):
                latency.append(self._now - start)
                seen = True
            if self._demand(self._recent[-1][1][0])[m] < level and self._now - start > 0.5 * HOLD:
                self._target[m] -= SPEED * (self._now - last)
            last = self._now
        yield from self._wait(HOLD)
        return self._mean()

    # -- what is judged -------------------------------------------------------------------------

    def _responds(self, m: int, before: _Reading, after: _Reading) -> bool:
        tension = abs(after.tension[m] - before.tension[m]) > RESPONSE[0]
        return bool(tension or before.length[m] - after.length[m] > RESPONSE[1])

    def _ask_outwards(self, m: int, home: _Reading, after: _Reading) -> Generator[None, None, None]:
        """Find out why a muscle did not respond."""
        robot, verdict = self._robot, self.verdict
        pulled = after.tension - home.tension
        wound = home.length - after.length
        other = int(np.where(wound > RESPONSE[1], pulled, -np.inf).argmax())
        yield from self._go(m, home.length[m])
        if other != m and pulled[other] > RESPONSE[0]:
            told = f'{robot.muscles[other]} winds in instead'
            verdict.failed('order', (m,), told, 'take commands in the order of muscles.yaml')
            return
        away = (self._highest - robot.tension.bias)[m] / self._stiffness[m]
        self._target[m] = home.length[m] + away
        yield from self._wait(HOLD)
        outwards = self._mean()
        yield from self._go(m, home.length[m])
        if outwards.tension[m] - home.tension[m] > RESPONSE[0]:
            told = 'a longer l_target winds it in'
            verdict.failed('sign', (m,), told, 'l and l_target must fall when the motor winds in')
            return
        told = 'it does not respond to muscle_length_command'
        how = 'is the motor on, the command read as m, and taken from the topic of this namespace?'
        verdict.failed('law', (m,), told, how)

    def _law(self, m: int) -> str:
        bias, stiffness = self._robot.tension.bias[m], self._stiffness[m]
        return f'T = T_bias + max(0, K (l − l_target)), T_bias {bias:g} N, K {stiffness:g} N/m'

    def _judge(self, m: int, levels: Sequence[_Reading], out: _Reading) -> None:
        """Judge the law by levels that were asked for, and by l_target beyond l."""
        robot, verdict = self._robot, self.verdict
        home, last = levels[0], levels[-1]
        bias = robot.tension.bias[m]
        asked, got = last.demand[m] - home.demand[m], last.tension[m] - home.tension[m]
        if asked < 0.25 * (self._highest[m] - bias):
            verdict.notes.append(f'{robot.muscles[m]}: the arm gave way, the law is not judged')
        elif abs(last.third[m] - home.third[m]) > 0.7 * asked and abs(got) < 0.3 * asked:
            told = 'row 3 does what tension must'
            verdict.failed('order', (m,), told, 'publish length, tension, temperature')
        elif not SLOPES[0] < got / asked < SLOPES[1]:
            told = f'T changes by {got:.0f} N where the law asks for {asked:.0f} N'
            verdict.failed('law', (m,), told, f'{self._law(m)}, l as published; is T in N?')
        elif abs(out.tension[m] - out.demand[m]) > TENSION_TOLERANCE:
            l_target = 'l_target is beyond l: max(0, …)' if out.demand[m] == bias else 'it gave way'
            told = f'T is {out.tension[m]:.0f} N, not {out.demand[m]:.0f} N, where {l_target}'
            verdict.failed('law', (m,), told, self._law(m))
        else:
            verdict.passed('law', m)
