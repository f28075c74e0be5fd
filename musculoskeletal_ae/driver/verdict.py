# SPDX-License-Identifier: Apache-2.0
"""What is judged of a driver, what may be wrong with it, and what came of it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.robot.robot import Robot

#: what is judged of each muscle: messages and their rate, rows and places in the array, units, the
#: sign and zero of l, the MSC law, its clip at tension.max, latency
CHECKS = ('rate', 'order', 'unit', 'sign', 'zero', 'law', 'clip', 'latency')
OK, WRONG, OPEN = 'ok', 'WRONG', '-'
LAW = 'T = min(T_max, T_bias + max(0, K (l − l_target))), T_bias {bias:g} N, K {k:g} N/m'
#: check, what was seen, what to change, by what is wrong (messages: why they are rejected)
FAULTS = {
    'silent': ('rate', 'no muscle_states came', 'publish them; see namespace and ROS_DOMAIN_ID'),
    'several': ('rate', '{n} nodes publish {topic}', 'one driver, and no emulator beside it'),
    'type': ('order', '{topic} is a {type}', 'publish a std_msgs/msg/Float64MultiArray'),
    'not finite': ('rate', '{told}',
                   'publish no NaN or infinity (but NaN for a temperature that is not measured)'),
    'missing joint': ('order', '{told}', 'name the joints as muscles.yaml does; all are wanted'),
    'wrong length': ('order', '{told}',
                     'publish 3×M values: row length, row tension, row temperature'),
    'wrong layout': ('order', '{told}',
                     "layout.dim is ('quantity', 3, 3M), ('muscle', M, M), or empty"),
    'refused': ('order', '{told}', 'see the contract in doc/your_robot.md'),
    'rate': ('rate', 'muscle_states came at {rate:.0f} Hz',
             'publish at {wanted:g} Hz, or say the rate: --rate here, `rate` of the nodes'),
    'gap': ('rate', 'nothing came for {gap:.2f} s',
            'read and publish in a loop of its own; nothing in it may wait'),
    'repeated': ('rate', '{share:.0f} % of the messages repeat the one before',
                 'publish each reading once, when it has been read'),
    'stuck': ('rate', 'the same reading in every message', 'is this module read at all?'),
    'silence': ('rate', 'no muscle_states for {gap:g} s while it was commanded',
                'keep publishing, whatever is commanded'),
    'rows': ('order', 'the rows look like {rows}', 'publish length, tension, temperature'),
    'by muscle': ('order', 'the values of each muscle stand together',
                  'publish 3 rows: length, tension, temperature'),
    'kelvin': ('unit', 'temperatures look like K', 'publish °C'),
    'length unit': ('unit', 'lengths look like {unit}', 'publish m'),
    'length': ('unit', 'length {seen} m', 'is it m, and zero at θ = 0?'),
    'tension': ('unit', 'tension {seen} N', 'is it N, and does pull count as +?'),
    'temperature': ('unit', 'temperature {seen} °C', 'is it °C? NaN where there is none'),
    'joint': ('unit', 'joint {name} reads {theta:.3g} rad, {beyond:.2g} beyond its limits',
              'is it rad, with the zero of the URDF?'),
    'place': ('order', 'it behaves like {other}', 'publish muscles in the order of muscles.yaml'),
    'sign': ('sign', '{told}', 'l must fall when the motor winds in'),
    'slope': ('unit', '{told}', 'check the radius of the spool, its encoder, and the route'),
    'zero': ('zero', 'l is {off:+.0f} mm from what the routes say at this posture and tension',
             'l must be 0 at θ = 0 without tension: subtract this, or call estimator/zero'),
    'deaf': ('law', 'nobody subscribes to {topic}', 'let the driver follow it'),
    'ran away': ('law', '{told}',
                 'it was let go: sign and unit of l, T and of the command; is T = T_bias + …?'),
    'no answer': ('law', 'it does not respond to muscle_length_command',
                  'is the motor on, the command in m, and taken from the topic of this namespace?'),
    'other one': ('order', '{other} winds in instead',
                  'take commands in the order of muscles.yaml'),
    'outwards': ('sign', 'a longer l_target winds it in',
                 'l and l_target must fall when the motor winds in'),
    'hold': ('law', 'T is {got:.0f} N where the law asks for {asked:.0f} N',
             f'{LAW}; is the wire slack, is T in N and its zero right?'),
    'third row': ('order', 'row 3 does what tension must', 'publish length, tension, temperature'),
    'gain': ('law', 'T changes by {got:.0f} N where the law asks for {asked:.0f} N',
             f'{LAW}, l as published; is T in N?'),
    'beyond l': ('law', 'T is {got:.0f} N, not {asked:.0f} N, with l_target beyond l: max(0, …)',
                 LAW),
    'clip': ('clip', 'T is {got:.0f} N, tension.max {most:g} N', LAW),
    'late': ('latency', '{late:.0f} ms from command to the first change',
             'at most {most:.0f}: no queues, no filters, one cycle of the bus'),
}  # fmt: skip


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
        check, saw, change = FAULTS[what]
        if muscles:
            first, robot = muscles[0], self.robot
            seen |= {'bias': robot.tension.bias[first], 'k': robot.stiffness[first]}
        muscles = muscles or tuple(range(self.robot.muscle_count))
        self._state[list(muscles), CHECKS.index(check)] = WRONG
        self.faults.append(Fault(check, muscles, saw.format(**seen), change.format(**seen)))

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
