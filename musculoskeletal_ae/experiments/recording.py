# SPDX-License-Identifier: Apache-2.0
"""Emulated arms driven in closed loop or by a list of commands, and recordings of their sensors."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools, Ints
from musculoskeletal_ae.control.controller import Controller
from musculoskeletal_ae.control.settings import Settings, Setup
from musculoskeletal_ae.emulator.faults import ArmReadings
from musculoskeletal_ae.emulator.modules import Arm
from musculoskeletal_ae.estimation.estimator import Estimator
from musculoskeletal_ae.exceptions import MessageError, MusculoskeletalError
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.motion.activities import LENGTH
from musculoskeletal_ae.motion.exploration import Exploration
from musculoskeletal_ae.motion.methods import Goal, first_command
from musculoskeletal_ae.motion.ramps import RAMP_SHARE
from musculoskeletal_ae.presets.preset import PAPER_PRESET
from musculoskeletal_ae.signals.body_state import Anomaly
from musculoskeletal_ae.signals.friction import directions

#: add this to the command of a switched-off muscle, to make it slack in any posture [m]
PAID_OUT = 0.1
SAMPLE_TIME = 0.01  # time between two messages [s]; the modules report at 100 Hz
#: random seeds of the exploration, to which the individual's seed is added, and of held-out motion
EXPLORATION_STREAM, HELD_OUT_STREAM = 100, 9000

#: function that is called with the arm and the time [s] before every step. It may attach a payload
#: or rupture muscles. It returns a mask (M,) of the muscles that are switched off, or None.
Script = Callable[[Arm, float], Bools | None]


class Recording(NamedTuple):
    """N samples of one arm at 100 Hz."""

    theta: Array  # true joint angles [rad], (N, D)
    theta_sensor: Array  # joint-sensor readings [rad], (N, D)
    length: Array  # measured lengths [m], (N, M)
    tension: Array  # measured tensions T_read [N], (N, M)
    command: Array  # length commands l_target [m], (N, M)

    def part(self, rows: slice | Ints) -> Recording:
        """Return the rows of the recording that `rows` selects."""
        return Recording(*(column[rows] for column in self))


class Motion(NamedTuple):
    """N steps of an arm or of its simulator."""

    theta: Array  # joint angles θ [rad], (N, D)
    tension: Array  # muscle tensions T [N], (N, M)


class ClosedLoop:
    """An emulated arm, the estimator and the controller, connected as the nodes connect them.

    Each message passes through sense → estimate → control → command.

    Attributes:
        arm: The emulated arm.
        estimator: The core of the estimator.
        core: The core of the controller.
        mae: The network in use.
        time: Time since the beginning [s].
        stops: How often `explore` has ended a stop.
    """

    def __init__(
        self,
        arm: Arm,
        mae: Mae,
        settings: Settings | None = None,
        seed: int = 0,
    ) -> None:
        """Connect an arm in its present posture; `seed` determines the exploration."""
        self.arm, self.core, self.stops = arm, Controller(arm.robot, settings, seed), 0
        self.estimator = Estimator(arm.robot, mae.preset)
        self._read, self.time = arm.sense(), 0.0
        self.use(mae)

    def use(self, mae: Mae) -> None:
        """Use a network for estimation and control."""
        self.mae = self.estimator.use(mae)
        self.core.use(self.mae)

    def step(self) -> tuple[Array, ...]:
        """Advance by one message; return a row of a recording.

        Raises:
            DivergedError: If the emulated arm has diverged; no message comes from it then.
        """
        arm, core, read, now = self.arm, self.core, self._read, self.time
        # The nodes count and drop bad messages, each of them for itself.
        with suppress(MessageError):
            core.take(read.muscles, now)
        with suppress(MessageError):
            core.estimated(self.estimate(read, now), now)
        command = core.step(now)
        if command is not None:
            self.estimator.commanded(now, **{command.kind: command.value})
            follow = arm.command_length if command.kind == LENGTH else arm.command_tension
            follow(command.value)
        arm.step(SAMPLE_TIME)
        arm.check()
        reading = arm.sense()
        self._read, self.time = reading, now + SAMPLE_TIME
        sent = read.muscles.length if command is None else command.value
        return arm.theta, reading.theta, reading.muscles.length, reading.muscles.tension, sent

    def estimate(self, read: ArmReadings, now: float) -> Array:
        """Estimate θ [rad] (D,) from the readings at `now` [s], and pass on the body state.

        Raises:
            MessageError: If the message cannot be used.
        """
        output = self.estimator.take(read.muscles, now, now)
        if self.estimator.body is not self.core.stream.body:
            self.core.use_body(self.estimator.body)
        assert output is not None
        return output.state.theta

    def explore(self) -> tuple[Array, ...]:
        """Explore for one message, and return a row of a recording.

        If the arm has stopped, estimator and controller are reset first, which succeeds as soon as
        the cause of the stop has cleared. A verification is not interrupted.
        """
        core = self.core
        supervisor = core.supervisor
        self.end_finding()
        if not supervisor.is_running and core.reset(self.time) is None:
            self.stops += 1
        if supervisor.is_running and not supervisor.explores:
            core.explore(True)
        return self.step()

    def end_finding(self) -> None:
        """Reset the estimator if it has found a fault. A verification is not interrupted."""
        if self.estimator.body.anomaly is Anomaly.FOUND:
            with suppress(MusculoskeletalError):  # refused while the suspect is implausible
                self.estimator.reset()

    def go(self, theta: Array, duration: float) -> None:
        """Move towards θ [rad] (D,) for `duration` [s].

        Raises:
            MusculoskeletalError: If the controller has stopped at the end.
        """
        self.approach(theta, duration)
        self.check()

    def approach(self, theta: Array, duration: float) -> None:
        """Move towards θ [rad] (D,) for `duration` [s], and ignore a stop of the controller."""
        self.target(theta)
        self.wait(duration)

    def check(self) -> None:
        """Check that the controller runs; raise a MusculoskeletalError if it has stopped."""
        condition = self.core.supervisor.condition
        if condition is not None:
            raise MusculoskeletalError(f'control stopped: {condition.text}')

    def target(self, theta: Array) -> None:
        """Set the target θ [rad] (D,) of the controller, without an additional torque."""
        self.core.target(dict(zip(self.arm.robot.joints, ((t, 0.0) for t in theta.tolist()))))

    def wait(self, duration: float) -> None:
        """Wait for `duration` [s] of simulated time."""
        for _ in range(round(duration / SAMPLE_TIME)):
            self.step()


def record(
    arm: Arm,
    mae: Mae,
    stream: int | Iterable[Goal],
    duration: float,
    script: Script | None = None,
) -> Recording:
    """Record an arm while a fixed list of commands drives it through the steps of exploration.

    Every command is computed by method `first`. Method `second` would need the current tension,
    which a fixed list cannot contain. The step of `second` is therefore replaced by `first` with
    the least tension that holds the posture on the geometric model.

    While a muscle is switched off, all muscle modules receive tension commands: 0 N for this
    muscle, and the tensions of muscle stiffness control for all other muscles. Position-controlled
    modules have no such tensions. They follow their lengths, and the tendon of the switched-off
    muscle is paid out instead.

    Args:
        arm: The emulated arm, which is moved.
        mae: The network that computes the commands.
        stream: Random seed of the exploration steps, or the steps themselves.
        duration: Duration [s], rounded up to whole steps.
        script: Function that is called before every message; see `Script`.

    Raises:
        DivergedError: If the emulated arm has diverged.
    """
    planned, rows = 0.0, list[tuple[Array, ...]]()
    # The first ramp starts at the present lengths, so that the command does not jump.
    robot, read = arm.robot, arm.sense()
    command = read.muscles.length
    if isinstance(stream, int):
        stream = Exploration(Setup(robot, Settings(preset=PAPER_PRESET)), stream)
    for step in stream:
        if planned >= duration - 1e-9:
            break
        assert step.tension is not None  # each step of the exploration states one
        start, goal = command, first_command(robot, mae, step.theta, step.tension)
        planned += step.duration
        for tick in range(round(step.duration / SAMPLE_TIME)):
            off = script(arm, SAMPLE_TIME * len(rows)) if script else None
            share = min(1.0, (tick + 1) * SAMPLE_TIME / (RAMP_SHARE * step.duration))
            command = start + share * (goal - start)
            demand = robot.actuation.demanded(read.muscles.length, command)
            if off is None or demand is None:
                arm.command_length(command if off is None else command + off * PAID_OUT)
            else:
                arm.command_tension(np.where(off, 0.0, demand))
            arm.step(SAMPLE_TIME)
            arm.check()
            read = arm.sense()
            muscles = read.muscles
            rows.append((arm.theta, read.theta, muscles.length, muscles.tension, command))
    return Recording(*columns(rows))


def columns(rows: Iterable[tuple[Any, ...]]) -> tuple[Any, ...]:
    """Convert rows of equal length to a tuple with one array for each column."""
    return tuple(np.array(column) for column in zip(*rows, strict=True))


def times(count: int) -> Array:
    """Return the times of the first `count` rows of a recording [s]."""
    return np.asarray(SAMPLE_TIME * np.arange(count), dtype=np.float64)


def rows_between(start: float, end: float) -> slice:
    """Return the rows of a recording between two times [s]."""
    return slice(round(start / SAMPLE_TIME), round(end / SAMPLE_TIME))


def mean_error(estimate: Array, truth: Array) -> float:
    """Return the mean of ‖θ_est − θ_true‖₂ [rad] over N samples of both, (N, D) each."""
    return float(np.linalg.norm(estimate - truth, axis=1).mean())


def end_tensions(mae: Mae, recording: Recording) -> Array:
    """Return the bone-side tensions T_end [N] (N, M) of a recording, computed as in the nodes.

    The tendon friction is the one that the network has learned.
    """
    return mae.transmission.end(recording.tension, directions(recording.length))


def make_error_function(
    recording: Recording, stride: int = 1, joints: Bools | None = None
) -> Callable[[Mae], float]:
    """Return a function that computes a network's mean error [rad] on every `stride`-th message.

    The friction directions are computed once, because they are the same for all networks. The mask
    `joints`, (D,), selects the joints that count; by default, all do.
    """
    direction = directions(recording.length)[::stride]
    part = recording.part(np.s_[::stride])

    def error(mae: Mae) -> float:
        tension = mae.transmission.end(part.tension, direction)
        estimate = mae.estimate(tension, part.length).theta
        if joints is None:
            return mean_error(estimate, part.theta)
        return mean_error(estimate[:, joints], part.theta[:, joints])

    return error


def estimation_error(mae: Mae, recording: Recording, stride: int = 1) -> float:
    """Return the mean error [rad] of a network's estimate on every `stride`-th message."""
    return make_error_function(recording, stride)(mae)
