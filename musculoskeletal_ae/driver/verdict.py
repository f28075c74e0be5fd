# SPDX-License-Identifier: Apache-2.0
"""What is judged of a driver, and what came of it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.robot.robot import Robot

#: what is judged of each muscle: messages and their rate, rows and places in the array, units, the
#: sign and zero of l, the MSC law, its clip at tension.max, latency
CHECKS = ('rate', 'order', 'unit', 'sign', 'zero', 'law', 'clip', 'latency')
OK, WRONG, OPEN = 'ok', 'WRONG', '-'


class Fault(NamedTuple):
    """One thing that is not as it must be."""

    check: str
    muscles: tuple[int, ...]  # their numbers; all for a fault of the whole driver
    saw: str
    change: str


class Verdict:
    """The judgement on one driver."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        shape = robot.muscle_count, len(CHECKS)
        self._state = np.full(shape, OPEN, dtype=object)
        self.faults: list[Fault] = []
        self.notes: list[str] = []  # what is no fault, or could not be judged

    def passed(self, check: str, *muscles: int) -> None:
        """Note that muscles (none: all) are as they must be, unless they were found wrong."""
        column = self._state[list(muscles) or slice(None), CHECKS.index(check)]
        column[column != WRONG] = OK
        self._state[list(muscles) or slice(None), CHECKS.index(check)] = column

    def failed(self, check: str, muscles: tuple[int, ...], saw: str, change: str) -> None:
        """Note what was seen, of some muscles (none: of all), and what is to be changed."""
        muscles = muscles or tuple(range(self._robot.muscle_count))
        self._state[list(muscles), CHECKS.index(check)] = WRONG
        self.faults.append(Fault(check, muscles, saw, change))

    @property
    def wrong(self) -> set[str]:
        """Which of the CHECKS found a fault."""
        return {fault.check for fault in self.faults}

    def add(self, other: Verdict) -> None:
        """Take over what another one found."""
        self.faults += other.faults
        self.notes += other.notes
        rank = [OPEN, OK, WRONG]
        for at, state in np.ndenumerate(other._state):
            self._state[at] = max(self._state[at], state, key=rank.index)

    def __str__(self) -> str:
        names = self._robot.muscles
        width = max(map(len, names)) + 2
        lines = [' ' * width + ''.join(f'{check:>9}' for check in CHECKS)]
        for name, row in zip(names, self._state):
            lines.append(f'{name:<{width}}' + ''.join(f'{state:>9}' for state in row))
        lines.append(f'{OPEN}: not judged')
        for fault in self.faults:
            whose = ', '.join(names[m] for m in fault.muscles)
            whose = 'all muscles' if len(fault.muscles) == len(names) else whose
            lines.append(
                f'fault: {fault.check} of {whose}: {fault.saw}\n    change: {fault.change}'
            )
        return '\n'.join([*lines, *(f'note: {note}' for note in self.notes)])
