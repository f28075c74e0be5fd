# SPDX-License-Identifier: Apache-2.0
"""Common parts of the motion tests of both kinds of muscle modules.

A muscle that departs too far from its commands is said to run away. It is then released, and the
test ends. Each kind of test defines when a muscle runs away (`MotionTest._run_away`).

Since the test also moves the joints, their sensors are compared with the lengths afterwards.
"""

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Generator, Sequence
from typing import Literal

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools, Ints
from musculoskeletal_ae.driver.order import EXCHANGE_BETTER, judge_order, wrong_side
from musculoskeletal_ae.driver.verdict import PROBLEMS, Verdict
from musculoskeletal_ae.report import is_overloaded
from musculoskeletal_ae.signals.joint_sensors import corrected, judge, sign_notes
from musculoskeletal_ae.signals.muscle_states import MuscleReadings
from musculoskeletal_ae.signals.wiring import WiringJudgement

#: pay a released muscle out for this time, and let a muscle settle for this time after its target
#: has moved back [s]
RELEASE = 0.6
MEAN = 0.3  # average the readings over this time at the end of a wait [s]
#: let the arm come to rest for this time after a motion, before its readings are judged [s]
SETTLE = 1.5
HOLD = 0.5  # judge the response to a command after holding it for this time [s]
SPEED = 0.01  # move the target length of the tested muscle inwards at this speed [m/s]
RELEASE_SPEED = 0.03  # move the target length of the tested muscle back at this speed [m/s]
ABOVE_BIAS = 40.0  # without --tension, test muscles up to this tension above T_bias [N]
#: release a muscle whose tension exceeds the highest or the demanded tension by this [N]
RUN_AWAY_TENSION = 60.0
MOMENT = 0.1  # let a muscle exceed a limit for this time, for example because the arm falls [s]
LATEST = 0.1  # report a fault if a module takes longer to respond to a command [s]
#: let a moving target advance for at most this time between two messages, so that it does not jump
#: after a gap [s]
LONGEST_ADVANCE = 0.05
#: count a change of T [N] or l [m] that exceeds the noise by this as a response to a command
RESPONSE = 4.0, 0.0006

#: a part of a test that takes time; each of its steps takes one message
Wait = Generator[None, None, None]


class RunAwayError(Exception):
    """A muscle runs away and must be released."""

    def __init__(self, muscle: int, fault: str, **values: object) -> None:
        """Store the arguments for `Verdict.failed`: the muscle, the fault, and its values."""
        super().__init__(fault)
        self.muscle, self.fault, self.values = muscle, fault, values


class WrongOrderError(Exception):
    """Commands wind in other muscles than those whose readings they should change."""

    def __init__(self, winds: dict[int, int]) -> None:
        """Store, for each muscle whose command winds in another one, which one that is."""
        super().__init__('wrong order')
        self.winds = winds


class MotionTest(ABC):
    """Moves one muscle at a time, with one command per message, and checks the responses."""

    _highest: Array  #: highest test tension [N] (M,)

    def __init__(self, verdict: Verdict, muscles: Sequence[int]) -> None:
        """Prepare to test the muscles with the given indices.

        Args:
            verdict: Receives the results.
            muscles: Indices of the muscles; if there are none, all muscles are tested.
        """
        self.verdict, robot = verdict, verdict.robot
        self._robot, self._muscles = robot, muscles or range(robot.muscle_count)
        #: index of the muscle that is being tested; None while the arm is held
        self._tested: int | None = None
        self.done = False
        #: whether each muscle has been tested in this run without a fault, (M,)
        self._is_verified: Bools = np.zeros(robot.muscle_count, dtype=bool)
        self._now = 0.0
        #: times [s] and readings of the messages of the last MEAN seconds
        self._recent: deque[tuple[float, MuscleReadings]] = deque()
        #: target lengths of the muscles [m], (M,); NaN before l is known
        self._target: Array = np.full(robot.muscle_count, np.nan)
        #: last time at which each muscle was within its limits [s]
        self._tame_at: Array = np.zeros(robot.muscle_count)
        #: θ (D,), readings and tested muscle of each message, −1 while the arm is held
        self._history: list[tuple[Array, MuscleReadings, int]] = []
        self._run = self._sequence()

    @property
    def trying(self) -> str:
        """The present step of the test, for messages: `hold`, or the name of a muscle."""
        return 'hold' if self._tested is None else self._robot.muscles[self._tested]

    def step(
        self, readings: MuscleReadings, now: float, theta: Array | None = None
    ) -> Array | None:
        """Continue the test with the newest readings, and return the next command.

        The command is l_target [m], (M,), or None if nothing is to be published.

        Args:
            readings: The readings of the newest message.
            now: Time [s].
            theta: θ of the joint sensors [rad], (D,), with NaN if unknown; None without sensors.
        """
        self._now = now
        if theta is not None:
            segment = -1 if self._tested is None else self._tested
            self._history.append((theta, readings, segment))
        self._recent.append((now, readings))
        while now - self._recent[0][0] > MEAN:
            self._recent.popleft()
        self.done = self.done or next(self._run, self) is self
        is_silent = self.done or np.isnan(self._target).any()
        return None if is_silent else self._command(readings.length)

    # -- differences between the kinds of modules -----------------------------------------------

    @abstractmethod
    def _command(self, length: Array) -> Array:
        """Return the command [m], (M,), for the present targets.

        Args:
            length: Measured lengths [m], (M,).
        """

    @abstractmethod
    def _hold(self) -> Wait:
        """Check that the modules hold the arm where it is."""

    @abstractmethod
    def _try(self, m: int) -> Wait:
        """Move muscle m, and check how its readings respond."""

    @abstractmethod
    def _run_away(self, newest: MuscleReadings, start: MuscleReadings) -> RunAwayError | None:
        """Return the error of a muscle that runs away, or None.

        Args:
            newest: The readings of the newest message.
            start: The readings of the newest message when the present wait began.
        """

    @abstractmethod
    def _release(self, error: RunAwayError) -> Generator[None, None, dict[int, int]]:
        """Release the muscle that has run away: pay it out within RELEASE seconds.

        A test may pay out all muscles instead, and may then search for a wrong order.

        Returns:
            Which muscle each command winds in; {} if unknown.
        """

    # -- common parts ---------------------------------------------------------------------------

    def _sequence(self) -> Wait:
        """Run the test: hold the arm, move each muscle, then judge the joint sensors."""
        try:
            yield from self._hold()
            for m in self._muscles:
                self._tested = m
                yield from self._try(m)
                faults = self.verdict.faults
                self._is_verified[m] = all(self.trying not in fault.subjects for fault in faults)
            self._judge_joints()
        except WrongOrderError as error:
            self._report_order(error.winds)
        except RunAwayError as error:
            # After the release no more commands follow, so that the modules go to their safe state.
            # The exception is a search for a wrong order, at less than the test tension.
            if winds := (yield from self._release(error)):
                self._report_order(winds)
            else:
                self.verdict.failed(error.fault, error.muscle, **error.values)

    def _report_order(self, winds: dict[int, int]) -> None:
        """Report that commands wind in other muscles: `winds[m]` is moved by the command of m."""
        names = self._robot.muscles
        (first, other), *more = winds.items()
        moves = [f'winding in {names[first]} moved the readings of {names[other]}']
        moves += [f'winding in {names[m]} those of {names[other]}' for m, other in more]
        misplaced = dict.fromkeys([*winds, *winds.values()])
        # Modules that follow positions hold their lengths, so a hand cannot move the arm.
        is_movable = self._robot.actuation.choose(self._knows_joints(), False)
        if side := self._wrong_side(winds):
            fault = f'misplaced {side}'
        else:
            fault = 'misplaced movable' if is_movable else 'misplaced'
        self.verdict.failed(fault, *misplaced, moves=', and '.join(moves), first=names[first])

    def _knows_joints(self) -> bool:
        """Return whether at least one message was received while all joint angles were known."""
        return any(np.isfinite(theta).all() for theta, _, _ in self._history)

    def _wrong_side(self, winds: dict[int, int]) -> Literal['readings', 'commands'] | None:
        """Return whether the readings or the commands are exchanged; None if it is unknown.

        `winds` is the column of the readings that responded to each muscle's command.
        """
        if any(self.verdict.has_passed('order', column) for column in winds.values()):
            return 'commands'  # the readings were checked while a hand moved the arm
        if not self._knows_joints():
            return None
        theta, length, tension, tested = self._columns()
        faults = judge(self._robot, theta, length, tension, segments=tested).faults
        return wrong_side(self._robot, theta, length, tension, tested, winds, faults)

    def _columns(self) -> tuple[Array, Array, Array, Ints]:
        """Return θ (N, D), l and T (N, M) and tested muscle (N,) of all messages."""
        theta, readings, tested = zip(*self._history, strict=True)
        stacked = MuscleReadings.stack(readings)
        return np.array(theta), stacked.length, stacked.tension, np.array(tested)

    def _judge_joints(self) -> None:
        """Judge the joint sensors by the lengths, unless the lengths are wrong."""
        verdict, robot = self.verdict, self._robot
        if not self._history or {'order', 'unit', 'sign'} & verdict.wrong:
            return
        theta, length, tension, tested = self._columns()
        if not self._knows_joints():
            verdict.notes.append('θ of some joints is unknown, so signs of θ were not checked')
            return
        judgement = judge(robot, theta, length, tension, segments=tested)
        order = judge_order(robot, theta, length, tension, tested)
        meant = corrected(theta, judgement.faults, robot.units)
        of_joints = judge_order(robot, meant, length, tension, tested)
        # A fault of the joint sensors is preferred, because it can look like exchanged antagonists.
        if order.is_faulty and (
            not judgement.faults or order.misfit < EXCHANGE_BETTER * of_joints.misfit
        ):
            # Modules that do not obey the law move in ways that look like another order.
            if 'law' not in verdict.wrong:
                self._report_misplaced(order)
            return
        for fault in judgement.faults:
            verdict.failed(fault.kind, names=', '.join(robot.joints[j] for j in fault.joints))
        if judgement.faults:
            if order.is_faulty:
                verdict.notes.append(
                    f'the lengths could also mean that {self._moves_like(order)}: check the order '
                    'of these muscles, too'
                )
            return
        for m in self._muscles:
            if m in order.right:
                verdict.passed('order', m)
        highest = float(self._highest.max())
        higher = min(1.5 * highest, float(robot.tension.limit.min()))
        again = f'Repeat the test with --tension {higher:.0f}, or move'
        remedy = (
            f'{again if higher > highest + 1.0 else "Move"} the arm by hand while check_driver '
            'listens'
        )
        verdict.notes += sign_notes(robot, judgement.right, remedy)

    def _report_misplaced(self, order: WiringJudgement) -> None:
        """Report muscles whose readings and commands are both misplaced."""
        moves = self._moves_like(order)
        self.verdict.failed('both misplaced', *order.wiring.misplaced, moves=moves)

    def _moves_like(self, order: WiringJudgement) -> str:
        names = self._robot.muscles
        moves = [f'{names[j]} moves like {names[k]}' for j, k in order.wiring.misplaced.items()]
        return ', and '.join(moves)

    def _wait(self, duration: float) -> Wait:
        """Wait for `duration` [s].

        Raises:
            RunAwayError: If a muscle runs away meanwhile.
        """
        end, start = self._now + duration, self._newest
        while self._now < end:
            yield
            if error := self._run_away(self._newest, start):
                raise error

    def _since(self, last: float) -> float:
        """Return the time [s] since `last`, but at most LONGEST_ADVANCE."""
        return min(self._now - last, LONGEST_ADVANCE)

    def _judge_latency(self, m: int, latency: float) -> None:
        """Judge the time [s] from a command to the first response of muscle m.

        A long time is no fault while this computer is overloaded, because commands and messages
        then wait for their processes.
        """
        if latency <= LATEST:
            self.verdict.passed('latency', m)
            return
        values = {'late': 1e3 * latency, 'most': 1e3 * LATEST}
        if is_overloaded():
            name, text = self._robot.muscles[m], PROBLEMS['late'].filled(**values).text
            self.verdict.excuse('latency', f'{name}: {text}')
        else:
            self.verdict.failed('late', m, **values)

    def _lasting(self, is_beyond: Bools) -> int | None:
        """Return a muscle that has been beyond its limits for longer than MOMENT, or None.

        `is_beyond` (M,) says which muscles are beyond their limits in the newest message.
        """
        self._tame_at[~is_beyond] = self._now
        is_wild = self._now - self._tame_at > MOMENT
        return int(is_wild.argmax()) if is_wild.any() else None

    @property
    def _newest(self) -> MuscleReadings:
        """The readings of the newest message."""
        return self._recent[-1][1]

    def _readings(self) -> MuscleReadings:
        """Return the readings of the last MEAN seconds, (N, M) of each quantity."""
        return MuscleReadings.stack(readings for _, readings in self._recent)

    def _noise(self) -> Array:
        """Return the standard deviations of the tensions [N], (M,), in the last MEAN seconds."""
        return np.std(self._readings().tension, axis=0)

    def _go(self, m: int, goal: float) -> Wait:
        """Move the target of muscle m to `goal` [m], then wait until the muscle has settled.

        The speed is RELEASE_SPEED, and the wait takes RELEASE seconds.
        """
        last = self._now
        while self._target[m] != goal:
            yield from self._wait(1e-9)
            most = RELEASE_SPEED * self._since(last)
            self._target[m] += np.clip(goal - self._target[m], -most, most)
            last = self._now
        yield from self._wait(RELEASE)
