# SPDX-License-Identifier: Apache-2.0
"""The learned body as a simulator: joint angles and muscle tensions from commanded lengths.

(Paper, §III-F.) The simulated arms follow the same
muscle length command as real ones, with muscle stiffness control being part of the arm: commanding
l_target, with its l_comp, gives the tensions it gives on the robot at rest. An arm that has had no
command rests at T_bias. One arm or thousands are the same compiled code, on all cores; their
network may be on a GPU. The preset chooses the equations (`Preset.make_simulator`); those of
preset `default` are in `equilibrium`.
"""

import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import compress
from typing import Any, Protocol

import numpy as np
from threadpoolctl import ThreadpoolController

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.presets.registry import PRESETS, preset_named
from musculoskeletal_ae.report import Report
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.simulation.equilibrium import PAID_OUT, ArmState

LONGEST_STEP = 0.01  # [s]; a longer time is cut into several
#: arms whose arrays fit into a core's cache together
CHUNK = 384
SETTLING_STEP, SETTLING_STEPS = 0.1, 300  # [s], for `settle`
SETTLED = 1e-6  # [rad] moved in a step

# Below these a stop or a module at its end does not count as a limit reached.
STOP_TORQUE, TENSION_MARGIN = 0.1, 1.0  # [N·m], [N]


class SimulatedBody(Protocol):
    """Steps N simulated arms of one robot."""

    def use(self, mae: Any, robot: Robot) -> None:
        """Take a network, and the robot with the muscles that are isolated now."""

    def step(
        self, state: ArmState, command: Array, h: float, wrench: Array, fixed: Array
    ) -> ArmState:
        """Return the arms h [s] later.

        Args:
            state: The arms now.
            command: l_target [m], (N, M).
            h: Time [s].
            wrench: On the end effectors, axes of the root link [N, N·m], (N, 6).
            fixed: Angles that joints are forced to [rad], (N, D); NaN for a free joint.
        """


class Simulation:
    """N simulated arms of one robot."""

    mae: Mae  # the learned body
    state: ArmState  # the arms now; assign it to go back to a state kept before
    command: Array  # l_target [m], (N, M)
    wrench: Array  # on the end effectors, axes of the root link [N, N·m], (N, 6)
    fixed: Array  # angles joints are forced to [rad], (N, D); nan for a free joint

    def __init__(
        self,
        robot: Robot,
        mae: Mae,
        preset: str = 'default',
        arms: int = 1,
        device: str | None = None,
    ) -> None:
        """Put arms at θ = 0 (or the nearest limit) with T_bias and no command.

        The network computes on a device of torch, such as `cuda`, if the preset can.

        Raises:
            MusculoskeletalError: If torch computes nothing there, the preset cannot, or there are
                no arms.
        """
        self.robot = robot
        chosen = preset_named(preset)
        self._body, self._device = chosen.make_simulator(self.robot), device
        if device is not None and not chosen.simulates_on_devices:
            legal = ', '.join(name for name, each in PRESETS.items() if each.simulates_on_devices)
            reason = f'preset {preset!r} simulates one arm after the other, and on no device'
            raise MusculoskeletalError(f'{reason}; given: {device!r}. Legal there: {legal}')
        self.wrench = np.zeros((0, 6))  # those of the arms that start
        self.use(mae)
        self.start_from(np.zeros((arms, robot.joint_count)))

    def use(self, mae: Mae) -> None:
        """Take a new network; the arms move on to its equilibrium from where they are.

        A FloatingPointError says that it cannot be simulated; the one in use stays.
        """
        self._body.use(mae if self._device is None else _there(mae, self._device), self.robot)
        self.mae = mae

    def isolate(self, muscles: Iterable[int]) -> None:
        """Let these muscles, places in T and l, pull nothing, and all others as they are told."""
        self.robot = self.robot.without(muscles)
        self.use(self.mae)

    def start_from(self, theta: Array) -> None:
        """Put the arms at θ [rad] (N, D), of numpy, with T_bias, commands forgotten.

        If they become more or fewer, wrenches and fixed angles are forgotten as well.

        Raises:
            MusculoskeletalError: If there are none.
        """
        robot = self.robot
        if not len(theta):
            raise MusculoskeletalError('arms: expected at least 1, got 0')
        if len(theta) != len(self.wrench):
            self.wrench = np.zeros((len(theta), 6))
            self.fixed = np.full((len(theta), robot.joint_count), np.nan)
        theta = np.clip(theta, robot.lower, robot.upper)
        tension = np.full((len(theta), robot.muscle_count), robot.tension.bias)
        self.command = np.full_like(tension, PAID_OUT)
        length = np.array(self.mae.lengths(theta, tension))
        nothing, not_slid = np.zeros_like(theta), np.zeros_like(tension)
        self.state = ArmState(theta, tension, length, length, nothing, not_slid)

    def step(self, dt: float) -> ArmState:
        """Let time pass [s], none if it is not positive; return the arms."""
        substeps = int(np.ceil(dt / LONGEST_STEP - 1e-9))
        for _ in range(substeps):
            self._advance(dt / substeps)
        return self.state

    def settle(self) -> ArmState:
        """Go on to the equilibrium of the command, in long steps; return the arms.

        Arms that find none within SETTLING_STEPS are returned as they are then.
        """
        for _ in range(SETTLING_STEPS):
            before = self.state
            self._advance(SETTLING_STEP)
            turned = abs(self.state.theta - before.theta).max()
            if max(turned, 1e-3 * abs(self.state.tension - before.tension).max()) < SETTLED:
                break
        return self.state

    def limits(self, arm: int = 0) -> list[str]:
        """Return the joints and muscles of one arm that are at the end of what they can do."""
        robot, forced, tension = self.robot, self.fixed[arm], self.state.tension[arm]
        stopped = np.isnan(forced) & (np.abs(self.state.holding[arm]) > STOP_TORQUE)
        stopped |= (forced < robot.lower) | (forced > robot.upper)
        full = robot.used & (tension > robot.tension.max - TENSION_MARGIN)
        return [*compress(robot.joints, stopped), *compress(robot.muscles, full)]

    def report(self) -> Report:
        """Say what acts on the first arm, and whether it is at a limit."""
        values = {'checkpoint version': str(self.mae.version)}
        fixed, wrench, command = self.fixed[0], self.wrench[0], self.command[0]
        if forced := ', '.join(compress(self.robot.joints, np.isfinite(fixed))):
            values['forced joints'] = forced
        if wrench.any():
            values['external wrench'] = f'{np.round(wrench, 3).tolist()} N, N·m'
        if limits := self.limits():
            return Report('warn', f'at the limit: {", ".join(limits)}', values)
        commanded = np.isfinite(command).all()
        return Report('ok', 'following commands' if commanded else 'resting at T_bias', values)

    def _advance(self, h: float) -> None:
        # Others may have assigned them, and compiled code is for arrays of one kind.
        command, wrench, fixed = (
            np.array(part, float, order='C') for part in (self.command, self.wrench, self.fixed)
        )
        count = len(command)
        chunk = CHUNK if self._device is None else -(-count // (os.cpu_count() or 1))
        if count <= chunk:
            self.state = self._body.step(self.state, command, h, wrench, fixed)
            return

        def advance(rows: slice) -> ArmState:
            state = ArmState(*(part[rows] for part in self.state))
            return self._body.step(state, command[rows], h, wrench[rows], fixed[rows])

        pieces = [slice(first, first + chunk) for first in range(0, count, chunk)]
        arms = on_all_cores(advance, pieces)
        self.state = ArmState(*map(np.concatenate, zip(*arms, strict=True)))


def _there(mae: Mae, device: str) -> Any:
    """Return a network whose lengths are computed on a device of torch."""
    # Only here: a node that simulates one arm does without torch.
    from musculoskeletal_ae.mae.network import TorchLengths
    from musculoskeletal_ae.mae.training import check_device

    check_device(device)
    return TorchLengths(mae, device)


def on_all_cores(function: Callable[[slice], ArmState], pieces: Sequence[slice]) -> list[ArmState]:
    """Return function(piece) of each piece, in order; the function may not wait for others.

    Compiled code and numpy let go of Python's lock while they compute, so threads suffice. BLAS
    would also like to use all cores for every product, and the two together are slower than either.
    """
    pool, libraries = _cores()
    with libraries.limit(limits=1, user_api='blas'):
        return list(pool.map(function, pieces))


@cache
def _cores() -> tuple[ThreadPoolExecutor, ThreadpoolController]:
    return ThreadPoolExecutor(os.cpu_count(), thread_name_prefix='batch'), ThreadpoolController()
