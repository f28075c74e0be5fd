# SPDX-License-Identifier: Apache-2.0
"""The learned body as a simulator: joint angles and muscle tensions from commanded lengths.

(Paper, §III-F.) The simulated arms follow the same length commands as the robot, because the
simulation includes muscle stiffness control. A length command l_target, which includes the
compensation l_comp(T) (paper, §III-E, eq. 6), causes the same tensions at rest as on the robot. An
arm without a command rests at T_bias, or holds its lengths if its modules follow positions. The
same compiled code simulates one arm or thousands, on all cores. The preset selects the equations
(`Preset.make_simulator`). The module `equilibrium` contains the equations of preset `default`.
"""

import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import compress
from typing import Protocol

import numpy as np
from threadpoolctl import ThreadpoolController

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.presets.registry import preset_named
from musculoskeletal_ae.report import Report
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.simulation.equilibrium import PAID_OUT, ArmState

LONGEST_STEP = 0.01  # divide a longer step into several [s]
#: simulate this many arms in a call of the compiled code, so that their arrays fit into a core's
#: cache
CHUNK = 384
#: let each step of `settle` last this long [s]; the steps follow no motion, so they may be long
SETTLING_STEP = 0.1
SETTLING_STEPS = 300  # end `settle` after this many steps, even if some arms have not settled
#: count arms as settled if a step moves them by less than this [rad]; a change of tension by 1000 N
#: counts like 1 rad
SETTLED = 1e-6

STOP_TORQUE = 0.1  # let `limits` name a joint whose stop exerts more than this torque [N·m]
TENSION_MARGIN = 1.0  # let `limits` name a muscle that is nearer to T_max than this [N]


class SimulatedBody(Protocol):
    """Steps N simulated arms by the equations of a preset (`Preset.make_simulator`)."""

    def use(self, mae: Mae, robot: Robot) -> None:
        """Use a network, and the robot with the currently isolated muscles."""

    def step(
        self, state: ArmState, command: Array, h: float, wrench: Array, fixed: Array
    ) -> ArmState:
        """Return the state of the arms after a step.

        Args:
            state: Present state of the arms.
            command: l_target [m], (N, M); PAID_OUT (∞) for muscles without a command.
            h: Duration of the step [s].
            wrench: Wrench on the end effectors in axes of the root link [N, N·m], (N, 6).
            fixed: Angles that joints are forced to [rad], (N, D); NaN for a free joint.
        """


class Simulation:
    """Simulates N arms with the learned body of one robot, in compiled code."""

    mae: Mae  # network whose learned body is simulated
    state: ArmState  # the arms now; assign an earlier state to return to it
    command: Array  # length commands l_target [m], (N, M)
    wrench: Array  # wrench on the end effectors in axes of the root link [N, N·m], (N, 6)
    fixed: Array  # angles that joints are forced to [rad], (N, D); NaN for a free joint

    def __init__(
        self,
        robot: Robot,
        mae: Mae,
        preset: str = 'default',
        arms: int = 1,
    ) -> None:
        """Start at θ = 0, or at the nearest joint limit, with T_bias and no command.

        Args:
            robot: The robot to simulate.
            mae: The network with the learned body.
            preset: Name of the preset, which selects the equations.
            arms: Number of arms.

        Raises:
            MusculoskeletalError: If `arms` is 0.
        """
        self.robot = robot
        self._body = preset_named(preset).make_simulator(self.robot)
        self.wrench = np.zeros((0, 6))  # `start_from` sets its size
        self.use(mae)
        self.start_from(np.zeros((arms, robot.joint_count)))

    def use(self, mae: Mae) -> None:
        """Use a new network; the arms then move from their present state to its equilibrium.

        Raises:
            FloatingPointError: If the new network cannot be simulated; the current network then
                stays in use.
        """
        self._body.use(mae, self.robot)
        self.mae = mae

    def isolate(self, muscles: Iterable[int]) -> None:
        """Isolate exactly the muscles with these indices; isolated muscles exert no tension."""
        self.robot = self.robot.without(muscles)
        self.use(self.mae)

    def start_from(self, theta: Array) -> None:
        """Start from θ [rad] (N, D), within the joint limits, with T_bias and no command.

        If the number of arms changes, wrenches and forced angles are reset as well.

        Raises:
            MusculoskeletalError: If N is 0.
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
        holding, slid = np.zeros_like(theta), np.zeros_like(tension)
        self.state = ArmState(theta, tension, length, length, holding, slid)

    def step(self, dt: float) -> ArmState:
        """Advance by `dt` [s], and return the new state of the arms.

        If `dt` is 0 or negative, the state does not change.
        """
        substeps = int(np.ceil(dt / LONGEST_STEP - 1e-9))
        for _ in range(substeps):
            self._advance(dt / substeps)
        return self.state

    def settle(self) -> ArmState:
        """Advance in long steps to the equilibrium of the command, and return the arms' state.

        Arms that have not settled after SETTLING_STEPS are returned in their current state.
        """
        for _ in range(SETTLING_STEPS):
            before = self.state
            self._advance(SETTLING_STEP)
            joint_change = abs(self.state.theta - before.theta).max()
            tension_change = abs(self.state.tension - before.tension).max()
            if max(joint_change, 1e-3 * tension_change) < SETTLED:
                break
        return self.state

    def limits(self, arm: int = 0) -> list[str]:
        """Return the names of one arm's joints at a joint limit and of its muscles at T_max."""
        robot, forced, tension = self.robot, self.fixed[arm], self.state.tension[arm]
        stopped = np.isnan(forced) & (np.abs(self.state.holding[arm]) > STOP_TORQUE)
        stopped |= (forced < robot.lower) | (forced > robot.upper)
        full = robot.used & (tension > robot.tension.max - TENSION_MARGIN)
        return [*compress(robot.joints, stopped), *compress(robot.muscles, full)]

    def report(self) -> Report:
        """Report the status of the first arm: forced joints, external wrench and limits."""
        values = {'checkpoint version': str(self.mae.version)}
        fixed, wrench, command = self.fixed[0], self.wrench[0], self.command[0]
        if forced := ', '.join(compress(self.robot.joints, np.isfinite(fixed))):
            values['forced joints'] = forced
        if wrench.any():
            values['external wrench'] = f'{np.round(wrench, 3).tolist()} N, N·m'
        if limits := self.limits():
            # This is not a warning, because an exploring healthy arm often reaches its limits.
            return Report(f'at the limit: {", ".join(limits)}', values)
        commanded = np.isfinite(command).all()
        waiting = self.robot.actuation.choose('resting at T_bias', 'holding its lengths')
        return Report('following commands' if commanded else waiting, values)

    def _advance(self, h: float) -> None:
        # Callers may assign any array, but the compiled code requires this type and order.
        command, wrench, fixed = (
            np.array(part, float, order='C') for part in (self.command, self.wrench, self.fixed)
        )
        count = len(command)
        if count <= CHUNK:
            self.state = self._body.step(self.state, command, h, wrench, fixed)
            return

        def advance(rows: slice) -> ArmState:
            state = ArmState(*(part[rows] for part in self.state))
            return self._body.step(state, command[rows], h, wrench[rows], fixed[rows])

        pieces = [slice(first, first + CHUNK) for first in range(0, count, CHUNK)]
        arms = on_all_cores(advance, pieces)
        self.state = ArmState(*map(np.concatenate, zip(*arms, strict=True)))


def on_all_cores(function: Callable[[slice], ArmState], pieces: Sequence[slice]) -> list[ArmState]:
    """Return function(piece) for each piece, in order; the calls run in parallel.

    A call must not wait for another call. Threads suffice, because compiled code and numpy release
    Python's global lock. BLAS is limited to one thread, because parallel calls with a parallel BLAS
    are slower than either alone.
    """
    pool, libraries = _cores()
    with libraries.limit(limits=1, user_api='blas'):
        return list(pool.map(function, pieces))


@cache
def _cores() -> tuple[ThreadPoolExecutor, ThreadpoolController]:
    return ThreadPoolExecutor(os.cpu_count(), thread_name_prefix='batch'), ThreadpoolController()
