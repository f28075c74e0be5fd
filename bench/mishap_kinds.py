# SPDX-License-Identifier: Apache-2.0
"""Mishaps of a laboratory: what happens, what may be stated about it, and how a person mends it.

A mishap declares which identifiers state it truly, and which are true but secondary. Statements of
`SELF` describe what a node itself does, and are never false. Every other warning or error while the
mishap lasts counts as false, and so does a statement that names only muscles and joints that are
not concerned. For conditions whose identifier this file does not know, the regular expression
`says` recognizes the text of a true statement.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin

from bench.lab import CONTROLLER, ESTIMATOR, LEARNER, CommandFault, Lab, Packet, ReadingFault
from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.conditions import ConditionKind
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.remedy_steps import Step
from musculoskeletal_ae.signals.muscle_states import MuscleReadings, Quantity

Rng = np.random.Generator

#: never count these as false: they describe what a node itself does in consequence of something
#: else, or only quote a reading or an estimate beyond its limits
SELF = frozenset({
    'implausible_estimate',
    'anomaly_detected', 'not_exploring', 'calibrating', 'learning_waits', 'gentle_only',
    'length_offsets_unknown', 'trajectory_slowed', 'nothing_to_learn', 'muscle_needed',
})  # fmt: skip
#: statements that a muscle is faulty, without saying which part of it
FAULTY = frozenset({'residual_distance', 'muscle_isolated'})
RUPTURE = FAULTY | {'slack_tendon'}
#: statements that a module does not follow: they name a jammed or weak motor, a wrong reading, and
#: lost commands as possible causes
NOT_FOLLOWING = frozenset({'module_not_following'})
JAM = FAULTY | NOT_FOLLOWING | {'slack_tendon'}
ONE_LENGTH = FAULTY | {'length_jump', 'length_disagrees'}
SEVERAL_LENGTHS = frozenset({'lengths_jumped', 'lengths_disagree'})
REVOKED = frozenset({'length_offsets_revoked', 'length_calibration_stuck'})
FROZEN = FAULTY | {'sensor_frozen'}
MISSING = FAULTY | {'values_missing', 'implausible_muscle_states', 'readings_rejected'}
TENSION_SENSOR = FAULTY | NOT_FOLLOWING | {
    'sensor_saturated', 'slack_tendon', 'overload',
}  # fmt: skip
JOINT = frozenset({
    'joint_sensors_doubted', 'joint_readings_impossible', 'joint_readings_missing',
})  # fmt: skip
#: statements that messages are rejected, and why; they are true while readings jump
REJECTED = frozenset({
    'implausible_muscle_states', 'readings_rejected', 'stale_muscle_states', 'stale_estimate',
})  # fmt: skip
STALE = frozenset({
    'stale_muscle_states', 'no_muscle_states', 'silent_topic', 'stale_estimate', 'slow_topic',
    'nothing_to_learn',
})  # fmt: skip
HEAT = frozenset({
    'tension_limited_by_heat', 'overheated', 'thermal_drift', 'module_changed',
})  # fmt: skip
OFF_TARGET = frozenset({
    'away_from_target', 'torque_missing', 'out_of_reach', 'overload', 'load_changed',
})  # fmt: skip
#: true symptoms of a base that is mounted in another direction
MOUNTED = OFF_TARGET | {'other_mounting'}
SOFTWARE = frozenset({
    Step.RESET_CONTROLLER, Step.RESET_ESTIMATOR, Step.CALIBRATE_LENGTHS, Step.EXPLORE,
    Step.EXPLORE_GENTLY, Step.RESTORE_MUSCLES, Step.WAIT_UNTIL_COOL, Step.REPORT_LOG,
    Step.CHANGE_TARGET,
})  # fmt: skip

SHOWN_ANGLE = 0.1  # expect a wrong joint angle to be noticed from this error on [rad]
SHOWN_LENGTH = 0.02  # expect a wrong length to be noticed from this error on [m]
SHOWN_TENSION = 20.0  # expect a wrong tension to be noticed from this error on [N]


def _at_once(_: Lab) -> bool:
    return True


@dataclass
class Case:
    """One mishap that has begun in a laboratory.

    Attributes:
        detail: The random size, muscle or joint of the mishap.
        mend: Mends the mishap, as a person does who has understood it.
        subjects: The muscles and joints that are concerned; () if the whole arm is.
        is_visible: Returns whether the nodes can notice the mishap in what they receive; called
            until it returns True.
        lasts: Time after which it ends by itself [s].
        settled_by: Steps of the nodes' advice each of which mends the mishap, without `mend`.
        found_at: Muscles and joints at which a person finds the fault, besides `subjects`.
    """

    detail: str
    mend: Callable[[Lab], object]
    subjects: tuple[str, ...] = ()
    is_visible: Callable[[Lab], bool] = _at_once
    lasts: float = math.inf
    settled_by: tuple[Step, ...] = ()
    found_at: tuple[str, ...] = ()


@dataclass(frozen=True)
class Mishap:
    """A kind of mishap.

    Attributes:
        name: Its name in tables.
        begin: Lets the mishap happen.
        true: Identifiers that state it truly.
        says: Regular expression; a statement with such a text states the mishap truly.
        allowed: Identifiers that are true but secondary.
        is_harmless: Whether the arm can simply go on. If so, nothing needs to be stated.
        holds: Whether the arm holds a posture when it begins; otherwise it explores.
        patience: Time for which an operator follows the advice [s].
    """

    name: str
    begin: Callable[[Lab, Rng], Case]
    true: frozenset[str] = frozenset()
    says: str = ''
    allowed: frozenset[str] = frozenset()
    is_harmless: bool = False
    holds: bool = False
    patience: float = 100.0


# -- changes of readings and commands --------------------------------------------------------------


def on_muscles(change: Callable[[float, MuscleReadings], None]) -> ReadingFault:
    """Return a fault that applies `change` to a copy of the readings of the muscle modules."""

    def fault(now: float, packet: Packet) -> list[Packet]:
        muscles = packet.muscles.copy()
        change(now, muscles)
        return [packet._replace(muscles=muscles)]

    return fault


def on_theta(change: Callable[[float, Array], None]) -> ReadingFault:
    """Return a fault that applies `change` to a copy of the joint angles, (D,)."""

    def fault(now: float, packet: Packet) -> list[Packet]:
        if packet.theta is None:
            return [packet]
        theta = packet.theta.copy()
        change(now, theta)
        return [packet._replace(theta=theta)]

    return fault


def silent(start: float, seconds: float) -> ReadingFault:
    """Return a fault in which the driver is silent for `seconds` after the time `start` [s]."""
    return lambda now, packet: [] if now < start + seconds else [packet]


def deaf(start: float, seconds: float) -> CommandFault:
    """Return a fault in which no command arrives for `seconds` after the time `start` [s]."""
    return lambda now, value: None if now < start + seconds else value


def _clear(lab: Lab) -> None:
    lab.wire.clear()
    lab.arm.set_faults([])


def _any(rng: Rng, names: tuple[str, ...] | list[str]) -> tuple[int, str]:
    number = int(rng.integers(len(names)))
    return number, names[number]


def _two(rng: Rng, names: tuple[str, ...] | list[str]) -> tuple[int, int]:
    first, second = rng.choice(len(names), 2, replace=False).tolist()
    return int(first), int(second)


def _sign(rng: Rng) -> float:
    return float(rng.choice((-1.0, 1.0)))


def _loaded(lab: Lab, rng: Rng) -> int:
    """Return a muscle that carries load, by the true tensions."""
    pull, bias = lab.arm.tension, lab.arm.robot.tension.bias
    loaded = np.flatnonzero(pull > bias + 2.0 * SHOWN_TENSION)
    return int(rng.choice(loaded)) if len(loaded) else int((pull - bias).argmax())


def _pulls_otherwise(muscle: int) -> Callable[[Lab], bool]:
    """Return a function that says whether the module of `muscle` does not pull as demanded.

    This is so if the tension deviates from the demanded one by more than SHOWN_TENSION.
    """

    def shown(lab: Lab) -> bool:
        sample, command = lab.controller.sample, lab.controller.limiter.command
        if sample is None or command is None:
            return False
        demand = lab.arm.robot.actuation.demanded(sample.length, command.value)
        return demand is not None and bool(
            abs(demand[muscle] - lab.arm.tension[muscle]) > SHOWN_TENSION
        )

    return shown


# -- tendons and modules ---------------------------------------------------------------------------


def rupture_under_load(lab: Lab, rng: Rng) -> Case:
    """A tendon ruptures while it carries load."""
    name = lab.arm.robot.muscles[_loaded(lab, rng)]
    lab.arm.set_faults([f'rupture:{name}'])
    return Case(name, _clear, (name,))


def rupture_at_rest(lab: Lab, rng: Rng) -> Case:
    """A tendon ruptures while it has the tension bias; noticed when it should carry load."""
    pull, bias = lab.arm.tension, lab.arm.robot.tension.bias
    idle = np.flatnonzero(pull < bias + 3.0)
    muscle = int(rng.choice(idle)) if len(idle) else int((pull - bias).argmin())
    name = lab.arm.robot.muscles[muscle]
    lab.arm.set_faults([f'rupture:{name}'])
    return Case(name, _clear, (name,), is_visible=_pulls_otherwise(muscle))


def _slackening(largest: float, speed: float) -> Callable[[Lab, Rng], Case]:
    """Return a mishap in which a tendon lengthens by about `largest` [m], at about `speed` m/s."""

    def begin(lab: Lab, rng: Rng) -> Case:
        _, name = _any(rng, lab.arm.robot.muscles)
        start, fast = lab.now, speed * rng.uniform(0.5, 1.5)
        size = largest * rng.uniform(0.7, 1.3)
        excess = [0.0]

        def creep(lab: Lab) -> None:
            longer = round(min(size, fast * (lab.now - start)), 4)
            if longer > excess[0] + 2e-4 or (longer == size and excess[0] != size):
                excess[0] = longer
                lab.arm.set_faults([f'slack:{name}:{longer:.4f}'])

        def mend(lab: Lab) -> None:
            if creep in lab.before_step:
                lab.before_step.remove(creep)
            lab.arm.set_faults([])

        lab.before_step.append(creep)
        return Case(
            f'{name}, {1e3 * size:.0f} mm at {1e3 * fast:.1f} mm/s', mend, (name,),
            is_visible=lambda _: excess[0] > min(SHOWN_LENGTH, 0.5 * size),
            settled_by=(Step.CALIBRATE_LENGTHS,),
        )  # fmt: skip

    return begin


def _offsets(lab: Lab, muscle: int, size: float) -> None:
    offset = np.zeros(lab.arm.robot.muscle_count)
    offset[muscle] = size
    lab.arm.set_length_offset(offset)


def slipped_winch(lab: Lab, rng: Rng) -> Case:
    """A spool slips on its shaft, so that the length jumps."""
    muscle, name = _any(rng, lab.arm.robot.muscles)
    size = _sign(rng) * rng.uniform(0.03, 0.1)
    _offsets(lab, muscle, size)
    return Case(
        f'{name}, {1e3 * size:.0f} mm', lambda lab: _offsets(lab, muscle, 0.0), (name,),
        settled_by=(Step.CALIBRATE_LENGTHS,),
    )  # fmt: skip


def retied(lab: Lab, rng: Rng) -> Case:
    """A tendon ruptures, and is tied again with another length."""
    muscle = _loaded(lab, rng)
    name = lab.arm.robot.muscles[muscle]
    size = _sign(rng) * rng.uniform(0.02, 0.05)
    lab.arm.set_faults([f'rupture:{name}'])

    def mend(lab: Lab) -> None:
        lab.arm.set_faults([])
        _offsets(lab, muscle, size)

    return Case(f'{name}, {1e3 * size:.0f} mm', mend, (name,))


def module_fault(kind: str, low: float = 0.0, high: float = 0.0) -> Callable[[Lab, Rng], Case]:
    """Return a mishap in which one module has the emulator's fault `kind`.

    The size of the fault is drawn between `low` and `high`, in the unit of the fault.
    """

    def begin(lab: Lab, rng: Rng) -> Case:
        muscle, name = _any(rng, lab.arm.robot.muscles)
        size = f':{rng.uniform(low, high):.3f}' if high else ''
        lab.arm.set_faults([f'{kind}:{name}{size}'])
        return Case(f'{name}{size}', _clear, (name,), is_visible=_pulls_otherwise(muscle))

    return begin


def hot_motor(lab: Lab, rng: Rng) -> Case:
    """A module has a temperature of at least 88 to 100 °C, whatever its muscle exerts."""
    _, name = _any(rng, lab.arm.robot.muscles)
    size = rng.uniform(88.0, 100.0)
    lab.arm.set_faults([f'overheat:{name}:{size:.0f}'])
    return Case(f'{name}, {size:.0f} °C', _clear, (name,))


# -- sensors of the modules ------------------------------------------------------------------------

LENGTH, TENSION = MuscleReadings.length, MuscleReadings.tension


def frozen(quantity: Quantity) -> Callable[[Lab, Rng], Case]:
    """Return a mishap in which the length or the tension reading of a random muscle freezes.

    `quantity` says which of the two. The mishap has an effect once the true value differs clearly
    from the frozen one.
    """

    def begin(lab: Lab, rng: Rng) -> Case:
        muscle, name = _any(rng, lab.arm.robot.muscles)
        kept: list[float] = []
        gap = [0.0]

        def freeze(_: float, muscles: MuscleReadings) -> None:
            value = float(quantity.of(muscles)[muscle])
            if not kept:
                kept.append(value)
            gap[0] = max(gap[0], abs(value - kept[0]))
            quantity.of(muscles)[muscle] = kept[0]

        lab.wire.reading_faults.append(on_muscles(freeze))
        shown = SHOWN_TENSION if quantity is TENSION else SHOWN_LENGTH
        return Case(name, _clear, (name,), is_visible=lambda _: gap[0] > shown)

    return begin


def tension_saturates(lab: Lab, _: Rng) -> Case:
    """The supply of the tension amplifiers drops, so that no reading exceeds 150 N."""
    highest = 150.0

    def clip(_: float, muscles: MuscleReadings) -> None:
        muscles.tension = np.minimum(muscles.tension, highest)

    lab.wire.reading_faults.append(on_muscles(clip))
    return Case(
        f'{highest:.0f} N', _clear, (),
        is_visible=lambda lab: bool((lab.arm.tension > highest + SHOWN_TENSION).any()),
    )  # fmt: skip


def changed(
    quantity: Quantity, change: Callable[[float, float], float], low: float, high: float, unit: str,
    is_signed: bool = True,
) -> Callable[[Lab, Rng], Case]:  # fmt: skip
    """Return a mishap in which one reading of a muscle is changed by a random size.

    `quantity` is the quantity that is read. `change` gets the true value and the size,
    which is drawn between `low` and `high`, and is negative at random if `is_signed`.
    """

    def begin(lab: Lab, rng: Rng) -> Case:
        muscle, name = _any(rng, lab.arm.robot.muscles)
        size = rng.uniform(low, high) * (_sign(rng) if is_signed else 1.0)

        shown, error = SHOWN_TENSION if quantity is TENSION else SHOWN_LENGTH, [0.0]

        def falsify(_: float, muscles: MuscleReadings) -> None:
            value = float(quantity.of(muscles)[muscle])
            quantity.of(muscles)[muscle] = change(value, size)
            error[0] = abs(float(quantity.of(muscles)[muscle]) - value)

        lab.wire.reading_faults.append(on_muscles(falsify))
        return Case(
            f'{name}, {size:.3g} {unit}', _clear, (name,),
            is_visible=lambda _: not error[0] <= shown,
        )  # fmt: skip

    return begin


def bias(value: float, size: float) -> float:
    """Return `value` plus `size`, but at least 0, like the reading of a tension sensor."""
    return max(value + size, 0.0)


def gain(value: float, size: float) -> float:
    """Return a value multiplied by `size`, as an amplifier with a wrong gain would."""
    return value * size


def nothing(_: float, __: float) -> float:
    """Return NaN instead of a value, as a sensor without a signal does."""
    return math.nan


def no_temperatures(lab: Lab, _: Rng) -> Case:
    """The driver stops reading temperatures."""

    def lose(_: float, muscles: MuscleReadings) -> None:
        muscles.temperature = np.nan

    lab.wire.reading_faults.append(on_muscles(lose))
    return Case('all', _clear)


def exchanged_tensions(lab: Lab, rng: Rng) -> Case:
    """The cables of two tension sensors are exchanged."""
    robot = lab.arm.robot
    a, b = _two(rng, robot.muscles)

    def swap(_: float, muscles: MuscleReadings) -> None:
        muscles.tension[[a, b]] = muscles.tension[[b, a]]

    lab.wire.reading_faults.append(on_muscles(swap))
    names = robot.muscles[a], robot.muscles[b]
    return Case(
        ' and '.join(names), _clear, names,
        is_visible=lambda lab: abs(lab.arm.tension[a] - lab.arm.tension[b]) > SHOWN_TENSION,
    )  # fmt: skip


def copied_length(lab: Lab, rng: Rng) -> Case:
    """The driver publishes the length of one muscle also as that of another."""
    robot = lab.arm.robot
    a, b = _two(rng, robot.muscles)
    gap = [0.0]

    def copy(_: float, muscles: MuscleReadings) -> None:
        gap[0] = abs(muscles.length[a] - muscles.length[b])
        muscles.length[a] = muscles.length[b]

    lab.wire.reading_faults.append(on_muscles(copy))
    return Case(
        f'{robot.muscles[a]} as {robot.muscles[b]}', _clear, (robot.muscles[a],),
        is_visible=lambda _: gap[0] > SHOWN_LENGTH,
    )  # fmt: skip


def lost_counts(lab: Lab, rng: Rng) -> Case:
    """An encoder loses a part of its counts while the winch pays out."""
    muscle, name = _any(rng, lab.arm.robot.muscles)
    share, state = rng.uniform(0.05, 0.2), {'last': math.nan, 'lost': 0.0}

    def lose(_: float, muscles: MuscleReadings) -> None:
        value = float(muscles.length[muscle])
        moved = 0.0 if math.isnan(state['last']) else value - state['last']
        state['last'] = value
        if moved > 0.0 and state['lost'] < 0.1:
            state['lost'] += share * moved
        muscles.length[muscle] = value - state['lost']

    lab.wire.reading_faults.append(on_muscles(lose))
    return Case(
        f'{name}, {100 * share:.0f} %', _clear, (name,),
        is_visible=lambda _: state['lost'] > SHOWN_LENGTH,
        settled_by=(),
    )  # fmt: skip


def noisy_tensions(lab: Lab, rng: Rng) -> Case:
    """A welder nearby adds noise to all tension readings."""
    size, noise = rng.uniform(5.0, 15.0), rng.spawn(1)[0]

    def disturb(_: float, muscles: MuscleReadings) -> None:
        muscles.tension = np.maximum(
            muscles.tension + noise.normal(0.0, size, len(muscles.length)), 0
        )

    lab.wire.reading_faults.append(on_muscles(disturb))
    return Case(f'{size:.0f} N for 10 s', _clear, lasts=10.0)


# -- joint sensors ---------------------------------------------------------------------------------


def joint_slips(lab: Lab, rng: Rng) -> Case:
    """A joint sensor slips on its shaft."""
    j, name = _any(rng, lab.arm.robot.joints)
    size = _sign(rng) * rng.uniform(0.1, 0.5)

    def slip(_: float, theta: Array) -> None:
        theta[j] += size

    lab.wire.reading_faults.append(on_theta(slip))
    return Case(f'{name}, {size:.2f} rad', _clear, (name,))


def joint_drifts(lab: Lab, rng: Rng) -> Case:
    """A joint sensor drifts, up to 0.5 rad."""
    j, name = _any(rng, lab.arm.robot.joints)
    rate, start = _sign(rng) * rng.uniform(0.005, 0.02), lab.now
    error = [0.0]

    def drift(now: float, theta: Array) -> None:
        error[0] = float(np.clip(rate * (now - start), -0.5, 0.5))
        theta[j] += error[0]

    lab.wire.reading_faults.append(on_theta(drift))
    return Case(
        f'{name}, {rate:.3f} rad/s', _clear, (name,),
        is_visible=lambda _: abs(error[0]) > SHOWN_ANGLE,
    )  # fmt: skip


def joint_fault(change: Callable[[float], float], what: str) -> Callable[[Lab, Rng], Case]:
    """Return a mishap in which a joint sensor reads the function `change` of its true angle.

    `what` describes the mishap in the results.
    """

    def begin(lab: Lab, rng: Rng) -> Case:
        j, name = _any(rng, lab.arm.robot.joints)
        first = float(lab.arm.theta[j])
        error = [0.0]

        def falsify(_: float, theta: Array) -> None:
            wrong = first if what == 'sticks' else change(float(theta[j]))
            error[0] = wrong - float(theta[j])
            theta[j] = wrong

        lab.wire.reading_faults.append(on_theta(falsify))
        return Case(name, _clear, (name,), is_visible=lambda _: not abs(error[0]) <= SHOWN_ANGLE)

    return begin


def joints_exchanged(lab: Lab, rng: Rng) -> Case:
    """Two joint sensors are exchanged."""
    robot = lab.arm.robot
    a, b = _two(rng, robot.joints)

    def swap(_: float, theta: Array) -> None:
        theta[[a, b]] = theta[[b, a]]

    lab.wire.reading_faults.append(on_theta(swap))
    names = robot.joints[a], robot.joints[b]
    return Case(
        ' and '.join(names), _clear, names,
        is_visible=lambda lab: abs(lab.arm.theta[a] - lab.arm.theta[b]) > SHOWN_ANGLE,
    )  # fmt: skip


def zeros_of_joints(lab: Lab, rng: Rng) -> Case:
    """The joint sensors read 0 in every second message, for some seconds."""
    seconds, chance = rng.uniform(1.0, 4.0), rng.spawn(1)[0]

    def burst(_: float, theta: Array) -> None:
        if chance.random() < 0.5:
            theta[:] = 0.0

    lab.wire.reading_faults.append(on_theta(burst))
    return Case(f'{seconds:.1f} s', _clear, lasts=seconds)


def zeros_between(lab: Lab, _: Rng) -> Case:
    """A second program publishes joint angles of 0 through the same driver."""

    def add(_: float, packet: Packet) -> list[Packet]:
        return [packet, packet._replace(theta=np.zeros(lab.arm.robot.joint_count))]

    lab.wire.reading_faults.append(add)
    return Case('100 Hz', _clear)


def one_minus_pi(lab: Lab, rng: Rng) -> Case:
    """A joint sensor reads −π in a single message."""
    j, name = _any(rng, lab.arm.robot.joints)
    start = lab.now

    def wrong(now: float, theta: Array) -> None:
        if now < start + 0.005:
            theta[j] = -math.pi

    lab.wire.reading_faults.append(on_theta(wrong))
    return Case(name, _clear, lasts=1.0)


def noisy_joints(lab: Lab, rng: Rng) -> Case:
    """The ground of the joint sensors is loose: their noise grows."""
    size, noise = rng.uniform(0.02, 0.05), rng.spawn(1)[0]

    def disturb(_: float, theta: Array) -> None:
        theta += noise.normal(0.0, size, len(theta))

    lab.wire.reading_faults.append(on_theta(disturb))
    return Case(f'{size:.2f} rad for 10 s', _clear, lasts=10.0)


def no_joints(lab: Lab, _: Rng) -> Case:
    """The driver of the joint sensors ends; muscle states go on."""
    lab.wire.reading_faults.append(lambda _, packet: [packet._replace(theta=None)])
    return Case('all', _clear)


# -- drivers and communication ---------------------------------------------------------------------


def _driver_restarts(lab: Lab) -> float:
    """Let the driver be silent and deaf while it restarts; return for how long [s]."""
    seconds = 1.0
    lab.wire.reading_faults.append(silent(lab.now, seconds))
    lab.wire.command_faults.append(deaf(lab.now, seconds))
    return seconds


def _since(start: float) -> Callable[[Lab], bool]:
    return lambda lab: lab.now >= start


def driver_exchanges(lab: Lab, rng: Rng) -> Case:
    """The driver restarts with two muscles exchanged, in states and in commands."""
    robot = lab.arm.robot
    a, b = _two(rng, robot.muscles)
    back = lab.now + _driver_restarts(lab)

    def swap(_: float, muscles: MuscleReadings) -> None:
        muscles.rows[:, [a, b]] = muscles.rows[:, [b, a]]

    def swap_command(_: float, value: Array) -> Array:
        value = value.copy()
        value[[a, b]] = value[[b, a]]
        return value

    lab.wire.reading_faults.append(on_muscles(swap))
    lab.wire.command_faults.append(swap_command)
    names = robot.muscles[a], robot.muscles[b]
    return Case(' and '.join(names), _clear, names, is_visible=_since(back))


def driver_reverses(lab: Lab, rng: Rng) -> Case:
    """The driver restarts with the other sign of one length, in states and in commands."""
    muscle, name = _any(rng, lab.arm.robot.muscles)
    back = lab.now + _driver_restarts(lab)

    def reverse(_: float, muscles: MuscleReadings) -> None:
        muscles.length[muscle] *= -1.0

    def reverse_command(_: float, value: Array) -> Array:
        value = value.copy()
        value[muscle] *= -1.0
        return value

    lab.wire.reading_faults.append(on_muscles(reverse))
    lab.wire.command_faults.append(reverse_command)
    return Case(name, _clear, (name,), is_visible=_since(back))


def driver_zeroes(lab: Lab, _: Rng) -> Case:
    """The driver restarts and counts all lengths from 0 in the present posture."""
    back = lab.now + _driver_restarts(lab)
    zero: list[Array] = []

    def shift(_: float, muscles: MuscleReadings) -> None:
        if not zero:
            zero.append(muscles.length.copy())
        muscles.length -= zero[0]

    def shift_command(_: float, value: Array) -> Array:
        return value + zero[0] if zero else value

    lab.wire.reading_faults.append(on_muscles(shift))
    lab.wire.command_faults.append(shift_command)
    return Case('all', _clear, is_visible=_since(back), settled_by=(Step.CALIBRATE_LENGTHS,))


def driver_in_mm(lab: Lab, _: Rng) -> Case:
    """The driver restarts with lengths in millimetres, in states and in commands."""
    back = lab.now + _driver_restarts(lab)

    def scale(_: float, muscles: MuscleReadings) -> None:
        muscles.length *= 1e3

    lab.wire.reading_faults.append(on_muscles(scale))
    lab.wire.command_faults.append(lambda _, value: 1e-3 * value)
    return Case('all', _clear, is_visible=_since(back))


def half_rate(lab: Lab, _: Rng) -> Case:
    """The driver restarts at half its rate."""
    _driver_restarts(lab)
    count = [0]

    def thin(_: float, packet: Packet) -> list[Packet]:
        count[0] += 1
        return [packet] * (count[0] % 2)

    lab.wire.reading_faults.append(thin)
    return Case('50 Hz', _clear, lasts=20.0)


def pause(seconds: float) -> Callable[[Lab, Rng], Case]:
    """Return a mishap in which the driver is silent for a time [s], and then goes on."""

    def begin(lab: Lab, _: Rng) -> Case:
        lab.wire.reading_faults.append(silent(lab.now, seconds))
        return Case(f'{seconds:g} s', _clear, is_visible=_since(lab.now + 0.2), lasts=seconds)

    return begin


def late_messages(lab: Lab, rng: Rng) -> Case:
    """A bad cable delays messages by up to 0.1 s and repeats some."""
    waiting: list[tuple[float, Packet]] = []
    chance = rng.spawn(1)[0]

    def delay(now: float, packet: Packet) -> list[Packet]:
        last = waiting[-1][0] if waiting else now
        waiting.append((max(last, now + chance.uniform(0.0, 0.1)), packet))
        due = [each for at, each in waiting if at <= now]
        waiting[:] = [(at, each) for at, each in waiting if at > now]
        return due * (2 if chance.random() < 0.2 else 1)

    lab.wire.reading_faults.append(delay)
    return Case('≤ 0.1 s for 10 s', _clear, lasts=10.0)


def lost_messages(lab: Lab, rng: Rng) -> Case:
    """A third of all messages and commands is lost."""
    chance = rng.spawn(1)[0]
    lab.wire.reading_faults.append(lambda _, packet: [packet] * (chance.random() > 0.33))
    lab.wire.command_faults.append(lambda _, value: value if chance.random() > 0.33 else None)
    return Case('33 % for 10 s', _clear, lasts=10.0)


def emergency_stop(lab: Lab, rng: Rng) -> Case:
    """Somebody presses the emergency stop of the modules, and releases it some seconds later."""
    seconds = rng.uniform(2.0, 5.0)
    lab.wire.command_faults.append(lambda *_: None)
    start = lab.now + lab.arm.command_timeout
    return Case(f'{seconds:.0f} s', _clear, is_visible=_since(start), lasts=seconds)


def lost_module(lab: Lab, rng: Rng) -> Case:
    """A module does not get commands any more, and keeps its last one."""
    muscle, name = _any(rng, lab.arm.robot.muscles)
    last: list[float] = []

    def keep(_: float, value: Array) -> Array:
        if not last:
            last.append(float(value[muscle]))
        value = value.copy()
        value[muscle] = last[0]
        return value

    lab.wire.command_faults.append(keep)
    return Case(name, _clear, (name,), is_visible=_pulls_otherwise(muscle))


# -- arm and people --------------------------------------------------------------------------------


def mounted(least: float, most: float) -> Callable[[Lab, Rng], Case]:
    """Return a mishap in which the base is mounted at an angle to the vertical.

    The angle is drawn between `least` and `most` [rad].
    """

    def begin(lab: Lab, rng: Rng) -> Case:
        around, angle = rng.uniform(0.0, 2.0 * math.pi), rng.uniform(least, most)
        axis = np.array([math.cos(around), math.sin(around), 0.0])
        start, took = lab.now, 3.0

        def turn(lab: Lab) -> None:
            share = min(1.0, (lab.now - start) / took)
            lab.arm.faults.mount = pin.exp3(-share * angle * axis)
            if share == 1.0:
                lab.before_step.remove(turn)

        def mend(lab: Lab) -> None:
            if turn in lab.before_step:
                lab.before_step.remove(turn)
            lab.arm.faults.mount = np.eye(3)

        lab.before_step.append(turn)
        return Case(f'{math.degrees(angle):.0f}°', mend, is_visible=_since(start + took))

    return begin


def _target_is_missed(lab: Lab) -> bool:
    target = lab.controller.target_state.theta
    return target is not None and bool(np.abs(lab.arm.theta - target).max() > SHOWN_ANGLE)


def payload(lab: Lab, _: Rng) -> Case:
    """A payload of 3.6 kg is put into the hand of an arm that holds."""
    arm: Any = lab.arm
    arm.set_payload(3.6)
    return Case('3.6 kg', lambda lab: lab.arm.set_payload(0.0), is_visible=_target_is_missed)


def held(lab: Lab, rng: Rng) -> Case:
    """Somebody holds the hand for some seconds."""
    seconds, stiffness = rng.uniform(4.0, 10.0), 400.0
    place = lab.arm.hand.translation.copy()

    def pull(lab: Lab) -> None:
        force = np.clip(stiffness * (place - lab.arm.hand.translation), -80.0, 80.0)
        lab.arm.set_wrench(np.concatenate([force, np.zeros(3)]))

    def let_go(lab: Lab) -> None:
        if pull in lab.before_step:
            lab.before_step.remove(pull)
        lab.arm.set_wrench(np.zeros(6))

    lab.before_step.append(pull)
    return Case(f'{seconds:.0f} s', let_go, lasts=seconds)


def pushed(lab: Lab, rng: Rng) -> Case:
    """Somebody bumps into the hand."""
    force = rng.normal(size=3)
    force *= rng.uniform(40.0, 80.0) / np.linalg.norm(force)
    lab.arm.set_wrench(np.concatenate([force, np.zeros(3)]))
    return Case('0.4 s', lambda lab: lab.arm.set_wrench(np.zeros(6)), lasts=0.4)


def more_friction(lab: Lab, _: Rng) -> Case:
    """Dust doubles the friction of the tendons (`kin`) or of the joints (`foreign`)."""

    def clean(lab: Lab) -> None:
        lab.arm.friction[:] *= 0.5

    lab.arm.friction[:] *= 2.0
    return Case('× 2', clean, lasts=30.0)


def stop_of_verification(lab: Lab, rng: Rng) -> Case:
    """An operator stops the arm while a suspect is verified."""
    lab.estimator.suspects.isolates = True
    muscle = _loaded(lab, rng)
    name = lab.arm.robot.muscles[muscle]
    lab.arm.set_faults([f'rupture:{name}'])
    stopped = [False]

    def stop(lab: Lab) -> None:
        if lab.estimator.suspects.verification is not None and not stopped[0]:
            stopped[0] = True
            lab.controller.stop(ConditionKind.OPERATOR)

    def mend(lab: Lab) -> None:
        lab.arm.set_faults([])

    lab.before_step.append(stop)
    return Case(name, mend, is_visible=lambda _: stopped[0], found_at=(name,))


def operator_stops(lab: Lab, _: Rng) -> Case:
    """An operator stops the arm."""
    lab.controller.stop(ConditionKind.OPERATOR)
    return Case('', lambda _: None, settled_by=(Step.RESET_CONTROLLER,))


def needless_calibration(lab: Lab, _: Rng) -> Case:
    """An operator calls estimator/zero although nothing is wrong."""
    lab.estimator.calibrate_lengths()
    lab.publish()
    return Case('', lambda _: None, lasts=0.0)


# -- nodes and networks ----------------------------------------------------------------------------


def restarts(node: str, settled_by: tuple[Step, ...] = ()) -> Callable[[Lab, Rng], Case]:
    """Return a mishap in which a node is killed and started again."""

    def begin(lab: Lab, _: Rng) -> Case:
        lab.restart(node)
        lasts = math.inf if settled_by else 2.5
        return Case(
            '', lambda _: None, is_visible=_since(lab.now + 0.2), lasts=lasts,
            settled_by=settled_by,
        )  # fmt: skip

    return begin


def stalls(*nodes: str) -> Callable[[Lab, Rng], Case]:
    """Return a mishap in which nodes do not run for some seconds."""

    def begin(lab: Lab, rng: Rng) -> Case:
        seconds = rng.uniform(1.0, 4.0)
        for node in nodes:
            lab.suspend(node, seconds)
        start = lab.now + (0.2 if CONTROLLER not in nodes else seconds)
        return Case(
            f'{seconds:.1f} s', lambda _: None, is_visible=_since(start), lasts=seconds + 0.2
        )

    return begin


def clock_jumps_back(lab: Lab, rng: Rng) -> Case:
    """The ROS clock is set back."""
    seconds = rng.uniform(1.0, 100.0)
    lab.jump_clock(-seconds)
    return Case(f'{seconds:.0f} s', lambda _: None, lasts=0.5)


#: a network that was learned by another individual; `mishaps` sets it
OTHER_NETWORK: list[Mae] = []


def wrong_network(lab: Lab, _: Rng) -> Case:
    """An operator sets the parameter `checkpoint` to the network of another individual."""
    before = lab.estimator.complete_mae
    is_used = lab.choose_network(OTHER_NETWORK[0])

    def mend(lab: Lab) -> None:
        if before is not None:
            lab.choose_network(before)

    def is_visible(lab: Lab) -> bool:
        output = lab.estimator.output
        if output is None or not is_used:
            return False  # the operator was told that the network is refused
        return bool(np.abs(output.state.theta - lab.arm.theta).max() > SHOWN_ANGLE)

    lasts = math.inf if is_used else 0.0
    return Case('' if is_used else 'refused', mend, is_visible=is_visible, lasts=lasts)


def healthy(_: Lab, __: Rng) -> Case:
    """Nothing happens for a minute."""
    return Case('', lambda _: None, lasts=60.0)


OF_JOINT = r'joint sensor|joint angle|joint reading|joint_states'
ORDER = r'exchang|swapp|order of|wrong column|sign|reversed|unit'
GRAVITY = r'gravity|mounted|away from its target|distance|payload|contact'
NETWORK = r'network|checkpoint'
_LENGTHS = ONE_LENGTH | SEVERAL_LENGTHS | REVOKED
_CONSEQUENCES = frozenset({'stale_estimate'})

MISHAPS: tuple[Mishap, ...] = (
    Mishap('nothing (control)', healthy, is_harmless=True),
    Mishap('tendon ruptures under load', rupture_under_load, RUPTURE, allowed=_CONSEQUENCES),
    Mishap('tendon ruptures at rest', rupture_at_rest, RUPTURE, allowed=_CONSEQUENCES),
    Mishap('tendon creeps', _slackening(0.06, 0.004), ONE_LENGTH | RUPTURE, allowed=REVOKED),
    Mishap('spool slips on its shaft', slipped_winch, ONE_LENGTH, says='jumped',
           allowed=REVOKED | REJECTED),
    Mishap('module jams', module_fault('stuck_motor'), JAM),
    Mishap('motor is weak', module_fault('winch_speed', 0.005, 0.02), JAM),
    Mishap('length reading freezes', frozen(LENGTH), FROZEN | ONE_LENGTH | NOT_FOLLOWING,
           allowed=REVOKED),
    Mishap('tension reading freezes', frozen(TENSION), FROZEN | TENSION_SENSOR),
    Mishap('joint sensor slips', joint_slips, JOINT, says=OF_JOINT),
    Mishap('joint sensor drifts', joint_drifts, JOINT, says=OF_JOINT),
    Mishap(
        'driver restarts, two muscles exchanged', driver_exchanges, says=ORDER,
        allowed=_LENGTHS | STALE | _CONSEQUENCES | REJECTED | HEAT,
    ),
    Mishap('operator stops a verification', stop_of_verification,
           frozenset({'operator_stop'}), allowed=RUPTURE | _CONSEQUENCES),
    Mishap('tension readings saturate', tension_saturates, TENSION_SENSOR, says='saturat'),
    Mishap('tension reading has an offset', changed(TENSION, bias, 30.0, 80.0, 'N'),
           TENSION_SENSOR),
    Mishap('tension reading is too small', changed(TENSION, gain, 0.4, 0.7, '×', False),
           TENSION_SENSOR),
    Mishap('length reads NaN', changed(LENGTH, nothing, 1.0, 1.0, '', False), MISSING,
           allowed=REJECTED),
    Mishap('tension reads NaN', changed(TENSION, nothing, 1.0, 1.0, '', False), MISSING,
           allowed=REJECTED),
    Mishap('temperatures are not read any more', no_temperatures, says='temperature',
           is_harmless=True),
    Mishap('motor is hot', hot_motor, HEAT, says='heat|hot', patience=300.0),
    Mishap('cables of two tension sensors exchanged', exchanged_tensions, TENSION_SENSOR,
           says=ORDER),
    Mishap('driver repeats another length', copied_length,
           ONE_LENGTH | FROZEN | NOT_FOLLOWING, says='jumped',
           allowed=REVOKED | REJECTED),
    Mishap('encoder loses counts', lost_counts, ONE_LENGTH | NOT_FOLLOWING,
           allowed=REVOKED | REJECTED | {'overload'}),
    Mishap('noise on tension readings', noisy_tensions, is_harmless=True, says='nois'),
    Mishap('joint sensor sticks', joint_fault(float, 'sticks'), JOINT, says=OF_JOINT),
    Mishap('joint sensor reversed', joint_fault(lambda x: -x, 'reversed'), JOINT,
           says=OF_JOINT),
    Mishap('two joint sensors exchanged', joints_exchanged, JOINT, says=OF_JOINT),
    Mishap('joint sensor unplugged (NaN)', joint_fault(lambda _: math.nan, 'NaN'), JOINT,
           says=f'{OF_JOINT}|not finite|NaN'),
    Mishap('joint sensors read 0 in bursts', zeros_of_joints, is_harmless=True,
           says=OF_JOINT),
    Mishap('joint angles of 0 between the readings', zeros_between, JOINT,
           says=OF_JOINT),
    Mishap('joint sensor reads −π once', one_minus_pi, is_harmless=True,
           says=OF_JOINT),
    Mishap('noise on joint sensors', noisy_joints, is_harmless=True, says='nois'),
    Mishap('driver of the joint sensors ends', no_joints, frozenset({'nothing_to_learn'}),
           says=OF_JOINT),
    Mishap('driver restarts, one length reversed', driver_reverses, says=ORDER,
           allowed=_LENGTHS | STALE | _CONSEQUENCES | REJECTED),
    Mishap('driver restarts, lengths counted from 0', driver_zeroes,
           SEVERAL_LENGTHS | REVOKED, says='jumped',
           allowed=STALE | _CONSEQUENCES | REJECTED),
    Mishap('driver restarts in mm', driver_in_mm, REJECTED,
           says=ORDER, allowed=_LENGTHS | STALE | _CONSEQUENCES),
    Mishap('driver restarts at half rate', half_rate, is_harmless=True, allowed=STALE),
    Mishap('messages pause for 0.3 s', pause(0.3), STALE),
    Mishap('messages pause for 1 s', pause(1.0), STALE),
    Mishap('messages pause for 5 s', pause(5.0), STALE),
    Mishap('messages come late and twice', late_messages, is_harmless=True, allowed=STALE),
    Mishap('messages are lost', lost_messages, is_harmless=True, allowed=STALE),
    Mishap('emergency stop pressed and released', emergency_stop, JAM,
           says='command|follow|emergency'),
    Mishap('module gets no commands', lost_module, JAM),
    Mishap('mounted upside down', mounted(0.8 * math.pi, math.pi), MOUNTED, says=GRAVITY,
           holds=True),
    Mishap('mounted on its side', mounted(0.3 * math.pi, 0.6 * math.pi), MOUNTED,
           says=GRAVITY, holds=True),
    Mishap('payload of 3.6 kg while holding', payload, OFF_TARGET, says='payload', holds=True,
           is_harmless=True),
    Mishap('somebody holds the hand', held, says='contact|held', allowed=OFF_TARGET,
           is_harmless=True),
    Mishap('somebody bumps into the hand', pushed, says='contact', allowed=OFF_TARGET,
           is_harmless=True),
    Mishap('friction doubles', more_friction, is_harmless=True),
    Mishap('operator stops the arm', operator_stops, frozenset({'operator_stop'})),
    Mishap('operator calibrates needlessly', needless_calibration, is_harmless=True),
    Mishap('estimator restarts', restarts(ESTIMATOR), frozenset({'stale_estimate'}),
           allowed=STALE | {'no_checkpoint'}),
    Mishap('learner restarts', restarts(LEARNER), is_harmless=True),
    Mishap('controller restarts while holding', restarts(CONTROLLER, (Step.RESET_CONTROLLER,)),
           frozenset({'restarted'}), allowed=STALE, holds=True),
    Mishap('estimator stalls', stalls(ESTIMATOR), frozenset({'stale_estimate'}), allowed=STALE),
    Mishap('computer stalls', stalls(ESTIMATOR, CONTROLLER, LEARNER), is_harmless=True,
           allowed=STALE),
    Mishap('network of another individual', wrong_network,
           frozenset({'unfit_checkpoint', 'unsuitable_network', 'implausible_estimate'}),
           says=NETWORK, allowed=_LENGTHS | JOINT | _CONSEQUENCES),
    Mishap('clock is set back', clock_jumps_back, is_harmless=True),
    Mishap('tendon retied with another length', retied, RUPTURE,
           allowed=_CONSEQUENCES | ONE_LENGTH | REVOKED | REJECTED),
    Mishap('tendon jumps off a guide', _slackening(0.04, 1.0), ONE_LENGTH | RUPTURE,
           allowed=REVOKED | REJECTED),
)  # fmt: skip
NAMES = {mishap.name: mishap for mishap in MISHAPS}
