# SPDX-License-Identifier: Apache-2.0
"""Check the response of a driver to commands by winding in each muscle a little, one at a time.

The modules must obey the law of muscle stiffness control (MSC), with the stiffness K. At first,
every l_target is the current l, at which T must be T_bias. Then, for each muscle, the target steps
inwards until the law

    T = min(T_max, T_bias + max(0, K (l − l_target)))

demands a low tension at the measured l. The target then returns, and moves beyond l, where T must
stay at T_bias.

Signs and order of commands are unknown before the test. Until a muscle has passed the test, its
target is limited: at the measured l, the law never demands more than the highest test tension.

Before the first muscle is tested, the arm is held. In this phase, the law demands at most the
fraction HELD of the test tension. All muscles are released as soon as a tension exceeds the
fraction ALARM. HELD and ALARM are fractions of the range from T_bias to the highest test tension.

An error of l (LENGTH_ERROR) becomes an error of T, which is K times as large. If K exceeds 50 kN/m,
this error of T exceeds TENSION_TOLERANCE and replaces the tolerance. The detection thresholds and
the default of the demanded tensions then grow in the same proportion.
"""

from collections.abc import Generator, Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from musculoskeletal_ae.arrays import Array, Bools
from musculoskeletal_ae.driver.motion_test import (
    ABOVE_BIAS,
    HOLD,
    LATEST,
    LONGEST_ADVANCE,
    MEAN,
    RELEASE,
    RELEASE_SPEED,
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

#: demand at least this much above T_bias [N], because noise hides the response to smaller demands
LEAST_ABOVE_BIAS = 20.0
FURTHEST = 0.025  # wind a muscle in by at most this [m]
SLACK = 0.01  # after winding in, set l_target this far beyond l [m], so that the law demands T_bias
RUN_AWAY = 0.05  # release all muscles, and end the test, if one shortens by more than this [m]
#: accept an error of T up to the larger of these: [N], and relative to the demand
TENSION_TOLERANCE, TENSION_SHARE = 10.0, 0.1
#: expect errors of l of up to this: two standard deviations of noise and resolution [m]
LENGTH_ERROR = 2.0e-4
#: report a fault if the change of T, divided by that of the demand, is outside this range
SLOPES = 0.7, 1.4
#: to check the clip, demand this beyond tension.max [N]; accept this excess of T, relative to it
CLIP = 20.0, 0.05
#: conclude that the sign of l or of the command is wrong if a muscle becomes taut at an l_target
#: within this distance of −l [m]
MIRROR_TOLERANCE = 0.008
#: While the arm is held before the first test, demand at most HELD, and release all muscles above
#: ALARM; both are fractions of the range from T_bias to the highest test tension. ALARM is
#: above 0.81, which healthy emulated arms reach while they still swing. A large K makes T noisy.
#: Where the tolerance of T exceeds TENSION_TOLERANCE, the alarm tension is raised by twice the
#: difference.
HELD, ALARM = 0.5, 0.9
#: treat T as oscillating, and release all muscles, if it crosses its mean more often than this in
#: MEAN seconds
OSCILLATES = 6
#: start a release with l_target this far beyond l [m], and increase the distance at this speed
#: [m/s]; the distance is small at first, because commands of wrong sign wind in
PAY_OUT = 0.003, 0.3
#: set every l_target this far beyond the largest l while searching for a wrong order [m]; no module
#: then pulls, whichever command it follows
CLEAR = 0.005
#: while searching for a wrong order, let the demand rise by at most this share of the range from
#: T_bias to ALARM within LONGEST_ADVANCE
SEARCH_SHARE = 0.5
CONFIRMATIONS = 3  # count a rise of tension as a response if this many messages in a row show it
MOST_BEYOND = 0.3  # demand at most this much beyond tension.max, relative to tension.max


class _Reading(NamedTuple):
    """Values that are averaged over MEAN seconds, (M,) each."""

    length: Array
    tension: Array
    temperature: Array
    demand: Array  # tension that the law demands, at most tension.max


class Winding(MotionTest):
    """Winds muscles in, with one command per message, and checks their responses."""

    def __init__(
        self, verdict: Verdict, muscles: Sequence[int] = (), highest: float | None = None
    ) -> None:
        """Prepare to test muscles.

        Args:
            verdict: Receives the results.
            muscles: Indices of the muscles to test. Without any, all muscles are tested.
            highest: Highest tension that is demanded of a muscle that starts at T_bias [N]. If the
                muscle carries more tension at the start, its highest demand is larger by the
                difference. If `highest` is at least tension.max, a last step demands more, to check
                that T stays at tension.max. None for ABOVE_BIAS above T_bias (more if K is large),
                but at most tension.max.

        Raises:
            MusculoskeletalError: If the response to `highest` could not be distinguished from
                noise, or if a muscle would need more than its tension.max.
        """
        super().__init__(verdict, muscles)
        robot = self._robot
        self._bias = robot.tension.bias
        #: tolerance of T [N] (M,), and the factor by which it exceeds TENSION_TOLERANCE
        self._tolerance = np.maximum(TENSION_TOLERANCE, LENGTH_ERROR * robot.stiffness)
        self._scale: Array = self._tolerance / TENSION_TOLERANCE
        self._response: Array = RESPONSE[0] * self._scale
        #: smallest tolerance of T [N] (M,), which applies where T_bias is demanded
        usual = np.minimum(TENSION_TOLERANCE, 0.5 * self._bias)
        self._resting = np.maximum(usual, LENGTH_ERROR * robot.stiffness)
        self._run_away_tension = np.minimum(RUN_AWAY_TENSION * self._scale, robot.tension.max)
        self._highest: Array = np.minimum(self._bias + ABOVE_BIAS * self._scale, robot.tension.max)
        if highest is not None:
            self._highest = np.full(robot.muscle_count, highest)
        for m in self._muscles:
            least = self._bias[m] + (LEAST_ABOVE_BIAS * self._scale)[m]
            most = robot.tension.max[m]
            if most < least:
                needed, limit = distinct(least, most)
                raise MusculoskeletalError(
                    f'muscle {robot.muscles[m]!r}: the check needs at least {needed} N, but '
                    f'tension.max is {limit} N; check only the other muscles, with --muscles'
                )
            if self._highest[m] < least:
                needed, limit = distinct(least, self._highest[m])
                raise MusculoskeletalError(
                    f'muscle {robot.muscles[m]!r}: the check needs at least {needed} N, '
                    f'but it may command {limit} N at most; pass a higher --tension'
                )
        #: tension [N] (M,) above which all muscles are released while the arm is held
        self._alarm: Array = self._bias + ALARM * (self._highest - self._bias)
        self._alarm += 2.0 * (self._tolerance - TENSION_TOLERANCE)
        #: highest tension [N] (M,) that is demanded in the present test
        self._most: Array = self._highest.copy()
        self._sent: Array = self._target.copy()  # the last command [m] (M,)
        #: whether the target of each muscle moves without limit, to search for a response, (M,)
        self._is_searched: Bools = np.zeros(robot.muscle_count, dtype=bool)
        #: standard deviation of T while the arm is held [N] (M,)
        self._swing: Array = np.zeros(robot.muscle_count)
        self._searches_order = False

    @property
    def trying(self) -> str:
        """The present step of the test, for messages: `hold`, `order` or the name of a muscle."""
        return 'order' if self._searches_order else super().trying

    # -- commands -------------------------------------------------------------------------------

    def _hold(self) -> Wait:
        yield from self._wait(MEAN)
        for pause in (SETTLE, HOLD):
            self._target[:] = self._mean().length
            yield from self._wait(pause)
        held, self._swing = self._mean(), self._noise()
        for m in np.flatnonzero(self._swing > self._tolerance).tolist():
            self.verdict.failed('hums', m, swing=self._swing[m])
        off = np.flatnonzero(self._off(held)).tolist()
        yield from self._search_order([m for m in off if self._obeys_another(m, held)])
        for m in off:
            self.verdict.failed('hold', m, got=held.tension[m], asked=held.demand[m])

    def _run_away(self, newest: MuscleReadings, start: MuscleReadings) -> RunAwayError | None:
        """Return the error of a muscle that exceeds its demand or shortens too far; else None.

        `newest` and `start` are the newest readings and those when the present wait began.
        """
        length, tension = newest.length, newest.tension
        tensions = self._robot.tension
        verified = np.minimum(np.maximum(tensions.limit, self._most), tensions.max)
        asked = np.minimum(
            self._demanded(length), np.where(self._is_verified, verified, self._ceiling())
        )
        excess = tension - asked - self._run_away_tension
        m = self._lasting(excess > 0.0)
        unverified = np.where(self._is_verified, -np.inf, excess)
        if self._tested is None and not np.isnan(self._sent).any():
            unverified = tension - self._alarm
        if (unverified > 0.0).any():
            m = int(np.nanargmax(unverified))
            recent = self._readings().tension[:, m]
            crossings = np.count_nonzero(np.diff(recent > recent.mean()))
            if self._tested is None and crossings > OSCILLATES:
                return RunAwayError(m, 'hums', swing=np.std(recent))
        if m is not None:
            detail = f'T rose to {tension[m]:.0f} N, but the demand was {asked[m]:.0f} N'
            rose = float(length[m] - start.length[m])
            fault = 'rising' if rose > RESPONSE[1] else 'ran away'
            return RunAwayError(m, fault, detail=detail, rose=1e3 * rose)
        fell = start.length - length
        if fell.max() > RUN_AWAY:
            detail = f'l fell by {1e3 * fell.max():.0f} mm'
            return RunAwayError(int(fell.argmax()), 'ran away', detail=detail)
        return None

    def _release(self, error: RunAwayError) -> Generator[None, None, dict[int, int]]:
        """Release all muscles by paying them out, because the arm may be falling.

        Each target follows from the newest l and not from the last target, because l may change in
        the wrong direction. If a tension still rises, the sign of the commands is wrong, and no
        more commands are sent. If a wrong order of the commands may be the cause, search for it.
        """
        # A length that rises as the muscle is wound in has the wrong sign, not the wrong place.
        suspects = [] if error.fault == 'rising' else self._misplaced()
        if suspects:
            if (yield from self._pay_out()):
                try:
                    yield from self._search_order(suspects)
                except WrongOrderError as wrong:
                    return wrong.winds
                except RunAwayError:
                    yield from self._pay_out()
            return {}
        start, before = self._now, self._newest.tension
        while (passed := self._now - start) < RELEASE:
            length, tension = self._newest.length, self._newest.tension
            if passed > 0.5 * LATEST and (tension > before.max() + self._response).any():
                break
            self._target = length + min(PAY_OUT[0] + PAY_OUT[1] * passed, 2.0 * RUN_AWAY)
            yield
        return {}

    # -- wrong order ------------------------------------------------------------------------------

    def _pay_out(self) -> Generator[None, None, bool]:
        """Pay out all muscles, whichever command each of them follows.

        Every target moves beyond the largest l. If a tension still rises, commands end, and the
        result is False.
        """
        start, before = self._now, self._newest.tension
        while (passed := self._now - start) < RELEASE:
            length, tension = self._newest.length, self._newest.tension
            if passed > 0.5 * LATEST and (tension > before.max() + self._response).any():
                return False
            self._target[:] = length.max() + CLEAR
            yield
        return True

    def _misplaced(self) -> list[int]:
        """Return the muscles that pull more than demanded, if a wrong order explains all of them.

        Each of them must then follow the command of another muscle that demands the excess, and no
        two of them the same command. If every muscle pulls, the order is therefore not wrong.
        """
        length, tension = self._newest.length, self._newest.tension
        demand = self._demanded(length)
        excess = tension - demand
        pulls = excess > self._tolerance
        needed = 0.5 * np.where(pulls, excess, -np.inf)
        # A module computes its tension from its own length, or, if two muscles are exchanged, from
        # the length that is published for the other one.
        own: Array = self._robot.stiffness[:, None] * (length[:, None] - self._sent[None, :])
        published = (demand - self._bias)[None, :]
        explained: Bools = np.maximum(own, published) > needed[:, None]
        np.fill_diagonal(explained, ~pulls)
        rows, columns = linear_sum_assignment(~explained)
        if not pulls.any() or not explained[rows, columns].all():
            return []
        return np.flatnonzero(pulls).tolist()

    def _obeys_another(self, m: int, held: _Reading) -> bool:
        """Return whether another muscle's command would demand the tension of muscle m at rest."""
        stretched = np.maximum(0.0, held.length[m] - self._sent)
        demands = self._bias[m] + self._robot.stiffness[m] * stretched
        fits = np.abs(demands - held.tension[m]) < 2.0 * np.maximum(
            self._tolerance[m], TENSION_SHARE * held.tension[m]
        )
        fits[m] = False
        return bool(fits.any())

    def _search_order(self, suspects: Sequence[int]) -> Wait:
        """Find out whether commands wind in other muscles, and return if they do not.

        At first, no command demands more than T_bias, whichever muscle follows it. Then one command
        after the other moves inwards, until the tension of any muscle rises noticeably.

        Args:
            suspects: Indices of the muscles whose commands may be misplaced.

        Raises:
            WrongOrderError: If commands wind in other muscles.
            RunAwayError: If a tension exceeds ALARM.
        """
        if not len(suspects):
            return
        self._searches_order = True
        self._is_searched[:] = False
        clear = float(self._newest.length.max()) + CLEAR
        self._target[:] = clear
        yield from self._wait(RELEASE)
        tested, self._tested = self._tested, None  # from now on, ALARM limits every tension
        winds = dict[int, int]()
        for suspect in suspects:
            m: int | None = suspect
            while m is not None and m not in winds:
                other = yield from self._first_to_respond(m, clear)
                if other is not None:
                    winds[m] = other
                m = other
        self._searches_order = False
        if misplaced := {m: other for m, other in winds.items() if m != other}:
            raise WrongOrderError(misplaced)
        self._target[:] = self._mean().length
        yield from self._wait(SETTLE)
        self._tested = tested

    def _first_to_respond(self, m: int, clear: float) -> Generator[None, None, int | None]:
        """Move the command of muscle m inwards, and return the muscle whose tension rises first.

        Args:
            m: Index of the muscle.
            clear: Target at which no muscle pulls [m].

        Returns:
            The index of the muscle, or None if none responds.
        """
        before = self._mean()
        answer = self._response + 3.0 * np.maximum(self._noise(), self._swing)
        rise = (self._alarm - self._bias)[m] / self._robot.stiffness[m]
        speed = min(RELEASE_SPEED, SEARCH_SHARE * rise / LONGEST_ADVANCE)
        floor = float(before.length.min()) - FURTHEST
        last, found, count = self._now, None, 0
        self._is_searched[m] = True
        while self._target[m] > floor and count < CONFIRMATIONS:
            self._target[m] -= speed * self._since(last)
            last = self._now
            yield from self._wait(1e-9)
            rose = (self._newest.tension - before.tension) / answer
            m_rose = int(rose.argmax())
            count = count + 1 if rose[m_rose] > 1.0 and m_rose in (found, None) else 0
            found = m_rose if rose[m_rose] > 1.0 else None
        reached = self._newest.tension
        self._target[m] = clear
        self._is_searched[m] = False
        yield from self._wait(RELEASE)
        if found is None or count < CONFIRMATIONS:
            return None
        # A tension that the command has raised falls with the command.
        fell = (reached - self._mean().tension)[found]
        return found if fell > 0.5 * answer[found] else None

    def _ceiling(self) -> Array:
        """Return the highest tension [N], (M,), to demand of muscles that are not yet verified."""
        highest = self._most
        if self._tested is None:
            highest = self._bias + HELD * (self._highest - self._bias)
        # Noise of l must not reach the limit, which would change the mean tension.
        return highest + 2.0 * LENGTH_ERROR * self._robot.stiffness

    def _command(self, length: Array) -> Array:
        """Return the targets, limited for muscles that have not passed the test yet.

        At the measured l, `length` [m], (M,), no target then demands more than `_ceiling`.
        """
        nearest = length - (self._ceiling() - self._bias) / self._robot.stiffness
        most_inwards = np.where(self._is_verified | self._is_searched, -np.inf, nearest)
        self._sent = np.maximum(self._target, most_inwards)
        return self._sent.copy()

    def _demanded(self, length: Array) -> Array:
        """Return the tensions [N], (..., M), that the present commands demand.

        Args:
            length: Measured lengths [m], (..., M).
        """
        demand = self._robot.actuation.demanded(length, self._sent)
        assert demand is not None  # None only for modules that follow positions (`Positioning`)
        return demand

    def _mean(self) -> _Reading:
        readings = self._readings()
        # Average the demand and not l, because the demand is a nonlinear function of the noisy l.
        demand = self._demanded(readings.length)
        clipped = np.minimum(demand, self._robot.tension.max).mean(axis=0)
        mean = MuscleReadings.of_rows(readings.rows.mean(axis=0))
        return _Reading(mean.length, mean.tension, mean.temperature, clipped)

    def _off(self, reading: _Reading) -> Bools:
        """Return a mask (M,) of the muscles whose tension is not the one that the law demands."""
        tolerated = np.maximum(self._resting, TENSION_SHARE * reading.demand)
        wrong: Bools = np.abs(reading.tension - reading.demand) > tolerated
        return wrong

    def _wind(
        self, m: int, level: float, home: float, latency: list[float]
    ) -> Generator[None, None, _Reading]:
        """Wind a muscle in until the law demands a given tension, and return the last reading.

        If the arm yields, so that the muscle shortens, l_target moves further inwards, until the
        demand or the distance FURTHEST is reached.

        Args:
            m: Index of the muscle.
            level: The demanded tension [N].
            home: l before the test [m]; limits how far the muscle is wound in.
            latency: Receives the time to the response [s], unless noise could hide it.
        """
        before = self._mean()
        noise = max(self._swing[m], self._noise()[m])
        answer = self._response[m] + 2.0 * noise
        # On a stiff arm, the tension rises before the next message and does not rise further. The
        # latency is therefore only measured if this single rise is clear of the noise.
        hidden = answer + 3.0 * noise > level - before.demand[m]
        further = (level - self._bias[m]) / self._robot.stiffness[m]
        self._target[m] = before.length[m] - further
        start = last = self._now
        while True:
            length = self._newest.length
            lacking = self._demanded(length)[m] < level
            going_on = lacking and home - self._target[m] < FURTHEST + further
            if self._now - start >= HOLD and not going_on:
                break
            if lacking and self._now - start > 0.5 * HOLD:
                self._target[m] -= SPEED * self._since(last)
            last = self._now
            yield from self._wait(1e-9)
            length, tension = self._newest.length[m], self._newest.tension[m]
            pulled = abs(tension - before.tension[m]) > answer
            answered = pulled or before.length[m] - length > 2.0 * RESPONSE[1]
            if answered and not latency and not hidden:
                latency.append(self._now - start)
        yield from self._wait(HOLD)
        return self._mean()

    # -- checks -----------------------------------------------------------------------------------

    def _try(self, m: int) -> Wait:
        robot, verdict, home = self._robot, self.verdict, self._mean()
        #: times to the response, for half and for the whole demand [s]
        half, whole = list[float](), list[float]()
        # The demand before the test may exceed T_bias, because the muscle carries the arm's weight.
        rise = (self._highest - self._bias)[m]
        self._most = self._highest.copy()
        self._most[m] = home.demand[m] + rise
        yield from self._wind(m, home.demand[m] + 0.5 * rise, home.length[m], half)
        last = yield from self._wind(m, home.demand[m] + rise, home.length[m], whole)
        pulled, wound = last.tension - home.tension, home.length - last.length
        if self._may_be_misplaced(m, home, last):
            yield from self._go(m, home.length[m])
            yield from self._search_order([m])
        if not (abs(pulled[m]) > self._response[m] or wound[m] > RESPONSE[1]):
            yield from self._ask_outwards(m, home, pulled, wound)
            return
        verdict.passed('unit', m)
        if wound[m] < -RESPONSE[1]:
            detail = f'l rose by {-1e3 * wound[m]:.1f} mm while the muscle was wound in'
            verdict.failed('sign', m, detail=detail)
        verdict.passed('sign', m)
        if is_misplaced := (other := self._whose_tension(m, home, last)) != m:
            verdict.failed('tension place', m, other=robot.muscles[other])
        clip = robot.tension.max[m]
        if clip <= self._highest[m] and not is_misplaced:
            beyond = max((CLIP[0] * self._scale)[m], 2.0 * CLIP[1] * clip)
            beyond = min(beyond, MOST_BEYOND * clip)
            self._most[m] = clip + beyond
            past = yield from self._wind(m, clip + beyond, home.length[m], [])
            if past.tension[m] > (1.0 + CLIP[1]) * clip:
                verdict.failed('clip', m, got=past.tension[m], most=clip)
            verdict.passed('clip', m)
        yield from self._go(m, home.length[m])
        yield from self._go(m, self._mean().length[m] + SLACK)
        if not is_misplaced:
            self._judge_law(m, home, last, self._mean())
        yield from self._go(m, home.length[m])
        if half or whole:
            self._judge_latency(m, min(half + whole))

    def _judge_law(self, m: int, home: _Reading, last: _Reading, out: _Reading) -> None:
        """Judge whether the tension of muscle m obeys the control law of the modules.

        `home` is the reading before winding in, `last` that at the highest demand, and `out` that
        with l_target beyond l, at which the law demands T_bias only.
        """
        failed = self.verdict.failed
        asked, got = last.demand[m] - home.demand[m], last.tension[m] - home.tension[m]
        if asked < 0.25 * (self._highest - self._bias)[m]:
            note = f'{self._robot.muscles[m]}: the arm moved, so the control law was not checked'
            self.verdict.notes.append(note)
            return
        if abs(last.temperature[m] - home.temperature[m]) > 0.7 * asked and abs(got) < 0.3 * asked:
            failed('third row', m)
        elif not SLOPES[0] < got / asked < SLOPES[1]:
            failed('gain', m, got=got, asked=asked)
        elif self._off(out)[m]:
            failed('beyond l', m, got=out.tension[m], asked=out.demand[m])
        else:
            self.verdict.passed('law', m)

    def _may_be_misplaced(self, m: int, home: _Reading, last: _Reading) -> bool:
        """Return whether another muscle seems to have followed the command of muscle m.

        That muscle was then wound in further than muscle m, and its tension rose by more than the
        law demanded of it.
        """
        pulled, wound = last.tension - home.tension, home.length - last.length
        excess = pulled - (last.demand - home.demand)
        rose = excess > self._response + 3.0 * self._swing
        others = rose & (wound > np.maximum(wound[m], RESPONSE[1]))
        others[m] = False
        return bool(others.any()) and pulled[m] < SLOPES[0] * (last.demand - home.demand)[m]

    def _whose_tension(self, m: int, home: _Reading, last: _Reading) -> int:
        """Return the muscle whose tension responds when muscle m is wound in.

        This is m itself unless the tension of another muscle responds instead.
        """
        asked, got = last.demand - home.demand, last.tension - home.tension
        if asked[m] < 0.25 * (self._highest - self._bias)[m] or abs(got[m]) > 0.3 * asked[m]:
            return m
        other = int((got - asked).argmax())
        return other if SLOPES[0] < (got - asked)[other] / asked[m] < SLOPES[1] else m

    def _find_onset(
        self, m: int, home: _Reading
    ) -> Generator[None, None, tuple[float, float] | None]:
        """Return the target [m] at which the tension of muscle m begins to rise.

        The target moves slowly inwards and outwards. Its range contains the negative of the
        measured length, because the tension would rise there if a sign were wrong. The search ends
        at the first response. It also ends if the length or the tension stays exactly constant,
        which shows that the sensor is not read any more.

        Returns:
            The target and the length at that time [m], or None without a response. The target is
            corrected for the rise of T that was needed to notice the response, so that target and
            length differ only because their zeros do.
        """
        home_length, far = (
            home.length[m],
            2.0 * self._response[m] / self._robot.stiffness[m] + SLACK,
        )
        answer = self._response[m] + 3.0 * self._swing[m]
        inwards = min(home_length - FURTHEST, -home_length) - far
        for goal in (inwards, max(home_length, -home_length) + far):
            last, gone, direction = self._now, 0.0, np.sign(goal - home_length)
            while gone < abs(goal - home_length):
                yield
                gone += SPEED * self._since(last)
                last = self._now
                readings = self._readings()
                length, tension = readings.length[:, m], readings.tension[:, m]
                if np.ptp(length) == 0.0 or np.ptp(tension) == 0.0:
                    return None
                self._target[m] = home_length + direction * gone
                rise = float(tension[-1] - home.tension[m])
                if abs(rise) > answer:
                    onset = self._target[m] + rise / self._robot.stiffness[m]
                    return float(onset), float(length[-1])
            yield from self._go(m, home_length)
        return None

    def _ask_outwards(self, m: int, home: _Reading, pulled: Array, wound: Array) -> Wait:
        """Find out why a muscle did not respond to winding in, and record the fault.

        Args:
            m: Index of the muscle.
            home: The reading before the test.
            pulled: Increase of T of all muscles when muscle m was wound in [N], (M,).
            wound: Decrease of l of all muscles when muscle m was wound in [m], (M,).
        """
        other = int(np.where(wound > RESPONSE[1], pulled, -np.inf).argmax())
        yield from self._go(m, home.length[m])
        if other != m and pulled[other] > self._response[other]:
            yield from self._search_order([m])
            raise WrongOrderError({m: other})
        self._target[m] = home.length[m] + ((self._highest - self._bias) / self._robot.stiffness)[m]
        yield from self._wait(HOLD)
        answered = self._mean().tension[m] - home.tension[m] > self._response[m]
        yield from self._go(m, home.length[m])
        if answered:
            self.verdict.failed('outwards', m)
            return
        self._is_searched[m] = True
        onset = yield from self._find_onset(m, home)
        self._is_searched[m] = False
        self._target[m] = home.length[m]  # at once, not at RELEASE_SPEED
        yield from self._wait(RELEASE)
        if onset is None:
            self.verdict.failed('no answer', m)
            return
        at, length = onset
        what = 'other zero'
        if abs(at + length) < MIRROR_TOLERANCE:
            what = 'mirrored' if at < length else 'mirrored command'
        self.verdict.failed(what, m, at=1e3 * at, l=1e3 * length)
