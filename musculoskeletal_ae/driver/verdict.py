# SPDX-License-Identifier: Apache-2.0
"""The checks of a driver, the problems that they can find, and the verdict."""

from collections.abc import Collection, Sequence
from itertools import chain, compress
from typing import Literal, get_args

import numpy as np

from musculoskeletal_ae.arrays import Bools
from musculoskeletal_ae.problems import Problem, read_problems
from musculoskeletal_ae.report import load_text
from musculoskeletal_ae.robot.model_errors import LARGEST
from musculoskeletal_ae.robot.robot import Robot

#: checks of each muscle: messages and their rate, order of rows and columns, units, sign and zero
#: of l, the MSC law, its clip at tension.max, and latency
Check = Literal['rate', 'order', 'unit', 'sign', 'zero', 'law', 'clip', 'latency']
CHECKS: tuple[Check, ...] = get_args(Check)
OK, WRONG, OPEN = 'ok', 'WRONG', '-'
POSITION_LAW = 'l → l_target, for as long as T is below T_max'
LAW = 'T = min(T_max, T_bias + max(0, K (l − l_target))), T_bias {:g} N, K {:g} N/m'


def _change_text(change: str) -> str:
    """Return the text of a change; if it has several steps, one numbered line for each."""
    steps = change.splitlines()
    if len(steps) == 1:
        return change
    return '\n            '.join(f'{n}. {step}' for n, step in enumerate(steps, 1))


#: problems by kind; kinds that reject messages begin with the topic. A row that states a subject is
#: about the joint angles, so that no muscle can be judged.
PROBLEMS = read_problems(__file__, 'driver_problems.yaml')


class Verdict:
    """The results of all checks of one driver."""

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        self._state = np.full((robot.muscle_count, len(CHECKS)), OPEN, dtype=object)
        self.faults: list[Problem] = []
        self.notes: list[str] = []  # remarks, and checks that were not possible
        #: checks that were not possible for all muscles, and how to make them possible
        self._remedies: list[tuple[tuple[Check, ...], str]] = []
        #: observations of checks that failed while this computer was overloaded, by check
        self._excused: dict[str, list[str]] = {}
        self._load = ''  # load of this computer at the first excused observation
        #: why the motion test must not begin although no fault was found; empty if it may begin
        self.obstacle = ''

    def passed(self, check: str, *muscles: int) -> None:
        """Record that muscles, by default all, passed a check, unless they have failed it."""
        for m in muscles or range(self.robot.muscle_count):
            if self._state[m, CHECKS.index(check)] == OPEN:
                self._state[m, CHECKS.index(check)] = OK

    def has_passed(self, check: Check, m: int) -> bool:
        """Return whether muscle m passed a check."""
        return bool(self._state[m, CHECKS.index(check)] == OK)

    def failed(self, what: str, *muscles: int, **values: object) -> None:
        """Record a fault.

        Args:
            what: Kind of the fault in PROBLEMS.
            muscles: Indices of the affected muscles. Without any, all muscles are affected.
            values: Values for the placeholders in the fault's texts.
        """
        problem = PROBLEMS[what]
        if muscles:
            first, robot = muscles[0], self.robot
            law = LAW.format(robot.tension.bias[first], robot.stiffness[first])
            values['law'] = robot.actuation.choose(law, POSITION_LAW)
        muscles = muscles or tuple(range(self.robot.muscle_count))
        self.faults.append(problem.filled(*(self.robot.muscles[m] for m in muscles), **values))
        if not problem.subjects:
            self._state[list(muscles), CHECKS.index(problem.check)] = WRONG

    def excuse(self, check: Check, observation: str) -> None:
        """Record that a check is not judged, because this computer is overloaded.

        Args:
            check: The check that is not judged.
            observation: What would have been a fault on a computer that is not overloaded.
        """
        self._load = self._load or load_text()
        self._excused.setdefault(check, []).append(observation)

    def advise(self, checks: tuple[Check, ...], remedy: str) -> None:
        """Record how to make checks possible; the report names the muscles that still lack one."""
        self._remedies.append((checks, remedy))

    def forbid_motion(self, reason: str) -> None:
        """Record why the motion test must not begin although no fault was found."""
        self.obstacle = reason

    def add(self, other: 'Verdict') -> None:
        """Add the results of another verdict on the same driver."""
        wrong = other._state == WRONG
        self._state[wrong] = WRONG
        self._state[(self._state == OPEN) & (other._state == OK)] = OK
        self.faults += other.faults
        self.notes += other.notes
        self._remedies += other._remedies
        for check, observations in other._excused.items():
            self._excused.setdefault(check, []).extend(observations)
        self.obstacle = self.obstacle or other.obstacle

    @property
    def allows_motion(self) -> bool:
        """Whether the motion test may begin: no fault was found, and the rate is high enough.

        Even a harmless fault forbids motion, because it may be mistaken for a dangerous one. For
        example, lengths of wrong sign can look like lengths with wrong zeros.
        """
        return not self.faults and not self.obstacle

    @property
    def wrong(self) -> set[str]:
        """Names of the checks that found a fault; a subset of CHECKS."""
        return {fault.check for fault in self.faults}

    @property
    def conclusion(self) -> str:
        """The last line of the report.

        If faults were found, it says that the check has failed. If every check was possible for
        every muscle, it says that the driver keeps its contract. Otherwise it names the checks
        that were not possible.
        """
        if self.faults:
            return 'driver check FAILED: fix the faults above'
        if not (unjudged := self._unjudged(CHECKS)):
            return 'the driver keeps its contract'
        return f'no fault found; not judged: {unjudged}'

    def _unjudged(self, checks: Sequence[Check], excluded: Bools | None = None) -> str:
        """Return which of these checks were not made, and for which muscles; '' if all were.

        Args:
            checks: The checks to look up.
            excluded: Muscles to leave out, (M,); None for none.
        """
        names: dict[str, list[str]] = {}  # checks by the muscles that they did not judge
        for check in checks:
            is_open = self._state[:, CHECKS.index(check)] == OPEN
            if excluded is not None:
                is_open &= ~excluded
            if is_open.any():
                whose = self._whose([*compress(self.robot.muscles, is_open)])
                names.setdefault(whose, []).append(check)
        return '; '.join(f'{", ".join(checks)} of {whose}' for whose, checks in names.items())

    def _whose(self, subjects: Collection[str]) -> str:
        """Return the names of subjects, separated by commas, or 'all muscles' for all of them."""
        return 'all muscles' if {*subjects} == {*self.robot.muscles} else ', '.join(subjects)

    @property
    def table(self) -> str:
        """The result of each check for each muscle."""
        names = self.robot.muscles
        width = max(map(len, names)) + 2
        rows = zip(('', *names), (CHECKS, *self._state))
        lines = [f'{name:<{width}}' + ''.join(f'{cell:>9}' for cell in row) for name, row in rows]
        return '\n'.join(lines)

    @property
    def remarks(self) -> list[str]:
        """Explanations of the table: faults, checks that were not possible, and notes."""
        remarks = [f'{OPEN}: not judged']
        if (self._state[:, CHECKS.index('zero')] == OK).any():
            tolerance = f'{1e3 * LARGEST:.0f} mm'
            remarks.append(
                f'zero ok: l agrees with the modelled route to {tolerance}; this check cannot '
                'detect smaller errors'
            )
        remarks += [
            f'fault: {fault.check} of {self._whose(fault.subjects)}: {fault.text}\n'
            f'    change: {_change_text(fault.remedy)}'
            for fault in self.faults
        ]
        if self._excused:
            observations = '; '.join(chain.from_iterable(self._excused.values()))
            remarks.append(
                f'not judged: {", ".join(self._excused)} (this computer is overloaded, load '
                f'{self._load}): {observations}. A driver that runs here may be slow for this '
                'reason alone: end other programs and repeat the check'
            )
        remarks += [f'note: {note}' for note in self.notes]
        # If order, unit or sign of a muscle is wrong, its other checks are open for this reason,
        # and the remedy would not help.
        columns = [CHECKS.index(check) for check in ('order', 'unit', 'sign')]
        has_fault: Bools = (self._state[:, columns] == WRONG).any(axis=1)
        has_fault |= any(PROBLEMS[fault.kind].subjects for fault in self.faults)
        for checks, remedy in self._remedies:
            if unjudged := self._unjudged(checks, has_fault):
                remarks.append(f'note: {unjudged} not judged: {remedy}')
        return remarks

    def __str__(self) -> str:
        return '\n'.join([self.table, *self.remarks])
