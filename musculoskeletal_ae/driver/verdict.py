# SPDX-License-Identifier: Apache-2.0
"""What is judged of a driver, what may be wrong with it, and what came of it."""

from typing import Literal, NamedTuple, get_args

import numpy as np

from musculoskeletal_ae.files import read_table
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.schema import Strict

#: what is judged of each muscle: messages and their rate, rows and places in the array, units, the
#: sign and zero of l, the MSC law, its clip at tension.max, latency
Check = Literal['rate', 'order', 'unit', 'sign', 'zero', 'law', 'clip', 'latency']
CHECKS: tuple[Check, ...] = get_args(Check)
OK, WRONG, OPEN = 'ok', 'WRONG', '-'
LAW = 'T = min(T_max, T_bias + max(0, K (l − l_target))), T_bias {:g} N, K {:g} N/m'


class FaultTexts(Strict, frozen=True, array_like=True):
    """An entry of faults.yaml."""

    check: Check
    seen: str
    change: str


#: by what is wrong; those of a message that is rejected begin with its topic
FAULTS = read_table(__file__, 'faults.yaml', dict[str, FaultTexts])


class Fault(NamedTuple):
    """One thing that is not as it must be."""

    check: str
    muscles: tuple[int, ...]  # their numbers; all for a fault of the whole driver
    saw: str
    change: str


class Verdict:
    """The judgement on one driver."""

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        self._state = np.full((robot.muscle_count, len(CHECKS)), OPEN, dtype=object)
        self.faults: list[Fault] = []
        self.notes: list[str] = []  # what is no fault, or could not be judged

    def passed(self, check: str, *muscles: int) -> None:
        """Note that muscles (none: all) are as they must be, unless they were found wrong."""
        for m in muscles or range(self.robot.muscle_count):
            if self._state[m, CHECKS.index(check)] == OPEN:
                self._state[m, CHECKS.index(check)] = OK

    def failed(self, what: str, *muscles: int, **seen: object) -> None:
        """Note one of the FAULTS, of some muscles (none: of all), with what its texts name."""
        texts = FAULTS[what]
        if muscles:
            first, robot = muscles[0], self.robot
            seen['law'] = LAW.format(robot.tension.bias[first], robot.stiffness[first])
        muscles = muscles or tuple(range(self.robot.muscle_count))
        self._state[list(muscles), CHECKS.index(texts.check)] = WRONG
        change = texts.change.format(**seen)
        self.faults.append(Fault(texts.check, muscles, texts.seen.format(**seen), change))

    def add(self, other: 'Verdict') -> None:
        """Add what another verdict on the same driver found."""
        wrong = other._state == WRONG
        self._state[wrong] = WRONG
        self._state[(self._state == OPEN) & (other._state == OK)] = OK
        self.faults += other.faults
        self.notes += other.notes

    @property
    def wrong(self) -> set[str]:
        """Which of the CHECKS found a fault."""
        return {fault.check for fault in self.faults}

    def __str__(self) -> str:
        names = self.robot.muscles
        width = max(map(len, names)) + 2
        rows = zip(('', *names), (CHECKS, *self._state))
        lines = [f'{name:<{width}}' + ''.join(f'{cell:>9}' for cell in row) for name, row in rows]
        lines.append(f'{OPEN}: not judged')
        for fault in self.faults:
            whose = ', '.join(names[m] for m in fault.muscles)
            whose = 'all muscles' if len(fault.muscles) == len(names) else whose
            lines += [
                f'fault: {fault.check} of {whose}: {fault.saw}',
                f'    change: {fault.change}',
            ]
        return '\n'.join([*lines, *(f'note: {note}' for note in self.notes)])
