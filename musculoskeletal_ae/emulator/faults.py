# SPDX-License-Identifier: Apache-2.0
"""Faults of wires, motors, sensors and their cables, switched while the arm moves.

A fault is one line, `KIND[:QUANTITY][:MUSCLE or JOINT][:SIZE]`: 'drop:0.3', 'stuck_motor:biceps',
'bias:tension:40', 'dead_sensor:elbow'. Without a name it is all muscles.
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array, Ints
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.validity import QUANTITIES

SPEED_LIMIT = 0.25  # [m/s] of a muscle module's motor; chosen
SPIKE_SHARE = 0.05  # of the readings have a spike, one muscle each


class Kind(NamedTuple):
    """What can be broken, and what its size means."""

    meaning: str
    size: float = 0.0  # by default
    most: float = 0.0  # 0: it has no size
    unit: str = ''
    of_muscle: bool = True
    of_quantity: bool = False


#: sizes of spike and bias by quantity, theta of a joint: default, most, unit
SIZES = {'length': (0.05, 1.0, 'm'), 'tension': (100.0, 1e4, 'N'),
         'temperature': (60.0, 1e3, '°C'), 'theta': (0.1, 3.2, 'rad')}  # fmt: skip
KINDS = {
    'drop': Kind('readings get lost', 0.5, 1.0, 'share', of_muscle=False),
    'delay': Kind('readings come late', 0.1, 10.0, 's', of_muscle=False),
    'duplicate': Kind('readings come twice', 0.5, 1.0, 'share', of_muscle=False),
    'reorder': Kind('readings come after the next one', 0.5, 1.0, 'share', of_muscle=False),
    'freeze': Kind('sensors repeat what they read', of_quantity=True),
    'dead_sensor': Kind('sensors read 0', of_quantity=True),
    'nan_sensor': Kind('sensors say NaN', of_quantity=True),
    'spike': Kind('sensors are off now and then', *SIZES['length'], of_quantity=True),
    'bias': Kind('sensors are off', *SIZES['length'], of_quantity=True),
    'stuck_motor': Kind('motors stand'),
    'winch_speed': Kind('motors are slower', 0.009, SPEED_LIMIT, 'm/s'),
    'unzeroed': Kind('lengths are off by 0.4 to 1 times this', 0.13, 1.0, 'm'),
    'slack': Kind('wires are longer', 0.05, 1.0, 'm'),
    'overheat': Kind('modules are hot', 90.0, 1e3, '°C'),
}
LEGAL = 'KIND[:QUANTITY][:MUSCLE or JOINT][:SIZE]; kinds: ' + ', '.join(KINDS)


class Readings(NamedTuple):
    """One sample of the arm's sensors."""

    theta: Array  # joint angles [rad], (D,)
    length: Array  # muscle lengths [m], (M,)
    tension: Array  # muscle tensions [N], (M,)
    temperature: Array  # housing temperatures of the modules [°C], (M,)


class Fault(NamedTuple):
    """One line, understood."""

    kind: str
    quantities: tuple[str, ...]
    which: Ints  # muscles, or joints where the quantity is theta
    size: float


def read_fault(line: str, robot: Robot) -> Fault:
    """Return what one line says.

    Raises:
        MusculoskeletalError: If it says nothing legal; the message says what is.
    """
    name, *words = (word.strip() for word in line.split(':'))
    if name not in KINDS:
        raise MusculoskeletalError(f'{line[:80]!r}; legal: {LEGAL}')
    kind = KINDS[name]
    quantities: tuple[str, ...] = QUANTITIES if kind.of_quantity else ()
    size, most, unit, least = kind.size, kind.most, kind.unit, 0.0
    if kind.of_quantity and words and words[0] in QUANTITIES:
        quantities = (words.pop(0),)
    elif kind.of_quantity and words and words[0] in robot.joints:
        quantities = ('theta',)
    elif kind.size:
        quantities = quantities[:1]  # of a spike or bias: length
    if quantities and kind.size:
        size, most, unit = SIZES[quantities[0]]
        unit, least = f'{unit} of {quantities[0]}', -most
    # A muscle may be called like a number.
    if words and most and ':'.join(words) not in robot.muscles:
        try:
            size = float(words[-1])
            words.pop()
        except ValueError:
            pass
    if not least <= size <= most:
        legal = f'sizes from {least:g} to {most:g} {unit}' if most else 'no size'
        raise MusculoskeletalError(f'{line[:80]!r}; legal: {legal}')
    if words and not kind.of_muscle:
        raise MusculoskeletalError(f'{line[:80]!r}; legal: {name}[:SIZE], which is of all readings')
    if quantities == ('theta',) and len(words) == 1:
        return Fault(name, quantities, np.array([robot.joints.index(words[0])]), size)
    muscles = robot.muscle_indices([':'.join(words)] if words else robot.muscles)
    return Fault(name, quantities, np.array(muscles), size)


class Faults:
    """All faults of one arm."""

    def __init__(self, robot: Robot, rng: np.random.Generator) -> None:
        """Nothing is broken."""
        self._robot, self._rng = robot, rng
        self._faults: tuple[Fault, ...] = ()
        self._frozen: dict[tuple[str, int], float] = {}
        self._held: Readings | None = None  # to come after the next one
        self._queue: list[tuple[float, Readings]] = []
        # What the mechanics follows, each (M,): share of its speed that a motor lacks, wire too
        # long [m], length read too long [m], and the least temperature of the housing [°C].
        self.stuck, self.slack, self.zero, self.hot = np.zeros((4, robot.muscle_count))
        self._forgotten = rng.spawn(1)[0].uniform(0.4, 1.0, (2, robot.muscle_count))
        self._forgotten = np.where(self._forgotten[1] < 0.7, -1.0, 1.0) * self._forgotten[0]
        self.set([])

    def set(self, lines: Iterable[str]) -> None:
        """Break what the lines say and mend all else.

        Raises:
            MusculoskeletalError: If one says nothing legal; nothing changes then.
        """
        before = self._late()
        self._faults = tuple(read_fault(line, self._robot) for line in lines)
        still = {(name, m) for f in self._of('freeze') for name in f.quantities for m in f.which}
        self._frozen = {one: read for one, read in self._frozen.items() if one in still}
        if not self._of('reorder'):
            self._held = None
        if self._late() != before:  # what is on the way would come between what is newer
            self._queue.clear()
        self.stuck[:] = self.slack[:] = self.zero[:] = 0.0
        self.hot[:] = -np.inf
        for fault in self._of('winch_speed'):
            self.stuck[fault.which] = 1.0 - fault.size / SPEED_LIMIT
        for fault in self._of('stuck_motor'):
            self.stuck[fault.which] = 1.0
        for kind, sizes in (('slack', self.slack), ('unzeroed', self.zero), ('overheat', self.hot)):
            for fault in self._of(kind):
                sizes[fault.which] = fault.size
        self.zero *= self._forgotten

    def _of(self, *names: str) -> list[Fault]:
        return [fault for fault in self._faults if fault.kind in names]

    def sensed(self, readings: Readings) -> Readings:
        """Return what the broken sensors read instead."""
        values = {name: getattr(readings, name).copy() for name in (*QUANTITIES, 'theta')}
        for fault in self._of('bias', 'spike', 'dead_sensor', 'nan_sensor', 'freeze'):
            for name in fault.quantities:
                value, which = values[name], fault.which
                if fault.kind == 'bias':
                    value[which] += fault.size
                elif fault.kind == 'dead_sensor':
                    value[which] = 0.0
                elif fault.kind == 'nan_sensor':
                    value[which] = np.nan
                elif fault.kind == 'freeze':
                    value[which] = [
                        self._frozen.setdefault((name, m), float(value[m])) for m in which
                    ]
                elif self._rng.random() < SPIKE_SHARE:
                    value[self._rng.choice(which)] += fault.size
        return readings._replace(**values)

    def _late(self) -> float:
        return sum(fault.size for fault in self._of('delay'))

    def _happens(self, name: str) -> bool:
        return any(self._rng.random() < fault.size for fault in self._of(name))

    def delivered(self, readings: Readings, now: float) -> list[Readings]:
        """Return what arrives at `now` [s], in this order, when `readings` have been sent."""
        sent = [] if self._happens('drop') else [readings]
        if sent and self._happens('duplicate'):
            sent *= 2
        if self._held is not None and sent:
            sent, self._held = [*sent, self._held], None
        elif sent and self._happens('reorder'):
            sent, self._held = [], readings
        self._queue += [(now + self._late(), one) for one in sent]
        due = [one for at, one in self._queue if at <= now]
        self._queue = [(at, one) for at, one in self._queue if at > now]
        return due
