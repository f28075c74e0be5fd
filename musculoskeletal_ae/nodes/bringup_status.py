# SPDX-License-Identifier: Apache-2.0
"""The node `bringup_status`: one line a second about a running arm, for `bringup.sh`.

On a terminal, where rich is installed (`--view` brings it), one screen instead, with muscles.

joint_states, estimated_joint_states, anomaly, anomaly_detected, muscle_states, isolated_muscles,
/diagnostics → stdout.
"""

import math
import sys
import time
from collections.abc import Sequence
from functools import partial
from importlib.util import find_spec
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import ExternalShutdownException
from std_msgs.msg import Float64

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.exceptions import printable
from musculoskeletal_ae.nodes.messages import RELIABLE, SENSOR
from musculoskeletal_ae.nodes.shell import STEADY, Shell
from musculoskeletal_ae.nodes.situation import OLD, Situation, figures
from musculoskeletal_ae.report import whole
from musculoskeletal_ae.robot.robot import Robot


class BringupStatus(Shell):
    """Prints estimation error, A, samples learned and number of checkpoints."""

    def __init__(self, **options: Any) -> None:
        super().__init__('bringup_status', **options)
        self.duration: float = self.parameter('duration')
        self.patience: float = self.parameter('patience')
        self.begun = time.monotonic()
        self.measured: tuple[float, Array | None] = -math.inf, None  # when [s], and θ
        self.errors: list[float] = []
        self.anomalies: list[float] = []
        self.situation = Situation(self.get_namespace())
        self.started: float | None = None
        self.follow_posture('joint_states', self._measured, some=True)
        self.follow_posture('estimated_joint_states', self._estimated)
        self.listen(Float64, 'anomaly', lambda m: self.anomalies.append(m.data), SENSOR)
        self.follow_anomaly(partial(setattr, self.situation, 'detected'))
        self.listen(DiagnosticArray, '/diagnostics', self.situation.diagnosed, RELIABLE)
        self.states: Array | None = None
        self.screen = open_screen()
        if self.screen is not None:
            self.follow_isolated(lambda _: None)  # of whom anything may be read
            self.follow_muscle_states(partial(setattr, self, 'states'), unknown=math.nan)
        self.create_timer(1.0, self._print, clock=STEADY)

    def destroy_node(self) -> None:
        """Leave the last screen standing."""
        if self.screen is not None:
            self.screen.stop()
        super().destroy_node()

    def _measured(self, theta: Array) -> None:
        self.measured = time.monotonic(), theta

    @property
    def theta(self) -> Array | None:
        """What joint sensors say [rad] (D,); None while they are silent."""
        at, theta = self.measured
        return theta if time.monotonic() - at <= OLD else None

    def _estimated(self, theta: Array) -> None:
        if (measured := self.theta) is not None:
            self.errors.append(float(np.linalg.norm(np.nan_to_num(theta - measured))))

    def _print(self) -> None:
        now = time.monotonic()
        if self.started is None and not self.anomalies:
            if 0.0 < self.patience < now - self.begun:
                sys.exit(f'the system did not come up: no estimate in {self.patience:g} s')
            return
        self.started = self.started or now
        means = (sum(v) / len(v) if v else math.nan for v in (self.errors, self.anomalies))
        told, known = self.situation, figures(self.theta is not None, *means)
        self.errors, self.anomalies = [], []
        line = f'{now - self.started:6.0f} s  {known}'
        line += f'  samples {told.samples or 0}  checkpoints {told.checkpoints or 0}'
        more = told.trouble() or told.hint()
        if self.screen is None:
            print(printable(f'{line}  {more}'.rstrip()), flush=True)
        else:
            self.screen.update(muscle_table(self.robot, self.states, [line, more]), refresh=True)
        if 0.0 < self.duration <= now - self.started:
            raise ExternalShutdownException


def open_screen() -> Any:
    """Return a rich display that is redrawn in place, None without rich or without a terminal."""
    if not sys.stdout.isatty() or find_spec('rich') is None:
        return None
    from rich.live import Live

    screen = Live(auto_refresh=False)
    screen.start()
    return screen


def muscle_table(robot: Robot, states: Array | None, lines: Sequence[str]) -> Any:
    """Return lines, and l [m], T [N] and °C (3, M) as a table with bars, for a terminal.

    What is NaN is not known.
    """
    from rich.bar import Bar
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, padding=(0, 1))
    for title in ('muscle', 'l [mm]', 'T [N]', '', '°C'):
        table.add_column(title, justify='left' if title in ('muscle', '') else 'right')
    rows = () if states is None else zip(robot.muscles, robot.tension.limit, states.T)
    for name, limit, (length, tension, temperature) in rows:
        colour = 'blue' if tension < limit else 'dark_orange'
        bar = Bar(limit, 0.0, max(0.0, tension), width=30, color=colour)
        table.add_row(Text(name), whole(1e3 * length), whole(tension), bar, whole(temperature))
    texts = [Text(printable(lines[0])), Text(printable(lines[1]), style='bold red')]
    return Group(*filter(None, texts), table)
