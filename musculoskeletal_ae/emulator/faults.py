# SPDX-License-Identifier: Apache-2.0
"""Faults of tendons, motors, sensors and communication, which can begin and end at any time.

A line `KIND[:QUANTITY][:MUSCLE or JOINT][:SIZE]` describes a fault, such as 'drop:0.3',
'stuck_motor:biceps', 'bias:tension:40', 'drift:theta:elbow:0.01' or 'dead_sensor:elbow'. If the
line names no muscle or joint, the fault affects all muscles. 'exchange:JOINT:JOINT' exchanges two
joint sensors, by default those of the first and the last joint. `mount_x` and `mount_y` turn the
base. The arm itself is then sound, but gravity acts in another direction than `robot.urdf` states.
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.signals.muscle_states import QUANTITIES, MuscleReadings

SPEED_LIMIT = 0.25  # wind no muscle module faster than this [m/s]; chosen by hand
TURN = 6.2832  # reject a turn of the base by more than this [rad], one revolution
SPIKE_SHARE = 0.05  # give one muscle a spike in this share of the readings
BURST_TIME, BURST_PAUSE = 0.3, 3.0  # let bursts and the pauses before them last this on average [s]


class FaultKind(NamedTuple):
    """A kind of fault: its effect, and the sizes, muscles and quantities that a line may state."""

    meaning: str
    size: float = 0.0  # size of the fault if its line states none, in the unit `unit`
    largest: float = 0.0  # largest legal size; 0 if the kind has no size
    unit: str = ''
    of_muscle: bool = True
    of_quantity: bool = False
    signed: bool = False  # whether the size may be negative


#: size of a spike or bias of each quantity (theta: joint angles): default, largest, unit
SIZES = {'length': (0.05, 1.0, 'm'), 'tension': (100.0, 1e4, 'N'),
         'temperature': (60.0, 1e3, '°C'), 'theta': (0.1, 3.2, 'rad')}  # fmt: skip
#: rate of a drift of each quantity: default, largest, unit
RATES = {'length': (1e-4, 0.1, 'm/s'), 'tension': (1.0, 1e3, 'N/s'),
         'temperature': (0.1, 1e2, '°C/s'), 'theta': (0.01, 1.0, 'rad/s')}  # fmt: skip
KINDS = {
    'drop': FaultKind('readings are lost', 0.5, 1.0, 'share', of_muscle=False),
    'delay': FaultKind('readings are delayed', 0.1, 10.0, 's', of_muscle=False),
    'duplicate': FaultKind('readings arrive twice', 0.5, 1.0, 'share', of_muscle=False),
    'reorder': FaultKind(
        'readings are swapped with the next one', 0.5, 1.0, 'share', of_muscle=False
    ),
    'freeze': FaultKind('sensors repeat their last value', of_quantity=True),
    'dead_sensor': FaultKind('sensors read 0', of_quantity=True),
    'nan_sensor': FaultKind('sensors read NaN', of_quantity=True),
    'spike': FaultKind('sensors have spikes of this size', *SIZES['length'], of_quantity=True),
    'bias': FaultKind('sensors have this offset', *SIZES['length'], of_quantity=True),
    'drift': FaultKind('sensors drift at this rate', *RATES['length'], of_quantity=True),
    'burst': FaultKind('sensors read this value in bursts', *SIZES['length'], of_quantity=True),
    'exchange': FaultKind('two joint sensors are exchanged', of_muscle=False),
    'rupture': FaultKind('tendons are ruptured'),
    'stuck_motor': FaultKind('motors are jammed'),
    'winch_speed': FaultKind('motors are limited to this speed', 0.009, SPEED_LIMIT, 'm/s'),
    'unzeroed': FaultKind('lengths have offsets of 0.4 to 1 times this size', 0.13, 1.0, 'm'),
    'offset': FaultKind('lengths have this offset', 0.05, 1.0, 'm', signed=True),
    'slack': FaultKind('tendons are longer by this size', 0.05, 1.0, 'm'),
    'overheat': FaultKind('modules have at least this temperature', 90.0, 1e3, '°C'),
    'saturate': FaultKind('tension sensors read at most this tension', 150.0, 1e4, 'N'),
    'mount_x': FaultKind('the base is turned about x', np.pi, TURN, 'rad', of_muscle=False),
    'mount_y': FaultKind('the base is turned about y', np.pi, TURN, 'rad', of_muscle=False),
}
LEGAL = 'KIND[:QUANTITY][:MUSCLE or JOINT][:SIZE]; kinds: ' + ', '.join(KINDS)


class ArmReadings(NamedTuple):
    """Readings of all sensors of an arm at one moment."""

    theta: Array  # joint angles [rad], (D,)
    muscles: MuscleReadings


#: names of the quantities whose sensors can be emulated as faulty
SENSED = tuple(quantity.name for quantity in QUANTITIES if quantity.name in SIZES)


class EmulatedFault(NamedTuple):
    """One fault, as a line describes it: its kind, the parts that it affects, and its size."""

    kind: str
    quantities: tuple[str, ...]
    which: tuple[int, ...]  # indices of the muscles, or of the joints if the quantity is theta
    size: float


def read_fault(line: str, robot: Robot) -> EmulatedFault:
    """Read the fault that a line describes.

    Raises:
        MusculoskeletalError: If the line is not legal; the message lists the legal forms.
    """
    name, *words = (word.strip() for word in line.split(':'))
    if name not in KINDS:
        raise MusculoskeletalError(f'fault {line[:80]!r}: unknown kind; legal: {LEGAL}')
    kind = KINDS[name]
    if name == 'exchange':
        words = words or [robot.joints[0], robot.joints[-1]]
        if len(words) != 2 or not set(words) <= set(robot.joints):
            legal = f'exchange:JOINT:JOINT; joints: {", ".join(robot.joints)}'
            problem = f'fault {line[:80]!r}: expected two joints'
            raise MusculoskeletalError(f'{problem}; legal: {legal}')
        exchanged = tuple(robot.joints.index(word) for word in words)
        return EmulatedFault(name, ('theta',), exchanged, 0.0)
    quantities: tuple[str, ...] = SENSED if kind.of_quantity else ()
    size, largest, unit = kind.size, kind.largest, kind.unit
    smallest = -largest if kind.signed else 0.0
    if kind.of_quantity and words and words[0] in SENSED:
        quantities = (words.pop(0),)
    elif kind.of_quantity and words and words[0] in ('theta', *robot.joints):
        words, quantities = words[words[0] == 'theta' :], ('theta',)
    elif kind.size:
        quantities = quantities[:1]  # without a quantity, faults with a size affect lengths
    if quantities and kind.size:
        size, largest, unit = (RATES if name == 'drift' else SIZES)[quantities[0]]
        unit, smallest = f'{unit} of {quantities[0]}', -largest
    # The last word is the size, or the name of a muscle, which may be a number.
    if words and largest and ':'.join(words) not in robot.muscles:
        try:
            size = float(words[-1])
            words.pop()
        except ValueError:
            pass
    if not smallest <= size <= largest:
        legal = f'sizes from {smallest:g} to {largest:g} {unit}'
        raise MusculoskeletalError(f'fault {line[:80]!r}: wrong size; legal: {legal}')
    if words and not kind.of_muscle:
        legal = f'{name}[:SIZE], without the name of a muscle or joint'
        raise MusculoskeletalError(f'fault {line[:80]!r} concerns the whole arm; legal: {legal}')
    if quantities == ('theta',):
        if unknown := [word for word in words if word not in robot.joints]:
            problem = f'fault {line[:80]!r}: unknown joint {unknown[0]!r}'
            raise MusculoskeletalError(f'{problem}; legal: {", ".join(robot.joints)}')
        joints = [robot.joints.index(word) for word in words] or range(robot.joint_count)
        return EmulatedFault(name, quantities, tuple(joints), size)
    muscles = robot.muscle_indices([':'.join(words)] if words else robot.muscles)
    return EmulatedFault(name, quantities, tuple(muscles), size)


class Faults:
    """All active faults of one arm; changes the readings of its sensors accordingly."""

    def __init__(self, robot: Robot, rng: np.random.Generator) -> None:
        """Start without faults."""
        self._robot, self._rng = robot, rng
        self._faults: tuple[EmulatedFault, ...] = ()
        self._frozen: dict[tuple[str, int], float] = {}
        self._reordered: ArmReadings | None = None  # readings that are sent after the next ones
        self._queue: list[tuple[float, ArmReadings]] = []
        self._time = 0.0  # time since the start [s]
        self._begins: dict[EmulatedFault, float] = {}  # start of each drift [s]
        #: time of the next change of each burst [s], and whether the burst is present
        self._bursts: dict[EmulatedFault, tuple[float, bool]] = {}
        # Effects on the mechanics, each (M,): relative loss of motor speed, excess length of the
        # tendon [m], offset of the length sensor [m], minimum temperature of the housing [°C],
        # highest reading of the tension sensor [N], to which the module reacts as well, and 1 for a
        # ruptured tendon.
        count = robot.muscle_count
        self.stuck, self.slack, self.zero, self.hot, self.ceiling, self.ruptured = np.zeros(
            (6, count)
        )
        size, sign = rng.spawn(1)[0].uniform(0.4, 1.0, (2, robot.muscle_count))
        #: turn of the base: the rotation matrix from its frame to that of `robot.urdf`, (3, 3)
        self.mount: Array = np.eye(3)
        self._unzeroed_factor = np.where(sign < 0.7, -1.0, 1.0) * size
        self.set([])

    def set(self, lines: Iterable[str]) -> None:
        """Set the active faults to those that the lines describe.

        Raises:
            MusculoskeletalError: If a line is not legal; the faults are then unchanged.
        """
        delay = self._delay()
        self._faults = tuple(read_fault(line, self._robot) for line in lines)
        frozen = {(name, m) for f in self._of('freeze') for name in f.quantities for m in f.which}
        self._frozen = {key: value for key, value in self._frozen.items() if key in frozen}
        self._begins = {f: self._begins.get(f, self._time) for f in self._of('drift')}
        self._bursts = {f: self._bursts.get(f, (self._time, True)) for f in self._of('burst')}
        if not self._of('reorder'):
            self._reordered = None
        if self._delay() != delay:  # otherwise, queued readings would arrive out of order
            self._queue.clear()
        self.stuck[:] = self.slack[:] = self.zero[:] = self.ruptured[:] = 0.0
        self.hot[:], self.ceiling[:] = -np.inf, np.inf
        for fault in self._of('winch_speed'):
            self.stuck[[*fault.which]] = 1.0 - fault.size / SPEED_LIMIT
        for fault in self._of('stuck_motor'):
            self.stuck[[*fault.which]] = 1.0
        sizes_of = {
            'slack': self.slack,
            'unzeroed': self.zero,
            'overheat': self.hot,
            'saturate': self.ceiling,
        }
        for kind, sizes in sizes_of.items():
            for fault in self._of(kind):
                sizes[[*fault.which]] = fault.size
        self.zero *= self._unzeroed_factor
        for fault in self._of('offset'):
            self.zero[[*fault.which]] += fault.size
        for fault in self._of('rupture'):
            self.ruptured[[*fault.which]] = 1.0
        self.mount = np.eye(3)
        for fault in self._of('mount_x', 'mount_y'):
            axis = np.array([fault.kind == 'mount_x', fault.kind == 'mount_y', False], dtype=float)
            self.mount = self.mount @ pin.exp3(fault.size * axis)

    def _of(self, *names: str) -> list[EmulatedFault]:
        return [fault for fault in self._faults if fault.kind in names]

    def pass_time(self, duration: float) -> None:
        """Let the time `duration` [s] pass, so that drifts grow, and bursts begin and end."""
        self._time += duration

    def _is_in_burst(self, fault: EmulatedFault) -> bool:
        until, is_present = self._bursts[fault]
        while self._time >= until:
            is_present = not is_present
            until += self._rng.exponential(BURST_TIME if is_present else BURST_PAUSE)
        self._bursts[fault] = until, is_present
        return is_present

    def apply(self, readings: ArmReadings) -> ArmReadings:
        """Apply all sensor faults to readings, and return the result."""
        theta, muscles = readings.theta.copy(), readings.muscles.copy()
        muscles.tension = np.minimum(muscles.tension, self.ceiling)
        # Most of these arrays are views of `muscles`, so the faults change its readings in place.
        values = {each.name: each.of(muscles) for each in QUANTITIES} | {'theta': theta}
        kinds = 'exchange', 'bias', 'drift', 'burst', 'spike', 'dead_sensor', 'nan_sensor', 'freeze'
        for fault in self._of(*kinds):
            is_in_burst = fault.kind == 'burst' and self._is_in_burst(fault)
            for name in fault.quantities:
                value, which = values[name], np.array(fault.which)
                size = np.full(len(which), fault.size)
                if name == 'theta':  # the size of such a fault is stated in the units of the joints
                    size = self._robot.units.to_theta(size, which)
                if fault.kind == 'bias':
                    value[which] += size
                elif fault.kind == 'exchange':
                    units = self._robot.units  # positions are what the sensors publish
                    value[which] = units.to_theta(units.to_position(value)[which[::-1]], which)
                elif fault.kind == 'drift':
                    value[which] += size * (self._time - self._begins[fault])
                elif fault.kind == 'burst':
                    value[which] = np.where(is_in_burst, size, value[which])
                elif fault.kind == 'dead_sensor':
                    value[which] = 0.0
                elif fault.kind == 'nan_sensor':
                    value[which] = np.nan
                elif fault.kind == 'freeze':
                    value[which] = [
                        self._frozen.setdefault((name, m), float(value[m])) for m in which
                    ]
                elif self._rng.random() < SPIKE_SHARE:
                    hit = which == self._rng.choice(which)
                    value[which[hit]] += size[hit]
        return ArmReadings(theta, muscles)

    def _delay(self) -> float:
        return sum(fault.size for fault in self._of('delay'))

    def _happens(self, name: str) -> bool:
        return any(self._rng.random() < fault.size for fault in self._of(name))

    def deliver(self, readings: ArmReadings, now: float) -> list[ArmReadings]:
        """Send `readings` at the time `now` [s], with all faults of communication applied.

        Readings can be lost, duplicated, delayed or swapped with the next ones.

        Returns:
            The readings that arrive at `now`, in the order of arrival; they may have been sent
            earlier. The list is empty if none arrive.
        """
        sent = [] if self._happens('drop') else [readings]
        if sent and self._happens('duplicate'):
            sent *= 2
        if self._reordered is not None and sent:
            sent, self._reordered = [*sent, self._reordered], None
        elif sent and self._happens('reorder'):
            sent, self._reordered = [], readings
        self._queue += [(now + self._delay(), one) for one in sent]
        due = [one for at, one in self._queue if at <= now]
        self._queue = [(at, one) for at, one in self._queue if at > now]
        return due
